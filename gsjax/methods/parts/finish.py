"""The end of a discovery: parts that no picture needs are given up, the scene and the poses of all frames are
what is refined, and the outcome is what edits work on."""

from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.rotations import quats_to_matrices
from gsjax.methods.parts.config import PartsConfig, StreamConfig
from gsjax.methods.parts.discover import centers_of
from gsjax.methods.parts.discovery import Discovery, joined, weights_of_run
from gsjax.methods.parts.pictures import where_parts_are
from gsjax.methods.parts.refine import RefineParams, refine_step
from gsjax.methods.parts.stream import Canonical, picture_loss, posed
from gsjax.methods.parts.trajectory import BACKGROUND, PartScene, Trajectory, trajectory_of
from gsjax.methods.protocols import SequenceLike
from gsjax.optim.compiler import host_options
from gsjax.optim.method import Run
from gsjax.rasterize.plan import with_room
from gsjax.scene.frame import Frame, one_camera, part_of
from gsjax.scene.gaussians import take
from gsjax.scene.handles import HandlePose
from gsjax.scene.region import TILE
from gsjax.scene.render import plan_render, render

_FRAMES, _CAMERAS = 6, 2  # by which parts are judged
_LEAST_CONTACT = 0.05  # share of a part's neighbours
_LEAST_WEIGHT = 0.02
_SHRINK = 2


def finished(sequence: SequenceLike, run: Run, config: PartsConfig) -> Run:
    """The run before the first step over all frames together, of which all frames were found: without
    needless parts, with weights that stay.

    Args:
        sequence: what the cameras saw.
        run: that followed parts to the last frame.
        config: settings.
    """
    discovery = without_needless(sequence, run.kept, np.asarray(weights_of_run(run)), config)
    poses = HandlePose(jnp.asarray(discovery.quats), jnp.asarray(discovery.translations))
    # Steps give away what they replace; what is kept stays whole.
    scene = discovery.canonical.movable, discovery.canonical.fixed
    params = RefineParams(*jax.tree.map(jnp.copy, scene), jax.tree.map(jnp.copy, poses))
    return run.having(params=params, state=refine_step(config).init(params), kept=discovery)


def without_needless(
    sequence: SequenceLike, discovery: Discovery, weights: Float[np.ndarray, "M P"], config: PartsConfig
) -> Discovery:
    """The parts that pictures need: from the smallest on, each joins the part that it touches, or the
    background, with which pictures get worse by least, if that is less than `unify.least_gain`.

    What a scene does not require is not modelled. It is decided by what is seen, and not by how motions
    compare: the motion of a thin piece is badly known, and matters little for the same reason.

    The weights that are left are fixed from here on, without those below 2 %: a softmax gives every part a
    little of everything, and to move a part would move all others a little.

    Args:
        sequence: what the cameras saw.
        discovery: all frames that were found.
        weights: of the movable Gaussians.
        config: settings.
    """
    judge = _Judge(sequence, discovery, weights, config)
    found, into = weights, np.arange(len(discovery.canonical.alive))
    here, before = judge(weights), None
    while before is None or (into != before).any():
        before = into.copy()
        for part in _smallest_first(weights.argmax(-1)):
            ways = {q: given(weights, part, q) for q in touching(discovery, weights.argmax(-1), part)}
            losses = {q: judge(changed) for q, changed in ways.items()}
            best = min(losses, key=losses.__getitem__)
            if losses[best] <= (1 + config.unify.least_gain) * here:
                weights, here = ways[best], losses[best]
                into[into == part] = best
    discovery, _ = joined(discovery, found, into)
    kept = settled(weights, np.asarray(discovery.canonical.alive))
    return discovery._replace(weights=jnp.asarray(kept))


def settled(weights: Float[np.ndarray, "M P"], alive: Bool[np.ndarray, "P"]) -> Float[np.ndarray, "M P"]:
    """The weights without those so small that they only tie parts to each other."""
    kept = np.where((weights < _LEAST_WEIGHT) | ~alive, 0.0, weights)
    return (kept / kept.sum(-1, keepdims=True)).astype(weights.dtype)


def given(weights: Float[np.ndarray, "M P"], part: int, to: int) -> Float[np.ndarray, "M P"]:
    """The weights with those of a part given to another."""
    changed = weights.copy()
    changed[:, to] += changed[:, part]
    changed[:, part] = 0
    return changed


def touching(discovery: Discovery, labels: Int[np.ndarray, "M"], part: int) -> list[int]:
    """The parts to which a share of a part's neighbours belongs, and the background.

    Args:
        discovery: with the neighbours of each Gaussian.
        labels: the part of each movable Gaussian.
        part: whose neighbours are counted.
    """
    neighbors = np.asarray(discovery.canonical.neighbors)[labels == part].ravel()
    all_ = np.concatenate([labels, np.full(discovery.canonical.fixed.num, BACKGROUND)])
    names, counts = np.unique(all_[neighbors], return_counts=True)
    near = names[counts >= _LEAST_CONTACT * len(neighbors)]
    return sorted({BACKGROUND, *near.tolist()} - {part})


def _smallest_first(labels: Int[np.ndarray, "M"]) -> list[int]:
    names, counts = np.unique(labels[labels != BACKGROUND], return_counts=True)
    return names[np.argsort(counts, kind="stable")].tolist()


class _Judge:
    """How well weights explain some pictures, spread over frames and cameras."""

    def __init__(
        self,
        sequence: SequenceLike,
        discovery: Discovery,
        weights: Float[np.ndarray, "M P"],
        config: PartsConfig,
    ):
        self._loss = _compiled(config.stream)
        self._canonical, self._headroom = discovery.canonical, 2 * config.headroom
        done = np.flatnonzero(discovery.done)
        frames = done[np.linspace(0, len(done) - 1, min(_FRAMES, len(done))).round().astype(int)]
        self._seen: list[tuple[HandlePose, Frame]] = []
        for i, t in enumerate(frames.tolist()):
            frame = part_of(sequence.frame(t), (), _SHRINK)
            count = sequence.num_cameras
            cameras = {(i + k * count // _CAMERAS) % count for k in range(_CAMERAS)}
            place = self._canonical, jnp.asarray(weights), discovery.pose(t)
            seen = where_parts_are(frame, *place, TILE // _SHRINK, blend=config.stream.blend)
            self._seen += [(discovery.pose(t), one_camera(seen, c)) for c in sorted(cameras)]
        scene = posed(self._canonical, jnp.asarray(weights), discovery.pose(int(done[0])))
        self._plan = plan_render(scene, frame.cameras, headroom=self._headroom)

    def __call__(self, weights: Float[np.ndarray, "M P"]) -> float:
        """The mean loss over the pictures."""
        losses = [self._of(jnp.asarray(weights), pose, frame) for pose, frame in self._seen]
        return float(np.mean(losses))

    def _of(self, weights: Float[Array, "M P"], pose: HandlePose, frame: Frame) -> float:
        """The loss in one picture, by a plan that holds it."""
        draw = partial(self._loss, self._canonical, weights, pose, frame)
        loss, self._plan = with_room(draw, self._plan, self._headroom)
        return float(loss)


class _Room(NamedTuple):
    """Whether a plan was too small, and what it should have held."""

    overflow: Bool[Array, ""]
    needed: Int[Array, ""]


@lru_cache(maxsize=2)
def _compiled(config: StreamConfig):
    @partial(jax.jit, static_argnames="plan", compiler_options=host_options())
    def loss(canonical: Canonical, weights, pose, frame, plan):
        scene = posed(canonical, weights, pose, config.blend)
        drawn = render(scene, frame.cameras, plan, roi=frame.masks)
        room = _Room(drawn.meta.overflow.any(), drawn.meta.needed.max())
        return picture_loss(drawn, frame, config), room

    return loss


def outcome(
    discovery: Discovery, weights: Float[np.ndarray, "M P"], times: Float[np.ndarray, "T"]
) -> tuple[PartScene, Trajectory]:
    """The scene with its parts, all Gaussians in the order in which they were given, and where parts were.

    Handles that nothing follows are left out, and the others stand in the middle of what follows them.

    Args:
        discovery: how far it is.
        weights: of the movable Gaussians.
        times: of the frames, seconds.
    """
    labels = weights.argmax(-1)
    kept = [BACKGROUND, *(p for p in np.unique(labels).tolist() if p != BACKGROUND)]
    count = len(discovery.order)
    full = np.zeros((count, len(kept)), np.float32)
    full[:, BACKGROUND] = 1
    full[discovery.order[: len(weights)]] = weights[:, kept] / weights[:, kept].sum(-1, keepdims=True)
    canonical = discovery.canonical
    before = np.asarray(canonical.centers)[kept]
    means = np.asarray(canonical.movable.means)
    after = centers_of(means, labels, weights.shape[1])[kept]
    quats = jnp.asarray(discovery.quats[:, kept])
    # x -> R (x - c) + c + T is the same motion about any c: T' = T + (R - I)(c' - c) .
    turned = jnp.einsum("tpij,pj->tpi", quats_to_matrices(quats), jnp.asarray(after - before))
    translations = jnp.asarray(discovery.translations[:, kept]) + turned - (after - before)
    everything = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), canonical.movable, canonical.fixed)
    scene = PartScene(take(everything, np.argsort(discovery.order)), jnp.asarray(full), jnp.asarray(after))
    return scene, trajectory_of(jnp.asarray(times, quats.dtype), HandlePose(quats, translations))
