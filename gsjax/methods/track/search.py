"""Search for where each group has gone: it is aligned with the images from several starts, and the best is
kept.

Every group continues from the best of its starts. If it jumps or changes its spin, all of them miss it, and
it agrees worse than usual. For such groups, shifts in all directions are tried and, for those that agree
worst after that, rotations about all axes: for as many as time allows.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.methods.track.align import (
    align,
    align_coarse_to_fine,
    coarse_shifts,
    disagreement,
    principal_axes,
    rotation_hypotheses,
)
from gsjax.methods.track.config import AlignConfig
from gsjax.methods.track.lost import Confidence
from gsjax.methods.track.points import Points, ToneImages
from gsjax.methods.track.recover import Relocation
from gsjax.methods.track.watch import JUMPED_FACTOR, MOVED_FACTOR, Estimate, SearchResult, Watch

_SHIFTS = 3  # groups that are shifted for each that is rotated, which takes twice as long
_DOUBT_WEIGHT = 0.5  # urgency of being in doubt, relative to a residual at its usual value
_WAIT_WEIGHT = 0.05  # urgency of each frame of waiting, relative to a residual at its usual value
_FIRST_WEIGHT = 1e3  # urgency of groups that must not wait, likewise
_RELOCATION_COST = 2  # a relocation takes as long as trying the rotations of two to three groups
_DISTINCT_ANGLE = 0.14  # radians; orientations further apart than this are distinct
_IMPROVED = 0.9  # a search found a better place if it lowered the residual by this factor
_MAX_OWN_RESIDUAL = 0.5  # above this a group is occluded or elsewhere, and its orientation is not known


align_groups = jax.vmap(align_coarse_to_fine, in_axes=(0, 0, 0, None, None))
"""`align_coarse_to_fine` of many groups, each from its own start."""
disagreements = jax.vmap(disagreement, in_axes=(0, 0, 0, None, None))
"""`disagreement` of many groups, each after its own twist."""


def best_of(residuals: Float[Array, "h *k"], twists: Float[Array, "h *k 6"]) -> Estimate:
    """The hypothesis with the smallest residual, for each group; the first wins ties."""
    residuals = jnp.where(jnp.isfinite(residuals), residuals, jnp.inf)
    best = jnp.argmin(residuals, axis=0, keepdims=True)
    take = jnp.take_along_axis
    return Estimate(take(twists, best[..., None], axis=0)[0], take(residuals, best, axis=0)[0])


def _every(step: int, points: Points) -> Points:
    """Every n-th point."""
    return jax.tree.map(lambda a: a[..., ::step], points)


def _residuals_at(twists: Float[Array, "h 6"], *where, widen: float = 1.0) -> Float[Array, "h"]:
    """`disagreement` of one group after each of many twists; `where` has its other arguments."""
    return jax.vmap(lambda twist: disagreement(twist, *where, widen))(twists)


def _better(known: Estimate, twist: Float[Array, "6"], *where) -> Estimate:
    """`known` or, if that agrees better, the estimate after `twist`; `where` as for `_residuals_at`."""
    residuals = jnp.stack([known.residuals, disagreement(twist, *where)])
    return best_of(residuals, jnp.stack([known.twists, twist]))


def search_shifts(
    known: Estimate,
    starts: Float[Array, "h 6"],
    points: Points,
    center: Float[Array, "3"],
    images: ToneImages,
    config: AlignConfig,
    shifts: Float[Array, "n 6"],
) -> Estimate:
    """The estimate `known` of one group, or a better one from its starts shifted in all directions.

    A quarter of the points selects the best shift of each start and aligns it; all points decide in the end.

    Args:
        known: the estimate so far.
        starts: twists to start from.
        points: points of the group.
        center: centroid of the group, metres.
        images: the new frame.
        config: configuration of the alignment.
        shifts: twists to add to the starts, among which they are distributed.
    """
    few, count = _every(4, points), len(starts)
    shifted = [starts[i] + shifts[i::count] for i in range(count)]
    ends = np.cumsum([*map(len, shifted)])[:-1]
    residuals = _residuals_at(jnp.concatenate(shifted), few, center, images, config, widen=config.widen)
    parts = jnp.split(residuals, ends)
    tried = jnp.stack([best_of(*part).twists for part in zip(parts, shifted, strict=True)])
    tried = jax.vmap(align_coarse_to_fine, in_axes=(0, None, None, None, None))(
        tried, few, center, images, config
    )
    best = best_of(_residuals_at(tried, few, center, images, config), tried)
    return _better(known, align(best.twists, points, center, images, config), points, center, images, config)


def search_rotations(
    known: Estimate,
    starts: Float[Array, "h 6"],
    points: Points,
    center: Float[Array, "3"],
    images: ToneImages,
    config: AlignConfig,
) -> tuple[Estimate, Float[Array, ""]]:
    """The estimate `known` of one group or a better one, and its lead: how much worse other orientations
    agree.

    Every start is aligned. Then rotations about all axes are tried from the best result, because a knock
    changes a spin from one frame to the next, and a round object may roll without changing its shape. Half
    the points choose among these hypotheses; all points make the final decision. If another orientation
    agrees nearly as well, the images do not determine the orientation. The lead is relative to the agreement,
    because occluded points agree with no orientation; it is 1 if all hypotheses end at the same orientation,
    and infinite if little agrees.

    Args:
        known: the estimate so far.
        starts: twists to start from.
        points: points of the group.
        center: centroid of the group, metres.
        images: the new frame.
        config: configuration of the alignment.
    """
    half = _every(2, points)

    def aligned(twists):
        over_twists = jax.vmap(align, in_axes=(0, None, None, None, None, None))
        return over_twists(twists, half, center, images, config, config.widen)

    tried = aligned(jnp.concatenate([starts, known.twists[None]]))
    residuals = _residuals_at(tried, half, center, images, config)
    if config.max_turn and config.turns:
        axes = principal_axes(points, center)
        tried = aligned(rotation_hypotheses(best_of(residuals, tried).twists, axes, config.turns))
        residuals = _residuals_at(tried, half, center, images, config)
    last = align(best_of(residuals, tried).twists, points, center, images, config)
    best = _better(known, last, points, center, images, config)
    apart = jaxlie.SO3.exp(best.twists[3:]).inverse() @ jaxlie.SO3.exp(tried[:, 3:])
    distinct = jnp.linalg.norm(apart.log(), axis=-1) > _DISTINCT_ANGLE
    rival = jnp.min(jnp.where(distinct, residuals, 1.0))
    own = disagreement(best.twists, half, center, images, config)
    return best, jnp.where(own < _MAX_OWN_RESIDUAL, (rival - own) / (1 - own), jnp.inf)


class Followed(NamedTuple):
    """The result of following each group from its starts."""

    estimate: Estimate
    aligned: Float[Array, "k"]  # residuals before any shift
    shifted: Bool[Array, "k"]  # groups that agreed worse than usual then, for which shifts were tried
    missed: Bool[Array, "k"]  # those of them that are still far off: try rotations, then relocation


def follow(
    starts: Float[Array, "h k 6"],
    points: Points,
    centers: Float[Array, "k 3"],
    images: ToneImages,
    config: AlignConfig,
    watch: Watch,
    visible: Bool[Array, "k"],
    everywhere: Int[Array, ""],
) -> Followed:
    """Each group aligned from the best of its starts and, if it then agrees worse than usual, from shifts of
    them: for up to three times as many groups as `everywhere`, the worst first. Arguments as for `search`."""
    over_starts = jax.vmap(disagreements, in_axes=(0, None, None, None, None))
    best = best_of(over_starts(starts, points, centers, images, config), starts)
    aligned = align_groups(best.twists, points, centers, images, config)
    residuals = jnp.stack([best.residuals, disagreements(aligned, points, centers, images, config)])
    first = estimate = best_of(residuals, jnp.stack([best.twists, aligned]))
    shifts = coarse_shifts(config, images)
    if not len(shifts):
        none = jnp.zeros_like(visible)
        return Followed(estimate, first.residuals, none, none)
    ratio = first.residuals / watch.usual
    jumped = visible & ~watch.lost & (ratio > JUMPED_FACTOR)
    order = jnp.argsort(-jnp.where(jumped, ratio, 0.0))
    count = jnp.minimum(jumped.sum(), _SHIFTS * everywhere)
    shifted = jnp.zeros_like(jumped).at[order].set(jnp.arange(len(order)) < count)

    def shift(i, estimate: Estimate) -> Estimate:
        group = order[i]
        known, own = jax.tree.map(lambda a: a[group], (estimate, points))
        where = (starts[:, group], own, centers[group], images, config, shifts)
        return _with_group(estimate, group, search_shifts(known, *where))

    estimate = jax.lax.fori_loop(0, count, shift, estimate)
    return Followed(estimate, first.residuals, shifted, shifted & watch.is_far_off(estimate.residuals))


def search(
    followed: Followed,
    starts: Float[Array, "h k 6"],
    points: Points,
    centers: Float[Array, "k 3"],
    images: ToneImages,
    config: AlignConfig,
    watch: Watch,
    visible: Bool[Array, "k"],
    everywhere: Int[Array, ""],
    suspects: Bool[Array, "k"] | None = None,
    relocate: Callable[[Int[Array, ""]], Relocation] | None = None,
) -> SearchResult:
    """The twist of each group that agrees best with the images, never worse than that of `follow`.

    Args:
        followed: result of `follow`.
        starts: hypotheses of each group: translation, metres, and rotation vector, radians.
        points: points of each group in the last frame.
        centers: centroids of the groups, metres.
        images: the new frame.
        config: configuration of the alignment.
        watch: record of how the groups have been followed.
        visible: groups that some camera sees. Others are searched for only if lost.
        everywhere: number of groups for which rotations are tried; a relocation counts as two. First come
            those that were glimpsed elsewhere, then lost ones that have waited, then those that agree worst
            relative to their usual residual or have waited longest. One more is relocated if several of the
            first two kinds are waiting. With 0, `follow` tries no shifts either.
        suspects: groups that are lost or may be. Relocation is tried for them instead of rotations, unless
            they are neither lost nor missed and have just moved; None: no group.
        relocate: function from the index of a suspect to where it may be instead.
    """
    estimate = followed.estimate
    moved = followed.aligned >= MOVED_FACTOR * watch.usual
    suspects = jnp.zeros_like(watch.lost) if suspects is None else suspects
    suspects &= watch.lost | followed.missed | ~moved
    urgency = estimate.residuals / watch.usual + _WAIT_WEIGHT * watch.waited + _DOUBT_WEIGHT * watch.doubtful
    waits, there = watch.lost & (watch.waited > 0), visible | watch.lost
    urgency += _FIRST_WEIGHT * (2 * watch.glimpsed + waits)
    order = jnp.argsort(-jnp.where(there, urgency, -jnp.inf))
    several = jnp.sum(watch.glimpsed | waits) > 1
    spent = jnp.cumsum(jnp.where(suspects, _RELOCATION_COST, 1)[order])
    within = (spent <= everywhere + _RELOCATION_COST * several) | (jnp.arange(len(order)) == 0)
    count = jnp.where(everywhere > 0, jnp.sum(within & there[order]), 0)

    def look(i, carried):
        estimate, relocation, tried, leads = carried
        group = order[i]

        def turned():
            known, own = jax.tree.map(lambda a: a[group], (estimate, points))
            better, lead = search_rotations(known, starts[:, group], own, centers[group], images, config)
            return _with_group(estimate, group, better), leads.at[group].set(lead)

        if relocate is None:
            estimate, leads = turned()
            return estimate, relocation, tried, leads
        turns = followed.missed[group] | ~suspects[group]
        estimate, leads = jax.lax.cond(turns, turned, lambda: (estimate, leads))
        lies_elsewhere = suspects[group] & ~(turns & ~watch.is_far_off(estimate.residuals)[group])
        found, find = partial(_with_group, relocation, group), relocate
        relocation = jax.lax.cond(lies_elsewhere, lambda: found(find(group)), lambda: relocation)
        return estimate, relocation, tried.at[group].set(lies_elsewhere), leads

    unknown, nothing = jnp.full_like(estimate.residuals, jnp.inf), jnp.zeros_like(estimate.residuals)
    none = Confidence(nothing, nothing, nothing > 0)
    nowhere = Relocation(jnp.zeros_like(estimate.twists), none, none)
    start = (estimate, nowhere, nothing > 0, unknown)
    estimate, relocation, tried, leads = jax.lax.fori_loop(0, count, look, start)
    searched = jnp.zeros(len(centers), bool).at[order].set(jnp.arange(len(centers)) < count)
    looked = followed.shifted | jnp.isfinite(leads) | (searched & ~tried)
    confirmed = looked & (estimate.residuals > _IMPROVED * followed.aligned)
    return SearchResult(estimate, searched, confirmed, relocation, tried, leads)


def _with_group(values, group, value):
    """A pytree of values of all groups, with that of one group replaced."""
    return jax.tree.map(lambda a, b: a.at[group].set(b), values, value)
