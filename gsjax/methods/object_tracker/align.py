"""Direct alignment of each group with the images: Gauss-Newton over six numbers a group, nothing rendered.

What aligns is a set of points with colours: the Gaussians' centres, which remember the first frame, and
pixels of the last frame that show the group, which know the sides that the first frame did not see. Each
point has a colour and a depth to agree with at the pixel it falls on:

    r_i = ( (I(pi(D x_i)) - c_i) / s_color,  (Z(pi(D x_i)) - z(D x_i)) / s_depth )

weighted by 1 / (1 + r^2)^2 (Geman-McClure), which forgets what is hidden by something else. The groups'
normal equations are independent of each other. An iteration costs a fraction of a rendered one, and depth
pulls from further away than colour does, so groups arrive, large turns included, where rendering can finish.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, Int

from gsjax.geometry.cameras import pixel_grid, project, unproject
from gsjax.methods.object_tracker.config import AlignConfig
from gsjax.methods.object_tracker.motion import Motion, turn_about
from gsjax.scene.frame import Frame


class Points(NamedTuple):
    """Coloured points that belong to groups 1..K, and which cameras they may be looked for in."""

    means: Float[Array, "p 3"]
    colors: Float[Array, "p 3"]
    groups: Int[Array, "p"]
    seen: Float[Array, "c p"]  # 0 to 1


def join(a: Points, b: Points) -> Points:
    """The points of both."""
    seen = jnp.concatenate([a.seen, b.seen], axis=-1)
    return Points(*(jnp.concatenate([x, y]) for x, y in zip(a[:3], b[:3], strict=True)), seen)


def sample_groups(points: Points, num_groups: int, per_group: int) -> Points:
    """Up to `per_group` points of each group, spread over it; a large one needs no more."""
    shuffle = 1.0 + jax.random.permutation(jax.random.key(1), points.groups.shape[0]).astype(jnp.float32)
    size = min(per_group, points.groups.shape[0])

    def one(group):
        priority, rows = jax.lax.top_k(jnp.where(points.groups == group, shuffle, 0.0), size)
        return rows, jnp.where(priority > 0, 1.0, 0.0), jnp.full(size, group)

    rows, real, groups = (a.ravel() for a in jax.vmap(one)(jnp.arange(1, num_groups + 1)))
    return Points(points.means[rows], points.colors[rows], groups, points.seen[:, rows] * real)


def pixels_of_groups(
    frame: Frame,
    labels: Int[Array, "c h w"],
    depths: Float[Array, "c h w"],
    num_groups: int,
    config: AlignConfig,
) -> Points:
    """Up to `config.pixels` pixels of each group in each camera, as points.

    Args:
        frame: what the cameras saw; without depth, the model's depth stands in.
        labels: the group of each pixel, 0 for none.
        depths: of the model at that pixel. What is measured further off
            than a group is thick is something else.
    """
    height, width = labels.shape[1:]
    grid = pixel_grid(width, height).reshape(-1, 2)
    # A fixed shuffle: any first few of the chosen pixels are spread over the whole group.
    shuffle = jax.random.permutation(jax.random.key(0), height * width).astype(jnp.float32)
    num_cameras = labels.shape[0]

    def one(camera, group):
        measured = (depths if frame.depths is None else frame.depths)[camera].ravel()
        near = jnp.abs(measured - depths[camera].ravel()) < config.max_thickness
        chosen = (labels[camera].ravel() == group) & (measured > 0) & near
        priority, rows = jax.lax.top_k(jnp.where(chosen, 1.0 + shuffle, 0.0), config.pixels)
        viewmat, K = frame.cameras.viewmat[camera], frame.cameras.K[camera]
        means = unproject(grid[rows], measured[rows], viewmat, K)
        colors = frame.images[camera].reshape(-1, 3)[rows]
        seen = jnp.zeros((num_cameras, config.pixels)).at[camera].set(priority > 0)
        return means, colors, jnp.full(config.pixels, group), seen

    cameras, groups = jnp.meshgrid(jnp.arange(num_cameras), jnp.arange(1, num_groups + 1), indexing="ij")
    means, colors, groups, seen = jax.vmap(one)(cameras.ravel(), groups.ravel())
    return Points(
        means.reshape(-1, 3),
        colors.reshape(-1, 3),
        groups.ravel(),
        jnp.moveaxis(seen, 1, 0).reshape(num_cameras, -1),
    )


def bilinear(image: Float[Array, "h w d"], pixels: Float[Array, "*n 2"]) -> Float[Array, "*n d"]:
    """`image` between pixel centres (at +0.5); outside, its border."""
    height, width = image.shape[:2]
    x = jnp.clip(pixels[..., 0] - 0.5, 0.0, width - 1.001)
    y = jnp.clip(pixels[..., 1] - 0.5, 0.0, height - 1.001)
    column, row = jnp.floor(x).astype(jnp.int32), jnp.floor(y).astype(jnp.int32)
    right, down = (x - column)[..., None], (y - row)[..., None]
    upper = image[row, column] * (1 - right) + image[row, column + 1] * right
    lower = image[row + 1, column] * (1 - right) + image[row + 1, column + 1] * right
    return upper * (1 - down) + lower * down


def _residual(twist, mean, center, color, viewmat, K, image, depth, config: AlignConfig):
    """(four residuals in units of their scale, which of them count) of one Gaussian in one camera."""
    rotation = jaxlie.SO3.exp(twist[3:])
    moved = center + rotation @ (mean - center) + twist[:3]
    pixel, z = project(moved, viewmat, K)
    height, width = image.shape[:2]
    inside = (pixel > 0.5).all() & (pixel[0] < width - 0.5) & (pixel[1] < height - 0.5) & (z > 1e-3)
    color_gap = (bilinear(image, pixel) - color) / config.color_scale
    if depth is None:
        return color_gap, jnp.full(3, inside, z.dtype)
    # The depth of four pixels that do not lie on one surface is nobody's depth: there, the nearest pixel's.
    column = jnp.clip(jnp.floor(pixel[0]).astype(jnp.int32), 0, width - 1)
    row = jnp.clip(jnp.floor(pixel[1]).astype(jnp.int32), 0, height - 1)
    nearest, smooth = depth[row, column], bilinear(depth[..., None], pixel)[0]
    measured = jnp.where(jnp.abs(smooth - nearest) < config.depth_scale, smooth, nearest)
    depth_gap = (measured - z) / config.depth_scale
    counts = jnp.stack([inside] * 3 + [inside & (nearest > 0)]).astype(z.dtype)
    return jnp.concatenate([color_gap, depth_gap[None]]), counts


def align(
    motion: Motion,
    points: Points,
    centers: Float[Array, "k 3"],
    frame: Frame,
    config: AlignConfig,
    widen: float = 1.0,
) -> Motion:
    """Levenberg-Marquardt from `motion` on all groups at once; delta stays as it is.

    Args:
        motion: where to start.
        points: where they were in the last frame.
        centers: the groups' centroids in the last frame.
        frame: what the cameras see now.
        widen: factor on the scales of the residuals; wider listens to more of what disagrees.
    """
    config = replace(config, color_scale=widen * config.color_scale, depth_scale=widen * config.depth_scale)
    member = points.groups - 1
    num_groups = centers.shape[0]

    def normal_equations(twists):
        """(cost, J^T W J, J^T W r) of every group."""
        moved = turn_about(points.means, twists, centers, points.groups)

        def one(mean, center, color, weight, viewmat, K, image, depth):
            def at(twist):
                return _residual(twist, mean, center, color, viewmat, K, image, depth, config)

            r, counts = at(jnp.zeros(6))
            jacobian = jax.jacfwd(lambda t: at(t)[0])(jnp.zeros(6))
            squared = (r**2).at[:3].set((r[:3] ** 2).mean())
            robust = counts * weight / (1 + squared) ** 2
            # What falls outside the picture, or is truncated, costs as much as a bad fit.
            cost = weight * jnp.where(counts > 0, squared / (1 + squared), 0.5).sum()
            weighted = jacobian * robust[:, None]
            return cost, weighted.T @ jacobian, weighted.T @ r

        current = centers + twists[:, :3]
        over_points = jax.vmap(one, in_axes=(0, 0, 0, 0, None, None, None, None))
        depth_axis = None if frame.depths is None else 0
        over_cameras = jax.vmap(over_points, in_axes=(None, None, None, 0, 0, 0, 0, depth_axis))
        views = (frame.cameras.viewmat, frame.cameras.K, frame.images, frame.depths)
        terms = over_cameras(moved, current[member], points.colors, points.seen, *views)
        return jax.tree.map(lambda a: jax.ops.segment_sum(a.sum(0), member, num_groups), terms)

    def iterate(carry, _):
        twists, trial, best_cost, damping, equations = carry
        cost, hessian, gradient = normal_equations(trial)
        better = cost < best_cost
        twists = jnp.where(better[:, None], trial, twists)
        best_cost = jnp.where(better, cost, best_cost)
        keep = lambda new, old: jnp.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)  # noqa: E731
        equations = (keep(hessian, equations[0]), keep(gradient, equations[1]))
        damping = jnp.clip(jnp.where(better, damping * 0.3, damping * 10.0), 1e-4, 1e4)
        hessian, gradient = equations
        diagonal = jnp.einsum("kii->ki", hessian)
        floor = jnp.array([1.0] * 3 + [1e-2] * 3)  # directions that no pixel speaks of stand still
        damped = hessian + (damping[:, None] * diagonal + floor)[:, :, None] * jnp.eye(6)
        change = -jnp.linalg.solve(damped, gradient[..., None])[..., 0]
        change = jnp.clip(change, -config.max_step, config.max_step)
        trial = _compose(change, twists)
        return (twists, trial, best_cost, damping, equations), None

    start = jnp.concatenate([motion.translations, motion.rotations], axis=-1)
    nothing = (jnp.zeros((num_groups, 6, 6)), jnp.zeros((num_groups, 6)))
    carry = (start, start, jnp.full(num_groups, jnp.inf), jnp.full(num_groups, 1e-2), nothing)
    (twists, *_), _ = jax.lax.scan(iterate, carry, None, length=config.iterations + 1)
    return Motion(twists[:, :3], twists[:, 3:], motion.delta)


def _compose(change: Float[Array, "k 6"], twists: Float[Array, "k 6"]) -> Float[Array, "k 6"]:
    """`twists` followed by `change` about the moved centres."""
    rotation = jaxlie.SO3.exp(change[:, 3:]) @ jaxlie.SO3.exp(twists[:, 3:])
    return jnp.concatenate([twists[:, :3] + change[:, :3], rotation.log()], axis=-1)


def disagreement(
    points: Points, means: Float[Array, "p 3"], num_groups: int, frame: Frame, config: AlignConfig
) -> Float[Array, "k"]:
    """How badly each group's points at `means` agree with the images: 0 perfect, 1 not at all."""

    def one(mean, color, weight, viewmat, K, image, depth):
        r, counts = _residual(jnp.zeros(6), mean, mean, color, viewmat, K, image, depth, config)
        of_color = (r[:3] ** 2).mean()
        squared = of_color[None] if depth is None else jnp.stack([of_color, r[3] ** 2])
        known = jnp.stack([counts[0], counts[-1]])[: squared.shape[0]]
        cost = jnp.sum(known * squared / (1 + squared)) / jnp.maximum(known.sum(), 1)
        return weight * jnp.where(counts[0] > 0, cost, 0.5)

    over_points = jax.vmap(one, in_axes=(0, 0, 0, None, None, None, None))
    depth_axis = None if frame.depths is None else 0
    views = (frame.cameras.viewmat, frame.cameras.K, frame.images, frame.depths)
    costs = jax.vmap(over_points, in_axes=(None, None, 0, 0, 0, 0, depth_axis))(
        means, points.colors, points.seen, *views
    )
    member = points.groups - 1
    total = jax.ops.segment_sum(costs.sum(0), member, num_groups)
    count = jax.ops.segment_sum(points.seen.sum(0), member, num_groups)
    return total / jnp.maximum(count, 1e-6)
