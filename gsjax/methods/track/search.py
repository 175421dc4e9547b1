"""Search for where each group has gone: several starts are aligned with the images, and the best is kept.

Every group continues from the best of its starts. A group that jumps or changes its spin is missed by all of
them and then agrees badly. So the groups that agree worst, as many as the time allows, are searched for
everywhere around.
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
    align_from_afar,
    coarse_shifts,
    disagreement,
    turn_hypotheses,
)
from gsjax.methods.track.config import AlignConfig
from gsjax.methods.track.lost import DOUBTFUL, LOST, Confidence, is_found
from gsjax.methods.track.points import Points, ToneImages
from gsjax.methods.track.recover import Relocation

_RESIDUAL_FLOOR = 0.02  # a residual below this is noise
_DOUBT_WEIGHT = 0.5  # urgency of being in doubt, relative to a residual at its usual value
_WAIT_WEIGHT = 0.05  # urgency of each frame of waiting, relative to a residual at its usual value
_DISTINCT_TURN = 0.14  # radians; orientations further apart than this are distinct
_STEADY_FACTOR = 2.0  # residual relative to the usual one above which a group has just moved: follow it first
_MAX_OWN_RESIDUAL = 0.5  # above this a group is hidden or elsewhere, and its orientation is not known
TURN_KNOWN = 0.045
"""Lead above which a group's orientation is known; docs/results-hard-cases.md has leads of both kinds."""
_FOUND_TURN_AGREEMENT = 0.65  # agreement above which a group that is found again has its first orientation


class Estimate(NamedTuple):
    """Where each group is, as far as is known."""

    twists: Float[Array, "*k 6"]  # translation, metres, and rotation vector, radians
    residuals: Float[Array, "*k"]  # disagreement with the images: 0 perfect, 1 not at all


class SearchResult(NamedTuple):
    """The result of a search."""

    estimate: Estimate
    searched: Bool[Array, "k"]  # groups that were searched for everywhere
    relocation: Relocation  # where each group may be instead, valid only where it was tried
    relocation_tried: Bool[Array, "k"]
    leads: Float[Array, "k"]  # see `search_everywhere`; infinite if unknown


align_groups = jax.vmap(align_from_afar, in_axes=(0, 0, 0, None, None))
"""`align_from_afar` of many groups, each from its own start."""
disagreements = jax.vmap(disagreement, in_axes=(0, 0, 0, None, None))
"""`disagreement` of many groups, each after its own twist."""


def best_of(residuals: Float[Array, "h *k"], twists: Float[Array, "h *k 6"]) -> Estimate:
    """The hypothesis with the least residual, for each group; the first wins ties."""
    residuals = jnp.where(jnp.isfinite(residuals), residuals, jnp.inf)
    best = jnp.argmin(residuals, axis=0, keepdims=True)
    take = jnp.take_along_axis
    return Estimate(take(twists, best[..., None], axis=0)[0], take(residuals, best, axis=0)[0])


def principal_axes(points: Points, center: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Principal axes of a group, one a row: a bottle rolls about its own, whichever way it lies."""
    away = (points.means - center[:, None]) * (points.seen > 0)[:, None]
    _, vectors = jnp.linalg.eigh(jnp.einsum("cip,cjp->ij", away, away))
    return vectors.T


def search_everywhere(
    known: Estimate,
    starts: Float[Array, "h 6"],
    points: Points,
    center: Float[Array, "3"],
    images: ToneImages,
    config: AlignConfig,
    shifts: Float[Array, "n 6"],
) -> tuple[Estimate, Float[Array, ""]]:
    """`known` of one group or a better estimate, and its lead: how much worse other orientations agree.

    Every start is aligned, and so is the best shift of each start, for groups without texture to match or
    that are pushed; the shifts are distributed over the starts. Then turns to all sides are tried from the
    best result, because a knock changes a spin from one frame to the next, and a round object may roll
    without changing its shape. Half the points choose among these hypotheses; all points make the final
    decision. If another orientation agrees nearly as well, the images do not determine the orientation. The
    lead is a fraction of the agreement, because hidden points agree with no orientation. It is infinite if
    little agrees or no turn was tried.

    Args:
        known: the estimate so far.
        starts: twists to start from.
        points: points of the group.
        center: centroid of the group, metres.
        images: the new frame.
        config: configuration of the alignment.
        shifts: twists that are added to the starts.
    """
    half = jax.tree.map(lambda a: a[..., ::2], points)

    def judged(twists, points, widen=1.0) -> Float[Array, "h"]:
        over_twists = jax.vmap(disagreement, in_axes=(0, None, None, None, None, None))
        return over_twists(twists, points, center, images, config, widen)

    def aligned(twists):
        over_twists = jax.vmap(align, in_axes=(0, None, None, None, None, None))
        return over_twists(twists, half, center, images, config, config.widen)

    tried = jnp.concatenate([starts, known.twists[None]])
    if len(shifts):
        few, count = jax.tree.map(lambda a: a[..., ::4], points), len(starts)
        shifted = [starts[i] + shifts[i::count] for i in range(count)]
        parts = jnp.split(
            judged(jnp.concatenate(shifted), few, config.widen), np.cumsum([*map(len, shifted)])[:-1]
        )
        tried = jnp.stack([*tried, *(best_of(*part).twists for part in zip(parts, shifted, strict=True))])
    tried = aligned(tried)
    residuals = judged(tried, half)
    if config.max_turn and config.turns:
        axes = principal_axes(points, center)
        tried = aligned(turn_hypotheses(best_of(residuals, tried).twists, axes, config.turns))
        residuals = judged(tried, half)
    last = align(best_of(residuals, tried).twists, points, center, images, config)
    ends = jnp.stack([known.twists, last])
    best = best_of(jnp.stack([known.residuals, disagreement(last, points, center, images, config)]), ends)
    apart = jaxlie.SO3.exp(best.twists[3:]).inverse() @ jaxlie.SO3.exp(tried[:, 3:])
    distinct = jnp.linalg.norm(apart.log(), axis=-1) > _DISTINCT_TURN
    rival = jnp.min(jnp.where(distinct, residuals, jnp.inf))
    own = disagreement(best.twists, half, center, images, config)
    return best, jnp.where(own < _MAX_OWN_RESIDUAL, (rival - own) / (1 - own), jnp.inf)


class Watch(NamedTuple):
    """Record of how each group has been followed, which decides where to search first."""

    usual: Float[Array, "k"]  # running mean of the residual
    waited: Float[Array, "k"]  # frames since the group was last searched for everywhere
    largest: Float[Array, "k"]  # most pixels that ever showed the group, all cameras together
    agrees: Float[Array, "k"]  # `Confidence.agreement` when it was last conclusive
    lost: Bool[Array, "k"]
    showed: Float[Array, "k"]  # `Confidence.coverage` in the first frame
    turn_known: Bool[Array, "k"]  # orientation known since the first frame, or since it was found again
    glimpsed: Bool[Array, "k"]  # found elsewhere in this frame, to be confirmed by the next one

    @property
    def doubtful(self) -> Bool[Array, "k"]:
        """Groups that may be elsewhere."""
        return self.lost | (self.agrees < DOUBTFUL)

    def after(
        self,
        residuals: Float[Array, "k"],
        result: SearchResult,
        counts: Float[Array, "k"],
        confidence: Confidence,
        elsewhere: Bool[Array, "k"],
        relocated: Bool[Array, "k"],
    ) -> "Watch":
        """The record one frame later.

        Args:
            residuals: as in `Estimate`, where each group was aligned.
            result: result of the search.
            counts: number of pixels that showed each group.
            confidence: confidence that each group is where it is believed to be.
            elsewhere: groups of which more shows in another place than in their own.
            relocated: those of them that were moved there.
        """
        lost = jnp.where(self.lost, ~is_found(confidence, self.showed), confidence.agreement < LOST)
        lost = jnp.where(confidence.conclusive, lost, self.lost)
        as_at_first = confidence.conclusive & (confidence.agreement > _FOUND_TURN_AGREEMENT)
        turn_known = jnp.where(self.lost | relocated, as_at_first, self.turn_known)
        found_elsewhere = elsewhere & is_found(result.relocation.confidence, self.showed)
        watch = Watch(
            usual=0.8 * self.usual + 0.2 * jnp.maximum(residuals, _RESIDUAL_FLOOR),
            waited=jnp.where(result.searched, 0.0, self.waited + 1.0),
            largest=jnp.maximum(self.largest, counts),
            agrees=jnp.where(confidence.conclusive, confidence.agreement, self.agrees),
            lost=lost,
            showed=self.showed,
            turn_known=turn_known & (result.leads > TURN_KNOWN) & ~lost,
            glimpsed=found_elsewhere & ~relocated & ~self.glimpsed,
        )
        return watch._replace(glimpsed=watch.glimpsed & watch.doubtful)


def first_watch(showed: Float[Array, "k"]) -> Watch:
    """The record before the second frame; `showed` is the coverage of each group in the first."""
    nothing, certain = jnp.zeros_like(showed), jnp.ones_like(showed)
    no, yes = nothing > 0, certain > 0
    return Watch(jnp.full_like(showed, 0.1), nothing, nothing, certain, no, showed, yes, no)


def search(
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
    """The twist of each group that agrees best with the images, no worse than any start.

    Args:
        starts: hypotheses of each group: translation, metres, and rotation vector, radians.
        points: points of each group in the last frame.
        centers: centroids of the groups, metres.
        images: the new frame.
        config: configuration of the alignment.
        watch: record of how the groups have been followed.
        visible: groups that some camera sees. Others are searched for only if lost.
        everywhere: number of groups that are searched for everywhere. First come those glimpsed elsewhere,
            then those that agree worst relative to their usual residual or have waited longest.
        suspects: groups that are lost or may be. They are relocated where others are followed, unless they
            are not lost and have just moved; None: no group.
        relocate: index of a suspect -> where it may be instead.
    """
    over_starts = jax.vmap(disagreements, in_axes=(0, None, None, None, None))
    best = best_of(over_starts(starts, points, centers, images, config), starts)
    aligned = align_groups(best.twists, points, centers, images, config)
    residuals = jnp.stack([best.residuals, disagreements(aligned, points, centers, images, config)])
    estimate = best_of(residuals, jnp.stack([best.twists, aligned]))
    steady = estimate.residuals < _STEADY_FACTOR * watch.usual
    suspects = jnp.zeros_like(watch.lost) if suspects is None else suspects & (watch.lost | steady)
    shifts = coarse_shifts(config, images)

    urgency = estimate.residuals / watch.usual + _WAIT_WEIGHT * watch.waited + _DOUBT_WEIGHT * watch.doubtful
    urgency = jnp.where(watch.glimpsed, jnp.inf, urgency)
    there = visible | watch.lost
    order = jnp.argsort(-jnp.where(there, urgency, -jnp.inf))
    count = jnp.minimum(everywhere, there.sum())

    def look(i, carried):
        estimate, relocation, leads = carried
        group = order[i]

        def follow():
            known, own = jax.tree.map(lambda a: a[group], (estimate, points))
            start = (starts[:, group], own, centers[group], images, config, shifts)
            better, lead = search_everywhere(known, *start)
            return _with_group(estimate, group, better), relocation, leads.at[group].set(lead)

        if relocate is None:
            return follow()
        elsewhere = partial(relocate, group)
        return jax.lax.cond(
            suspects[group], lambda: (estimate, _with_group(relocation, group, elsewhere()), leads), follow
        )

    unknown, nothing = jnp.full_like(estimate.residuals, jnp.inf), jnp.zeros_like(estimate.residuals)
    none = Confidence(nothing, nothing, nothing > 0)
    nowhere = Relocation(jnp.zeros_like(estimate.twists), none, none)
    estimate, relocation, leads = jax.lax.fori_loop(0, count, look, (estimate, nowhere, unknown))
    searched = jnp.zeros(len(centers), bool).at[order].set(jnp.arange(len(centers)) < count)
    return SearchResult(estimate, searched, relocation, searched & suspects, leads)


def _with_group(values, group, value):
    """A pytree of values of all groups, with that of one group replaced."""
    return jax.tree.map(lambda a, b: a.at[group].set(b), values, value)
