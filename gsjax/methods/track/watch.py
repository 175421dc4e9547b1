"""The record of how each group has been followed: its usual residual, and whether it is lost or has been
found again."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gsjax.methods.track.lost import (
    DOUBTFUL,
    FOUND,
    FOUND_FRAMES,
    LOST,
    PROBATION,
    SUDDEN,
    SURELY_FOUND,
    SURELY_LOST,
    Confidence,
    is_found,
)
from gsjax.methods.track.recover import Relocation

_RESIDUAL_FLOOR = 0.02  # a residual below this is noise
JUMPED_FACTOR = 1.5
"""Residual relative to the usual one above which a group may have jumped."""
MOVED_FACTOR = 2.0
"""The same above which it has just moved."""
_CALM_FACTOR = 1.25  # the same below which it agrees as usual
_FAR_OFF_FACTOR, _FAR_OFF = 4.0, 0.3  # the same, and the residual itself, above which it is far off
MIN_LEAD = 0.045
"""Lead above which a group's orientation is known; docs/results-hard-cases.md has leads of both kinds."""
_TRUSTED_AGREEMENT = 0.65  # agreement above which the orientation of a group that was found is trusted


class Estimate(NamedTuple):
    """The estimated motion of each group."""

    twists: Float[Array, "*k 6"]  # translation, metres, and rotation vector, radians
    residuals: Float[Array, "*k"]  # disagreement with the images: 0 if perfect, 1 if nothing agrees


class SearchResult(NamedTuple):
    """The result of a search."""

    estimate: Estimate
    searched: Bool[Array, "k"]  # groups for which rotations or other places were tried
    confirmed: Bool[Array, "k"]  # groups for which shifts or rotations found no better place
    relocation: Relocation  # where each group may be instead, valid only where it was tried
    relocation_tried: Bool[Array, "k"]
    leads: Float[Array, "k"]  # see `search_rotations`; infinite if unknown


class Watch(NamedTuple):
    """Record of how each group has been followed; it decides where to search first, and which are lost."""

    usual: Float[Array, "k"]  # running mean of the residual
    waited: Float[Array, "k"]  # frames since the group was last `SearchResult.searched`
    largest: Float[Array, "k"]  # most pixels that ever showed the group, all cameras together
    agrees: Float[Array, "k"]  # `Confidence.agreement` when it was last conclusive
    lost: Bool[Array, "k"]
    showed: Float[Array, "k"]  # `Confidence.coverage` in the first frame
    turn_known: Bool[Array, "k"]  # orientation known since the first frame, or since it was found again
    glimpsed: Bool[Array, "k"]  # found elsewhere in this frame, to be confirmed by the next one
    streak: Float[Array, "k"]  # consecutive frames in which the group has looked found
    probation: Float[Array, "k"]  # searches that a group that was found again has yet to pass, see `after`

    @property
    def doubtful(self) -> Bool[Array, "k"]:
        """Groups that may be elsewhere."""
        return self.lost | (self.agrees < DOUBTFUL) | (self.probation > 1)

    def is_far_off(self, residuals: Float[Array, "k"]) -> Bool[Array, "k"]:
        """Groups that agree nowhere near as well as usual."""
        return residuals > jnp.maximum(_FAR_OFF_FACTOR * self.usual, _FAR_OFF)

    def after(
        self,
        residuals: Float[Array, "k"],
        result: SearchResult,
        counts: Float[Array, "k"],
        confidence: Confidence,
        elsewhere: Bool[Array, "k"],
        relocated: Bool[Array, "k"],
        *,
        searches: int = PROBATION,
    ) -> "Watch":
        """The record one frame later.

        The usual residual rises only where a search found no better place; otherwise a group that lags would
        soon appear to agree as usual. A group is lost if its agreement is below a threshold, or drops within
        one frame while its residual rises. It is found if most of it agrees, or enough of it in several
        frames in a row. Then it is on probation, in case another object only looks alike: several searches
        elsewhere must find no better place, and then a search has to determine its orientation.

        Args:
            residuals: as in `Estimate`, where each group was aligned.
            result: result of the search.
            counts: number of pixels that showed each group.
            confidence: confidence that each group is where it is believed to be.
            elsewhere: groups with stronger evidence in another place than in their own.
            relocated: those of them that were moved there.
            searches: number of searches elsewhere that a group on probation has to pass; 0 if none is
                possible, so that it passes once its orientation is known.
        """
        agreement, conclusive = confidence.agreement, confidence.conclusive
        there = is_found(confidence, self.showed)
        streak = jnp.where(there, self.streak + 1.0, 0.0)
        found = there & ((agreement > SURELY_FOUND) | (streak >= FOUND_FRAMES))
        calm = self.turn_known & (residuals < _CALM_FACTOR * self.usual)
        least = jnp.where(self.probation > 0, FOUND, jnp.where(calm, SURELY_LOST, LOST))
        dropped = (agreement < SUDDEN * self.agrees) & (residuals > MOVED_FACTOR * self.usual)
        lost = jnp.where(self.lost | relocated, ~found, (agreement < least) | dropped)
        lost = jnp.where(conclusive, lost, self.lost)

        confirmed = (self.probation == 1) & jnp.isfinite(result.leads) & conclusive
        confirmed &= agreement > _TRUSTED_AGREEMENT
        passed = (self.probation > 1) & result.relocation_tried & ~elsewhere
        probation = self.probation - (passed | confirmed)
        probation = jnp.where(self.lost | relocated, 1.0 + searches, probation)
        probation = jnp.where(lost, 0.0, probation)
        turn_known = (self.turn_known | confirmed) & (probation == 0) & (result.leads > MIN_LEAD) & ~lost

        found_elsewhere = elsewhere & is_found(result.relocation.confidence, self.showed)
        residuals = jnp.maximum(residuals, _RESIDUAL_FLOOR)
        usual = jnp.where(result.confirmed | (residuals < self.usual), residuals, self.usual)
        watch = Watch(
            usual=0.8 * self.usual + 0.2 * usual,
            waited=jnp.where(result.searched, 0.0, self.waited + 1.0),
            largest=jnp.maximum(self.largest, counts),
            agrees=jnp.where(conclusive, agreement, self.agrees),
            lost=lost,
            showed=self.showed,
            turn_known=turn_known,
            glimpsed=found_elsewhere & ~relocated & ~self.glimpsed,
            streak=streak,
            probation=probation,
        )
        return watch._replace(glimpsed=watch.glimpsed & watch.doubtful)


def first_watch(showed: Float[Array, "k"]) -> Watch:
    """The record before the second frame; `showed` is the coverage of each group in the first."""
    nothing, certain = jnp.zeros_like(showed), jnp.ones_like(showed)
    no, yes = nothing > 0, certain > 0
    usual = jnp.full_like(showed, 0.1)
    return Watch(usual, nothing, nothing, certain, no, showed, yes, no, nothing, nothing)
