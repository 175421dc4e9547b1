"""Photometric refinement of D_k and delta_i against the new images (papers/000, section II-C)."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float

from gsjax.geometry.cameras import project
from gsjax.losses.photometric import weighted_mean
from gsjax.methods.object_tracker.config import RefineConfig
from gsjax.methods.object_tracker.motion import Motion, Pose, group_means, move, place
from gsjax.methods.object_tracker.scene import TrackedScene
from gsjax.rasterize.plan import TILE, Plan
from gsjax.scene.frame import Frame
from gsjax.scene.render import render


class RefineBatch(NamedTuple):
    """What the refinement is given and does not train."""

    scene: TrackedScene
    frame: Frame
    plan: Plan
    pose: Pose  # of the last frame
    centers: Float[Array, "k 3"]
    roi: Bool[Array, "c height width"]


def refine_loss(
    motion: Motion, batch: RefineBatch, *, step: Any, key: Any, config: RefineConfig
) -> tuple[Float[Array, ""], dict[str, Any]]:
    """Truncated colour and depth differences over the region of interest, and what delta costs.

    Pixels of the region count by their rendered alpha, taken as a constant: what no Gaussian covers says
    nothing, and uncovering it gains nothing.
    """
    scene, frame = batch.scene, batch.frame
    groups = scene.labels[: scene.num_moving]
    pose = move(batch.pose, motion, batch.centers, groups)
    rendered = render(place(scene, pose), frame.cameras, batch.plan, roi=batch.roi)
    weights = jax.lax.stop_gradient(rendered.alphas) * batch.roi
    if frame.weights is not None:
        weights = weights * frame.weights
    difference = jnp.minimum(jnp.abs(rendered.colors - frame.images), config.color_limit).mean(-1)
    # Sums over pixels, in units of a thousand: an object's pull does not depend on what else is in view.
    color = 1e-3 * jnp.sum(difference * weights)
    loss = color
    if frame.depths is not None:
        known = weights * (frame.depths > 0)
        gap = jnp.minimum(jnp.abs(rendered.depths - frame.depths), config.depth_limit)
        loss += 1e-3 * config.depth_weight * jnp.sum(gap * known)
    spread = group_means(
        jnp.sum((motion.delta / config.delta_scale) ** 2, axis=-1), groups, scene.num_objects
    )
    loss += 1e-3 * config.delta_weight * spread.sum()
    info = {
        "color": weighted_mean(difference, weights),
        "overflow": rendered.meta.overflow.any(),
        "needed": rendered.meta.needed.max(),
    }
    return loss, info


def refine(motion: Motion, batch: RefineBatch, config: RefineConfig) -> tuple[Motion, dict[str, Any]]:
    """Adam from `motion`, with rates that fall to a tenth over the iterations."""
    fade = optax.exponential_decay(1.0, config.iterations, 0.1)

    def rate(value):
        return optax.adam(lambda i: value * fade(i), b1=0.8, b2=0.95)

    optimizer = optax.multi_transform(
        {"t": rate(config.translation_rate), "r": rate(config.rotation_rate), "d": rate(config.delta_rate)},
        Motion("t", "r", "d"),
    )

    def loss(motion):
        fixed = (
            motion
            if config.se3
            else Motion(motion.translations, jnp.zeros_like(motion.rotations), motion.delta)
        )
        return refine_loss(fixed, batch, step=0, key=None, config=config)

    def iterate(carry, _):
        motion, state = carry
        (value, info), gradient = jax.value_and_grad(loss, has_aux=True)(motion)
        gradient = jax.tree.map(lambda g: jnp.where(jnp.isfinite(g), g, 0.0), gradient)
        updates, state = optimizer.update(gradient, state, motion)
        return (optax.apply_updates(motion, updates), state), {**info, "loss": value}

    start = (motion, optimizer.init(motion))
    (motion, _), infos = jax.lax.scan(iterate, start, None, length=config.iterations)
    overflow, needed = infos.pop("overflow").any(), infos.pop("needed").max()
    info = {name: values[-1] for name, values in infos.items()}
    return motion, {**info, "first_loss": infos["loss"][0], "overflow": overflow, "needed": needed}


def region_of_interest(positions: list[Float[Array, "m 3"]], frame: Frame) -> Bool[Array, "c height width"]:
    """Pixels of all tiles that hold or border on a moving Gaussian, in any of the given poses."""
    width, height = frame.cameras.width, frame.cameras.height
    columns, rows = -(-width // TILE), -(-height // TILE)
    points = jnp.concatenate(positions)

    def one(viewmat, K):
        pixels, depth = project(points, viewmat, K)
        tile = jnp.floor(pixels / TILE)
        inside = (depth > 1e-3) & (tile >= -1).all(-1) & (tile[:, 0] <= columns) & (tile[:, 1] <= rows)
        column, row = jnp.clip(tile, -1, jnp.array([columns, rows])).astype(jnp.int32).T
        touched = jnp.zeros((rows + 2, columns + 2), bool).at[row + 1, column + 1].max(inside)
        near = jax.lax.reduce_window(touched, False, jnp.logical_or, (3, 3), (1, 1), "SAME")[1:-1, 1:-1]
        return jnp.repeat(jnp.repeat(near, TILE, axis=0), TILE, axis=1)[:height, :width]

    return jax.vmap(one)(frame.cameras.viewmat, frame.cameras.K)


def point_residuals(
    colors: Float[Array, "m 3"],
    means: Float[Array, "m 3"],
    seen: Float[Array, "c m"],
    scene: TrackedScene,
    frame: Frame,
    config: RefineConfig,
) -> Float[Array, "k"]:
    """How badly Gaussians at `means` agree with the pixels they fall on, a group; 0 is perfect, 1 is truncated.

    A cheap stand-in for rendering, to choose between hypotheses: colour and depth at each centre, both
    truncated, averaged over the Gaussians that were seen. Falling outside the picture counts as a half.
    """
    height, width = frame.images.shape[1:3]

    def one(viewmat, K, image, depth, weight):
        pixels, z = project(means, viewmat, K)
        inside = (
            (pixels > 0.5).all(-1) & (pixels[:, 0] < width - 0.5) & (pixels[:, 1] < height - 0.5) & (z > 1e-3)
        )
        where = jnp.where(inside[:, None], pixels - 0.5, 0.0)
        value = _bilinear(image, where)
        residual = jnp.minimum(jnp.abs(value - colors).mean(-1), config.color_limit) / config.color_limit
        if depth is not None:
            column, row = jnp.round(where).astype(jnp.int32).T
            measured = depth[row, column]
            gap = jnp.minimum(jnp.abs(measured - z), config.depth_limit) / config.depth_limit
            residual = jnp.where(measured > 0, 0.5 * (residual + gap), residual)
        return jnp.where(inside, residual, 0.5) * weight, weight

    depth_axis = None if frame.depths is None else 0
    views = (frame.cameras.viewmat, frame.cameras.K, frame.images, frame.depths, seen)
    residual, weight = jax.vmap(one, in_axes=(0, 0, 0, depth_axis, 0))(*views)
    groups = scene.labels[: scene.num_moving] - 1
    total = jax.ops.segment_sum(residual.sum(0), groups, scene.num_objects)
    count = jax.ops.segment_sum(weight.sum(0), groups, scene.num_objects)
    return total / jnp.maximum(count, 1e-6)


def _bilinear(image: Float[Array, "h w 3"], where: Float[Array, "m 2"]) -> Float[Array, "m 3"]:
    coordinates = [where[:, 1], where[:, 0]]
    sample = jax.vmap(
        lambda a: jax.scipy.ndimage.map_coordinates(a, coordinates, order=1, mode="nearest"), -1, -1
    )
    return sample(image)
