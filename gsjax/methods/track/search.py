"""Search for where each group has gone: several starts are aligned with the images, and the best is kept.

Every group goes on from the better of its starts. That loses what jumps or changes its spin, and then it
agrees badly; so the groups that agree worst, as many as there is time for, are looked for everywhere around.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.methods.track.align import align, coarse_shifts, disagreement, turned, widened
from gsjax.methods.track.config import AlignConfig
from gsjax.methods.track.lost import DOUBTFUL, LOST, Confidence, is_found
from gsjax.methods.track.points import Points, Sight
from gsjax.methods.track.recover import Relocation

_LEAST_USUAL = 0.02  # a residual below this is noise
_IN_DOUBT = 0.5  # what being lost, or hardly looking as at first, counts beside a residual as usual
_PATIENCE = 0.05  # what a frame of waiting counts beside a residual as usual
_OTHER_TURN = 0.14  # radians; what is turned by more than this is turned otherwise
_CALM = 2.0  # a residual above that beside the usual one: a group has just moved, and is followed first
_AGREES_AT_ALL = 0.5  # residual above which a group is hidden or elsewhere, and its turn is not known
TURN_KNOWN = 0.045  # lead above which a group's turn is known; docs/results-hard-cases.md has both sides
_FOUND_TURNED = 0.65  # share that must agree of what is found again for it to be turned as it was at first


class Found(NamedTuple):
    """Where each group is, as far as is known."""

    twists: Float[Array, "*k 6"]  # translation, metres, and rotation vector, radians
    residuals: Float[Array, "*k"]  # how badly that agrees with the images: 0 perfect, 1 not at all


class Sought(NamedTuple):
    """What a search found."""

    found: Found
    looked_for: Bool[Array, "k"]  # everywhere
    again: Relocation  # where each group may be instead ...
    recovered: Bool[Array, "k"]  # ... that was looked for where it was not believed to be
    leads: Float[Array, "k"]  # see `look_everywhere`; infinite where that is not known


def judge(
    twists: Float[Array, "k 6"],
    points: Points,
    centers: Float[Array, "k 3"],
    sight: Sight,
    config: AlignConfig,
) -> Float[Array, "k"]:
    """How badly each group agrees with the images after its twist.

    Args:
        twists: translations in metres, rotation vectors.
        points: of all groups.
        centers: about which groups turn, metres.
        sight: what cameras saw.
        config: limits of colour and depth.
    """
    over_groups = jax.vmap(disagreement, in_axes=(0, 0, 0, None, None))
    return over_groups(twists, points, centers, sight, config)


def least(residuals: Float[Array, "h *k"], twists: Float[Array, "h *k 6"]) -> Found:
    """For each group the twist of the hypothesis with the least residual; the first wins ties."""
    residuals = jnp.where(jnp.isfinite(residuals), residuals, jnp.inf)
    best = jnp.argmin(residuals, axis=0, keepdims=True)
    take = jnp.take_along_axis
    return Found(take(twists, best[..., None], axis=0)[0], take(residuals, best, axis=0)[0])


def principal_axes(points: Points, center: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Axes of a group, one a row: a bottle rolls about its own, whichever way it lies."""
    away = (points.means - center[:, None]) * (points.seen > 0)[:, None]
    _, vectors = jnp.linalg.eigh(jnp.einsum("cip,cjp->ij", away, away))
    return vectors.T


def look_everywhere(
    known: Found,
    starts: Float[Array, "h 6"],
    points: Points,
    center: Float[Array, "3"],
    sight: Sight,
    config: AlignConfig,
    shifts: Float[Array, "n 6"],
) -> tuple[Found, Float[Array, ""]]:
    """`known` of one group, or what agrees better; and its lead: how much worse every other turn agrees.

    Every start is aligned, and so is the best shift of each, for what has no texture to match, or is pushed;
    one shift is tried from one start, the next from another. Then turns to all sides are tried from the best,
    because a knock changes a spin from one frame to the next, and a round thing may roll without its shape
    changing. Half the points choose among these; all of them have the last word. A turn that ends elsewhere
    and agrees nearly as well shows that pictures do not determine the turn. The lead is a share of what
    agrees, for what is hidden agrees with no turn. Where little agrees, or no turn was tried, it is infinite.

    Args:
        known: where the group was found already, and how well that agrees.
        starts: twists to begin from.
        points: of the group.
        center: about which it turns, metres.
        sight: what cameras saw.
        config: of the alignment.
        shifts: tried from the starts, as twists.
    """
    wide, half = widened(config), jax.tree.map(lambda a: a[..., ::2], points)

    def judged(twists, points, config) -> Float[Array, "h"]:
        over_twists = jax.vmap(disagreement, in_axes=(0, None, None, None, None))
        return over_twists(twists, points, center, sight, config)

    def aligned(twists):
        over_twists = jax.vmap(align, in_axes=(0, None, None, None, None))
        return over_twists(twists, half, center, sight, wide)

    tried = jnp.concatenate([starts, known.twists[None]])
    if len(shifts):
        few, count = jax.tree.map(lambda a: a[..., ::4], points), len(starts)
        shifted = [starts[i] + shifts[i::count] for i in range(count)]
        parts = jnp.split(judged(jnp.concatenate(shifted), few, wide), np.cumsum([*map(len, shifted)])[:-1])
        tried = jnp.stack([*tried, *(least(*part).twists for part in zip(parts, shifted, strict=True))])
    tried = aligned(tried)
    residuals = judged(tried, half, config)
    if config.max_turn and config.turns:
        axes = principal_axes(points, center)
        tried = aligned(turned(least(residuals, tried).twists, axes, config.turns))
        residuals = judged(tried, half, config)
    last = align(least(residuals, tried).twists, points, center, sight, config)
    ends = jnp.stack([known.twists, last])
    found = least(jnp.stack([known.residuals, disagreement(last, points, center, sight, config)]), ends)
    apart = jaxlie.SO3.exp(found.twists[3:]).inverse() @ jaxlie.SO3.exp(tried[:, 3:])
    others = jnp.linalg.norm(apart.log(), axis=-1) > _OTHER_TURN
    rival = jnp.min(jnp.where(others, residuals, jnp.inf))
    own = disagreement(found.twists, half, center, sight, config)
    return found, jnp.where(own < _AGREES_AT_ALL, (rival - own) / (1 - own), jnp.inf)


class Watch(NamedTuple):
    """How each group has been followed, which decides where to look first."""

    usual: Float[Array, "k"]  # residual of late
    waited: Float[Array, "k"]  # frames since it was last looked for everywhere
    largest: Float[Array, "k"]  # pixels that showed it when it was seen best, all cameras together
    agrees: Float[Array, "k"]  # how much of what was last seen of it looked as at first, 0 to 1
    lost: Bool[Array, "k"]
    showed: Float[Array, "k"]  # share of it that was seen in the first frame, of what faced the cameras
    turn_known: Bool[Array, "k"]  # since the first frame, or since it was found again
    glimpsed: Bool[Array, "k"]  # found elsewhere in this frame, which the next one is to confirm

    @property
    def doubtful(self) -> Bool[Array, "k"]:
        """Whether it may be elsewhere."""
        return self.lost | (self.agrees < DOUBTFUL)

    def after(
        self,
        residuals: Float[Array, "k"],
        sought: Sought,
        shown: Float[Array, "k"],
        sure: Confidence,
        elsewhere: Bool[Array, "k"],
        retaken: Bool[Array, "k"],
    ) -> "Watch":
        """One frame later.

        Args:
            residuals: as in `Found`, where each group was aligned.
            sought: what the search found.
            shown: pixels that showed each group.
            sure: whether each group is where it is believed to be.
            elsewhere: groups of which more is seen in another place than in theirs.
            retaken: those of them that were moved there.
        """
        usual = 0.8 * self.usual + 0.2 * jnp.maximum(residuals, _LEAST_USUAL)
        lost = jnp.where(self.lost, ~is_found(sure, self.showed), sure.agrees < LOST)
        lost = jnp.where(sure.tells, lost, self.lost)
        as_at_first = sure.tells & (sure.agrees > _FOUND_TURNED)
        turn_known = jnp.where(self.lost | retaken, as_at_first, self.turn_known) & (
            sought.leads > TURN_KNOWN
        )
        watch = Watch(
            usual,
            jnp.where(sought.looked_for, 0.0, self.waited + 1.0),
            jnp.maximum(self.largest, shown),
            jnp.where(sure.tells, sure.agrees, self.agrees),
            lost,
            self.showed,
            turn_known & ~lost,
            elsewhere & is_found(sought.again.sure, self.showed) & ~retaken & ~self.glimpsed,
        )
        return watch._replace(glimpsed=watch.glimpsed & watch.doubtful)


def first_watch(showed: Float[Array, "k"]) -> Watch:
    """The watch before the second frame; `showed` is how much of each group was seen in the first."""
    nothing, certain = jnp.zeros_like(showed), jnp.ones_like(showed)
    no, yes = nothing > 0, certain > 0
    return Watch(jnp.full_like(showed, 0.1), nothing, nothing, certain, no, showed, yes, no)


def search(
    starts: Float[Array, "h k 6"],
    points: Points,
    centers: Float[Array, "k 3"],
    sight: Sight,
    config: AlignConfig,
    watch: Watch,
    visible: Bool[Array, "k"],
    everywhere: Int[Array, ""],
    astray: Bool[Array, "k"] | None = None,
    recover: Callable[[Int[Array, ""]], Relocation] | None = None,
) -> Sought:
    """The twist of each group that agrees best with the images, no worse than any start.

    Args:
        starts: hypotheses: translation, metres, and rotation vector, radians, of each group.
        points: of each group in the last frame.
        centers: what groups turn about.
        sight: what the cameras see now.
        watch: how groups have been followed so far.
        visible: groups that a camera sees; of others only what is lost is looked for.
        everywhere: how many groups are looked for everywhere, those first that agree worst beside what is
            usual for them, or that have waited longest; before all others what was glimpsed elsewhere.
        astray: groups that are lost, or may be: they are recovered where others are followed, unless they are
            not lost and have just moved; None: nobody.
        recover: index of an astray group -> where it may be instead.
    """
    judged = jax.vmap(judge, in_axes=(0, None, None, None, None))
    best = least(judged(starts, points, centers, sight, config), starts)
    over_groups = jax.vmap(align, in_axes=(0, 0, 0, None, None))
    aligned = over_groups(best.twists, points, centers, sight, widened(config))
    aligned = over_groups(aligned, points, centers, sight, config)
    residuals = jnp.stack([best.residuals, judge(aligned, points, centers, sight, config)])
    found = least(residuals, jnp.stack([best.twists, aligned]))
    calm = found.residuals < _CALM * watch.usual
    astray = jnp.zeros_like(watch.lost) if astray is None else astray & (watch.lost | calm)

    shifts = coarse_shifts(config, sight)

    urgency = found.residuals / watch.usual + _PATIENCE * watch.waited + _IN_DOUBT * watch.doubtful
    urgency = jnp.where(watch.glimpsed, jnp.inf, urgency)
    there = visible | watch.lost
    order = jnp.argsort(-jnp.where(there, urgency, -jnp.inf))
    count = jnp.minimum(everywhere, there.sum())

    def look(i, carried):
        found, again, leads = carried
        group = order[i]

        def follow():
            known, own = jax.tree.map(lambda a: a[group], (found, points))
            start = (starts[:, group], own, centers[group], sight, config, shifts)
            better, lead = look_everywhere(known, *start)
            return _with(found, group, better), again, leads.at[group].set(lead)

        if recover is None:
            return follow()
        seek = partial(recover, group)
        return jax.lax.cond(astray[group], lambda: (found, _with(again, group, seek()), leads), follow)

    unknown, nothing = jnp.full_like(found.residuals, jnp.inf), jnp.zeros_like(found.residuals)
    none = Confidence(nothing, nothing, nothing > 0)
    nowhere = Relocation(jnp.zeros_like(found.twists), none, none)
    found, again, leads = jax.lax.fori_loop(0, count, look, (found, nowhere, unknown))
    looked_for = jnp.zeros(len(centers), bool).at[order].set(jnp.arange(len(centers)) < count)
    return Sought(found, looked_for, again, looked_for & astray, leads)


def _with(all_of_them, index, one):
    """`all_of_them`, of which that of an index is `one`."""
    return jax.tree.map(lambda a, b: a.at[index].set(b), all_of_them, one)
