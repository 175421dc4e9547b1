"""The host's loop: frame after frame away from the anchor, first onwards and then back; poses of the past are
frozen, weights are shared, and now and then parts become one or two."""

from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from time import perf_counter
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.rotations import normalize_quats, quats_to_matrices
from gsjax.losses.extra import ExtraLosses, named_losses
from gsjax.methods.parts.config import PartsConfig, StreamConfig
from gsjax.methods.parts.discover import Start, Views, radii_of
from gsjax.methods.parts.stream import (
    Canonical,
    Seen,
    StreamBatch,
    StreamParams,
    StreamState,
    posed,
    skinning_weights,
    stream_step,
)
from gsjax.methods.parts.trajectory import BACKGROUND
from gsjax.methods.parts.unify import Motions, best_cut, motions_of, unified
from gsjax.methods.parts.weights import saying
from gsjax.optim.compiler import host_options
from gsjax.rasterize.plan import Plan
from gsjax.scene.frame import Frame, one_camera, part_of
from gsjax.scene.handles import Blend, HandlePose, at_rest, skin
from gsjax.scene.region import TILE, tiles_to_pixels, touched_tiles
from gsjax.scene.render import plan_render

_HALF, _WHOLE = 2, 1  # sizes of pictures, by how many times smaller they are
_REWARM = 100  # steps after parts became one, or two
_REST = 4  # looks that pass before a part is divided again


class Followed(NamedTuple):
    """What is known after one more frame.

    Attributes:
        t: the frame.
        parts: everything so far.
        losses: of this frame's steps.
        skipped: steps that changed nothing, because a number in them was not finite.
        seconds: that it took, without what compiled.
        compile_seconds: that compiling took in it.
        joined: what became one: (part, into which).
        divided: what became two: (new part, of which).
    """

    t: int
    parts: "Parts"
    losses: Float[np.ndarray, "iterations"]
    skipped: int
    seconds: float
    compile_seconds: float
    joined: list[tuple[int, int]]
    divided: list[tuple[int, int]]


class Parts(NamedTuple):
    """The state of a discovery, to go on from.

    Attributes:
        canonical: the scene and which handles there are.
        params: the pose at the last frame, and what weights are made of.
        state: of the optimizer.
        quats, translations: poses at all frames, [T,P,4] and [T,P,3]; at rest where not yet found.
        found: of each frame, as which it was found; 0 is the anchor, -1 is not yet.
        born: of each part, with the how-manieth frame its own motion begins.
        rests: of each part, until which frame it is not divided again.
    """

    canonical: Canonical
    params: StreamParams
    state: StreamState
    quats: Float[np.ndarray, "T P 4"]
    translations: Float[np.ndarray, "T P 3"]
    found: Int[np.ndarray, "T"]
    born: Int[np.ndarray, "P"]
    rests: Int[np.ndarray, "P"]

    @property
    def weights(self) -> Float[Array, "M P"]:
        """Of the movable Gaussians."""
        return skinning_weights(self.params.field, self.canonical)

    @property
    def done(self) -> Bool[np.ndarray, "T"]:
        """Which frames were found."""
        return self.found >= 0

    @property
    def count(self) -> int:
        """How many frames were found after the anchor."""
        return int(self.found.max())

    def pose(self, t: int) -> HandlePose:
        """At frame t; at rest where it is not yet found."""
        return HandlePose(jnp.asarray(self.quats[t]), jnp.asarray(self.translations[t]))

    @property
    def motions(self) -> Motions:
        """Of all parts, in the order in which frames were found."""
        order = np.argsort(self.found)[-self.count - 1 :]
        rotations = np.asarray(quats_to_matrices(jnp.asarray(self.quats[order])))
        return motions_of(rotations, self.translations[order], np.asarray(self.canonical.centers))


def first_parts(start: Start, frames: int, config: PartsConfig) -> Parts:
    """Before anything is followed: all at rest.

    Args:
        start: where all begins.
        frames: how many there will be.
        config: how parts are followed.
    """
    slots, count = len(start.canonical.alive), start.canonical.movable.num
    params = StreamParams(at_rest(slots), start.field)
    quats = np.zeros((frames, slots, 4), np.float32)
    quats[..., 0] = 1
    translations = np.zeros((frames, slots, 3), np.float32)
    found = np.where(np.arange(frames) == start.anchor.frame, 0, -1)
    state = stream_step(config.stream).init(params, count)
    nothing = np.zeros(slots, int)
    return Parts(start.canonical, params, state, quats, translations, found, nothing, nothing)


def order_of_frames(frames: int, anchor: int) -> list[int]:
    """Onwards from the anchor to the end, then back from it to the beginning."""
    return [*range(anchor + 1, frames), *reversed(range(anchor))]


def follow(
    views: Views, start: Start, parts: Parts, config: PartsConfig, *, extra_losses: ExtraLosses = ()
) -> Iterator[Followed]:
    """Frame by frame, until all are found. The same parts, start and config give the same bits, wherever the
    discovery was begun or resumed.

    Args:
        views: what the cameras saw.
        start: from `begin`.
        parts: from `first_parts`, or those of an earlier `Followed`.
        config: how.
        extra_losses: functions `loss(scene, rendered, frame)` (`gsjax.losses.extra`) of one's own, whose
            scene is a `PosedScene`; give `refine` the same.
    """
    named_losses(extra_losses)  # before it is a key, which a list cannot be
    run = _Frames(views, config, extra_losses)
    order = order_of_frames(views.num_frames, start.anchor.frame)
    for count, t in enumerate(order, 1):
        if parts.done[t]:
            continue
        begun = perf_counter()
        parts, losses, skipped, compiling = run.found(parts, t, 1 if t > start.anchor.frame else -1)
        changes: dict[str, list[tuple[int, int]]] = {"joined": [], "divided": []}
        if config.unify.every and (count % config.unify.every == 0 or count == len(order)):
            parts, changes["joined"] = unify(parts, config)
            if count < len(order):
                parts, changes["divided"] = split(parts, config)
            state = parts.state._replace(pulls=jnp.zeros_like(parts.state.pulls))
            parts = parts._replace(state=state)
        seconds = perf_counter() - begun - compiling
        yield Followed(t, parts, losses, skipped, seconds, compiling, **changes)


class _Frames:
    """Finds the pose at one frame after the other; keeps pictures of the past, and plans."""

    def __init__(self, views: Views, config: PartsConfig, extra_losses: ExtraLosses):
        self._views, self._config = views, config
        self._advance = _compiled(config.stream, extra_losses)
        self._past: dict[int, Frame] = {}  # pictures of half the size, on the host, colours in bytes
        self._plans: dict[int, Plan] = {}
        self._known: set[Any] = set()

    def found(
        self, parts: Parts, t: int, way: int
    ) -> tuple[Parts, Float[np.ndarray, "iterations"], int, float]:
        """Parts with the pose at frame t, all losses, how many steps were skipped, seconds of compiling."""
        config, rng = self._config.stream, np.random.default_rng((self._config.seed, t))
        before, canonical = parts.pose(t - way), parts.canonical
        # Steps give away what they replace; the parts of the last frame stay whole.
        field = jax.tree.map(jnp.copy, parts.params.field)
        params, state = StreamParams(_predicted(parts, t, way, before), field), parts.state.in_new_frame()
        weights = parts.weights
        frame = self._views.frame(t)
        now = {
            size: seen_at(
                part_of(frame, (), size), canonical, weights, params.pose, TILE // size, blend=config.blend
            )
            for size in (_HALF, _WHOLE)
        }
        past = np.flatnonzero(parts.found >= parts.born[np.asarray(canonical.alive)].max())
        past = past if len(past) else np.array([parts.found.argmax()])
        looks, losses, skipped, compiling = _turns(rng, len(frame.images)), [], 0, 0.0
        for i in range(config.iterations):
            size = _HALF if i < config.coarse * config.iterations else _WHOLE
            back = [(int(rng.choice(past)), int(rng.integers(len(frame.images)))) for _ in range(config.past)]
            while True:
                plan = self._plan(size, now, parts, weights)
                batch = StreamBatch(canonical, one_camera(now[size], looks(i)), plan, weights)
                if back:
                    seen = tuple(self._seen_then(u, c, canonical, weights, parts) for u, c in back)
                    batch = batch._replace(past=seen, past_plan=self._plan(_HALF, now, parts, weights))
                begun = perf_counter()
                params, state, info = self._advance(params, state, batch, i / config.iterations)
                grown = self._grown(info, size)
                if (key := (size, batch.plan, batch.past_plan)) not in self._known:
                    self._known.add(key)
                    compiling += perf_counter() - begun
                if not grown:
                    break
            losses.append(info["now"])
            skipped += int(info["skipped"])
        self._past[t] = _on_host(now[_HALF].frame)
        quats, translations, found = parts.quats.copy(), parts.translations.copy(), parts.found.copy()
        quats[t], translations[t], found[t] = params.pose.quats, params.pose.translations, parts.count + 1
        parts = parts._replace(
            params=params, state=state, quats=quats, translations=translations, found=found
        )
        return parts, np.asarray(losses), skipped, compiling

    def _seen_then(
        self, u: int, c: int, canonical: Canonical, weights: Array, parts: Parts
    ) -> tuple[Seen, HandlePose]:
        """What one camera saw in a frame of the past, and where handles were."""
        if u not in self._past:
            self._past[u] = _on_host(part_of(self._views.frame(u), (), _HALF))
        frame = one_camera(self._past[u], c)
        frame = eqx.tree_at(lambda f: f.images, frame, jnp.asarray(frame.images, jnp.float32) / 255)
        blend = self._config.stream.blend
        return seen_at(frame, canonical, weights, parts.pose(u), TILE // _HALF, blend=blend), parts.pose(u)

    def _plan(self, size: int, now: dict[int, Seen], parts: Parts, weights: Array) -> Plan:
        if size not in self._plans:
            scene = posed(parts.canonical, weights, parts.pose(int(np.argmax(parts.found))))
            cameras = now[size].frame.cameras
            self._plans[size] = plan_render(scene, cameras, headroom=self._config.headroom)
        return self._plans[size]

    def _grown(self, info: dict[str, Array], size: int) -> bool:
        """Whether a plan was too small, which is then larger."""
        grown = False
        for of, told in ((size, "overflow"), (_HALF, "past_overflow")):
            if told in info and bool(info[told]):
                needed = int(info[told.replace("overflow", "needed")])
                self._plans[of] = self._plans[of].grown(needed, self._config.headroom)
                grown = True
        return grown


@lru_cache(maxsize=2)
def _compiled(config: StreamConfig, extra_losses: ExtraLosses) -> Callable:
    """The jitted step; what it replaces is given away."""
    step = stream_step(config, extra_losses)

    @partial(jax.jit, compiler_options=host_options(), donate_argnums=(0, 1))
    def advance(params, state, batch, share):
        return step.update(params, state, batch, step=share, key=None)

    return advance


def _predicted(parts: Parts, t: int, way: int, before: HandlePose) -> HandlePose:
    """Where handles are if they go on as from the frame before the last to the last."""
    earlier = t - 2 * way
    if not (0 <= earlier < len(parts.done) and parts.done[earlier]):
        return before
    first = parts.pose(earlier)
    quats = normalize_quats(2 * before.quats - first.quats)
    return HandlePose(quats, 2 * before.translations - first.translations)


@partial(jax.jit, static_argnames=("tile", "blend"))
def seen_at(
    frame: Frame, canonical: Canonical, weights: Array, pose: HandlePose, tile: int = TILE, *, blend: Blend
) -> Seen:
    """Pixels count where what moves is, and where it was in the canonical scene.

    Args:
        frame: what cameras saw.
        canonical: the scene.
        weights: of its movable Gaussians, [M,P].
        pose: where handles are.
        tile: pixels a side of what counts together.
        blend: of rotations.
    """
    moves = weights[:, BACKGROUND] < 0.5
    moved = skin(canonical.movable, weights, canonical.centers, pose, blend).means
    # What stands still is put behind all cameras' backs, where it touches nothing.
    nowhere = jnp.full_like(moved, jnp.nan)
    places = [jnp.where(moves[:, None], means, nowhere) for means in (moved, canonical.movable.means)]
    return Seen(frame, tiles_to_pixels(touched_tiles(places, frame, tile), frame, tile))


def _turns(rng: np.random.Generator, cameras: int) -> Callable[[int], int]:
    """Which camera a step looks at: all in a random order, and then in another."""
    order = np.concatenate([rng.permutation(cameras) for _ in range(64)])
    return lambda i: int(order[i % len(order)])


def _on_host(frame: Frame) -> Frame:
    images = np.round(255 * np.asarray(frame.images)).astype(np.uint8)
    rest = jax.tree.map(np.asarray, frame)
    return eqx.tree_at(lambda f: f.images, rest, images)


def unify(parts: Parts, config: PartsConfig) -> tuple[Parts, list[tuple[int, int]]]:
    """Parts that moved alike so far are one from here on, by the larger one's motion; and who joined whom."""
    into = unified(
        parts.motions,
        np.asarray(parts.canonical.movable.means),
        np.asarray(parts.weights).argmax(-1),
        np.asarray(parts.canonical.alive),
        parts.born,
        noise_m=config.unify.noise * float(parts.canonical.pixel),
        tolerance=config.unify.tolerance,
    )
    return joined(parts, into)


def joined(parts: Parts, into: Int[np.ndarray, "P"]) -> tuple[Parts, list[tuple[int, int]]]:
    """Parts after each has joined the one that `into` names, itself for those that stay; and those that did.
    Slots whose part has no Gaussian left are free again."""
    pairs = [(int(p), int(q)) for p, q in enumerate(into) if p != q]
    weights, alive = np.asarray(parts.weights), np.asarray(parts.canonical.alive).copy()
    members = np.unique(weights.argmax(-1))
    left = np.isin(np.arange(len(alive)), [BACKGROUND, *members]) & (into == np.arange(len(alive)))
    if (left == alive).all():
        return parts, pairs
    weights = np.where(left, weights @ np.eye(len(into), dtype=np.float32)[into], 0)
    return _with_weights(parts, weights / weights.sum(-1, keepdims=True), left), pairs


def split(parts: Parts, config: PartsConfig) -> tuple[Parts, list[tuple[int, int]]]:
    """The part whose sides are pulled apart most is two from here on, if there is a slot and it is no chance;
    and (new part, of which). Both move as the one did, and become one again where they go on to."""
    weights, alive = np.asarray(parts.weights), np.asarray(parts.canonical.alive)
    points, pulls = np.asarray(parts.canonical.movable.means), np.asarray(parts.state.pulls)
    labels, free = weights.argmax(-1), np.flatnonzero(~alive)
    waking = [p for p in np.unique(labels).tolist() if p != BACKGROUND and parts.rests[p] <= parts.count]
    cuts = {p: best_cut(points[labels == p], pulls[labels == p]) for p in waking}
    best = max(cuts, key=lambda p: cuts[p].score, default=BACKGROUND)
    if best == BACKGROUND or not len(free) or cuts[best].score < config.unify.least_cut:
        return parts, []
    new, beyond = int(free[0]), np.flatnonzero(labels == best)[cuts[best].beyond]
    weights, alive = weights.copy(), alive.copy()
    weights[beyond, new], weights[beyond, best], alive[new] = weights[beyond, best], 0, True
    quats, translations = parts.quats.copy(), parts.translations.copy()
    centers = np.asarray(parts.canonical.centers).copy()
    quats[:, new], translations[:, new], centers[new] = quats[:, best], translations[:, best], centers[best]
    born, rests = parts.born.copy(), parts.rests.copy()
    born[new] = parts.count + 1
    rests[[best, new]] = parts.count + _REST * config.unify.every
    canonical = parts.canonical._replace(centers=jnp.asarray(centers))
    parts = parts._replace(
        canonical=canonical, quats=quats, translations=translations, born=born, rests=rests
    )
    return _with_weights(parts, weights, alive), [(new, best)]


def _with_weights(parts: Parts, weights: np.ndarray, alive: np.ndarray) -> Parts:
    """With a field that says these weights."""
    centers, labels = np.asarray(parts.canonical.centers), weights.argmax(-1)
    radii = jnp.asarray(radii_of(np.asarray(parts.canonical.movable.means), labels, centers))
    canonical = parts.canonical._replace(alive=jnp.asarray(alive), radii=radii)
    targets = jnp.asarray(weights), canonical.alive
    field, _ = saying(parts.params.field, canonical.located, *targets, _REWARM)
    return parts._replace(canonical=canonical, params=parts.params._replace(field=field))
