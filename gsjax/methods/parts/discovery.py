"""How far a discovery is: the scene, which parts there are, and where they were in all frames found so far.
Now and then parts become one or two (MotionSplicer, section 3.2)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.rotations import normalize_quats, quats_to_matrices
from gsjax.methods.parts.config import PartsConfig
from gsjax.methods.parts.discover import Start, radii_of
from gsjax.methods.parts.stream import Canonical, StreamParams, skinning_weights, stream_step
from gsjax.methods.parts.trajectory import BACKGROUND
from gsjax.methods.parts.unify import Motions, best_cut, motions_of, unified
from gsjax.methods.parts.weights import fit_field_to_weights
from gsjax.optim.method import Run
from gsjax.scene.handles import HandlePose, at_rest

Pairs = tuple[tuple[int, int], ...]
"""Parts that became one, (part, into which), or two, (new part, of which)."""
_REWARM = 100  # steps that fit a grid after parts became one, or two
_REST = 4  # times that divisions are looked for and a part that was divided is left alone


class Discovery(NamedTuple):
    """What steps are given, and what changes between frames; `Run.kept` of `gsjax.methods.parts.Parts`.

    Attributes:
        canonical: the scene and which handles there are.
        order: rows of the given Gaussians, those that may move first.
        anchor: the canonical frame.
        quats, translations: poses at all frames, [T,P,4] and [T,P,3]; at rest where not yet found.
        found: position of each frame in the order in which frames were found; 0 is the anchor, -1 is not yet.
        born: number of frames that were found when each part's own motion began.
        rests: number of found frames up to which each part is not divided again.
        frame: the frame whose pose is being found, or was found last; -1 before the first.
        weights: of the movable Gaussians: before `frame`, or, once all frames are found, for good.
        predicted: where handles were before the first step of `frame`.
        joined: parts that became one: (part, into which).
        divided: parts that became two: (new part, of which).
    """

    canonical: Canonical
    order: Int[np.ndarray, "N"]
    anchor: int
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

    @property
    def done(self) -> Bool[np.ndarray, "T"]:
        """Which frames were found."""
        return self.found >= 0

    @property
    def count(self) -> int:
        """How many frames were found, the anchor left out."""
        return int(self.found.max())

    @property
    def is_between_frames(self) -> bool:
        """Whether the pose of the newest frame is found, or there is none yet."""
        return self.frame < 0 or bool(self.done[self.frame])

    def pose(self, t: int) -> HandlePose:
        """The pose at frame t; at rest where it is not yet found."""
        return HandlePose(jnp.asarray(self.quats[t]), jnp.asarray(self.translations[t]))

    @property
    def motions(self) -> Motions:
        """The motions of all parts, in the order in which frames were found."""
        order = np.argsort(self.found)[-self.count - 1 :]
        rotations = np.asarray(quats_to_matrices(jnp.asarray(self.quats[order])))
        return motions_of(rotations, self.translations[order], np.asarray(self.canonical.centers))


def order_of_frames(frames: int, anchor: int) -> list[int]:
    """Onwards from the anchor to the end, then back from it to the beginning."""
    return [*range(anchor + 1, frames), *reversed(range(anchor))]


def first_run(start: Start, frames: int, config: PartsConfig) -> Run:
    """The run before anything is followed: all parts are at rest.

    Args:
        start: from `begin`.
        frames: T.
        config: how parts are followed.
    """
    slots, count = len(start.canonical.alive), start.canonical.movable.num
    quats = np.zeros((frames, slots, 4), np.float32)
    quats[..., 0] = 1
    nothing, rest = np.zeros(slots, int), at_rest(slots)
    # Steps give away what they replace, and the start stays whole.
    field = jax.tree.map(jnp.copy, start.field)
    params = StreamParams(rest, field, jnp.zeros((count, 3), start.canonical.movable.means.dtype))
    discovery = Discovery(
        canonical=start.canonical,
        order=start.order,
        anchor=start.anchor.frame,
        quats=quats,
        translations=np.zeros((frames, slots, 3), np.float32),
        found=np.where(np.arange(frames) == start.anchor.frame, 0, -1),
        born=nothing,
        rests=nothing,
        frame=-1,
        weights=skinning_weights(start.field, start.canonical),
        predicted=at_rest(slots),
    )
    return Run(params, stream_step(config.stream).init(params), kept=discovery)


def opened(run: Run, t: int) -> Run:
    """The run before the first step of frame t, whose handles go on as from the frame before the last to the
    last."""
    discovery: Discovery = run.kept
    way = 1 if t > discovery.anchor else -1
    before, earlier = discovery.pose(t - way), t - 2 * way
    pose = before
    if 0 <= earlier < len(discovery.done) and discovery.done[earlier]:
        first = discovery.pose(earlier)
        quats = normalize_quats(2 * before.quats - first.quats)
        pose = HandlePose(quats, 2 * before.translations - first.translations)
    # Steps give away what they replace; what is kept stays whole.
    weights, predicted = jax.tree.map(jnp.copy, (weights_of_run(run), pose))
    kept = discovery._replace(frame=t, weights=weights, predicted=predicted)
    return run.having(params=run.params._replace(pose=pose), state=run.state.in_new_frame(), kept=kept)


def closed(run: Run, config: PartsConfig) -> Run:
    """The run after the last step of its frame: the pose is kept, and where it is time parts become one or
    two."""
    discovery: Discovery = run.kept
    t, quats, translations = discovery.frame, discovery.quats.copy(), discovery.translations.copy()
    found, count = discovery.found.copy(), discovery.count + 1
    quats[t], translations[t], found[t] = run.params.pose.quats, run.params.pose.translations, count
    run = run.having(kept=discovery._replace(quats=quats, translations=translations, found=found))
    last = count == len(found) - 1
    if config.unify.every and (count % config.unify.every == 0 or last):
        run = unify(run, config)
        if not last:
            run = split(run, config)
        run = run.having(state=run.state._replace(pulls=jnp.zeros_like(run.state.pulls)))
    return run


def weights_of_run(run: Run) -> Float[Array, "M P"]:
    """The weights of the movable Gaussians by the field of a run that follows parts."""
    return skinning_weights(run.params.field, run.kept.canonical)


def unify(run: Run, config: PartsConfig) -> Run:
    """The run in which parts that moved alike so far are one from here on, by the larger one's motion."""
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
    after, weights = joined(discovery, weights, into)
    return run if after is discovery else _refitted(run, after, weights)


def joined(
    discovery: Discovery, weights: Float[np.ndarray, "M P"], into: Int[np.ndarray, "P"]
) -> tuple[Discovery, Float[np.ndarray, "M P"]]:
    """The discovery and the weights after each part has joined the one that `into` names, itself for those
    that stay. Slots whose part has no Gaussian left are free again.

    Args:
        discovery: before.
        weights: of the movable Gaussians.
        into: a part for each part.
    """
    pairs = tuple((int(p), int(q)) for p, q in enumerate(into) if p != q)
    alive, members = np.asarray(discovery.canonical.alive), np.unique(weights.argmax(-1))
    left = np.isin(np.arange(len(alive)), [BACKGROUND, *members]) & (into == np.arange(len(alive)))
    if (left == alive).all():
        return discovery, weights
    weights = np.where(left, weights @ np.eye(len(into), dtype=np.float32)[into], 0)
    weights = weights / weights.sum(-1, keepdims=True)
    return _with_parts(discovery, weights, left)._replace(joined=(*discovery.joined, *pairs)), weights


def split(run: Run, config: PartsConfig) -> Run:
    """The run in which the part whose sides are pulled apart most is two from here on, if there is a slot and
    it is no chance. Both move as the one did, and become one again where they go on to."""
    discovery: Discovery = run.kept
    canonical = discovery.canonical
    weights, alive = np.asarray(weights_of_run(run)), np.asarray(canonical.alive)
    points, pulls = np.asarray(canonical.movable.means), np.asarray(run.state.pulls)
    labels, free, count = weights.argmax(-1), np.flatnonzero(~alive), discovery.count
    waking = [p for p in np.unique(labels).tolist() if p != BACKGROUND and discovery.rests[p] <= count]
    cuts = {p: best_cut(points[labels == p], pulls[labels == p]) for p in waking}
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
    """With these parts, as far as these weights reach."""
    canonical = discovery.canonical
    means, centers = np.asarray(canonical.movable.means), np.asarray(canonical.centers)
    radii = jnp.asarray(radii_of(means, weights.argmax(-1), centers))
    return discovery._replace(canonical=canonical._replace(alive=jnp.asarray(alive), radii=radii))


def _refitted(run: Run, discovery: Discovery, weights: Float[np.ndarray, "M P"]) -> Run:
    """The run with a field fitted to these weights."""
    canonical = discovery.canonical
    field, _ = fit_field_to_weights(
        run.params.field, canonical.located, jnp.asarray(weights), canonical.alive, _REWARM
    )
    return run.having(params=run.params._replace(field=field), kept=discovery)
