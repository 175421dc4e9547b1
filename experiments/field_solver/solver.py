"""How fast does the least-squares problem of a field converge, by conjugate gradients or by Adam?"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from experiments.shared.fields import articulated, codebook_of, flawed_teacher
from gsjax.engine.drive import drive
from gsjax.methods.distill import PRESETS, Distill, Problem, SolveConfig
from gsjax.optim.compiler import host_options
from gsjax.optim.method import Run
from gsjax.rasterize.frozen import paint_shown

PASSES, ENOUGH = 40, 100  # over the views; and iterations after which the objective is at its least
CONFIG = replace(PRESETS["solve"], solve=SolveConfig(iterations=ENOUGH))


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """The objective per pixel after each pass, from the vote on."""
    scene = articulated(folder)
    _, codes = codebook_of(scene.photographs)
    teacher, _ = flawed_teacher(scene, codes, seed, snap=2)
    cameras = [scene.photographs.camera(i) for i in scene.taught]
    method = Distill(CONFIG)
    problem, first = method.start(scene.gaussians, cameras, teacher, scene.rasterize_mode)
    solved, seconds = solution(method, problem, first)
    losses = solved[: PASSES + 1]
    if options["method"] == "Adam":
        problem, first = method.start(scene.gaussians, cameras, teacher, scene.rasterize_mode)
        losses, seconds = descent(method, problem, first, options["rate"])
    way = losses[0] - solved[-1]
    excess = (np.array(losses) - solved[-1]) / way
    return {
        "losses": [float(loss) for loss in losses],
        "excess": excess.tolist(),
        "first": losses[0],
        "last": losses[-1],
        "passes": len(losses) - 1,
        "within_10": passes_to(excess, 0.1),
        "within_1": passes_to(excess, 0.01),
        "pass_seconds": seconds,
    }


def passes_to(excess: Float[np.ndarray, "n"], share: float) -> int | None:
    """The first pass after which no more than a share of the excess is left; None if there is none."""
    there = np.flatnonzero(excess <= share)
    return int(there[0]) if len(there) else None


def solution(method: Distill, problem: Problem, first: Run) -> tuple[list[float], float]:
    """The objective of the vote and after each iteration, and the median seconds of a pass."""
    count, losses, times, seconds = len(problem.views), [], [], 0.0
    for now in drive(method, problem, first):
        seconds += now.seconds
        if now.step % count == 0:
            if now.step > count:  # the first pass is the vote, the second tells its objective
                losses.append(float(now.info["loss"]))
            times.append(seconds)
            seconds = 0.0
    return losses, float(np.median(times))


def descent(method: Distill, problem: Problem, first: Run, rate: float) -> tuple[list[float], float]:
    """The same from the vote on by Adam, whose steps each take the gradient of the whole objective."""
    count, run = len(problem.views), first
    for now in drive(method, problem, first):
        run = now.run
        if now.step == count:
            break
    state, x = run.state, jnp.array(run.params.encoding)
    gradient = gradient_of(problem, run)
    optimizer = optax.adam(rate)
    known, losses, times = optimizer.init(x), [], []
    for _ in range(PASSES + 1):
        begun = perf_counter()
        value, slope = gradient(x)
        updates, known = optimizer.update(slope, known, x)
        x = jax.block_until_ready(optax.apply_updates(x, updates))
        losses.append(float(value / state.pixels))
        times.append(perf_counter() - begun)
    return losses, float(np.median(times))


def gradient_of(problem: Problem, run: Run) -> Callable[[Array], tuple[Array, Array]]:
    """The objective and its gradient, view after view."""
    lift, tie, neighbors = run.params.lift, run.state.tie, problem.neighbors
    assert neighbors is not None

    def of_view(x, batch):
        image, alphas = paint_shown(batch.view, x[batch.view.rows], batch.plan)
        wanted = (batch.codebook @ lift)[jnp.maximum(batch.ids, 0)] * alphas[..., None]
        return jnp.sum(jnp.where((batch.ids >= 0)[..., None], (image - wanted) ** 2, 0.0))

    def of_neighbors(x):
        return tie * sum(jnp.sum((x - x[others]) ** 2) for others in neighbors.T)

    parts = [jax.jit(jax.value_and_grad(f), compiler_options=host_options()) for f in (of_view, of_neighbors)]

    def found(x: Array) -> Iterator[tuple[Array, Array]]:
        yield parts[1](x)
        yield from (parts[0](x, batch) for batch in problem.views)

    def gradient(x: Array) -> tuple[Array, Array]:
        return jax.tree.map(lambda *each: sum(each), *found(x))

    return gradient


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """The excess over passes, a line for each method."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(7, 4.5), dpi=110, layout="constrained")
    axes = drawing.subplots()
    for row in rows:
        name = row["method"] + ("" if row.get("rate") is None else f", rate {row['rate']:g}")
        excess = np.maximum(row["excess"], 1e-6)
        axes.plot(excess, lw=2.5 if row["method"] != "Adam" else 1.2, label=name)
    axes.set(
        yscale="log", xlabel="passes over the views", ylabel="objective above its minimum, of the vote's"
    )
    axes.set_ylim(1e-5, 10)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    drawing.savefig(path, format=path.suffix.removeprefix(".") or "png")
