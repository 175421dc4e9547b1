"""Where has each group gone? Several starts are aligned with the images, and what agrees best is kept."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from gsjax.methods.object_tracker.align import align, disagreement
from gsjax.methods.object_tracker.config import AlignConfig
from gsjax.methods.object_tracker.points import Points, Sight, carry


def widened(config: AlignConfig) -> AlignConfig:
    """Wider scales of the residuals, which listen to more of what disagrees: for starts that are far off."""
    factor = config.widen
    return replace(config, color_scale=factor * config.color_scale, depth_scale=factor * config.depth_scale)


def judge(
    twists: Float[Array, "k 6"],
    points: Points,
    centers: Float[Array, "k 3"],
    sight: Sight,
    config: AlignConfig,
) -> Float[Array, "k"]:
    """How badly each group agrees with the images after its twist: 0 perfect, 1 not at all."""
    return disagreement(carry(points, twists, centers), sight, config)


class Found(NamedTuple):
    """Where each group is, as far as is known."""

    twists: Float[Array, "k 6"]  # translation, metres, and rotation vector, radians
    residuals: Float[Array, "k"]  # how badly that agrees with the images, as `judge` has it


def least(residuals: Float[Array, "h k"], twists: Float[Array, "h k 6"]) -> Found:
    """For each group the twist of the hypothesis with the least residual; the first wins ties."""
    residuals = jnp.where(jnp.isfinite(residuals), residuals, jnp.inf)
    best, group = jnp.argmin(residuals, axis=0), jnp.arange(residuals.shape[1])
    return Found(twists[best, group], residuals[best, group])


def turned(
    twists: Float[Array, "k 6"], axes: Float[Array, "k 3 3"], angles: tuple[float, ...]
) -> Float[Array, "h k 6"]:
    """The twists themselves, and each after a turn to either side by each angle about each of its axes."""
    steps = jnp.concatenate([axes * s * angle for angle in angles for s in (1.0, -1.0)], axis=1)
    steps = jnp.concatenate([jnp.zeros_like(steps[:, :1]), steps], axis=1)

    def one(step):
        rotation = jaxlie.SO3.exp(twists[:, 3:]) @ jaxlie.SO3.exp(step)
        return jnp.concatenate([twists[:, :3], rotation.log()], axis=-1)

    return jax.vmap(one, in_axes=1)(steps)


def principal_axes(points: Points, centers: Float[Array, "k 3"]) -> Float[Array, "k 3 3"]:
    """Axes of each group, one a row: a bottle rolls about its own, whichever way it lies."""
    weights = (points.seen > 0).astype(points.means.dtype)
    away = (points.means - centers[:, None, None]) * weights[..., None]
    _, vectors = jnp.linalg.eigh(jnp.einsum("kcpi,kcpj->kij", away, away))
    return jnp.swapaxes(vectors, -1, -2)


def ball(radius: float, spacing: float) -> Float[np.ndarray, "n 3"]:
    """The points of a cubic grid within `radius` of the origin."""
    steps = spacing * np.arange(-(radius // spacing), radius // spacing + 1)
    grid = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    return grid[np.linalg.norm(grid, axis=1) <= radius]


def _shifted(points: Points, centers: Float[Array, "k 3"], sight: Sight, config: AlignConfig):
    """The pure translation of each group, of a coarse grid, that agrees best: of some of its points."""
    some = jax.tree.map(lambda a: a[:, :, ::4], points)
    shifts = jnp.asarray(ball(config.reach, config.spacing), points.means.dtype)
    twists = jnp.zeros((len(shifts), len(centers), 6), points.means.dtype).at[..., :3].set(shifts[:, None])
    residuals = jax.lax.map(lambda t: judge(t, some, centers, sight, widened(config)), twists)
    return least(residuals, twists).twists


def search(
    starts: Float[Array, "h k 6"],
    points: Points,
    centers: Float[Array, "k 3"],
    sight: Sight,
    config: AlignConfig,
) -> Found:
    """The twist of each group that agrees best with the images; no worse than the first start.

    Every start is aligned, and with depth so is the best shift of a coarse grid, for what has no texture to
    match.
    Then turns to all sides are tried from the best, because a knock changes a spin from one frame to the
    next, and a round thing may roll without its shape changing.

    Args:
        starts: hypotheses: translation, metres, and rotation vector, radians, of each group.
        points: of each group in the last frame.
        centers: what groups turn about.
        sight: what the cameras see now.
    """

    def judged(twists):
        return jax.lax.map(lambda t: judge(t, points, centers, sight, config), twists)

    def better(known: Found, tried) -> Found:
        """`known`, or what of `tried` agrees better."""
        residuals = jnp.concatenate([known.residuals[None], judged(tried)])
        return least(residuals, jnp.concatenate([known.twists[None], tried]))

    def aligned(twists):
        return jax.lax.map(lambda t: align(t, points, centers, sight, widened(config)), twists)

    # By colour alone, a plain thing would slide about within its outline.
    if sight.depths is not None and config.reach:
        starts = jnp.concatenate([starts, _shifted(points, centers, sight, config)[None]])
    # What stands still is the first hypothesis, whatever is tried.
    best = Found(starts[0], judged(starts[:1])[0])
    best = better(best, aligned(starts) if config.every_start else starts[1:])
    if config.max_turn and config.turns:
        best = better(best, aligned(turned(best.twists, principal_axes(points, centers), config.turns)))
    return better(best, align(best.twists, points, centers, sight, config)[None])
