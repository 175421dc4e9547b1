"""The rasterizer beside its peers on one GPU: gsplat (CUDA, PyTorch), splax (Warp, JAX), and gsjax twice.

    python -m benchmarks.peers --out FOLDER [--only garden-0 ...] [--with kernels xla gsplat splax]

Every call has slightly different inputs. Two times are reported: of a call whose result is awaited, and of a
call among many that are not, which is what a training loop sees. Rows carry the ratio to gsplat. A peer that
cannot be imported is left out, and named.
"""

import argparse
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("SCIPY_ARRAY_API", "1")  # splax wants it set before the first import of scipy
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # PyTorch needs a share of the memory

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.programs import BACKWARD, FORWARD, JVP, make_pool, make_programs
from benchmarks.timing import MIN_CALLS, median_and_p95, sample
from benchmarks.workloads import HD, VGA, Scene, Workload, ball_workload, choose, garden
from gsjax.engine import machine
from gsjax.geometry.spherical_harmonics import SH_C0
from gsjax.io.atomic import write_json
from gsjax.rasterize import fused
from gsjax.rasterize.rasterization import plan as make_plan

SUITE = [
    *(Workload(f"garden-{c}", partial(garden, c), 648, 420) for c in range(3)),
    *(ball_workload(n, size) for n in (10_000, 100_000, 1_000_000) for size in (VGA, (1280, 720), HD)),
]
AWAITED, STREAMED = 30, 60  # calls
MAX_SECONDS = 1.5  # of either, per program

Program = Callable[[int], Any]  # starts the i-th call, and returns its results
Wait = Callable[[Any], Any]


@dataclass(frozen=True)
class Row:
    """One program of one implementation on one workload."""

    workload: str
    implementation: str
    program: str
    awaited_ms: float
    awaited_p95_ms: float
    streamed_ms: float
    pairs: int | None = None


def gsjax_programs(
    workload: Workload, scene: Scene, kernels: bool
) -> Iterator[tuple[str, Program, Wait, int]]:
    """This package's programs, by the kernels or by XLA's loops."""
    fused.available.cache_clear()
    usable = fused.available()
    fused_available = fused.available
    if kernels and not usable:
        raise ImportError("the kernels need a CUDA GPU and warp-lang")
    if not kernels:
        fused.available = lambda: False  # type: ignore[assignment]
    try:
        jax.clear_caches()
        gaussians = (*scene[:4], scene.viewmat[None], scene.K[None], workload.width, workload.height)
        plans = {d: make_plan(*gaussians, derivative=d) for d in ("reverse", "forward")}
        pool = make_pool(scene)
        for name, program in make_programs(scene, plans).items():
            if kernels and name == JVP:
                continue  # forward mode is XLA's in both
            run = jax.jit(program)
            _, (_, pairs, overflow) = run(pool[0], None)  # compiles
            if bool(overflow.any()):
                raise RuntimeError("the plan was too small for a perturbed scene")
            yield (
                name,
                lambda i, run=run: run(pool[i % len(pool)], None),
                jax.block_until_ready,
                int(pairs.sum()),
            )
    finally:
        fused.available = fused_available


def splax_programs(workload: Workload, scene: Scene) -> Iterator[tuple[str, Program, Wait, None]]:
    """splax, which draws colours of spherical harmonics of degree 0 and clamps alpha at 0.999."""
    import splax

    size, K = (workload.height, workload.width), np.asarray(scene.K)
    focal, center = (float(K[0, 0]), float(K[1, 1])), (float(K[0, 2]), float(K[1, 2]))
    background = jnp.zeros(3)

    def draw(trained, viewmat):
        means, scales, quats, colors, opacities = trained
        return splax.render(
            means, scales, quats, colors, opacities, viewmat=viewmat, background=background,
            img_shape=size, f=focal, c=center,
        )  # fmt: skip

    def loss(trained, viewmat):
        colors, alphas = draw(trained, viewmat)
        return jnp.sum(colors**2) + jnp.sum(alphas)

    inputs = []
    for one in make_pool(scene):
        odds = jnp.clip(one["opacities"], 1e-6, 1 - 1e-6)
        colors = (one["colors"] - 0.5) / SH_C0
        trained = (one["means"], jnp.log(one["scales"]), one["quats"], colors, jnp.log(odds / (1 - odds)))
        inputs.append((trained, one["viewmats"][0]))
    for name, run in ((FORWARD, jax.jit(draw)), (BACKWARD, jax.jit(jax.value_and_grad(loss)))):
        yield name, lambda i, run=run: run(*inputs[i % len(inputs)]), jax.block_until_ready, None


def gsplat_programs(workload: Workload, scene: Scene) -> Iterator[tuple[str, Program, Wait, None]]:
    """gsplat, as its trainer calls it."""
    import torch
    from gsplat import rasterization

    def tensor(a):
        return torch.tensor(np.array(a), device="cuda")

    names = ("means", "quats", "scales", "opacities", "colors")
    inputs = [{k: tensor(one[k]) for k in (*names, "viewmats")} for one in make_pool(scene)]
    K = tensor(scene.K)[None]

    def draw(one):
        return rasterization(
            *(one[k] for k in names), one["viewmats"], K, workload.width, workload.height, packed=False
        )

    def forward(i):
        with torch.no_grad():
            return draw(inputs[i % len(inputs)])

    def backward(i):
        one = dict(inputs[i % len(inputs)])
        leaves = {k: one[k].detach().requires_grad_(True) for k in names}
        colors, alphas, _ = draw({**one, **leaves})
        return torch.autograd.grad((colors**2).sum() + alphas.sum(), list(leaves.values()))

    for name, run in ((FORWARD, forward), (BACKWARD, backward)):
        yield name, run, lambda _: torch.cuda.synchronize(), None


IMPLEMENTATIONS = {
    "kernels": partial(gsjax_programs, kernels=True),
    "xla": partial(gsjax_programs, kernels=False),
    "gsplat": gsplat_programs,
    "splax": splax_programs,
}


def streamed(program: Program, wait: Wait) -> float:
    """Milliseconds per call of many calls in a row, of which only the last one is awaited."""
    wait(program(0))
    calls, began = 0, time.perf_counter()
    while calls < STREAMED and (calls < MIN_CALLS or time.perf_counter() - began < MAX_SECONDS):
        result = program(calls)
        calls += 1
    wait(result)
    return 1e3 * (time.perf_counter() - began) / calls


def measure(workload: Workload, names: list[str], report: Callable[[Row], None]) -> list[str]:
    """Time the programs of all implementations on one workload; returns notes on what could not be."""
    scene, notes = workload.make(), []
    for name in names:
        try:
            for program, run, wait, pairs in IMPLEMENTATIONS[name](workload, scene):
                seconds = sample(lambda i: wait(run(i)), AWAITED, MAX_SECONDS)  # noqa: B023
                median, p95 = median_and_p95(seconds)
                report(Row(workload.name, name, program, median, p95, streamed(run, wait), pairs))
        except Exception as error:
            notes.append(f"{workload.name}, {name}: {type(error).__name__}: {str(error)[:300]}")
    return notes


def table(rows: list[Row]) -> str:
    """Rows as Markdown, with ratios to gsplat."""
    of_gsplat = {(r.workload, r.program): r.streamed_ms for r in rows if r.implementation == "gsplat"}
    lines = [
        "| scene | program | by | ms, awaited | p95 | ms, streamed | of gsplat |",
        "| --- | --- | --- | ---: | ---: | ---: | ---: |",
    ]
    for row in sorted(rows, key=lambda r: (r.workload, r.program)):
        gsplat = of_gsplat.get((row.workload, row.program))
        ratio = f"{row.streamed_ms / gsplat:.2f}" if gsplat else ""
        times = f"{row.awaited_ms:.3f} | {row.awaited_p95_ms:.3f} | {row.streamed_ms:.3f}"
        lines.append(f"| {row.workload} | {row.program} | {row.implementation} | {times} | {ratio} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--with", dest="names", nargs="*", default=list(IMPLEMENTATIONS))
    options = parser.parse_args()
    known = {workload.name: workload for workload in SUITE}
    rows: list[Row] = []
    notes: list[str] = []

    def report(row: Row) -> None:
        rows.append(row)
        times = f"{row.awaited_ms:9.3f} ms awaited {row.streamed_ms:9.3f} streamed"
        label = f"{row.workload:>22} {row.program:>17} {row.implementation:>8}"
        print(f"{label} {times}", flush=True)

    for name in choose(list(known), options.only):
        notes += measure(known[name], options.names, report)
        machine_now = machine.describe()
        write_json(
            options.out / "peers.json",
            {"rows": [asdict(r) for r in rows], "machine": machine_now, "notes": notes},
        )
    print(table(rows), *notes, sep="\n")


if __name__ == "__main__":
    main()
