"""Where has each group gone? Several starts are aligned with the images, and what agrees best is kept.

Every group goes on from the better of its starts. That loses what jumps or changes its spin, and then it
agrees badly; so the groups that agree worst, as many as there is time for, are looked for everywhere around.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.methods.object_tracker.align import align, disagreement
from gsjax.methods.object_tracker.config import AlignConfig
from gsjax.methods.object_tracker.points import Points, Sight

_LEAST_USUAL = 0.02  # a residual below this is noise
_PATIENCE = 0.05  # what a frame of waiting counts beside a residual as usual


def widened(config: AlignConfig) -> AlignConfig:
    """Wider scales of the residuals, which listen to more of what disagrees: for starts that are far off."""
    factor = config.widen
    return replace(config, color_scale=factor * config.color_scale, depth_scale=factor * config.depth_scale)


class Found(NamedTuple):
    """Where each group is, as far as is known."""

    twists: Float[Array, "*k 6"]  # translation, metres, and rotation vector, radians
    residuals: Float[Array, "*k"]  # how badly that agrees with the images: 0 perfect, 1 not at all


def judge(
    twists: Float[Array, "k 6"],
    points: Points,
    centers: Float[Array, "k 3"],
    sight: Sight,
    config: AlignConfig,
) -> Float[Array, "k"]:
    """How badly each group agrees with the images after its twist."""
    over_groups = jax.vmap(disagreement, in_axes=(0, 0, 0, None, None))
    return over_groups(twists, points, centers, sight, config)


def least(residuals: Float[Array, "h *k"], twists: Float[Array, "h *k 6"]) -> Found:
    """For each group the twist of the hypothesis with the least residual; the first wins ties."""
    residuals = jnp.where(jnp.isfinite(residuals), residuals, jnp.inf)
    best = jnp.argmin(residuals, axis=0, keepdims=True)
    take = jnp.take_along_axis
    return Found(take(twists, best[..., None], axis=0)[0], take(residuals, best, axis=0)[0])


def turned(
    twist: Float[Array, "6"], axes: Float[Array, "3 3"], angles: tuple[float, ...]
) -> Float[Array, "h 6"]:
    """The twist itself, and after a turn to either side by each angle about each of the axes."""
    steps = jnp.concatenate([axes * s * angle for angle in angles for s in (1.0, -1.0)])
    steps = jnp.concatenate([jnp.zeros_like(steps[:1]), steps])
    rotations = (jaxlie.SO3.exp(twist[3:]) @ jaxlie.SO3.exp(steps)).log()
    return jnp.concatenate([jnp.broadcast_to(twist[:3], rotations.shape), rotations], axis=-1)


def principal_axes(points: Points, center: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Axes of a group, one a row: a bottle rolls about its own, whichever way it lies."""
    away = (points.means - center[:, None]) * (points.seen > 0)[:, None]
    _, vectors = jnp.linalg.eigh(jnp.einsum("cip,cjp->ij", away, away))
    return vectors.T


def ball(radius: float, spacing: float) -> Float[np.ndarray, "n 3"]:
    """The points of a cubic grid within `radius` of the origin."""
    steps = spacing * np.arange(-(radius // spacing), radius // spacing + 1)
    grid = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    return grid[np.linalg.norm(grid, axis=1) <= radius]


def look_everywhere(
    known: Found,
    starts: Float[Array, "h 6"],
    points: Points,
    center: Float[Array, "3"],
    sight: Sight,
    config: AlignConfig,
) -> Found:
    """`known` of one group, or what agrees better.

    Every start is aligned, and with depth so is the best shift of a coarse grid, for what has no texture to
    match. Then turns to all sides are tried from the best, because a knock changes a spin from one frame to
    the next, and a round thing may roll without its shape changing. Half the points choose among these; all
    of them have the last word.
    """
    wide, half = widened(config), jax.tree.map(lambda a: a[..., ::2], points)

    def judged(twists, points, config) -> Found:
        over_twists = jax.vmap(disagreement, in_axes=(0, None, None, None, None))
        return least(over_twists(twists, points, center, sight, config), twists)

    def aligned(twists):
        over_twists = jax.vmap(align, in_axes=(0, None, None, None, None))
        return over_twists(twists, half, center, sight, wide)

    starts = jnp.concatenate([starts, known.twists[None]])
    # By colour alone, a plain thing would slide about within its outline.
    if sight.depths is not None and config.reach:
        shifts = jnp.asarray(ball(config.reach, config.spacing), starts.dtype)
        shifts = jnp.zeros((len(shifts), 6), starts.dtype).at[:, :3].set(shifts)
        few = jax.tree.map(lambda a: a[..., ::4], points)
        starts = jnp.concatenate([starts, judged(shifts, few, wide).twists[None]])
    best = judged(aligned(starts), half, config).twists
    if config.max_turn and config.turns:
        best = judged(
            aligned(turned(best, principal_axes(points, center), config.turns)), half, config
        ).twists
    last = align(best, points, center, sight, config)
    residuals = jnp.stack([known.residuals, disagreement(last, points, center, sight, config)])
    return least(residuals, jnp.stack([known.twists, last]))


class Watch(NamedTuple):
    """How each group has been followed, which says where to look first."""

    usual: Float[Array, "k"]  # residual of late
    waited: Float[Array, "k"]  # frames since it was last looked for everywhere
    largest: Float[Array, "k"]  # pixels that showed it when it was seen best, all cameras together

    def after(
        self, residuals: Float[Array, "k"], looked_for: Bool[Array, "k"], shown: Float[Array, "k"]
    ) -> "Watch":
        """One frame later.

        Args:
            residuals: as in `Found`.
            looked_for: which groups were looked for everywhere.
            shown: pixels that showed each group.
        """
        usual = 0.8 * self.usual + 0.2 * jnp.maximum(residuals, _LEAST_USUAL)
        waited = jnp.where(looked_for, 0.0, self.waited + 1.0)
        return Watch(usual, waited, jnp.maximum(self.largest, shown))


def first_watch(num_groups: int) -> Watch:
    """Before the first frame."""
    return Watch(jnp.full(num_groups, 0.1), jnp.zeros(num_groups), jnp.zeros(num_groups))


def search(
    starts: Float[Array, "h k 6"],
    points: Points,
    centers: Float[Array, "k 3"],
    sight: Sight,
    config: AlignConfig,
    watch: Watch,
    visible: Bool[Array, "k"],
    everywhere: Int[Array, ""],
) -> tuple[Found, Bool[Array, "k"]]:
    """The twist of each group that agrees best with the images, no worse than any start; and which
    groups were looked for everywhere.

    Args:
        starts: hypotheses: translation, metres, and rotation vector, radians, of each group.
        points: of each group in the last frame.
        centers: what groups turn about.
        sight: what the cameras see now.
        watch: how groups have been followed so far.
        visible: groups that a camera sees; no other is looked for.
        everywhere: how many groups are looked for everywhere, those first that agree worst beside what is
            usual for them, or that have waited longest.
    """
    judged = jax.vmap(judge, in_axes=(0, None, None, None, None))
    best = least(judged(starts, points, centers, sight, config), starts)
    over_groups = jax.vmap(align, in_axes=(0, 0, 0, None, None))
    aligned = over_groups(best.twists, points, centers, sight, widened(config))
    aligned = over_groups(aligned, points, centers, sight, config)
    residuals = jnp.stack([best.residuals, judge(aligned, points, centers, sight, config)])
    found = least(residuals, jnp.stack([best.twists, aligned]))

    urgency = jnp.where(visible, found.residuals / watch.usual + _PATIENCE * watch.waited, -jnp.inf)
    order = jnp.argsort(-urgency)
    count = jnp.minimum(everywhere, visible.sum())

    def look(i, found: Found) -> Found:
        group = order[i]
        known, own = jax.tree.map(lambda a: a[group], (found, points))
        better = look_everywhere(known, starts[:, group], own, centers[group], sight, config)
        return jax.tree.map(lambda all, one: all.at[group].set(one), found, better)

    found = jax.lax.fori_loop(0, count, look, found)
    return found, jnp.zeros(len(centers), bool).at[order].set(jnp.arange(len(centers)) < count)
