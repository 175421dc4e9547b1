"""Do parts that are tracked in pictures and lifted hold together? All methods start from the same true
masks."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import map_coordinates
from trimesh.registration import procrustes

from experiments.shared.discoveries import Options, canonical_of, pose_from, start_from_truth
from experiments.shared.recordings import recorded
from experiments.shared.timing import jitted
from gsjax.data import Sequence
from gsjax.engine.drive import drive
from gsjax.engine.recording import open_recording
from gsjax.geometry.cameras import project
from gsjax.geometry.flow import seen_in_both
from gsjax.io.ply import read_ply
from gsjax.methods.parts import Parts, PartsConfig, Start
from gsjax.methods.parts.discovery import close_frame, weights_of_run
from gsjax.methods.parts.stream import posed, skinning_weights
from gsjax.perception.optical_flow import DisFlow
from gsjax.perception.propagation import FlowPropagator
from gsjax.rasterize.plan import with_room
from gsjax.scene.handles import HandlePose, rigid_motions
from gsjax.scene.render import plan_render, render, render_with_room

HELD_OUT, ANCHOR = (3, 8), 0
AFTER = (5, 15, 39)
TRIMMED = 3.0  # points off by more than this many medians are taken as lost
LEAST_POINTS = 6  # needed to place a part
NEAR_M = 0.02  # a Gaussian this far behind the visible surface is occluded


class Problem(NamedTuple):
    """The input of the methods, and the truth that they are scored against.

    Attributes:
        sequence: the recording's training cameras.
        start: a discovery that starts from the true masks.
        motions: true motions of the handles.
        labels: true masks by handle, [T,C,H,W].
    """

    sequence: Sequence
    start: Start
    motions: Float[np.ndarray, "T P 4 4"]
    labels: Int[np.ndarray, "T C H W"]


class Tracked(NamedTuple):
    """The result of a method: masks by handle, and the motions of the handles, if it has any."""

    labels: Int[np.ndarray, "T C H W"]
    motions: Float[np.ndarray, "T P 4 4"] | None


@cache
def problem(folder: Path) -> Problem:
    """articulated_0, from the anchor on."""
    dataset = str(recorded("articulated_0"))
    sequence = open_recording(dataset, (), HELD_OUT, ":").tracked
    options = Options(dataset, folder, eval_cameras=HELD_OUT, anchor=ANCHOR)
    gaussians, _ = read_ply(canonical_of(options, folder) / "scene.ply")
    start, motions, slots = start_from_truth(sequence, gaussians, ANCHOR, PartsConfig())
    every = [[sequence.mask(t, c) for c in range(sequence.num_cameras)] for t in range(sequence.num_frames)]
    return Problem(sequence, start, motions, slots[np.maximum(every, 0)])


def masks_tracked(given: Problem) -> Tracked:
    """Masks tracked in each video separately, from frame to frame."""
    sequence, found = given.sequence, []
    for c in range(sequence.num_cameras):
        video = np.stack([sequence.image(t, c) for t in range(sequence.num_frames)])
        found.append(FlowPropagator()(video, given.labels[ANCHOR, c]))
    return Tracked(np.stack(found, axis=1), None)


def points_lifted(given: Problem) -> Tracked:
    """Parts moved to where the 2D tracks of their Gaussians meet in space."""
    sequence, canonical = given.sequence, given.start.canonical
    means = np.asarray(canonical.movable.means, np.float64)
    parts = np.asarray(skinning_weights(given.start.field, canonical)).argmax(-1)
    tracks = [_tracks(given, c, means, parts) for c in range(sequence.num_cameras)]
    motions = np.broadcast_to(np.eye(4), given.motions.shape).copy()
    for t in range(1, sequence.num_frames):
        points = _met([places[t] for places in tracks], sequence, t)
        for part in range(1, motions.shape[1]):
            mine = (parts == part) & np.isfinite(points).all(-1)
            fitted = _fitted(means[mine], points[mine])
            motions[t, part] = motions[t - 1, part] if fitted is None else fitted
    return Tracked(_masks(given, motions), motions)


def followed(given: Problem) -> Tracked:
    """As in `gsjax parts`, except that the parts stay those of the true masks."""
    usual = PartsConfig()
    unify, refine = replace(usual.unify, every=0), replace(usual.refine, iterations=0)
    config = replace(usual, unify=unify, refine=refine)
    method = Parts(config)
    problem, run = method.start(given.sequence, given.start)
    *_, now = drive(method, problem, run, headroom=config.headroom)
    run = close_frame(now.run, config)
    parts = run.kept
    rotations, offsets = jax.vmap(partial(rigid_motions, parts.canonical.centers))(
        HandlePose(jnp.asarray(parts.quats), jnp.asarray(parts.translations))
    )
    motions = np.broadcast_to(np.eye(4), given.motions.shape).copy()
    motions[..., :3, :3], motions[..., :3, 3] = rotations, offsets
    return Tracked(_masks(given, motions, weights_of_run(run)), motions)


def _tracks(
    given: Problem, c: int, means: Float[np.ndarray, "n 3"], parts: Int[np.ndarray, "n"]
) -> Float[np.ndarray, "T n 2"]:
    """Pixels of points in one camera over all frames, by flow from frame to frame; NaN once a point is
    lost."""
    sequence, canonical = given.sequence, given.start.canonical
    camera = sequence.frame(ANCHOR).cameras
    one = jax.tree.map(lambda a: a[c : c + 1], camera)
    whole = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), canonical.movable, canonical.fixed)
    depth = np.asarray(render_with_room(whole, one)[0].depths[0])
    uv, z = (np.asarray(a) for a in project(jnp.asarray(means, jnp.float32), one.viewmat[0], one.K[0]))
    columns, rows = np.clip(uv.astype(int), 0, [camera.width - 1, camera.height - 1]).T
    inside = (uv >= 0).all(-1) & (uv < [camera.width, camera.height]).all(-1)
    shown = (
        inside
        & (given.labels[ANCHOR, c][rows, columns] == parts)
        & (np.abs(z - depth[rows, columns]) < NEAR_M)
    )
    found, flow = [np.where(shown[:, None], uv, np.nan)], DisFlow()
    for t in range(1, sequence.num_frames):
        before, now = sequence.image(t - 1, c), sequence.image(t, c)
        ahead = flow(before, now)
        sure = np.where(seen_in_both(ahead, flow(now, before))[..., None], ahead, np.nan)
        at = np.nan_to_num(found[-1] - 0.5, nan=-9.0)[:, ::-1].T
        steps = [map_coordinates(sure[..., k], at, order=1, cval=np.nan) for k in range(2)]
        found.append(found[-1] + np.stack(steps, axis=-1))
    return np.stack(found)


def _met(places: list[Float[np.ndarray, "n 2"]], sequence: Sequence, t: int) -> Float[np.ndarray, "n 3"]:
    """Least-squares intersections of the rays of two or more cameras; NaN with fewer."""
    lhs, rhs, count = np.zeros((len(places[0]), 3, 3)), np.zeros((len(places[0]), 3)), 0
    for c, uv in enumerate(places):
        viewmat, K = sequence.viewmats[t, c], sequence.Ks[t, c]
        rays = np.concatenate([uv, np.ones((len(uv), 1))], axis=1) @ np.linalg.inv(K).T @ viewmat[:3, :3]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        known = np.isfinite(uv).all(-1)
        across = np.where(known[:, None, None], np.eye(3) - rays[:, :, None] * rays[:, None], 0.0)
        eye = -viewmat[:3, :3].T @ viewmat[:3, 3]
        lhs, rhs, count = lhs + across, rhs + across @ eye, count + known
    points = np.full((len(count), 3), np.nan)
    points[count > 1] = np.linalg.solve(lhs[count > 1], rhs[count > 1, :, None])[..., 0]
    return points


def _fitted(means: Float[np.ndarray, "n 3"], points: Float[np.ndarray, "n 3"]) -> np.ndarray | None:
    """The rigid motion from `means` to `points`, without lost points; None where too few are left."""
    kept = np.ones(len(means), bool)
    for _ in range(4):
        if kept.sum() < LEAST_POINTS:
            return None
        motion = procrustes(means[kept], points[kept], reflection=False, scale=False, return_cost=False)
        off = np.linalg.norm(means @ motion[:3, :3].T + motion[:3, 3] - points, axis=-1)
        kept = off <= TRIMMED * np.median(off[kept])
    return motion


def _masks(
    given: Problem, motions: Float[np.ndarray, "T P 4 4"], weights: Any = None
) -> Int[np.ndarray, "T C H W"]:
    """Masks of the parts in all frames for the given motions of the handles."""
    canonical, sequence = given.start.canonical, given.sequence
    weights = skinning_weights(given.start.field, canonical) if weights is None else weights
    shares = jnp.concatenate([weights, jax.nn.one_hot(jnp.zeros(canonical.fixed.num, int), weights.shape[1])])
    centers, plan, found = np.asarray(canonical.centers), None, []

    @jitted
    def draw(gaussians, cameras, plan):
        drawn = render(gaussians, cameras, plan, features=shares)
        return drawn.features, drawn.meta

    for t, motion in enumerate(motions):
        gaussians = posed(canonical, weights, pose_from(motion, centers))
        cameras = sequence.frame(t).cameras
        plan = plan or plan_render(gaussians, cameras, headroom=2.0)
        drawn, plan = with_room(partial(draw, gaussians, cameras), plan, 2.0)
        found.append(np.asarray(drawn.argmax(-1)))
    return np.stack(found)


METHODS: dict[str, Callable[[Problem], Tracked]] = {
    "masks tracked": masks_tracked,
    "points tracked and lifted": points_lifted,
    "followed in space": followed,
}


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One method."""
    given, begun = problem(folder.parent / "canonical"), perf_counter()
    found = METHODS[options["method"]](given)
    minutes = (perf_counter() - begun) / 60
    parts = range(1, given.motions.shape[1])
    ious = np.array(
        [[_iou(a == p, b == p) for p in parts] for a, b in zip(found.labels, given.labels, strict=True)]
    )
    row = {f"iou_{t}": float(ious[t].mean()) for t in AFTER} | {
        "iou": float(ious[1:].mean()),
        "worst_iou": float(ious[1:].mean(0).min()),
        "ious": ious.mean(1).tolist(),
        "minutes": minutes,
    }
    if found.motions is not None:
        means = np.asarray(given.start.canonical.movable.means, np.float64)
        labels = np.asarray(skinning_weights(given.start.field, given.start.canonical)).argmax(-1)
        points = [_point_error(means[labels == p], found.motions[:, p], given.motions[:, p]) for p in parts]
        row |= {"point_mm": float(np.mean(points)), "worst_point_mm": float(max(points))}
    return {"point_mm": None, "worst_point_mm": None} | row


def _iou(found: Bool[np.ndarray, "C H W"], true: Bool[np.ndarray, "C H W"]) -> float:
    return float((found & true).sum() / max((found | true).sum(), 1))


def _point_error(
    means: Float[np.ndarray, "n 3"], found: Float[np.ndarray, "T 4 4"], true: Float[np.ndarray, "T 4 4"]
) -> float:
    """Median over the points of a part of their error, averaged over time, mm."""
    gap = found - true
    off = np.einsum("tij,nj->tni", gap[:, :3, :3], means) + gap[:, None, :3, 3]
    return 1000 * float(np.median(np.linalg.norm(off, axis=-1).mean(0)))


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """Overlap with the true masks over time."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(7, 4), dpi=110, layout="constrained")
    axes = drawing.subplots()
    for row in rows:
        axes.plot(row["ious"], label=row["method"])
    axes.set(xlabel="frames since the masks were told", ylabel="overlap with the true masks", ylim=(0, 1))
    axes.grid(color="0.9")
    axes.legend()
    drawing.savefig(path)
