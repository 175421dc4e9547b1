"""Direct alignment of a group with the images: Levenberg-Marquardt over its rigid motion, without rendering.

A set of points with colours is aligned: pixels that showed the group earlier, and centres (see `points`).
Each is compared in colour and depth with the pixel it projects to:

    r_i = ( (I(pi(D x_i)) - c_i) / s_color,  (Z(pi(D x_i)) - z(D x_i)) / s_depth )

with I and c as tones (see `points`), which depend little on shading, and weighted by 1 / (1 + r^2)^2
(Geman-McClure), which suppresses occluded points. An iteration costs a fraction of one that renders, and
depth converges from further away than colour, so even after large rotations, groups come close enough for
photometric refinement to converge. All functions here are for one group and one start; `jax.vmap` maps them
over many.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from gsjax.methods.track.config import AlignConfig
from gsjax.methods.track.points import Points, ToneImages, carry, rotated, sum_of_three
from gsjax.optim.compiler import in_memory

_CHANNELS = (3, 1)  # weights in the cost: of colour, the mean of three channels, and of depth


class Sample(NamedTuple):
    """An image of d channels, sampled at p positions."""

    values: Float[Array, "d p"]
    slopes: Float[Array, "2 d p"]  # along x and y, per pixel
    nearest: Float[Array, "d p"]  # values of the nearest pixel


class PixelPosition(NamedTuple):
    """Positions between the centres of four pixels, which are at +0.5."""

    pixel: Int[Array, "p"]  # flat index of the upper left one
    right: Float[Array, "p"]  # distance to the right of its centre, pixels, 0 to 1
    down: Float[Array, "p"]  # distance below its centre, pixels, 0 to 1


def pixel_position(x: Float[Array, "p"], y: Float[Array, "p"], width: int, height: int) -> PixelPosition:
    """The positions (x, y), pixels with centres at +0.5, clamped to an image of this width and height."""
    x = jnp.clip(x - 0.5, 0.0, width - 1.001)
    y = jnp.clip(y - 0.5, 0.0, height - 1.001)
    column, row = jnp.floor(x).astype(jnp.int32), jnp.floor(y).astype(jnp.int32)
    return PixelPosition(row * width + column, x - column, y - row)


def bilinear(image: Float[Array, "h w d"], at: PixelPosition) -> Sample:
    """The image, interpolated bilinearly at these positions."""
    _, width, channels = image.shape
    (pixel, right, down), pixels = at, image.reshape(-1, channels)
    a, b, c, d = (pixels[pixel + offset].T for offset in (0, 1, width, width + 1))
    upper, lower = a + right * (b - a), c + right * (d - c)
    across = (b - a) + down * ((d - c) - (b - a))
    above, below = jnp.where(right < 0.5, a, b), jnp.where(right < 0.5, c, d)
    return Sample(
        upper + down * (lower - upper),
        jnp.stack([across, lower - upper]),
        jnp.where(down < 0.5, above, below),
    )


class Residuals(NamedTuple):
    """Differences between points and images: red, green, blue and, if the frame has it, depth."""

    values: Float[Array, "c d p"]  # in units of their scales
    counts: Bool[Array, "c kinds p"]  # whether there is a colour, and a depth, to compare with
    gradients: Float[Array, "c 3 d p"]  # with respect to the point, per metre


def _residuals(
    points: Points, images: ToneImages, config: AlignConfig, widen: Float[ArrayLike, ""] = 1.0
) -> Residuals:
    """The residuals of one group's points."""
    height, width, channels = images.pixels.shape[1:]
    scales = widen * jnp.array([config.color_scale] * 3 + [config.depth_scale] * (channels - 3))[:, None]

    def one(means, tones, viewmat, K, image):
        local = rotated(viewmat[:3, :3], means) + viewmat[:3, 3:]
        z = jnp.maximum(local[2], 1e-6)
        x, y, _ = rotated(K, local) / z
        inside = (x > 0.5) & (x < width - 0.5) & (y > 0.5) & (y < height - 0.5) & (local[2] > 1e-3)
        # All cameras' K: under vmap, a condition on this camera's own would compute both branches.
        at = in_memory(pixel_position(x, y, width, height), images.cameras.K)
        found, (across, along), nearest = bilinear(image, at)
        wanted, counts = tones, inside[None]
        if channels == 4:
            # Depth interpolated between two surfaces is that of neither: take the nearest pixel's there.
            smooth = jnp.abs(found[3] - nearest[3]) < scales[3]
            found = found.at[3].set(jnp.where(smooth, found[3], nearest[3]))
            across, along = (slope.at[3].set(jnp.where(smooth, slope[3], 0.0)) for slope in (across, along))
            wanted = jnp.concatenate([tones, local[2:]])
            counts = jnp.stack([inside, inside & (nearest[3] > 0)])
        # d pixel / d local = (K - pixel e_z^T) / z
        gradients = K[0, :, None, None] * (across / z) + K[1, :, None, None] * (along / z)
        gradients = gradients.at[2].add(-(x * across + y * along) / z)
        if channels == 4:
            gradients = gradients.at[2, 3].add(-1.0)
        gradients = jnp.swapaxes(rotated(viewmat[:3, :3].T, jnp.swapaxes(gradients / scales, 0, 1)), 0, 1)
        return Residuals((found - wanted) / scales, counts, gradients)

    return jax.vmap(one)(points.means, points.tones, images.cameras.viewmat, images.cameras.K, images.pixels)


def _by_kind(products: Float[Array, "*n c d p"]) -> list[Float[Array, "*n c p"]]:
    """Sums over the channels of colour and, if there is one, of depth."""
    color, channels = sum_of_three(products[..., :3, :], axis=-2), products.shape[-2]
    return [color, *(products[..., i, :] for i in range(3, channels))]


def _squared(residuals: Residuals) -> list[Float[Array, "c p"]]:
    """Squared residuals; for colour, the mean of the three channels."""
    color, *depth = _by_kind(residuals.values**2)
    return [color / 3, *depth]


class _Fit(NamedTuple):
    """A twist and its normal equations."""

    twist: Float[Array, "6"]
    cost: Float[Array, ""]
    hessian: Float[Array, "6 6"]
    gradient: Float[Array, "6"]


def _normal_equations(
    twist: Float[Array, "6"],
    points: Points,
    center: Float[Array, "3"],
    images: ToneImages,
    config: AlignConfig,
    widen: Float[ArrayLike, ""] = 1.0,
) -> _Fit:
    """Cost, J^T W J and J^T W r after `twist`, for a small twist that follows it about the moved centre."""
    moved = carry(points, twist, center)
    residuals = _residuals(moved, images, config, widen)
    squared = _squared(residuals)
    kinds = list(zip(_CHANNELS[: len(squared)], squared, jnp.moveaxis(residuals.counts, 1, 0), strict=True))
    # Where there is nothing to compare with, a point costs half as much as one that disagrees entirely.
    costs = points.seen * sum(n * jnp.where(counts, r / (1 + r), 0.5) for n, r, counts in kinds)
    weights = [points.seen * counts / (1 + r) ** 2 for _, r, counts in kinds]
    arms = tuple(jnp.moveaxis(moved.means - (center + twist[:3])[:, None], 1, 0))
    x, y, z = jnp.moveaxis(residuals.gradients, 1, 0)

    def over_channels(a, b) -> Float[Array, "c p"]:
        return jnp.asarray(sum(w * ab for w, ab in zip(weights, _by_kind(a * b), strict=True)))

    # A row of the Jacobian is (g, arm x g), so a point adds (F, F A^T; A F, A F A^T) with A v = arm x v and F
    # the sum of g g^T over its channels. No row is stored, as XLA:CPU would for a matrix product.
    products = [over_channels(*pair) for pair in ((x, x), (x, y), (x, z), (y, y), (y, z), (z, z))]
    pulls = [over_channels(a, residuals.values) for a in (x, y, z)]
    (xx, xy, xz, yy, yz, zz), pulls, costs = in_memory((products, pulls, costs), images.cameras.K)
    forces = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
    levers = [_cross(arms, force) for force in forces]  # the columns of A F
    torques = [_cross(arms, lever) for lever in zip(*levers, strict=True)]
    upper = [(*force, *lever) for force, lever in zip(forces, levers, strict=True)]
    lower = [(*lever, *torque) for lever, torque in zip(zip(*levers, strict=True), torques, strict=True)]
    hessian = jnp.stack([jnp.stack(row).sum((1, 2)) for row in upper + lower])
    *gradient, cost = jnp.stack([*pulls, *_cross(arms, pulls), costs]).sum((1, 2))
    return _Fit(twist, cost, hessian, jnp.stack(gradient))


def _cross(a, b):
    """a x b, with three arrays each."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def align(
    twist: Float[Array, "6"],
    points: Points,
    center: Float[Array, "3"],
    images: ToneImages,
    config: AlignConfig,
    widen: Float[ArrayLike, ""] = 1.0,
) -> Float[Array, "6"]:
    """The twist (translation, metres, and rotation vector) that Levenberg-Marquardt finds.

    Args:
        twist: the start.
        points: points of one group, in the last frame.
        center: its centroid in the last frame, metres.
        images: the new frame.
        config: configuration of the alignment.
        widen: factor on the scales of the residuals; `config.widen` for starts that are far off.
    """
    longest = jnp.array([config.max_step] * 3 + [config.max_turn] * 3)
    # Regularises directions that no pixel constrains.
    floor = jnp.array([1.0] * 3 + [1e-2 if config.max_turn else 1e12] * 3)

    def iterate(carried, _):
        best, trial, damping = carried
        new = _normal_equations(trial, points, center, images, config, widen)
        better = new.cost < best.cost
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, best)
        damping = jnp.clip(jnp.where(better, damping * 0.3, damping * 10.0), 1e-4, 1e4)
        damped = best.hessian + jnp.diag(damping * jnp.diagonal(best.hessian) + floor)
        change = -jax.scipy.linalg.solve(damped, best.gradient, assume_a="pos")
        return (best, compose(jnp.clip(change, -longest, longest), best.twist), damping), None

    nothing = _Fit(twist, jnp.inf, jnp.zeros((6, 6), twist.dtype), jnp.zeros_like(twist))
    start = (jax.tree.map(jnp.asarray, nothing), twist, jnp.asarray(1e-2, twist.dtype))
    (best, *_), _ = jax.lax.scan(iterate, start, None, length=config.iterations + 1)
    return best.twist


def align_coarse_to_fine(
    twist: Float[Array, "6"],
    points: Points,
    center: Float[Array, "3"],
    images: ToneImages,
    config: AlignConfig,
) -> Float[Array, "6"]:
    """The twist after `align` with wide scales, then with the usual ones. Arguments as for `align`."""

    def once(twist, widen):
        return align(twist, points, center, images, config, widen), None

    return jax.lax.scan(once, twist, jnp.array([config.widen, 1.0], twist.dtype))[0]


def ball_grid(radius: float, spacing: float) -> Float[np.ndarray, "n 3"]:
    """The points of a cubic grid within `radius` of the origin, `spacing` apart."""
    steps = spacing * np.arange(-(radius // spacing), radius // spacing + 1)
    grid = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    return grid[np.linalg.norm(grid, axis=1) <= radius]


def coarse_shifts(config: AlignConfig, images: ToneImages) -> Float[Array, "n 6"]:
    """Twists that shift in all directions; none without depth, where objects of one colour would slide."""
    if not config.reach or images.depths is None:
        return jnp.zeros((0, 6))
    shifts = jnp.asarray(ball_grid(config.reach, config.spacing), float)
    return jnp.concatenate([shifts, jnp.zeros_like(shifts)], axis=1)


def principal_axes(points: Points, center: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Principal axes of a group, one per row: a bottle rolls about its own, whichever way it lies."""
    away = (points.means - center[:, None]) * (points.seen > 0)[:, None]
    _, vectors = jnp.linalg.eigh(jnp.einsum("cip,cjp->ij", away, away))
    return vectors.T


def rotation_hypotheses(
    twist: Float[Array, "6"], axes: Float[Array, "3 3"], angles: tuple[float, ...]
) -> Float[Array, "h 6"]:
    """The twist itself, and the twist after a rotation by plus or minus each angle about each of the axes."""
    steps = jnp.concatenate([axes * s * angle for angle in angles for s in (1.0, -1.0)])
    steps = jnp.concatenate([jnp.zeros_like(steps[:1]), steps])
    rotations = (jaxlie.SO3.exp(twist[3:]) @ jaxlie.SO3.exp(steps)).log()
    return jnp.concatenate([jnp.broadcast_to(twist[:3], rotations.shape), rotations], axis=-1)


def compose(change: Float[Array, "*k 6"], twists: Float[Array, "*k 6"]) -> Float[Array, "*k 6"]:
    """`twists` followed by `change` about the moved centres."""
    rotation = jaxlie.SO3.exp(change[..., 3:]) @ jaxlie.SO3.exp(twists[..., 3:])
    return jnp.concatenate([twists[..., :3] + change[..., :3], rotation.log()], axis=-1)


def disagreement(
    twist: Float[Array, "6"],
    points: Points,
    center: Float[Array, "3"],
    images: ToneImages,
    config: AlignConfig,
    widen: Float[ArrayLike, ""] = 1.0,
) -> Float[Array, ""]:
    """Disagreement of a group's points with the images after its twist: 0 if perfect, 1 if nothing agrees.

    Colour and depth have equal weight; a point outside the image counts half. Arguments as for `align`.
    """
    residuals = _residuals(carry(points, twist, center), images, config, widen)
    kinds = list(zip(_squared(residuals), jnp.moveaxis(residuals.counts, 1, 0), strict=True))
    cost = sum(counts * r / (1 + r) for r, counts in kinds)
    compared = sum(counts.astype(cost.dtype) for _, counts in kinds)
    cost = jnp.where(compared > 0, cost / jnp.maximum(compared, 1), 0.5)
    costs = in_memory(points.seen * cost, images.cameras.K)
    return jnp.sum(costs) / jnp.maximum(points.seen.sum(), 1e-6)
