"""Direct alignment of each group with the images: Levenberg-Marquardt over six numbers, nothing rendered.

What aligns is a set of points with colours: pixels that showed the group earlier, and centres (see `points`).
Each has a colour and a depth to agree with at the pixel it falls on:

    r_i = ( (I(pi(D x_i)) - c_i) / s_color,  (Z(pi(D x_i)) - z(D x_i)) / s_depth )

with I and c as tones (see `points`), which see little of shading, and weighted by 1 / (1 + r^2)^2
(Geman-McClure), which forgets what is hidden by something else. The groups' normal equations are independent
of each other. An iteration costs a fraction of a rendered one, and depth pulls from further away than colour
does, so groups arrive, large turns included, where rendering can finish.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from gsjax.geometry.cameras import project
from gsjax.methods.object_tracker.config import AlignConfig
from gsjax.methods.object_tracker.points import Points, Sight, carry, of_groups


def bilinear(
    image: Float[Array, "h w d"], pixels: Float[Array, "*n 2"]
) -> tuple[Float[Array, "*n d"], Float[Array, "*n d 2"]]:
    """`image` between pixel centres (at +0.5), and its slope along x and y a pixel; outside, its border."""
    height, width = image.shape[:2]
    x = jnp.clip(pixels[..., 0] - 0.5, 0.0, width - 1.001)
    y = jnp.clip(pixels[..., 1] - 0.5, 0.0, height - 1.001)
    column, row = jnp.floor(x).astype(jnp.int32), jnp.floor(y).astype(jnp.int32)
    right, down = (x - column)[..., None], (y - row)[..., None]
    a, b = image[row, column], image[row, column + 1]
    c, d = image[row + 1, column], image[row + 1, column + 1]
    upper, lower = a + right * (b - a), c + right * (d - c)
    across = (b - a) + down * ((d - c) - (b - a))
    return upper + down * (lower - upper), jnp.stack([across, lower - upper], axis=-1)


class Residuals(NamedTuple):
    """How points differ from the images: red, green, blue and, where the frame has it, depth."""

    values: Float[Array, "c p d"]  # in units of their scales
    counts: Float[Array, "c p d"]  # 1 where there is something to compare with, else 0
    gradients: Float[Array, "c p d 3"]  # with respect to the point, a metre


def _residuals(points: Points, sight: Sight, config: AlignConfig) -> Residuals:
    """Of one group's points."""
    height, width = sight.tones.shape[1:3]

    def one(points, tones, viewmat, K, image, depth):
        pixels, z = project(points, viewmat, K)
        # d pixel / d point = (K - pixel e_z^T) / z, turned into the world's axes.
        axis = viewmat[2, :3]
        moves = (K[:2] @ viewmat[:3, :3] - pixels[:, :, None] * axis) / jnp.maximum(z, 1e-6)[:, None, None]
        inside = (pixels > 0.5).all(-1) & (pixels < jnp.array([width, height]) - 0.5).all(-1)
        inside &= z > 1e-3
        found, slopes = bilinear(image, pixels)
        values = (found - tones) / config.color_scale
        gradients = slopes @ moves / config.color_scale
        counts = jnp.broadcast_to(inside[:, None], values.shape)
        if depth is None:
            return Residuals(values, counts.astype(z.dtype), gradients)
        # The depth between pixels that lie on two surfaces is nobody's: there, the nearest pixel's.
        column, row = jnp.floor(pixels).astype(jnp.int32).T
        nearest = depth[jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)]
        between, slope = bilinear(depth[..., None], pixels)
        smooth = jnp.abs(between[:, 0] - nearest) < config.depth_scale
        gap = (jnp.where(smooth, between[:, 0], nearest) - z) / config.depth_scale
        pull = (jnp.where(smooth[:, None], (slope @ moves)[:, 0], 0.0) - axis) / config.depth_scale
        return Residuals(
            jnp.concatenate([values, gap[:, None]], axis=1),
            jnp.concatenate([counts, (inside & (nearest > 0))[:, None]], axis=1).astype(z.dtype),
            jnp.concatenate([gradients, pull[:, None]], axis=1),
        )

    over_cameras = jax.vmap(one, in_axes=(0, 0, 0, 0, 0, None if sight.depths is None else 0))
    cameras = sight.cameras
    return over_cameras(points.means, points.tones, cameras.viewmat, cameras.K, sight.tones, sight.depths)


def _of_color(residuals: Residuals) -> Float[Array, "c p d"]:
    """Squared residuals, in which each colour channel has the mean of the three."""
    squared = residuals.values**2
    mean = squared[..., :3].mean(-1, keepdims=True)
    return jnp.concatenate([jnp.broadcast_to(mean, (*mean.shape[:-1], 3)), squared[..., 3:]], axis=-1)


def _normal_equations(points: Points, center: Float[Array, "3"], sight: Sight, config: AlignConfig):
    """(cost, J^T W J, J^T W r) of one group, for a small twist about `center`."""
    residuals = _residuals(points, sight, config)
    squared = _of_color(residuals)
    weights = points.seen[..., None]
    # What falls outside the picture, or is truncated, costs as much as a bad fit.
    cost = jnp.sum(weights * jnp.where(residuals.counts > 0, squared / (1 + squared), 0.5))
    arms = jnp.cross((points.means - center)[:, :, None], residuals.gradients)
    jacobian = jnp.concatenate([residuals.gradients, arms], axis=-1)
    robust = weights * residuals.counts / (1 + squared) ** 2
    weighted = jacobian * robust[..., None]
    hessian = jnp.einsum("cpdi,cpdj->ij", weighted, jacobian)
    return cost, hessian, jnp.einsum("cpdi,cpd->i", weighted, residuals.values)


class _Fit(NamedTuple):
    """The best twist so far of each group, with what it takes to go on from it."""

    twists: Float[Array, "k 6"]
    cost: Float[Array, "k"]
    hessian: Float[Array, "k 6 6"]
    gradient: Float[Array, "k 6"]


def align(
    twists: Float[Array, "k 6"],
    points: Points,
    centers: Float[Array, "k 3"],
    sight: Sight,
    config: AlignConfig,
) -> Float[Array, "k 6"]:
    """Levenberg-Marquardt from `twists` (translation, rotation vector) on all groups at once.

    Args:
        twists: where to start.
        points: where they were in the last frame.
        centers: the groups' centroids in the last frame.
        sight: what the cameras see now.
    """

    longest = jnp.array([config.max_step] * 3 + [config.max_turn] * 3)

    def fit(twists) -> _Fit:
        over_groups = jax.vmap(_normal_equations, in_axes=(0, 0, None, None))
        moved = carry(points, twists, centers)
        return _Fit(twists, *over_groups(moved, centers + twists[:, :3], sight, config))

    def iterate(carried, _):
        best, trial, damping = carried
        new = fit(trial)
        better = new.cost < best.cost
        best = jax.tree.map(lambda a, b: of_groups(better, a, b), new, best)
        damping = jnp.clip(jnp.where(better, damping * 0.3, damping * 10.0), 1e-4, 1e4)
        diagonal = jnp.einsum("kii->ki", best.hessian)
        # Directions that no pixel speaks of stand still.
        floor = jnp.array([1.0] * 3 + [1e-2 if config.max_turn else 1e12] * 3)
        damped = best.hessian + (damping[:, None] * diagonal + floor)[:, :, None] * jnp.eye(6)
        change = -jnp.linalg.solve(damped, best.gradient[..., None])[..., 0]
        trial = compose(jnp.clip(change, -longest, longest), best.twists)
        return (best, trial, damping), None

    count = len(twists)
    nothing = _Fit(twists, jnp.full(count, jnp.inf), jnp.zeros((count, 6, 6)), jnp.zeros((count, 6)))
    start = (nothing, twists, jnp.full(count, 1e-2))
    (best, *_), _ = jax.lax.scan(iterate, start, None, length=config.iterations + 1)
    return best.twists


def compose(change: Float[Array, "*k 6"], twists: Float[Array, "*k 6"]) -> Float[Array, "*k 6"]:
    """`twists` followed by `change` about the moved centres."""
    rotation = jaxlie.SO3.exp(change[..., 3:]) @ jaxlie.SO3.exp(twists[..., 3:])
    return jnp.concatenate([twists[..., :3] + change[..., :3], rotation.log()], axis=-1)


def disagreement(points: Points, sight: Sight, config: AlignConfig) -> Float[Array, "k"]:
    """How badly each group's points agree with the images: 0 perfect, 1 not at all.

    Colour and depth count the same; what falls outside the picture counts half.
    """

    def one(points):
        residuals = _residuals(points, sight, config)
        squared, counts = _of_color(residuals)[..., 2:], residuals.counts[..., 2:]
        known = jnp.maximum(counts.sum(-1), 1)
        cost = jnp.sum(counts * squared / (1 + squared), axis=-1) / known
        cost = jnp.where(counts[..., 0] > 0, cost, 0.5)
        return jnp.sum(points.seen * cost) / jnp.maximum(points.seen.sum(), 1e-6)

    return jax.vmap(one)(points)
