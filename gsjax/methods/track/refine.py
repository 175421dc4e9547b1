"""Photometric refinement of D_k and delta_i against the new images (Object-Aware Gaussian Splatting for
Robotic Manipulation, section II-C)."""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import optax
from jaxtyping import Array, Bool, Float

from gsjax.geometry.cameras import camera_centers
from gsjax.losses.extra import ExtraLosses, extra_terms
from gsjax.losses.photometric import weighted_mean
from gsjax.methods.track.config import RefineConfig
from gsjax.methods.track.motion import Motion, Pose, facing, group_means, move, place
from gsjax.methods.track.region import shift_background
from gsjax.methods.track.scene import TrackedScene
from gsjax.optim.residuals import block_residual
from gsjax.rasterize.plan import Plan
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import Rendered, render


class RefineBatch(NamedTuple):
    """The fixed input of the refinement."""

    scene: TrackedScene
    frame: Frame
    plan: Plan
    pose: Pose  # of the last frame
    centers: Float[Array, "k 3"]
    roi: Bool[Array, "c height width"]


def refine_loss(
    motion: Motion,
    batch: RefineBatch,
    *,
    step: Any,
    key: Any,
    config: RefineConfig,
    extra_losses: ExtraLosses = (),
) -> tuple[Float[Array, ""], dict[str, Any]]:
    """Truncated colour and depth differences over the region of interest, and a penalty on delta.

    Pixels of the region are weighted by their rendered alpha, taken as a constant: uncovered pixels do not
    count, and uncovering one gains nothing.

    Args:
        motion: motion of groups and Gaussians, the parameters.
        batch: see `RefineBatch`.
        step, key: not used; they belong to the signature of a loss.
        config: limits and weights.
        extra_losses: custom losses to add (`gsjax.losses.extra`); their scene is the `TrackedScene` after the
            motion.
    """
    scene, frame = batch.scene, batch.frame
    gaussians, rendered, weights = _moved(motion, batch)
    difference = jnp.minimum(jnp.abs(rendered.colors - frame.images), config.color_limit).mean(-1)
    # Sums over pixels, in thousands: the gradient of an object does not depend on what else is in view.
    color = 1e-3 * jnp.sum(difference * weights)
    loss = color
    if frame.depths is not None:
        known = weights * (frame.depths > 0)
        gap = jnp.minimum(jnp.abs(rendered.depths - frame.depths), config.depth_limit)
        loss += 1e-3 * config.depth_weight * jnp.sum(gap * known)
    squared = jnp.sum((motion.delta / config.delta_scale) ** 2, axis=-1)
    penalty = group_means(squared, scene.groups, scene.num_objects).sum()
    loss += 1e-3 * config.delta_weight * penalty
    info = {
        "color": weighted_mean(difference, weights),
        "overflow": rendered.meta.overflow.any(),
        "needed": rendered.meta.needed.max(),
    }
    if extra_losses:
        now = eqx.tree_at(lambda s: s.gaussians, scene, gaussians)
        info["extra"] = extra_terms(extra_losses, now, rendered, frame)
        loss += sum(info["extra"].values())
    return loss, info


def refine_residual(
    motions: jaxlie.SE3,
    batch: RefineBatch,
    *,
    step: Any,
    key: Any,
    config: RefineConfig,
    block: int = 4,
    softness: float = 0.1,
) -> tuple[dict[str, Float[Array, "..."]], dict[str, Any]]:
    """The differences of `refine_loss` as residuals of rigid motions, for `gsjax.optim.least_squares`.

    Half their sum of squares is a thousand times that loss (with blocks of one pixel), except that
    differences below `softness` times their limit are smoothed.

    Args:
        motions: motion of each of the K groups about its centre.
        batch: see `RefineBatch`. If the Jacobian is computed by columns, the plan's derivative must be
            "forward".
        step, key: not used; they belong to the signature of a residual.
        config: limits and weights.
        block, softness: as for `block_residual`.
    """
    twists = jnp.concatenate([motions.translation(), motions.rotation().log()], axis=-1)
    _, rendered, weights = _moved(Motion(twists, jnp.zeros_like(batch.pose.means)), batch)
    frame = batch.frame
    residual = partial(block_residual, block=block, softness=softness)
    residuals = {
        "color": residual(rendered.colors - frame.images, weights[..., None] / 3, config.color_limit)
    }
    if frame.depths is not None:
        known = config.depth_weight * weights * (frame.depths > 0)
        gap = (rendered.depths - frame.depths)[..., None]
        residuals["depth"] = residual(gap, known[..., None], config.depth_limit)
    return residuals, {"overflow": rendered.meta.overflow.any(), "needed": rendered.meta.needed.max()}


def _moved(motion: Motion, batch: RefineBatch) -> tuple[Gaussians, Rendered, Float[Array, "c height width"]]:
    """The scene after the motion, its render, and the weight of each pixel."""
    scene, cameras = batch.scene, batch.frame.cameras
    pose = move(batch.pose, motion, batch.centers, scene.groups)
    visibility = facing(scene, pose, camera_centers(cameras.viewmat))
    gaussians = place(scene, pose)
    rendered = render(gaussians, cameras, batch.plan, roi=batch.roi, visibility=visibility)
    return gaussians, rendered, jax.lax.stop_gradient(rendered.alphas) * batch.roi


def refine(
    motion: Motion, batch: RefineBatch, config: RefineConfig, extra_losses: ExtraLosses = ()
) -> tuple[Motion, Float[Array, "b 3"] | None, dict[str, Any]]:
    """Adam from `motion`, with learning rates that fall to a tenth over the iterations.

    Args:
        motion: initial motion of groups and Gaussians.
        batch: see `RefineBatch`.
        config: rates, limits and weights.
        extra_losses: see `refine_loss`.

    Returns:
        The motion, the displacement of each Gaussian of the batch's background (None if that is frozen), and
        info, whose `culled` counts elements of gradients that were not finite and were set to 0.
    """
    rates = jnp.array([config.translation_rate] * 3 + [config.rotation_rate] * 3)
    still = batch.scene.num_moving
    shifts = jnp.zeros_like(batch.scene.gaussians.means[still:]) if config.background_rate else None

    def scaled(updates, _):
        motion, shifts = updates
        shifts = None if shifts is None else config.background_rate * shifts
        return Motion(rates * motion.twists, config.delta_rate * motion.delta), shifts

    optimizer = optax.chain(
        optax.scale_by_adam(b1=0.8, b2=0.95),
        optax.scale_by_schedule(optax.exponential_decay(-1.0, config.iterations, 0.1)),
        optax.stateless(scaled),
    )

    def loss(trained):
        motion, shifts = trained
        moved = batch if shifts is None else batch._replace(scene=shift_background(batch.scene, shifts))
        return refine_loss(motion, moved, step=0, key=None, config=config, extra_losses=extra_losses)

    def iterate(carry, _):
        trained, state = carry
        (value, info), gradient = jax.value_and_grad(loss, has_aux=True)(trained)
        culled = sum(jnp.sum(~jnp.isfinite(g)) for g in jax.tree.leaves(gradient))
        gradient = jax.tree.map(lambda g: jnp.where(jnp.isfinite(g), g, 0.0), gradient)
        updates, state = optimizer.update(gradient, state, trained)
        return (optax.apply_updates(trained, updates), state), {**info, "loss": value, "culled": culled}

    trained = (motion, shifts)
    end: Any  # optax annotates less than it returns
    end, infos = jax.lax.scan(iterate, (trained, optimizer.init(trained)), None, length=config.iterations)
    motion, shifts = end[0]
    overflow, needed = infos.pop("overflow").any(), infos.pop("needed").max()
    info = jax.tree.map(lambda values: values[-1], infos)
    info |= {"first_loss": infos["loss"][0], "culled": infos["culled"].sum()}
    return motion, shifts, {**info, "overflow": overflow, "needed": needed}
