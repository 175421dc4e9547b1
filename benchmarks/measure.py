"""Measure one workload: every program, with floors, memory and pairs."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.floors import TILE, Floors, between, is_calm, measure_floors, rectangle_pairs
from benchmarks.metrics import Metric
from benchmarks.programs import BACKWARD, FORWARD, JVP, make_pool, make_programs, make_stages
from benchmarks.timing import Compiled, compile_program, median_and_p95, sample
from benchmarks.workloads import Scene, Workload
from gsjax.optim.compiler import host_options
from gsjax.rasterize.plan import Plan
from gsjax.rasterize.rasterization import plan as make_plan

MAX_ATTEMPTS = 3  # for a noisy workload
GIB = 2**30
PRODUCTS = {FORWARD: 1, BACKWARD: 3}  # of weights and features; backward also their gradients
PLAIN, UNREAD = ", plain jit", ", no reads"


@dataclass(frozen=True)
class Timed:
    """One program on one workload: a row of the table."""

    workload: str
    program: str
    gaussians: int
    width: int
    height: int
    channels: int
    calls: int
    median_ms: float
    p95_ms: float
    exp_floor_ms: float
    exp_floors: float  # the median as a multiple of it
    copy_floor_ms: float
    copy_floors: float
    product_floors: float | None  # of the features' matrix products, forward and backward; else None
    compile_s: float
    memory_gib: float
    pairs: int  # Gaussian-tile pairs drawn
    pixel_pairs: int
    rectangle_pairs: int  # pairs of a Gaussian and a 16x16 tile in its bounding box
    ns_per_rectangle_pixel: float
    noisy: bool

    def metrics(self) -> list[Metric]:
        key = f"{self.workload}/{self.program}"
        return [
            Metric(f"{key}/median", self.median_ms, "ms", "lower", 0.15, noisy=self.noisy),
            Metric(f"{key}/floors", self.exp_floors, "exp floors", "lower", 0.25, True, self.noisy),
            Metric(f"{key}/compile", self.compile_s, "s", "lower", 1.0, True, self.noisy),
            Metric(f"{key}/memory", self.memory_gib, "GiB", "lower", 0.02, True),
        ]


@dataclass(frozen=True)
class Result:
    """Results of a workload."""

    rows: list[Timed]
    floors: tuple[Floors, Floors]  # right before and right after
    attempts: int
    notes: list[str]  # what could not be measured, and why

    def metrics(self) -> list[Metric]:
        if not self.rows:
            return []
        row = self.rows[0]
        pairs = Metric(f"{row.workload}/pairs", row.pairs, "pairs", "lower", 1e-3, True)
        # A property of the scene: another number means that another scene was rendered.
        drawn = Metric(f"{row.workload}/rectangle_pairs", row.rectangle_pairs, "pairs", "same", 1e-3, True)
        return [pairs, drawn, *(metric for row in self.rows for metric in row.metrics())]

    def as_rows(self) -> list[dict[str, Any]]:
        return [asdict(row) for row in self.rows]


def available_bytes() -> float:
    """Memory available to a program on the host; on a GPU XLA itself reports a shortage."""
    meminfo = Path("/proc/meminfo")
    if jax.default_backend() != "cpu" or not meminfo.exists():
        return float("inf")
    fields = dict(line.split(":") for line in meminfo.read_text().splitlines())
    return 0.8 * 1024 * int(fields["MemAvailable"].split()[0])


def compile_all(workload: Workload, scene: Scene, inputs: dict, say: Callable) -> dict[str, Compiled]:
    """Compile every program of a workload and its variants, by name."""
    gaussians = (*scene[:4], scene.viewmat[None], scene.K[None], workload.width, workload.height)
    plans = {d: make_plan(*gaussians, derivative=d) for d in ("reverse", "forward")}
    reads = jnp.zeros((1, plans["reverse"].num_tiles), jnp.int32)
    compiled = {}
    for name, program in make_programs(scene, plans).items():
        say(f"{workload.name}: compiling {name}")
        compiled[name] = compile_program(program, inputs, reads, options=host_options())
        if workload.variants and name != JVP:
            compiled[name + PLAIN] = compile_program(program, inputs, reads)
            compiled[name + UNREAD] = compile_program(program, inputs, None, options=host_options())
    if workload.variants:
        for name, program in make_stages(scene, plans["reverse"]).items():
            compiled[name] = compile_program(program, inputs, reads, options=host_options())
    return compiled


def run_program(compiled: Compiled, pool: list[dict], first_reads, repeats: int) -> tuple[list[float], int]:
    """Seconds of each call, and the pairs of the last one. Each call gets the reads of the previous one.

    Raises:
        RuntimeError: a perturbed scene did not fit the plan, so a call drew nothing.
    """
    last: list[Any] = [None, (first_reads, None, None)]
    overflows = []

    def call(i: int):
        reads = None if first_reads is None else last[1][0]
        last[:] = compiled.run(pool[i % len(pool)], reads)
        overflows.append(last[1][2])
        return last

    seconds = sample(call, repeats)
    if any(bool(overflow.any()) for overflow in overflows):
        raise RuntimeError("the plan was too small for a perturbed scene; increase its headroom")
    return seconds, int(last[1][1].sum())


def measure(
    workload: Workload,
    repeats: int,
    *,
    say: Callable[[str], None] = lambda text: None,
    floors: Callable[[], Floors] = measure_floors,
) -> Result:
    """Time all programs of a workload between two measurements of the floors; repeat if these differ.

    Raises:
        FileNotFoundError: the workload's data are absent.
    """
    scene, notes = workload.make(), []
    pool = make_pool(scene)
    boxes = rectangle_pairs(scene[:4], scene.viewmat, scene.K, workload.width, workload.height)
    compiled = compile_all(workload, scene, pool[0], say)
    for name in list(compiled):
        if compiled[name].memory > available_bytes():
            needed = compiled.pop(name).memory / GIB
            notes.append(f"{workload.name}, {name}: not run, it needs {needed:.1f} GiB")
    tile = Plan(workload.width, workload.height, capacity=0)
    zeros = jnp.zeros((1, tile.num_tiles), jnp.int32)
    for attempt in range(1, MAX_ATTEMPTS + 1):
        before, timed = floors(), {}
        for name, program in compiled.items():
            say(f"{workload.name}: timing {name}" + (f", attempt {attempt}" if attempt > 1 else ""))
            reads = None if name.endswith(UNREAD) else zeros
            calls = min(repeats, workload.repeats or repeats)
            timed[name] = run_program(program, pool, reads, calls)
        after = floors()
        if is_calm(before, after):
            break
    floor, rows = between(before, after), []
    for name, (seconds, pairs) in timed.items():
        median, p95 = median_and_p95(seconds)
        exp_ms, copy_ms = floor.exp_ms(boxes), floor.copy_ms(compiled[name].traffic)
        pixel_pairs = pairs * tile.tile_pixels
        product_ms = floor.product_ms(pixel_pairs, workload.channels, PRODUCTS.get(name, 0))
        rows.append(
            Timed(
                workload=workload.name,
                program=name,
                gaussians=len(scene.means),
                width=workload.width,
                height=workload.height,
                channels=workload.channels,
                calls=len(seconds),
                median_ms=median,
                p95_ms=p95,
                exp_floor_ms=exp_ms,
                exp_floors=median / max(exp_ms, 1e-9),
                copy_floor_ms=copy_ms,
                copy_floors=median / max(copy_ms, 1e-9),
                product_floors=median / product_ms if product_ms and workload.channels > 3 else None,
                compile_s=compiled[name].seconds,
                memory_gib=compiled[name].memory / GIB,
                pairs=pairs,
                pixel_pairs=pixel_pairs,
                rectangle_pairs=boxes,
                ns_per_rectangle_pixel=1e6 * median / max(boxes * TILE * TILE, 1),
                noisy=not is_calm(before, after),
            )
        )
    return Result(rows, (before, after), attempt, notes)
