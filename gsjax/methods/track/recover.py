"""Recovery of a lost group: many places are guessed and aligned, and the one where most of it shows is kept.

Residuals cannot choose, for they take what hides a group, or lies outside the pictures, for a disagreement.
So `confidence` does, with the Gaussians of the first frame that would face each camera. The result is a
guess, from which the next frame goes on, until enough of the group shows there for it to be found: in two
frames, for of many guesses one may agree by chance.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Key

from gsjax.methods.track.align import align, coarse_shifts, compose, turned, widened
from gsjax.methods.track.config import AlignConfig
from gsjax.methods.track.layers import Shown
from gsjax.methods.track.lost import COLOR_SCALE, Confidence, confidence
from gsjax.methods.track.points import Points, Sight, sum_of_three
from gsjax.methods.track.reference import ReferencePoints, as_facing

_LARGEST_TURN = 2.0  # radians; a camera that looks for a point has seldom lost it from sight by less
_NEAR_GUESS = 0.3  # radians; how a guess that goes on from a guess is turned
_STARTS = 8  # guesses that are aligned
_ROUNDS = 2  # in which turns of the best are tried


def relative_twists(twists: Float[Array, "*k 6"], moved: Float[Array, "*k 6"]) -> Float[Array, "*k 6"]:
    """The same places as after `twists`, from where groups are after `moved`, both about the same centres."""
    turns = jaxlie.SO3.exp(twists[..., 3:]) @ jaxlie.SO3.exp(moved[..., 3:]).inverse()
    return jnp.concatenate([twists[..., :3] - moved[..., :3], turns.log()], axis=-1)


class Relocation(NamedTuple):
    """Another place where a lost group may be."""

    twists: Float[Array, "*k 6"]  # from where it is believed to be
    sure: Confidence
    before: Confidence  # of the last frame's guess, aligned: what agreed by chance does not again


class SearchContext(NamedTuple):
    """The images that a lost group is looked for in, and what hides it there."""

    sight: Sight
    background: Float[Array, "c h w"] | None  # its depth, metres, where it is known; else 0
    others: Float[Array, "c h w"]  # depth of groups that are not in doubt, see `depths_of_others`
    unexplained_pixels: Points  # pixels of the last frame that no group explains


def recover(
    key: Key[Array, ""],
    reference: ReferencePoints,
    center: Float[Array, "3"],
    guess: Float[Array, "6"],
    around: SearchContext,
    config: AlignConfig,
    gap: float,
) -> Relocation:
    """The place where most of one lost group shows.

    Args:
        key: of the random places.
        reference: of the group.
        center: what it turns about.
        guess: the result of the last frame, from where the group is believed to be now.
        around: what it is looked for in.
        gap: see `confidence`.
    """
    sight = around.sight

    def shown(twists, reference) -> Confidence:
        points = jax.vmap(as_facing, in_axes=(None, 0, None, None))(reference, twists, center, sight)
        return confidence(points, sight, gap, around.background, around.others)

    def aligned(twist):
        faces = as_facing(reference, twist, center, sight).seen
        points = as_facing(reference, jnp.zeros_like(twist), center, sight)._replace(seen=faces)
        for scales in (widened(config), config):
            twist = align(twist, points, center, sight, scales)
        return twist

    def places(twists) -> tuple[Float[Array, "n 6"], Confidence]:
        """As they are, and then aligned."""
        twists = jnp.concatenate([twists, jax.vmap(aligned)(twists)])
        return twists, shown(twists, reference)

    def best(places) -> tuple[Float[Array, "6"], Confidence]:
        return jax.tree.map(lambda a: a[jnp.argmax(evidence(places[1]))], places)

    tried, shifts = guess[None], coarse_shifts(config, sight)
    if len(shifts):
        few = jax.tree.map(lambda a: a[..., ::4], reference)
        drawn = guesses(key, shifts, reference, center, around.unexplained_pixels, guess, config)
        most = jax.lax.top_k(evidence(shown(drawn, few)), min(_STARTS, len(drawn)))[1]
        tried = jnp.concatenate([tried, drawn[most]])
    found = places(tried)
    _, before = best(jax.tree.map(lambda a: a[:: len(tried)], found))  # the guess, and the guess aligned
    twist, sure = best(found)
    if config.max_turn and config.turns:
        for _ in range(_ROUNDS):
            twist, sure = best(places(turned(twist, jnp.eye(3), config.turns)))
    return Relocation(twist, sure, before)


def evidence(sure: Confidence) -> Float[Array, "*k"]:
    """Evidence that a group is in a place: much of it shows there, and what shows agrees."""
    return jnp.where(sure.tells, sure.agrees * sure.shows, 0.0)


def depths_of_others(shown: Shown, doubtful: Bool[Array, "k"]) -> Float[Array, "c h w"]:
    """Depth of the groups that are not in doubt, where they were last seen; else 0. What shows these shows no
    group that is looked for: that may be where another is believed to be that is elsewhere itself."""
    sound = (shown.labels > 0) & ~doubtful[shown.labels - 1]
    return jnp.where(sound, shown.depths, 0.0)


def with_unexplained(
    shown: Shown, sight: Sight, num_groups: int, gap: float, thickness: float, coarseness: int
) -> Shown:
    """`shown`, where pixels that no group explains have the label num_groups + 1 and their measured depth.

    Args:
        gap: what is measured this much nearer than the background is not explained by it, metres ...
        thickness: ... and this much nearer than a group, metres.
        coarseness: n, where `shown` has every n-th pixel.
    """
    if sight.depths is None:
        return shown
    measured = sight.depths[:, ::coarseness, ::coarseness]
    nearest = shown.depths - jnp.where(shown.labels > 0, thickness, gap)
    unexplained = (measured > 0) & shown.covered & (measured < nearest)
    labels = jnp.where(unexplained, num_groups + 1, shown.labels)
    return shown._replace(labels=labels, depths=jnp.where(unexplained, measured, shown.depths))


def guesses(
    key: Key[Array, ""],
    shifts: Float[Array, "h 6"],
    reference: ReferencePoints,
    center: Float[Array, "3"],
    unexplained_pixels: Points,
    guess: Float[Array, "6"],
    config: AlignConfig,
) -> Float[Array, "h 6"]:
    """Places where a lost group may be: half of them at unexplained pixels and a quarter near by, turned at
    random, and a quarter near the guess.

    Args:
        key: of the random places.
        shifts: what is tried near by.
        reference: of the group. Those of about an unexplained pixel's colour are brought to it.
        center: what the group turns about.
        unexplained_pixels: pixels that no group explains, as each camera sees them.
        guess: see `recover`.
        config: without `max_turn` nothing is turned.
    """
    count = len(shifts)
    place, pair, axis, angle, small = jax.random.split(key, 5)
    to, colors, there = (jnp.moveaxis(a, 0, -2).reshape(*a.shape[1:-1], -1) for a in unexplained_pixels)
    any_there = there.sum() > 0
    chosen = jax.random.choice(place, len(there), (count,), p=there + ~any_there)
    apart = sum_of_three((colors[:, chosen, None] - reference.tones[:, None]) ** 2, axis=0) / COLOR_SCALE**2
    paired = jax.random.categorical(pair, jnp.where(reference.real, -apart, -jnp.inf))
    turns = jax.random.normal(axis, (count, 3))
    turns /= jnp.linalg.norm(turns, axis=1, keepdims=True)
    turns *= _LARGEST_TURN * jax.random.uniform(angle, (count, 1)) * (config.max_turn > 0)
    offsets = reference.means[:, paired].T - center
    away = to[:, chosen].T - center - jaxlie.SO3.exp(turns).apply(offsets)
    unexplained = (jnp.arange(count) % 2 == 1) & any_there
    far = jnp.concatenate([jnp.where(unexplained[:, None], away, shifts[:, :3]), turns], axis=1)
    nearly = _NEAR_GUESS * jax.random.normal(small, (count, 3)) * (config.max_turn > 0)
    near = compose(jnp.concatenate([shifts[:, :3] / 2, nearly], axis=1), jnp.broadcast_to(guess, far.shape))
    return jnp.where((jnp.arange(count) % 4 == 0)[:, None], near, far)
