"""Relocation of a lost group: the best of many guesses are aligned, and the one at which most of the group is
seen is kept.

Residuals cannot rank guesses, because they count occluded points, and those outside the images, as
disagreement. So `group_confidence` ranks them, by the Gaussians of the first frame that would face each
camera. The result is itself a guess, from which the next frame continues until enough of the group is seen
there for it to be found: in two frames unless agreement is high, because among many guesses one may agree by
chance.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Key

from gsjax.methods.track.align import (
    align,
    align_coarse_to_fine,
    coarse_shifts,
    compose,
    principal_axes,
    rotation_hypotheses,
)
from gsjax.methods.track.config import AlignConfig
from gsjax.methods.track.layers import Shown
from gsjax.methods.track.lost import COLOR_SCALE, Confidence, group_confidence
from gsjax.methods.track.points import Points, ToneImages, pixels_of_groups, sum_of_three
from gsjax.methods.track.reference import ReferencePoints, points_facing
from gsjax.optim.compiler import in_memory

_LARGEST_TURN = 2.0  # radians; beyond it, the points that were visible seldom still face the camera
_NEAR_TURN = 0.3  # radians; standard deviation of rotations near the last guess, per axis
_AT_PIXELS = 4  # guesses at unexplained pixels for each coarse shift
_STARTS = (6, 18, 14)  # guesses of each kind that are aligned, with a quarter of the points
_ROUNDS = 2  # of rotations that are tried from the best of them


def relative_twists(twists: Float[Array, "*k 6"], moved: Float[Array, "*k 6"]) -> Float[Array, "*k 6"]:
    """The twists that lead from the poses after `moved` to those after `twists`, about the same centres."""
    turns = jaxlie.SO3.exp(twists[..., 3:]) @ jaxlie.SO3.exp(moved[..., 3:]).inverse()
    return jnp.concatenate([twists[..., :3] - moved[..., :3], turns.log()], axis=-1)


class Relocation(NamedTuple):
    """Another place where a lost group may be."""

    twists: Float[Array, "*k 6"]  # from where it is believed to be
    confidence: Confidence
    guess_confidence: Confidence  # at the last frame's guess, aligned: agreement by chance does not recur


class SearchContext(NamedTuple):
    """The images in which a lost group is searched for, and what may occlude it there."""

    images: ToneImages
    background: Float[Array, "c h w"] | None  # its depth, metres, 0 if unknown
    others: Float[Array, "c h w"]  # depth of the groups that are not in doubt, see `depths_of_others`
    unexplained: Points  # pixels of the images that the last scene does not explain


def recover(
    key: Key[Array, ""],
    reference: ReferencePoints,
    center: Float[Array, "3"],
    guess: Float[Array, "6"],
    context: SearchContext,
    config: AlignConfig,
    gap: float,
) -> Relocation:
    """The place where most of one lost group is seen.

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

    def places(twists, by: ReferencePoints, how) -> tuple[Float[Array, "n 6"], Confidence]:
        """The twists as they are, then aligned with the points `by`; and the confidence in each, from all."""

        def aligned(twist):
            faces = points_facing(by, twist, center, images).seen
            points = points_facing(by, jnp.zeros_like(twist), center, images)._replace(seen=faces)
            return how(twist, points, center, images, config)

        twists = in_memory(jnp.concatenate([twists, jax.vmap(aligned)(twists)]), images.cameras.K)
        return twists, shown(twists, reference)

    few = jax.tree.map(lambda a: a[..., ::4], reference)
    tried, shifts = [guess[None]], coarse_shifts(config, images)
    axes = principal_axes(Points(reference.means[None], reference.tones[None], reference.real[None]), center)
    if len(shifts):
        near, around, spun = jax.random.split(key, 3)
        drawn = (
            guesses_near(near, shifts, guess, config),
            guesses_at(around, shifts, few, center, context.unexplained, config),
            guesses_spun(spun, len(shifts), axes, reference, center, guess, config),
        )
        drawn = in_memory(drawn, images.cameras.K)
        for kind, most in zip(drawn, _STARTS, strict=True):
            best = jax.lax.top_k(evidence(shown(kind, few)), min(most, len(kind)))[1]
            tried.append(kind[best])
    tried = jnp.concatenate(tried)
    turns = config.turns if config.max_turn else ()
    each = 1 + 6 * len(turns)
    beam = max(len(tried) // each, 1) if turns else 1
    count = max(len(tried), beam * each)

    def padded(twists):
        return jnp.concatenate([twists, jnp.broadcast_to(guess, (count - len(twists), 6))])

    def one_round(_, tried):
        """The best of the twists tried so far, and rotations of these."""
        twists, confidence = places(tried, few, partial(align, widen=config.widen))
        best = best_distinct(beam, twists, evidence(confidence), config)
        turned = [rotation_hypotheses(twist, axes, turns) if turns else twist[None] for twist in best]
        return padded(jnp.concatenate(turned))

    tried = jax.lax.fori_loop(0, 1 + (_ROUNDS if turns else 0), one_round, padded(tried))
    twists, confidence = places(jnp.stack([guess, tried[0]]), reference, align_coarse_to_fine)
    best = jnp.argmax(evidence(confidence))
    of_guess = jnp.argmax(evidence(confidence).at[1::2].set(-1.0))  # the guess as it is, and aligned
    of_best = jax.tree.map(lambda a: a[best], confidence)
    return Relocation(twists[best], of_best, jax.tree.map(lambda a: a[of_guess], confidence))


def best_distinct(
    count: int, twists: Float[Array, "n 6"], evidence: Float[Array, "n"], config: AlignConfig
) -> list[Float[Array, "6"]]:
    """The `count` twists with the most evidence, each of which differs from all those before it."""
    best = []
    for _ in range(count):
        best.append(twists[jnp.argmax(evidence)])
        apart = relative_twists(twists, jnp.broadcast_to(best[-1], twists.shape))
        far, turned = (jnp.linalg.norm(part, axis=1) for part in (apart[:, :3], apart[:, 3:]))
        differs = (far > config.spacing) | (turned > max(config.turns, default=0.0))
        evidence = jnp.where(differs, evidence, -1.0)
    return best


def evidence(confidence: Confidence) -> Float[Array, "*k"]:
    """Evidence that a group is in a place: much of it is seen there, and agrees."""
    return jnp.where(confidence.conclusive, confidence.agreement * confidence.coverage, 0.0)


def depths_of_others(shown: Shown, doubtful: Bool[Array, "k"]) -> Float[Array, "c h w"]:
    """Depth of the groups that are not in doubt, where they were last seen; else 0. A pixel that shows one of
    these shows no group that is searched for. Doubtful groups are omitted: they may be elsewhere."""
    sound = (shown.labels > 0) & ~doubtful[shown.labels - 1]
    return jnp.where(sound, shown.depths, 0.0)


def unexplained_pixels(
    shown: Shown, images: ToneImages, gap: float, config: AlignConfig, coarseness: int
) -> Points:
    """Pixels of a frame that are nearer than what the scene shows there: something has moved in front of it.

    Args:
        shown: what the scene shows, in every n-th pixel.
        images: the frame, with depths.
        gap: the background does not explain depth that is nearer by more than this, metres.
        config: a group does not explain depth that is nearer by more than its `max_thickness`.
        coarseness: n.
    """
    assert images.depths is not None
    measured = images.depths[:, ::coarseness, ::coarseness]
    nearest = shown.depths - jnp.where(shown.labels > 0, config.max_thickness, gap)
    unexplained = (measured > 0) & shown.covered & (measured < nearest)
    pixels = pixels_of_groups(images, unexplained.astype(jnp.int32), measured, 1, config, coarseness)
    return jax.tree.map(lambda a: a[0], pixels)


def guesses_near(
    key: Key[Array, ""], shifts: Float[Array, "n 6"], guess: Float[Array, "6"], config: AlignConfig
) -> Float[Array, "n 6"]:
    """Places near the last guess, where a lost group may be: shifted by half of `shifts`, and rotated
    slightly at random (`key`) unless `config.max_turn` is 0."""
    turns = _NEAR_TURN * jax.random.normal(key, (len(shifts), 3)) * (config.max_turn > 0)
    nearby = jnp.concatenate([shifts[:, :3] / 2, turns], axis=1)
    return compose(nearby, jnp.broadcast_to(guess, nearby.shape))


def guesses_at(
    key: Key[Array, ""],
    shifts: Float[Array, "h 6"],
    reference: ReferencePoints,
    center: Float[Array, "3"],
    unexplained: Points,
    config: AlignConfig,
) -> Float[Array, "n 6"]:
    """Places where a lost group may be, rotated at random: around where it is believed to be and, four times
    as many, at random unexplained pixels, if there are any.

    Args:
        key: random key.
        shifts: shifts of the places around.
        reference: reference points of the group. One of a similar colour is placed at an unexplained pixel.
        center: centroid of the group, metres.
        unexplained: see `unexplained_pixels`.
        config: nothing is rotated if its `max_turn` is 0.
    """
    around, shifts = len(shifts), jnp.tile(shifts[:, :3], (1 + _AT_PIXELS, 1))
    count = len(shifts)
    place, pair, axis, angle = jax.random.split(key, 4)
    to, colors, there = (jnp.moveaxis(a, 0, -2).reshape(*a.shape[1:-1], -1) for a in unexplained)
    any_there = there.sum() > 0
    chosen = jax.random.choice(place, len(there), (count,), p=there + ~any_there)
    apart = sum_of_three((colors[:, chosen, None] - reference.tones[:, None]) ** 2, axis=0) / COLOR_SCALE**2
    paired = jax.random.categorical(pair, jnp.where(reference.real, -apart, -jnp.inf))
    turns = jax.random.normal(axis, (count, 3))
    turns /= jnp.linalg.norm(turns, axis=1, keepdims=True)
    turns *= _LARGEST_TURN * jax.random.uniform(angle, (count, 1)) * (config.max_turn > 0)
    offsets = reference.means[:, paired].T - center
    away = to[:, chosen].T - center - jaxlie.SO3.exp(turns).apply(offsets)
    at_pixel = (jnp.arange(count) >= around) & any_there
    return jnp.concatenate([jnp.where(at_pixel[:, None], away, shifts), turns], axis=1)


def guesses_spun(
    key: Key[Array, ""],
    count: int,
    axes: Float[Array, "3 3"],
    reference: ReferencePoints,
    center: Float[Array, "3"],
    guess: Float[Array, "6"],
    config: AlignConfig,
) -> Float[Array, "n 6"]:
    """The guess of the last frame, as it is or flipped about an axis of the group, and spun about an axis by
    any angle, because objects that look alike when rotated (cans, boxes) are often found rotated at first.

    Args:
        key: random key.
        count: n, static.
        axes: principal axes of the group, one per row.
        reference, center, guess, config: as for `recover`.
    """
    angles = jax.random.uniform(key, (count, 1), minval=-jnp.pi, maxval=jnp.pi)
    flips = jnp.pi * jnp.concatenate([axes, jnp.zeros_like(axes[:1])])
    index, turns = jnp.arange(count), config.max_turn > 0
    flips, spins = turns * flips[index // 3 % 4], turns * angles * axes[index % 3]
    last = jaxlie.SO3.exp(guess[3:])
    spun = last @ jaxlie.SO3.exp(flips) @ jaxlie.SO3.exp(spins)
    arm = solid_center(reference) - center
    stays = guess[:3] + last.apply(arm) - spun.apply(jnp.broadcast_to(arm, (count, 3)))
    return jnp.concatenate([stays, spun.log()], axis=1)


def solid_center(reference: ReferencePoints) -> Float[Array, "3"]:
    """The middle of an object of which some sides are known, metres: the point at the same distance below all
    of them, by least squares over the point and the distance. Without normals, their centroid."""
    weights = reference.real / jnp.maximum(reference.real.sum(), 1)
    mean, normal = reference.means @ weights, reference.normals @ weights
    away, tilt = reference.means - mean[:, None], reference.normals - normal[:, None]
    depth = jnp.sum(weights * away * tilt) / jnp.maximum(jnp.sum(weights * tilt**2), 1e-6)
    return mean - depth * normal
