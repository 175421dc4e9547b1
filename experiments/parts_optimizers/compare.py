"""The handles' poses at one frame by different optimizers: error over time, on the same pictures.

Parts are the true ones, and the update starts from their true poses at an earlier frame, so that only the
optimizers differ.
"""

from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import lineax
import numpy as np
import optimistix
from jaxtyping import Array, Float

from experiments.shared.discoveries import Options, canonical_of, pose_from, start_from_truth
from experiments.shared.recordings import recorded
from experiments.shared.timing import jitted, median_ms, timed
from gsjax.engine.recording import open_recording
from gsjax.io.ply import read_ply
from gsjax.methods.parts import (
    BACKGROUND,
    Canonical,
    PartsConfig,
    StreamBatch,
    StreamParams,
    stream_step,
)
from gsjax.methods.parts.pictures import with_part_masks
from gsjax.methods.parts.residual import pose_residual
from gsjax.methods.parts.screws import motions_of, pose_of
from gsjax.methods.parts.stream import posed, skinning_weights
from gsjax.optim.least_squares import LEVENBERG_MARQUARDT, least_squares_step
from gsjax.scene.frame import Frame, of_cameras, part_of
from gsjax.scene.handles import HandlePose, rigid_motions
from gsjax.scene.region import TILE
from gsjax.scene.render import plan_render, render

HELD_OUT, ANCHOR = (3, 8), 0
FRAMES = (4, 16, 30)  # frames that updates start from; tuning used frame 7, which is not among them
HALF, WHOLE = 2, 1
MOVED_M = 0.002  # parts that move less between two frames are not scored
NEAR = 1.5  # an error of at most this times the best of all counts as arrived
ADAM_COUNTS, COUNTS = (5, 10, 20, 40, 60, 120), (1, 2, 4, 6)
# The background has columns of zeros, so the least-norm solution is taken.
GAUSS_NEWTON = optimistix.GaussNewton(1e-4, 1e-5, linear_solver=lineax.AutoLinearSolver(well_posed=False))


class Update(NamedTuple):
    """The input of a method, and the truth that it is scored against.

    Attributes:
        canonical: the scene; its handles are the true parts.
        weights: weights of its movable Gaussians.
        start: the true pose at the earlier frame.
        end: the true pose at the later one.
        frames: the later frame, by the factor by which its pictures are scaled down.
    """

    canonical: Canonical
    weights: Float[Array, "M P"]
    start: HandlePose
    end: HandlePose
    frames: dict[int, Frame]

    def errors(self, pose: HandlePose) -> dict[int, float]:
        """For each part that moves, the mean distance of its points from their true places, mm."""
        means, labels = np.asarray(self.canonical.movable.means), np.asarray(self.weights.argmax(-1))
        found, true, before = (self._placed(means, one) for one in (pose, self.end, self.start))
        errors = {}
        for part in np.unique(labels[labels != BACKGROUND]).tolist():
            of = labels == part
            if np.linalg.norm(true[part, of] - before[part, of], axis=-1).mean() > MOVED_M:
                errors[part] = 1000 * float(np.linalg.norm(found[part, of] - true[part, of], axis=-1).mean())
        return errors

    def _placed(self, means: np.ndarray, pose: HandlePose) -> Float[np.ndarray, "P M 3"]:
        rotations, offsets = map(np.asarray, rigid_motions(self.canonical.centers, pose))
        return np.einsum("pij,mj->pmi", rotations, means) + offsets[:, None]

    def batch(self, size: int, cameras: tuple[int, ...], derivative: str) -> StreamBatch:
        """The batch of one iteration with some of the cameras."""
        frame = self.frames[size]
        at = self.canonical, self.weights, self.start
        seen = with_part_masks(frame, *at, TILE // size, blend=PartsConfig().stream.blend)
        plan = plan_render(posed(self.canonical, self.weights, self.start), frame.cameras, headroom=1.6)
        seen = of_cameras(seen, np.array(cameras))
        return StreamBatch(self.canonical, seen, 1.0, replace(plan, derivative=derivative), self.weights)

    @property
    def cameras(self) -> tuple[int, ...]:
        """All of them."""
        return tuple(range(len(self.frames[WHOLE].images)))


class Trace(NamedTuple):
    """The result of a method: numbers of iterations, milliseconds until then, and the poses."""

    counts: tuple[int, ...]
    ms: list[float]
    poses: list[HandlePose]


@cache
def updates(gap: int, frames: tuple[int, ...] = FRAMES) -> list[Update]:
    """Updates in articulated_0, from each of `frames` to the frame `gap` later."""
    dataset = recorded("articulated_0")
    options = Options(str(dataset), Path("unused"), eval_cameras=HELD_OUT, anchor=ANCHOR)
    sequence = open_recording(str(dataset), (), HELD_OUT, ":").tracked
    fitted = canonical_of(options, FOLDER) / "scene.ply"
    start, motions, _ = start_from_truth(
        sequence, read_ply(fitted)[0], ANCHOR, replace(PartsConfig(), weights="table")
    )
    canonical, weights = start.canonical, skinning_weights(start.field, start.canonical)
    centers = np.asarray(canonical.centers)
    found = []
    for t in frames:
        frame = sequence.frame(t + gap)
        sizes = {size: part_of(frame, (), size) for size in (HALF, WHOLE)}
        before, after = (pose_from(motions[u], centers) for u in (t, t + gap))
        found.append(Update(canonical, weights, before, after, sizes))
    return found


FOLDER = Path("runs/experiments/parts_optimizers/canonical")


def adam(update: Update, coarse: float | None = None) -> Trace:
    """Adam as in the stream, without the past and with a fixed field."""
    config = replace(PartsConfig().stream, past=0, field_rate=0.0)
    config = config if coarse is None else replace(config, coarse=coarse)
    step = stream_step(config)
    advance = jitted(lambda params, state, batch: step.update(params, state, batch, step=0, key=None))
    batches = {size: [update.batch(size, (c,), "reverse") for c in update.cameras] for size in (HALF, WHOLE)}
    field, nudges = jnp.log(jnp.maximum(update.weights, 1e-9)), jnp.zeros((len(update.weights), 3))
    params = StreamParams(update.start, field, nudges)
    state = step.init(params)
    each = {
        size: float(np.median([median_ms(advance, params, state, batch) for batch in of]))
        for size, of in batches.items()
    }
    poses, ms = [], []
    for count in ADAM_COUNTS:
        at, known, rng, spent = params, state, np.random.default_rng(count), 0.0
        turns = np.concatenate([rng.permutation(len(update.cameras)) for _ in range(count)])
        for i in range(count):
            size = HALF if i < config.coarse * count else WHOLE
            batch = batches[size][turns[i]]._replace(progress=i / count)
            at, known, _ = advance(at, known, batch)
            spent += each[size]
        poses.append(at.pose)
        ms.append(spent)
    return Trace(ADAM_COUNTS, ms, poses)


def least_squares(
    update: Update, solver, block: int = 4, softness: float = 0.1, most: int | None = None
) -> Trace:
    """Least squares on all cameras at once, or on groups of `most` in turn; the last iterations at full
    size."""

    def residual(motions, batch, *, step, key):
        config = PartsConfig().stream
        return pose_residual(
            motions, batch, step=step, key=key, config=config, block=block, softness=softness
        )

    step = least_squares_step(residual, solver)

    @jitted
    def advance(motions, state, batch):
        return step.update(motions, state, batch, step=0, key=None)

    groups = np.random.default_rng(0).permutation(update.cameras).reshape(-1, most or len(update.cameras))
    motions, poses, ms = motions_of(update.start), [], []
    for size, count in ((HALF, COUNTS[-2]), (WHOLE, COUNTS[-1] - COUNTS[-2])):
        batches = [update.batch(size, tuple(sorted(group)), "forward") for group in groups.tolist()]
        state = step.init(motions)  # a new problem from here on
        timed(advance, motions, state, batches[0])  # compiles
        for i in range(count):
            (motions, state, _), took = timed(advance, motions, state, batches[i % len(batches)])
            poses.append(pose_of(motions))
            ms.append(took)
    return Trace(COUNTS, np.cumsum(ms)[np.array(COUNTS) - 1].tolist(), [poses[count - 1] for count in COUNTS])


METHODS = {
    "Adam": adam,
    "Adam, half size": partial(adam, coarse=1.0),
    "Levenberg-Marquardt": partial(least_squares, solver=LEVENBERG_MARQUARDT),
    "Levenberg-Marquardt, two cameras": partial(least_squares, solver=LEVENBERG_MARQUARDT, most=2),
    "Gauss-Newton": partial(least_squares, solver=GAUSS_NEWTON),
}


@jitted
def draw(batch: StreamBatch, pose: HandlePose):
    """The reference for times: the scene rendered in all cameras at half the size."""
    return render(posed(batch.canonical, batch.weights, pose), batch.now.cameras, batch.plan).colors


@cache
def traces(gap: int) -> dict[str, dict[str, Any]]:
    """All methods, since each is compared with the best; means over the updates."""
    given, found, draws = updates(gap), {}, []
    for name, method in METHODS.items():
        runs = [method(update) for update in given]
        draws += [
            median_ms(draw, update.batch(HALF, update.cameras, "reverse"), update.start) for update in given
        ]
        errors = [
            [update.errors(pose) for pose in run.poses] for update, run in zip(given, runs, strict=True)
        ]
        found[name] = {
            "counts": runs[0].counts,
            "ms": np.mean([run.ms for run in runs], axis=0),
            "mm": np.mean([[np.mean([*e.values()]) for e in of] for of in errors], axis=0),
            "worst_mm": max(max(of[-1].values()) for of in errors),
        }
    start = np.mean([np.mean([*update.errors(update.start).values()]) for update in given])
    return {name: {**trace, "start_mm": start, "draw_ms": np.median(draws)} for name, trace in found.items()}


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One method over one gap. All methods of a gap run together the first time."""
    found = traces(options["gap"])
    mine = found[options["method"]]
    there = np.flatnonzero(mine["mm"] <= NEAR * min(trace["mm"].min() for trace in found.values()))
    iteration = mine["ms"][-1] / mine["counts"][-1]
    return {
        "start_mm": mine["start_mm"],
        "final_mm": mine["mm"][-1],
        "worst_mm": mine["worst_mm"],
        "iterations": mine["counts"][-1],
        "iteration_ms": iteration,
        "iteration_draws": iteration / mine["draw_ms"],
        "arrived_ms": mine["ms"][there[0]] if len(there) else None,
        "counts": mine["counts"],
        "errors_mm": mine["mm"],
        "times_ms": mine["ms"],
        "draw_ms": mine["draw_ms"],
    }


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """A panel for each gap, a curve for each method."""
    from matplotlib.figure import Figure

    gaps = list(dict.fromkeys(row["gap"] for row in rows))
    drawing = Figure(figsize=(6 * len(gaps), 4.6), dpi=110, layout="constrained")
    for axes, gap in zip(drawing.subplots(1, len(gaps), sharex=True, sharey=True), gaps, strict=True):
        mine = [row for row in rows if row["gap"] == gap]
        axes.axhline(mine[0]["start_mm"], color="0.4", lw=1, ls=":")
        for row in mine:
            draws = np.array(row["times_ms"]) / row["draw_ms"]
            axes.plot(draws, row["errors_mm"], "o-", ms=4, label=row["method"])
        axes.set(xscale="log", yscale="log", title=f"{gap} frame{'s' * (gap > 1)} on")
        axes.set(xlabel="time, in draws of the scene", ylabel="mean point error [mm]")
        axes.grid(color="0.9", which="both")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.legend(fontsize=8)
    drawing.savefig(path)
