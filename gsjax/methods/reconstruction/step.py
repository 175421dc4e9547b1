"""One step of the fit: draw a view, compare, descend, and let what is transparent walk (3DGS-MCMC)."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt8

from gsjax.geometry.cameras import Camera
from gsjax.losses.photometric import photometric_loss, weighted_mean
from gsjax.methods.reconstruction.config import FitConfig
from gsjax.optim.densification import exploration, forgotten, is_alive, relocate
from gsjax.optim.step import Step, all_finite, gradient_step, keep_if, per_field_adam
from gsjax.rasterize.plan import Plan
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import render

_FINAL_RATE = 0.01  # of the means, over the first


class Observation(NamedTuple):
    """A photograph on the device.

    Attributes:
        image: RGB, 0 to 255.
        mask: which pixels count; None where all do.
        depth: 0 where unknown; None without depth.
        camera: one camera, viewmat [1,4,4] and K [1,3,3].
    """

    image: UInt8[Array, "1 height width 3"]
    mask: Bool[Array, "1 height width"] | None
    depth: Float[Array, "1 height width"] | None
    camera: Camera


class Batch(NamedTuple):
    """What a step is given: a photograph, the colour behind the scene, and a plan to draw it with."""

    seen: Observation
    background: Float[Array, "1 3"]
    plan: Plan


def fit_loss(config: FitConfig, radius: float) -> Callable:
    """`loss(gaussians, batch, *, step, key)`: L1 and D-SSIM, the difference in depth, and what opacity and
    size cost (3DGS-MCMC, eq. 10), of one photograph."""

    def loss(gaussians: Gaussians, batch: Batch, *, step: Any, key: Any):
        seen, background, plan = batch
        drawn = render(gaussians, seen.camera, plan, backgrounds=background)
        target = seen.image.astype(drawn.colors.dtype) / 255
        image = drawn.colors
        if seen.mask is not None:  # what does not count is as it was photographed: no slope, no edge
            image = jnp.where(seen.mask[..., None], image, target)
        value = photometric_loss(image, target, config.dssim_weight)
        counted = 1.0 if seen.mask is None else seen.mask.mean()
        mse = jnp.square(image - target).mean() / counted
        if config.depth_weight and seen.depth is not None:
            known = (seen.depth > 0) & jax.lax.stop_gradient(drawn.alphas > 0.5)
            if seen.mask is not None:
                known &= seen.mask
            off = weighted_mean(jnp.abs(drawn.depths - seen.depth), known.astype(value.dtype))
            value += config.depth_weight * off / radius
        alive = jax.lax.stop_gradient(is_alive(gaussians).astype(value.dtype))
        value += config.growth.opacity_cost * weighted_mean(gaussians.opacities, alive)
        value += config.growth.scale_cost * weighted_mean(gaussians.scales.mean(-1), alive) / radius
        return value, {
            "psnr": -10 * jnp.log10(mse),
            "overflow": drawn.meta.overflow.any(),
            "needed": drawn.meta.needed.max(),
        }

    return loss


def reconstruction_step(config: FitConfig, radius: float) -> Step:
    """Adam on Gaussians, and the walk of 3DGS-MCMC.

    `batch` is a `Batch`, `step` the share of the fit that is done, 0 to 1, and `key` is needed. `info` has
    `alive` beside what the loss says.

    Args:
        config: of the fit.
        radius: of the scene, the unit in which means move.
    """
    rates = vars(config.rates)
    loss = fit_loss(config, radius)

    def of(gaussians: Gaussians) -> Step:
        there = [name for name in rates if getattr(gaussians, name) is not None]
        # Means go as far as Adam's rate of 1 says, and then only a share of it, which falls with time.
        return gradient_step(loss, per_field_adam({name: rates[name] for name in there} | {"means": 1.0}))

    def update(params: Gaussians, state, batch: Batch, *, step, key: PRNGKeyArray):
        moved, new_state, info = of(params).update(params, state, batch, step=step, key=key)
        rate = rates["means"] * radius * _FINAL_RATE**step
        walk = exploration(moved, key, config.growth.noise * rate)
        walk = jnp.where(is_alive(moved)[:, None] & ~info["skipped"], walk, 0.0)
        means = params.means + rate * (moved.means - params.means) + walk
        moved = eqx.tree_at(lambda g: g.means, moved, means)
        sound = all_finite(moved)
        params, state = keep_if(sound, (moved, new_state), (params, state))
        return params, state, info | {"alive": is_alive(params).sum(), "skipped": info["skipped"] | ~sound}

    return Step(lambda params: of(params).init(params), update)


def grow(
    gaussians: Gaussians, state: Any, key: PRNGKeyArray, cap: Int[Array, ""] | int, factor: float
) -> tuple[Gaussians, Any]:
    """Dead Gaussians move to where more are needed, and there may be `factor` times as many, up to `cap`."""
    used = jnp.max(jnp.where(is_alive(gaussians), jnp.arange(gaussians.num) + 1, 0))
    slots = jnp.clip((used * factor).astype(jnp.int32), used, cap)
    moved, touched = relocate(gaussians, key, slots)
    return moved, forgotten(state, touched)
