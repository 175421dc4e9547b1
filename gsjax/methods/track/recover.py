"""Relocation of a lost group: many guesses are aligned, and the one where most of the group shows is kept.

Residuals cannot choose among guesses, because they count as disagreement what hides a group or lies outside
the images. So `group_confidence` chooses, from the Gaussians of the first frame that would face each camera.
The result is again a guess, from which the next frame continues, until enough of the group shows there for it
to be found, in two frames: among many guesses one may agree by chance.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Key

from gsjax.methods.track.align import align_from_afar, coarse_shifts, compose, turn_hypotheses
from gsjax.methods.track.config import AlignConfig
from gsjax.methods.track.layers import Shown
from gsjax.methods.track.lost import COLOR_SCALE, Confidence, group_confidence
from gsjax.methods.track.points import Points, ToneImages, sum_of_three
from gsjax.methods.track.reference import ReferencePoints, points_facing

_LARGEST_TURN = 2.0  # radians; beyond it, the points that were visible seldom still face the camera
_NEAR_TURN = 0.3  # radians; standard deviation of turns near the last guess, per axis
_STARTS = 8  # guesses that are aligned
_ROUNDS = 2  # of turns that are tried from the best


def relative_twists(twists: Float[Array, "*k 6"], moved: Float[Array, "*k 6"]) -> Float[Array, "*k 6"]:
    """The twists that lead from the places after `moved` to those after `twists`, about the same centres."""
    turns = jaxlie.SO3.exp(twists[..., 3:]) @ jaxlie.SO3.exp(moved[..., 3:]).inverse()
    return jnp.concatenate([twists[..., :3] - moved[..., :3], turns.log()], axis=-1)


class Relocation(NamedTuple):
    """Another place where a lost group may be."""

    twists: Float[Array, "*k 6"]  # from where it is believed to be
    confidence: Confidence
    guess_confidence: Confidence  # in the last frame's guess, aligned: agreement by chance does not recur


class SearchContext(NamedTuple):
    """The images in which a lost group is searched for, and what hides it there."""

    images: ToneImages
    background: Float[Array, "c h w"] | None  # its depth, metres, 0 if unknown
    others: Float[Array, "c h w"]  # depth of the groups that are not in doubt, see `depths_of_others`
    unexplained_pixels: Points  # of the last frame


def recover(
    key: Key[Array, ""],
    reference: ReferencePoints,
    center: Float[Array, "3"],
    guess: Float[Array, "6"],
    context: SearchContext,
    config: AlignConfig,
    gap: float,
) -> Relocation:
    """The place where most of one lost group shows.

    Args:
        key: random key of the guesses.
        reference: reference points of the group.
        center: centroid of the group, metres.
        guess: result of the last frame, as a twist from where the group is believed to be now.
        context: the images.
        config: configuration of the alignment.
        gap: see `group_confidence`.
    """
    images = context.images

    def shown(twists, reference) -> Confidence:
        points = jax.vmap(points_facing, in_axes=(None, 0, None, None))(reference, twists, center, images)
        return group_confidence(points, images, gap, context.background, context.others)

    def aligned(twist):
        faces = points_facing(reference, twist, center, images).seen
        points = points_facing(reference, jnp.zeros_like(twist), center, images)._replace(seen=faces)
        return align_from_afar(twist, points, center, images, config)

    def places(twists) -> tuple[Float[Array, "n 6"], Confidence]:
        """The twists as they are, and then aligned."""
        twists = jnp.concatenate([twists, jax.vmap(aligned)(twists)])
        return twists, shown(twists, reference)

    def best(places) -> tuple[Float[Array, "6"], Confidence]:
        return jax.tree.map(lambda a: a[jnp.argmax(evidence(places[1]))], places)

    tried, shifts = guess[None], coarse_shifts(config, images)
    if len(shifts):
        few = jax.tree.map(lambda a: a[..., ::4], reference)
        drawn = draw_guesses(key, shifts, reference, center, context.unexplained_pixels, guess, config)
        most = jax.lax.top_k(evidence(shown(drawn, few)), min(_STARTS, len(drawn)))[1]
        tried = jnp.concatenate([tried, drawn[most]])
    rounds = _ROUNDS if config.max_turn and config.turns else 0
    count = max(len(tried), 1 + 6 * len(config.turns)) if rounds else len(tried)
    tried = jnp.concatenate([tried, jnp.broadcast_to(guess, (count - len(tried), 6))])

    def one_round(i, last: Relocation) -> Relocation:
        """What was drawn, and then turns of the best, all by one program."""
        turned = turn_hypotheses(last.twists, jnp.eye(3), config.turns) if rounds else tried
        turned = jnp.concatenate([turned, jnp.broadcast_to(last.twists, (count - len(turned), 6))])
        found = places(jnp.where(i == 0, tried, turned))
        of_guess = best(jax.tree.map(lambda a: a[::count], found))[1]  # the guess as it is, and aligned
        of_guess = jax.tree.map(partial(jnp.where, i == 0), of_guess, last.guess_confidence)
        return Relocation(*best(found), of_guess)

    nothing = jnp.zeros((), guess.dtype)
    unknown = Confidence(nothing, nothing, nothing > 0)
    return jax.lax.fori_loop(0, 1 + rounds, one_round, Relocation(guess, unknown, unknown))


def evidence(confidence: Confidence) -> Float[Array, "*k"]:
    """Evidence that a group is in a place: much of it shows there, and agrees."""
    return jnp.where(confidence.conclusive, confidence.agreement * confidence.coverage, 0.0)


def depths_of_others(shown: Shown, doubtful: Bool[Array, "k"]) -> Float[Array, "c h w"]:
    """Depth of the groups that are not in doubt, where they were last seen; else 0. A pixel that shows one of
    these shows no group that is searched for. A doubtful group may be elsewhere itself, so it has none."""
    sound = (shown.labels > 0) & ~doubtful[shown.labels - 1]
    return jnp.where(sound, shown.depths, 0.0)


def label_unexplained(
    shown: Shown, images: ToneImages, num_groups: int, gap: float, thickness: float, coarseness: int
) -> Shown:
    """`shown`, in which pixels that no group explains have the label num_groups + 1 and their measured depth.

    Args:
        shown: what the scene shows, of every n-th pixel.
        images: the frame.
        num_groups: K.
        gap: the background does not explain depth that is nearer by more than this, metres.
        thickness: a group does not explain depth that is nearer by more than this, metres.
        coarseness: n.
    """
    if images.depths is None:
        return shown
    measured = images.depths[:, ::coarseness, ::coarseness]
    nearest = shown.depths - jnp.where(shown.labels > 0, thickness, gap)
    unexplained = (measured > 0) & shown.covered & (measured < nearest)
    labels = jnp.where(unexplained, num_groups + 1, shown.labels)
    return shown._replace(labels=labels, depths=jnp.where(unexplained, measured, shown.depths))


def draw_guesses(
    key: Key[Array, ""],
    shifts: Float[Array, "h 6"],
    reference: ReferencePoints,
    center: Float[Array, "3"],
    unexplained_pixels: Points,
    guess: Float[Array, "6"],
    config: AlignConfig,
) -> Float[Array, "h 6"]:
    """Random places where a lost group may be: half of them at unexplained pixels and a quarter nearby, both
    turned at random, and a quarter near the last guess.

    Args:
        key: random key.
        shifts: shifts of the places nearby.
        reference: reference points of the group. One of a similar colour is brought to an unexplained pixel.
        center: centroid of the group, metres.
        unexplained_pixels: pixels that no group explains, in each camera.
        guess: see `recover`.
        config: nothing is turned if its `max_turn` is 0.
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
    small_turns = _NEAR_TURN * jax.random.normal(small, (count, 3)) * (config.max_turn > 0)
    nearby = jnp.concatenate([shifts[:, :3] / 2, small_turns], axis=1)
    near = compose(nearby, jnp.broadcast_to(guess, far.shape))
    return jnp.where((jnp.arange(count) % 4 == 0)[:, None], near, far)
