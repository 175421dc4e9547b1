"""The end of a discovery: parts that no picture needs are given up, and the others are what edits work on."""

from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from gsjax.geometry.rotations import quats_to_matrices
from gsjax.methods.parts.config import PartsConfig, StreamConfig
from gsjax.methods.parts.discover import Start, Views, centers_of
from gsjax.methods.parts.follow import Parts, joined, seen_at
from gsjax.methods.parts.stream import Canonical, picture_loss, posed
from gsjax.methods.parts.trajectory import BACKGROUND, PartScene, Trajectory, trajectory_of
from gsjax.methods.parts.weights import SimplexTable
from gsjax.optim.compiler import host_options
from gsjax.scene.frame import one_camera, part_of
from gsjax.scene.gaussians import take
from gsjax.scene.handles import HandlePose
from gsjax.scene.region import TILE
from gsjax.scene.render import plan_render, render

_FRAMES, _CAMERAS = 6, 2  # by which parts are judged
_LEAST_CONTACT = 0.05  # share of a part's neighbours
_LEAST_WEIGHT = 0.02
_SHRINK = 2


def without_needless(views: Views, parts: Parts, config: PartsConfig) -> tuple[Parts, list[tuple[int, int]]]:
    """Parts that pictures need: from the smallest on, each joins the part that it touches, or the background,
    with which pictures get worst by least, if that is less than `unify.least_gain`; and who joined whom.

    What a scene does not require is not modelled. It is decided by what is seen, and not by how motions
    compare: the motion of a thin piece is badly known, and matters little for the same reason.

    The weights that are left are a table from here on, without those below 2 %: a softmax gives every part a
    little of everything, and to move a part would move all others a little.
    """
    judge = _Judge(views, parts, config)
    weights, into = np.asarray(parts.weights), np.arange(len(parts.canonical.alive))
    here, before = judge(parts, weights), None
    while before is None or (into != before).any():
        before = into.copy()
        for part in _smallest_first(weights.argmax(-1)):
            ways = {q: given(weights, part, q) for q in touching(parts, weights.argmax(-1), part)}
            losses = {q: judge(parts, changed) for q, changed in ways.items()}
            best = min(losses, key=losses.__getitem__)
            if losses[best] <= (1 + config.unify.least_gain) * here:
                weights, here = ways[best], losses[best]
                into[into == part] = best
    parts, pairs = joined(parts, into)
    return settled(parts, weights), pairs


def settled(parts: Parts, weights: Float[np.ndarray, "M P"]) -> Parts:
    """With a table of weights, without those so small that they only tie parts to each other."""
    kept = np.where((weights < _LEAST_WEIGHT) | ~np.asarray(parts.canonical.alive), 0.0, weights)
    table = SimplexTable(jnp.asarray(kept / kept.sum(-1, keepdims=True), weights.dtype))
    return parts._replace(params=parts.params._replace(field=table))


def given(weights: Float[np.ndarray, "M P"], part: int, to: int) -> Float[np.ndarray, "M P"]:
    """The weights with those of a part given to another."""
    changed = weights.copy()
    changed[:, to] += changed[:, part]
    changed[:, part] = 0
    return changed


def touching(parts: Parts, labels: Int[np.ndarray, "M"], part: int) -> list[int]:
    """The parts to which a share of a part's neighbours belongs, and the background.

    Args:
        parts: with the neighbours of each Gaussian.
        labels: the part of each movable Gaussian.
        part: whose neighbours are counted.
    """
    neighbors = np.asarray(parts.canonical.neighbors)[labels == part].ravel()
    all_ = np.concatenate([labels, np.full(parts.canonical.fixed.num, BACKGROUND)])
    names, counts = np.unique(all_[neighbors], return_counts=True)
    near = names[counts >= _LEAST_CONTACT * len(neighbors)]
    return sorted({BACKGROUND, *near.tolist()} - {part})


def _smallest_first(labels: Int[np.ndarray, "M"]) -> list[int]:
    names, counts = np.unique(labels[labels != BACKGROUND], return_counts=True)
    return names[np.argsort(counts, kind="stable")].tolist()


class _Judge:
    """How well parts explain some pictures, spread over frames and cameras."""

    def __init__(self, views: Views, parts: Parts, config: PartsConfig):
        self._loss = _compiled(config.stream)
        done = np.flatnonzero(parts.done)
        frames = done[np.linspace(0, len(done) - 1, min(_FRAMES, len(done))).round().astype(int)]
        self._seen = []
        for i, t in enumerate(frames.tolist()):
            frame = part_of(views.frame(t), (), _SHRINK)
            cameras = [(i + k * views.num_cameras // _CAMERAS) % views.num_cameras for k in range(_CAMERAS)]
            at = parts.canonical, parts.weights, parts.pose(t)
            seen = seen_at(frame, *at, TILE // _SHRINK, blend=config.stream.blend)
            self._seen += [(t, one_camera(seen, c)) for c in sorted(set(cameras))]
        scene = posed(parts.canonical, parts.weights, parts.pose(int(done[0])))
        self._headroom = 2 * config.headroom
        self._plan = plan_render(scene, frame.cameras, headroom=self._headroom)

    def __call__(self, parts: Parts, weights: Float[np.ndarray, "M P"]) -> float:
        arguments = parts.canonical, jnp.asarray(weights)
        return float(np.mean([self._of(*arguments, parts.pose(t), seen) for t, seen in self._seen]))

    def _of(self, *arguments: Any) -> float:
        """The loss in one picture, by a plan that holds it."""
        while True:
            loss, overflow, needed = self._loss(*arguments, self._plan)
            if not bool(overflow):
                return float(loss)
            self._plan = self._plan.grown(int(needed), self._headroom)


@lru_cache(maxsize=2)
def _compiled(config: StreamConfig):
    @partial(jax.jit, static_argnames="plan", compiler_options=host_options())
    def loss(canonical: Canonical, weights, pose, seen, plan):
        scene = posed(canonical, weights, pose, config.blend)
        drawn = render(scene, seen.frame.cameras, plan, roi=seen.counts)
        return picture_loss(drawn, seen, config), drawn.meta.overflow.any(), drawn.meta.needed.max()

    return loss


def outcome(start: Start, parts: Parts, times: Float[np.ndarray, "T"]) -> tuple[PartScene, Trajectory]:
    """The scene with its parts, all Gaussians in the order in which they were given, and where parts were.

    Handles that nothing follows are left out, and the others stand in the middle of what follows them.

    Args:
        start: where all began.
        parts: that were followed.
        times: of the frames, seconds.
    """
    weights = np.asarray(parts.weights)
    labels = weights.argmax(-1)
    kept = [BACKGROUND, *(p for p in np.unique(labels).tolist() if p != BACKGROUND)]
    count = len(start.order)
    full = np.zeros((count, len(kept)), np.float32)
    full[:, BACKGROUND] = 1
    full[start.order[: len(weights)]] = weights[:, kept] / weights[:, kept].sum(-1, keepdims=True)
    before = np.asarray(parts.canonical.centers)[kept]
    means = np.asarray(parts.canonical.movable.means)
    after = centers_of(means, labels, weights.shape[1])[kept]
    quats = jnp.asarray(parts.quats[:, kept])
    # x -> R (x - c) + c + T is the same motion about any c: T' = T + (R - I)(c' - c) .
    turned = jnp.einsum("tpij,pj->tpi", quats_to_matrices(quats), jnp.asarray(after - before))
    translations = jnp.asarray(parts.translations[:, kept]) + turned - (after - before)
    everything = jax.tree.map(
        lambda a, b: jnp.concatenate([a, b]), parts.canonical.movable, parts.canonical.fixed
    )
    scene = PartScene(take(everything, np.argsort(start.order)), jnp.asarray(full), jnp.asarray(after))
    return scene, trajectory_of(jnp.asarray(times, quats.dtype), HandlePose(quats, translations))
