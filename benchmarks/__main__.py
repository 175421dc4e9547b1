"""Times of the rasterizer on seeded scenes, as ratios to what exp alone would cost.

`python -m benchmarks` (`make bench`) prints one table and writes benchmarks/results/bench.json. A pair is one
Gaussian on one tile, 256 pixels. The floor is exp over as many float32 values, in a 4 MB block that stays in
cache, measured in the same run: ratios to it travel between machines better than milliseconds.
"""

import json
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import machine
from gsjax.geometry.cameras import intrinsics, look_at
from gsjax.optim.compiler import host_options
from gsjax.rasterize.plan import TILE
from gsjax.rasterize.rasterization import plan, rasterization

RESULT = Path(__file__).parent / "results" / "bench.json"
COUNTS = (1_000, 10_000, 100_000)
SIZES = ((320, 240), (640, 480))
REPEATS = 9
BLOCK = 2**20  # float32 values in 4 MB
# Only the outermost jit of a program may carry compiler options. This one doubles the speed of compositing.
OPTIONS = host_options() or None


def scene(num: int, seed: int = 0) -> list:
    """A ball of small Gaussians before a camera: means, quats, scales, opacities, colors, viewmats."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(num, 3))
    means = (
        directions / np.linalg.norm(directions, axis=1, keepdims=True) * rng.uniform(size=(num, 1)) ** (1 / 3)
    )
    scales = np.exp(rng.uniform(np.log(0.3), np.log(1.5), (num, 3))) * 0.7 / num ** (1 / 3)
    arrays = (means, rng.normal(size=(num, 4)), scales, rng.uniform(0.05, 1, num), rng.uniform(size=(num, 3)))
    viewmat = look_at(np.array([2.2, 0.4, 0.9]), np.zeros(3))
    return [jnp.asarray(a, jnp.float32) for a in (*arrays, viewmat[None])]


def times_ms(run, *args) -> list[float]:
    jax.block_until_ready(run(*args))
    samples = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        jax.block_until_ready(run(*args))
        samples.append(1e3 * (time.perf_counter() - began))
    return samples


def exp_floor_ns() -> float:
    """Nanoseconds of exp for one float32 value."""
    passes = 32
    run = jax.jit(
        lambda x: jax.lax.fori_loop(0, passes, lambda _, y: jnp.exp(-y), x), compiler_options=OPTIONS
    )
    return 1e6 * float(np.median(times_ms(run, jnp.linspace(0.0, 1.0, BLOCK)))) / (passes * BLOCK)


def compiled(function, *args):
    """(the compiled function, seconds that tracing and compiling took)."""
    began = time.perf_counter()
    run = jax.jit(function, compiler_options=OPTIONS).lower(*args).compile()
    return run, time.perf_counter() - began


def measure(num: int, width: int, height: int, floor_ns: float) -> list[dict]:
    args = scene(num)
    Ks = jnp.asarray(intrinsics(0.9 * width, width, height)[None], jnp.float32)
    plans = {d: plan(*args[:4], args[5], Ks, width, height, derivative=d) for d in ("reverse", "forward")}

    def image(*args, derivative="reverse"):
        return rasterization(*args, Ks, width, height, plan=plans[derivative])

    def loss(*args):
        colors, alphas, _ = image(*args)
        return jnp.sum(colors * colors) + jnp.sum(alphas)

    def push(*args):
        return jax.jvp(lambda *a: image(*a, derivative="forward")[0], args, args)

    programs = {
        "forward": image,
        "forward+backward": jax.value_and_grad(loss, argnums=tuple(range(6))),
        "jvp": push,
    }
    rows, pairs = [], None
    for name, function in programs.items():
        run, compile_s = compiled(function, *args)
        if pairs is None:
            pairs = int(run(*args)[2].pairs[0])
        samples = times_ms(run, *args)
        floor_ms = 1e-6 * floor_ns * pairs * TILE * TILE
        rows.append(
            {
                "program": name,
                "gaussians": num,
                "width": width,
                "height": height,
                "pairs": pairs,
                "compile_s": round(compile_s, 2),
                "median_ms": round(float(np.median(samples)), 2),
                "p95_ms": round(float(np.percentile(samples, 95)), 2),
                "floor_ms": round(floor_ms, 3),
                "ratio_to_floor": round(float(np.median(samples)) / floor_ms, 2),
            }
        )
    return rows


def main() -> None:
    floor_ns = exp_floor_ns()
    print(f"{machine.in_words()}\nexp floor {floor_ns:.3f} ns a value; median and p95 of {REPEATS} runs\n")
    heads = ("Gaussians", "image", "pairs", "compile s", "median ms", "p95 ms", "/ floor")
    print(f"{'program':17}" + "".join(f"{head:>10}" for head in heads))
    rows = []
    for num in COUNTS:
        for width, height in SIZES:
            for row in measure(num, width, height, floor_ns):
                rows.append(row)
                times = (row[key] for key in ("compile_s", "median_ms", "p95_ms", "ratio_to_floor"))
                head = f"{row['program']:17}{num:10}{f'{width}x{height}':>10}{row['pairs']:10}"
                print(head + "".join(f"{t:10.1f}" for t in times), flush=True)
    record = {
        "machine": machine.describe(),
        "exp_floor_ns": round(floor_ns, 4),
        "repeats": REPEATS,
        "rows": rows,
    }
    RESULT.parent.mkdir(exist_ok=True)
    RESULT.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
