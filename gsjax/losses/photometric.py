"""Image losses: L1, D-SSIM (Kerbl et al. 2023, eq. 7) and truncated depth differences."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

_C1, _C2 = 0.01**2, 0.03**2  # Wang et al. 2004, for values 0 to 1
_WINDOW = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
_WINDOW /= _WINDOW.sum()


def weighted_mean(values: Float[Array, "*n"], weights: Float[Array, "*n"]) -> Float[Array, ""]:
    """Weighted mean of `values`; 0 if all weights are 0."""
    return jnp.sum(values * weights) / jnp.maximum(jnp.sum(weights), 1e-12)


def l1_loss(
    image: Float[Array, "*n channels"],
    target: Float[Array, "*n channels"],
    weights: Float[Array, "*n"] | None = None,
) -> Float[Array, ""]:
    """Mean absolute difference over channels and (weighted) pixels.

    Args:
        image: the rendered image.
        target: the recorded image.
        weights: weights of the pixels (default: all equal).
    """
    difference = jnp.abs(image - target).mean(-1)
    return difference.mean() if weights is None else weighted_mean(difference, weights)


def truncated_l1(
    values: Float[Array, "*n"], targets: Float[Array, "*n"], weights: Float[Array, "*n"], limit: float
) -> Float[Array, ""]:
    """Weighted mean of min(|difference|, limit): larger differences belong to a different object.

    Args:
        values: rendered values, such as depths.
        targets: recorded values.
        weights: weights of the values, 0 where nothing was recorded.
        limit: largest difference that counts in full, in the unit of the values.
    """
    return weighted_mean(jnp.minimum(jnp.abs(values - targets), limit), weights)


@jax.custom_jvp
def ssim(image: Float[Array, "c h w k"], target: Float[Array, "c h w k"]) -> Float[Array, ""]:
    """Mean structural similarity (Wang et al. 2004) with an 11-pixel Gaussian window, values 0 to 1: as in
    scikit-image, over the pixels whose window lies in the image. An image smaller than the window is padded
    with black.

    The derivative is written by hand: blurring is its own transpose, so three more blurs give the gradient,
    while autodiff's transposed slices take ten times as long. It supports forward and reverse mode, to first
    order.
    """
    moments = _moments(_planes(image), _planes(target))
    return jnp.vdot(_weights(moments.mx), _similarity(moments))


def _ssim_jvp(primals, tangents):
    x, y = map(_planes, primals)
    moments = _moments(x, y)
    score, change = jnp.vdot(_weights(x), _similarity(moments)), jnp.zeros((), x.dtype)
    swapped = _Moments(moments.my, moments.mx, moments.yy, moments.xx, moments.xy)
    for one, other, known, tangent in ((x, y, moments, tangents[0]), (y, x, swapped, tangents[1])):
        if type(tangent) is not SymbolicZero:  # a photograph has none, and its gradient then costs nothing
            change += jnp.vdot(_slope(one, other, known), _planes(tangent))
    return score, change


ssim.defjvp(_ssim_jvp, symbolic_zeros=True)


class _Moments(NamedTuple):
    """Blurred images, and blurred products of them."""

    mx: Float[Array, "n h w"]
    my: Float[Array, "n h w"]
    xx: Float[Array, "n h w"]
    yy: Float[Array, "n h w"]
    xy: Float[Array, "n h w"]


def _planes(images: Float[Array, "c h w k"]) -> Float[Array, "n h w"]:
    """Channels of images as separate planes, so that neighbours in a row are adjacent in memory."""
    return jnp.moveaxis(images, -1, 1).reshape(-1, *images.shape[1:3])


@partial(jax.jit, inline=True)
def _blurred(planes: Float[Array, "n h w"]) -> Float[Array, "n h w"]:
    half = len(_WINDOW) // 2
    for axis in (1, 2):
        length = planes.shape[axis]
        padded = jnp.pad(planes, [(half, half) if i == axis else (0, 0) for i in range(3)])
        parts = (jax.lax.slice_in_dim(padded, i, i + length, axis=axis) for i in range(len(_WINDOW)))
        planes = jnp.asarray(sum(w * part for w, part in zip(_WINDOW.tolist(), parts, strict=True)))
    return planes


def _weights(planes: Float[Array, "n h w"]) -> Float[Array, "n h w"]:
    """Weight of each pixel in the mean."""
    count, height, width = planes.shape
    half = len(_WINDOW) // 2
    if min(height, width) < len(_WINDOW):
        half = 0
    inner = np.zeros((height, width))
    inner[half : height - half, half : width - half] = 1
    return jnp.broadcast_to(jnp.asarray(inner / (count * inner.sum()), planes.dtype), planes.shape)


def _moments(x: Float[Array, "n h w"], y: Float[Array, "n h w"]) -> _Moments:
    return _Moments(*jnp.split(_blurred(jnp.concatenate([x, y, x * x, y * y, x * y])), 5))


def _factors(m: _Moments):
    """Numerators and denominators of luminance, and of contrast with structure."""
    luminance = 2 * m.mx * m.my + _C1, m.mx**2 + m.my**2 + _C1
    return *luminance, 2 * (m.xy - m.mx * m.my) + _C2, m.xx - m.mx**2 + m.yy - m.my**2 + _C2


def _similarity(m: _Moments) -> Float[Array, "n h w"]:
    a, b, c, d = _factors(m)
    return a * c / (b * d)


def _slope(x: Float[Array, "n h w"], y: Float[Array, "n h w"], m: _Moments) -> Float[Array, "n h w"]:
    """Derivative of the mean similarity with respect to each pixel of x."""
    a, b, c, d = _factors(m)
    score, weights = a * c / (b * d), _weights(x)
    by_mx = 2 * m.my * (c - a) / (b * d) - 2 * m.mx * score * (1 / b - 1 / d)
    back = _blurred(jnp.concatenate([weights * by_mx, -weights * score / d, weights * 2 * a / (b * d)]))
    through_mx, through_xx, through_xy = jnp.split(back, 3)
    return through_mx + 2 * x * through_xx + y * through_xy


def photometric_loss(
    image: Float[Array, "c h w k"], target: Float[Array, "c h w k"], dssim_weight: float = 0.2
) -> Float[Array, ""]:
    """(1 - w) L1 + w (1 - SSIM) / 2 (Kerbl et al. 2023, eq. 7).

    Args:
        image: C rendered images, 0 to 1.
        target: the recorded images.
        dssim_weight: w, 0 to 1.
    """
    dssim = (1 - ssim(image, target)) / 2
    return (1 - dssim_weight) * l1_loss(image, target) + dssim_weight * dssim
