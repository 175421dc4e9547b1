"""The state of a discovery: the scene, its parts, and their poses in all frames found so far. Every few
frames, parts are joined or divided (MotionSplicer, section 3.2)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.rotations import normalize_quats, quats_to_matrices
from gsjax.methods.parts.config import PartsConfig
from gsjax.methods.parts.discover import Start, radii_of
from gsjax.methods.parts.screws import pose_from
from gsjax.methods.parts.stream import Canonical, StreamParams, skinning_weights, stream_step
from gsjax.methods.parts.trajectory import BACKGROUND
from gsjax.methods.parts.unify import Motions, best_cut, scene_motions, unified
from gsjax.methods.parts.weights import fit_field_to_weights
from gsjax.optim.method import Run
from gsjax.optim.step import copied
from gsjax.scene.handles import HandlePose, at_rest

Pairs = tuple[tuple[int, int], ...]
"""Joined parts, as (part, the part that it was joined to), or divided ones, as (new part, the part that it
was split from)."""
_REWARM = 100  # steps that fit a grid after parts were joined or divided
_LEAST_CONTACT = 0.05  # share of a part's neighbours that must belong to another part for them to touch
_REST = 4  # rounds of divisions for which a newly divided part is left alone


class Discovery(NamedTuple):
    """The state that is constant within a frame and changes between frames; `Run.kept` of
    `gsjax.methods.parts.Parts`.

    Attributes:
        canonical: the scene and its handles.
        order: rows of the given Gaussians, movable ones first.
        anchor: the canonical frame.
        exposures: maps of each camera's colours to those of the scene.
        quats, translations: poses at all frames, [T,P,4] and [T,P,3]; at rest where not yet found.
        found: rank of each frame in the order of discovery; 0 is the anchor, -1 is not yet found.
        born: number of found frames when each part's own motion began.
        rests: number of found frames from which each part may be divided again.
        frame: the frame whose pose is being found, or was found last; -1 before the first.
        weights: weights of the movable Gaussians before `frame`, or the final ones once all frames are found.
        predicted: poses of the handles before the first step of `frame`.
        joined: joined parts.
        divided: divided parts.
        absent: frames from which each part is absent; None if none ever is, or before that is known.
    """

    canonical: Canonical
    order: Int[np.ndarray, "N"]
    anchor: int
    exposures: Float[np.ndarray, "C 3 4"]
    quats: Float[np.ndarray, "T P 4"]
    translations: Float[np.ndarray, "T P 3"]
    found: Int[np.ndarray, "T"]
    born: Int[np.ndarray, "P"]
    rests: Int[np.ndarray, "P"]
    frame: int
    weights: Float[Array, "M P"]
    predicted: HandlePose
    joined: Pairs = ()
    divided: Pairs = ()
    absent: Bool[np.ndarray, "T P"] | None = None

    @property
    def done(self) -> Bool[np.ndarray, "T"]:
        """The frames that were found."""
        return self.found >= 0

    @property
    def count(self) -> int:
        """Number of frames that were found, without the anchor."""
        return int(self.found.max())

    @property
    def is_between_frames(self) -> bool:
        """Whether no frame is in progress."""
        return self.frame < 0 or bool(self.done[self.frame])

    def pose(self, t: int) -> HandlePose:
        """The pose at frame t; at rest if it is not yet found."""
        return HandlePose(*jax.device_put((self.quats[t], self.translations[t])))

    @property
    def motions(self) -> Motions:
        """The motions of all parts, in the order in which frames were found."""
        order = np.argsort(self.found)[-self.count - 1 :]
        rotations = np.asarray(quats_to_matrices(jax.device_put(self.quats[order])))
        return scene_motions(rotations, self.translations[order], np.asarray(self.canonical.centers))


def order_of_frames(frames: int, anchor: int) -> list[int]:
    """Frames from the anchor to the end, then from the anchor back to the beginning."""
    return [*range(anchor + 1, frames), *reversed(range(anchor))]


def initial_run(start: Start, frames: int, config: PartsConfig) -> Run:
    """The run before the first frame, with all parts at rest; for two states, the run after the second.

    Args:
        start: from `begin`.
        frames: T, the number of frames.
        config: settings.
    """
    slots, count = len(start.canonical.alive), start.canonical.movable.num
    quats = np.zeros((frames, slots, 4), np.float32)
    quats[..., 0] = 1
    nothing, rest = np.zeros(slots, int), at_rest(slots)
    nudges = jax.device_put(np.zeros((count, 3), start.canonical.movable.means.dtype))
    params = StreamParams(rest, copied(start.field), nudges)
    discovery = Discovery(
        canonical=start.canonical,
        order=start.order,
        anchor=start.anchor.frame,
        exposures=start.exposures,
        quats=quats,
        translations=np.zeros((frames, slots, 3), np.float32),
        found=np.where(np.arange(frames) == start.anchor.frame, 0, -1),
        born=nothing,
        rests=nothing,
        frame=-1,
        weights=skinning_weights(start.field, start.canonical),
        predicted=at_rest(slots),
    )
    if start.motions is not None:
        discovery = _with_other_state(discovery, start.motions)
    return Run(params, jax.jit(stream_step(config.stream).init)(params), kept=discovery)


def _with_other_state(discovery: Discovery, motions: Float[np.ndarray, "P 4 4"]) -> Discovery:
    """The discovery with the other of its two frames found."""
    other, centers = 1 - discovery.anchor, discovery.canonical.centers
    pose = pose_from(jnp.asarray(motions, centers.dtype), centers)
    quats, translations, found = discovery.quats.copy(), discovery.translations.copy(), discovery.found.copy()
    quats[other], translations[other], found[other] = pose.quats, pose.translations, 1
    return discovery._replace(quats=quats, translations=translations, found=found, frame=other)


def open_frame(run: Run, t: int) -> Run:
    """The run before the first step of frame t, with poses extrapolated from the two frames before it."""
    discovery: Discovery = run.kept
    direction = 1 if t > discovery.anchor else -1
    before, earlier = discovery.pose(t - direction), t - 2 * direction
    pose = before
    if 0 <= earlier < len(discovery.done) and discovery.done[earlier]:
        pose = _extrapolated(discovery.pose(earlier), before)
    kept = discovery._replace(frame=t, weights=copied(weights_of_run(run)))
    return with_prediction(run.having(state=run.state.for_new_frame(), kept=kept), pose)


def with_prediction(run: Run, pose: HandlePose) -> Run:
    """The run before the first step of its frame, starting from a pose."""
    kept = run.kept._replace(predicted=copied(pose))
    return run.having(params=run.params._replace(pose=pose), kept=kept)


@jax.jit
def _extrapolated(first: HandlePose, second: HandlePose) -> HandlePose:
    """The pose after two poses, at the same velocity."""
    quats = normalize_quats(2 * second.quats - first.quats)
    return HandlePose(quats, 2 * second.translations - first.translations)


def close_frame(run: Run, config: PartsConfig) -> Run:
    """The run after the last step of its frame: the pose is stored, and every few frames, parts are
    joined and divided."""
    discovery: Discovery = run.kept
    t, quats, translations = discovery.frame, discovery.quats.copy(), discovery.translations.copy()
    found, count = discovery.found.copy(), discovery.count + 1
    quats[t], translations[t], found[t] = run.params.pose.quats, run.params.pose.translations, count
    run = run.having(kept=discovery._replace(quats=quats, translations=translations, found=found))
    last = count == len(found) - 1
    if config.unify.every and (count % config.unify.every == 0 or last):
        run = _unify(run, config)
        if not last:
            run = _split(run, config)
        run = run.having(state=run.state._replace(pulls=jnp.zeros_like(run.state.pulls)))
    return run


def weights_of_run(run: Run) -> Float[Array, "M P"]:
    """The weights of the movable Gaussians, from the field of a run that tracks parts."""
    return skinning_weights(run.params.field, run.kept.canonical)


def _unify(run: Run, config: PartsConfig) -> Run:
    """The run after joining parts that have moved alike; the smaller takes the motion of the larger."""
    discovery: Discovery = run.kept
    weights = np.asarray(weights_of_run(run))
    into = unified(
        discovery.motions,
        np.asarray(discovery.canonical.movable.means),
        weights.argmax(-1),
        np.asarray(discovery.canonical.alive),
        discovery.born,
        noise_m=config.unify.noise * float(discovery.canonical.pixel),
        tolerance=config.unify.tolerance,
    )
    after, weights = join_parts(discovery, weights, into)
    return run if after is discovery else _refitted(run, after, weights)


def join_parts(
    discovery: Discovery, weights: Float[np.ndarray, "M P"], into: Int[np.ndarray, "P"]
) -> tuple[Discovery, Float[np.ndarray, "M P"]]:
    """The discovery and the weights after joining parts. Slots whose part has no Gaussian left are freed.

    Args:
        discovery: the discovery before.
        weights: weights of the movable Gaussians.
        into: the part that each part joins; itself if it stays.
    """
    pairs = tuple((int(p), int(q)) for p, q in enumerate(into) if p != q)
    alive, members = np.asarray(discovery.canonical.alive), np.unique(weights.argmax(-1))
    left = np.isin(np.arange(len(alive)), [BACKGROUND, *members]) & (into == np.arange(len(alive)))
    if (left == alive).all():
        return discovery, weights
    weights = np.where(left, weights @ np.eye(len(into), dtype=np.float32)[into], 0)
    weights = weights / weights.sum(-1, keepdims=True)
    return _with_parts(discovery, weights, left)._replace(joined=(*discovery.joined, *pairs)), weights


def adjacent_parts(discovery: Discovery, weights: Float[np.ndarray, "M P"], part: int) -> list[int]:
    """The background, and the parts that a part touches: at least 5 % of its neighbours belong to them.

    Args:
        discovery: the neighbours of each Gaussian.
        weights: weights of the movable Gaussians.
        part: index of the part.
    """
    labels = weights.argmax(-1)
    neighbors = np.asarray(discovery.canonical.neighbors)[labels == part].ravel()
    all_ = np.concatenate([labels, np.full(discovery.canonical.fixed.num, BACKGROUND)])
    names, counts = np.unique(all_[neighbors], return_counts=True)
    near = names[counts >= _LEAST_CONTACT * len(neighbors)]
    return sorted({BACKGROUND, *near.tolist()} - {part})


def _split(run: Run, config: PartsConfig) -> Run:
    """The run after dividing the part whose sides are pulled apart most, if a slot is free and the score is
    significant. Both sides inherit its motion, and are joined again if they keep moving alike."""
    discovery: Discovery = run.kept
    canonical = discovery.canonical
    weights, alive = np.asarray(weights_of_run(run)), np.asarray(canonical.alive)
    points, pulls = np.asarray(canonical.movable.means), np.asarray(run.state.pulls)
    labels, free, count = weights.argmax(-1), np.flatnonzero(~alive), discovery.count
    candidates = [p for p in np.unique(labels).tolist() if p != BACKGROUND and discovery.rests[p] <= count]
    cuts = {p: best_cut(points[labels == p], pulls[labels == p]) for p in candidates}
    best = max(cuts, key=lambda p: cuts[p].score, default=BACKGROUND)
    if best == BACKGROUND or not len(free) or cuts[best].score < config.unify.least_cut:
        return run
    new, beyond = int(free[0]), np.flatnonzero(labels == best)[cuts[best].beyond]
    weights, alive = weights.copy(), alive.copy()
    weights[beyond, new], weights[beyond, best], alive[new] = weights[beyond, best], 0, True
    quats, translations = discovery.quats.copy(), discovery.translations.copy()
    centers = np.asarray(canonical.centers).copy()
    quats[:, new], translations[:, new], centers[new] = quats[:, best], translations[:, best], centers[best]
    born, rests = discovery.born.copy(), discovery.rests.copy()
    born[new] = count + 1
    rests[[best, new]] = count + _REST * config.unify.every
    discovery = discovery._replace(
        canonical=canonical._replace(centers=jnp.asarray(centers)),
        quats=quats,
        translations=translations,
        born=born,
        rests=rests,
        divided=(*discovery.divided, (new, best)),
    )
    return _refitted(run, _with_parts(discovery, weights, alive), weights)


def _with_parts(
    discovery: Discovery, weights: Float[np.ndarray, "M P"], alive: Bool[np.ndarray, "P"]
) -> Discovery:
    """The discovery with other slots alive, and part radii to match these weights."""
    canonical = discovery.canonical
    means, centers = np.asarray(canonical.movable.means), np.asarray(canonical.centers)
    radii = jnp.asarray(radii_of(means, weights.argmax(-1), centers))
    return discovery._replace(canonical=canonical._replace(alive=jnp.asarray(alive), radii=radii))


def _refitted(run: Run, discovery: Discovery, weights: Float[np.ndarray, "M P"]) -> Run:
    """The run with this discovery and a field fitted to the weights."""
    canonical = discovery.canonical
    field, _ = fit_field_to_weights(
        run.params.field, canonical.located, jnp.asarray(weights), canonical.alive, _REWARM
    )
    return run.having(params=run.params._replace(field=field), kept=discovery)
