"""Image losses: L1, D-SSIM (Kerbl et al. 2023, eq. 7) and truncated depth differences."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_C1, _C2 = 0.01**2, 0.03**2  # Wang et al. 2004, for values 0 to 1


def weighted_mean(values: Float[Array, "*n"], weights: Float[Array, "*n"]) -> Float[Array, ""]:
    """Mean of `values` under `weights`; 0 where all weights are."""
    return jnp.sum(values * weights) / jnp.maximum(jnp.sum(weights), 1e-12)


def l1_loss(
    image: Float[Array, "*n channels"],
    target: Float[Array, "*n channels"],
    weights: Float[Array, "*n"] | None = None,
) -> Float[Array, ""]:
    """Mean absolute difference over channels and (weighted) pixels."""
    difference = jnp.abs(image - target).mean(-1)
    return difference.mean() if weights is None else weighted_mean(difference, weights)


def truncated_l1(
    values: Float[Array, "*n"], targets: Float[Array, "*n"], weights: Float[Array, "*n"], limit: float
) -> Float[Array, ""]:
    """Weighted mean of min(|difference|, limit): what is further off is of something else."""
    return weighted_mean(jnp.minimum(jnp.abs(values - targets), limit), weights)


def _blur(images: Float[Array, "c h w k"], size: int = 11, sigma: float = 1.5) -> Float[Array, "c h w k"]:
    offsets = jnp.arange(size) - size // 2
    kernel = jnp.exp(-0.5 * (offsets / sigma) ** 2)
    kernel = (kernel / kernel.sum()).astype(images.dtype)
    for axis in (1, 2):
        half = size // 2
        padded = jnp.pad(images, [(half, half) if i == axis else (0, 0) for i in range(4)], mode="edge")
        length = images.shape[axis]
        images = sum(kernel[i] * jax.lax.slice_in_dim(padded, i, i + length, axis=axis) for i in range(size))
    return images


def ssim(image: Float[Array, "c h w k"], target: Float[Array, "c h w k"]) -> Float[Array, ""]:
    """Mean structural similarity (Wang et al. 2004) with an 11-pixel Gaussian window, values 0 to 1."""
    k = image.shape[-1]
    stacked = jnp.concatenate([image, target, image * image, target * target, image * target], axis=-1)
    blurred = _blur(stacked)
    mean_x, mean_y, xx, yy, xy = (blurred[..., i * k : (i + 1) * k] for i in range(5))
    var_x, var_y, cov = xx - mean_x**2, yy - mean_y**2, xy - mean_x * mean_y
    score = (2 * mean_x * mean_y + _C1) * (2 * cov + _C2)
    return (score / ((mean_x**2 + mean_y**2 + _C1) * (var_x + var_y + _C2))).mean()


def photometric_loss(
    image: Float[Array, "c h w k"], target: Float[Array, "c h w k"], dssim_weight: float = 0.2
) -> Float[Array, ""]:
    """(1 - w) L1 + w (1 - SSIM) / 2."""
    dssim = (1 - ssim(image, target)) / 2
    return (1 - dssim_weight) * l1_loss(image, target) + dssim_weight * dssim
