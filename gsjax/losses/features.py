"""Losses between a rendered feature map and a teacher's features of its pixels (FD-3DGS, section 3.4).

A field of C channels is compared with a teacher of D channels through a linear map W, [D, C], without bias.
With g the C rendered channels of a pixel and e the teacher's D, all that L_rec (eq. 4) and L_cos (eq. 5) need
of W g is

    |W g|^2 = g^T (W^T W) g    and    e . W g = (W^T e) . g,

so neither forms D numbers per pixel; and a teacher that assigns one of K vectors to each pixel, such as masks
with one embedding each, needs W^T e for those K only. Both are exact.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gsjax.losses.photometric import weighted_mean

_LEAST_NORM = 1e-12  # squared


class Likeness(NamedTuple):
    """Products that compare W g with e, pixel by pixel: |W g|^2, (W g) . e and |e|^2."""

    squared: Float[Array, "*pixels"]
    product: Float[Array, "*pixels"]
    target: Float[Array, "*pixels"]


def likeness(
    rendered: Float[Array, "*pixels c"],
    weights: Float[Array, "d c"],
    codebook: Float[Array, "k d"],
    ids: Int[Array, "*pixels"],
) -> Likeness:
    """Likeness of pixels to the codebook rows that the teacher assigns to them; -1 counts as 0.

    Args:
        rendered: g.
        weights: W.
        codebook: the K vectors of the teacher.
        ids: codebook row of each pixel.
    """
    gram = jnp.matmul(weights.T, weights, precision="highest")
    toward = jnp.matmul(codebook, weights, precision="highest")  # [k, c]
    squared = jnp.sum(jnp.matmul(rendered, gram, precision="highest") * rendered, axis=-1)
    row = jnp.maximum(ids, 0)
    product = jnp.take_along_axis(
        jnp.matmul(rendered, toward.T, precision="highest"), row[..., None], axis=-1
    )[..., 0]
    return Likeness(jnp.maximum(squared, 0.0), product, jnp.sum(codebook**2, axis=-1)[row])


def likeness_to_map(
    rendered: Float[Array, "*pixels c"], weights: Float[Array, "d c"], target: Float[Array, "*pixels d"]
) -> Likeness:
    """Likeness of pixels to a separate feature for each.

    Args:
        rendered: g.
        weights: W.
        target: e.
    """
    lifted = jnp.matmul(rendered, weights.T, precision="highest")
    return Likeness(
        jnp.sum(lifted**2, axis=-1), jnp.sum(lifted * target, axis=-1), jnp.sum(target**2, axis=-1)
    )


def feature_error(
    likeness: Likeness, alphas: Float[Array, "*pixels"], dimension: int
) -> Float[Array, "*pixels"]:
    """L_rec of each pixel: the mean over D channels of (W g - alpha e)^2.

    A half-transparent pixel should show half a feature; otherwise Gaussians at the border of the scene would
    need larger features than their neighbours.

    Args:
        likeness: likeness of W g to e.
        alphas: rendered opacity of each pixel.
        dimension: D.
    """
    squared, product, target = likeness
    return (squared - 2 * alphas * product + alphas**2 * target) / dimension


def cosine_error(likeness: Likeness) -> Float[Array, "*pixels"]:
    """L_cos of each pixel: 1 - cos(W g, e); its gradient is 0 where one of the two is zero."""
    squared, product, target = likeness
    there = (squared > _LEAST_NORM) & (target > _LEAST_NORM)
    lengths = jnp.sqrt(jnp.where(there, squared * target, 1.0))
    return 1 - jnp.where(there, product / lengths, 0.0)


def cycle_error(
    low: Float[Array, "n c"],
    high: Float[Array, "n d"],
    weights: Float[Array, "d c"],
    inverse: Float[Array, "c d"],
) -> Float[Array, "n"]:
    """L_cyc of each pixel or Gaussian (eq. 9): |W' F - F'_low|_1 + |W F'_low - F|_1.

    Args:
        low: F'_low, in the field's channels.
        high: F, in the teacher's channels.
        weights: W, from the field's channels to the teacher's.
        inverse: W', from the teacher's channels to the field's.
    """
    back = jnp.matmul(high, inverse.T, precision="highest") - low
    forth = jnp.matmul(low, weights.T, precision="highest") - high
    return jnp.abs(back).sum(axis=-1) + jnp.abs(forth).sum(axis=-1)


def max_pooled(features: Float[Array, "h w c"], edge: int) -> Float[Array, "h_ w_ c"]:
    """Maximum of each channel over windows of `edge` x `edge` pixels; incomplete windows at the right and
    bottom are left out."""
    high, wide = features.shape[0] // edge, features.shape[1] // edge
    windows = features[: high * edge, : wide * edge].reshape(high, edge, wide, edge, -1)
    return windows.max(axis=(1, 3))


def pooled_ids(ids: Int[Array, "h w"], edge: int) -> Int[Array, "h_ w_"]:
    """The single id that each window of `max_pooled` shows, or -1 if it shows several or none."""
    high, wide = ids.shape[0] // edge, ids.shape[1] // edge
    windows = ids[: high * edge, : wide * edge].reshape(high, edge, wide, edge)
    most, least = windows.max(axis=(1, 3)), windows.min(axis=(1, 3))
    return jnp.where(most == least, most, -1)


def contrastive_loss(
    features: Float[Array, "n c"], ids: Int[Array, "n"], gamma: float = 1.0
) -> Float[Array, ""]:
    """Pull features of the same object together and push different objects apart (FD-3DGS, eq. 6, as its text
    describes it):

        - mean over A of log( sum over B with A's id of K(A, B) / sum over all B of K(A, B) ),

    with K(A, B) = exp(-gamma |A - B|^2) and B different from A. Computed in logarithms, because K underflows
    for features that are 10 apart. A pixel A without another of its id is not an anchor; without anchors the
    loss is 0.

    Args:
        features: features of pixels.
        ids: object of each pixel; pixels with -1 are ignored.
        gamma: inverse squared length scale of the kernel K.
    """
    # Centring changes no distance; without it a common offset would cost precision.
    features = features - jax.lax.stop_gradient(features.mean(axis=0))
    lengths = jnp.sum(features**2, axis=-1)
    products = jnp.matmul(features, features.T, precision="highest")
    apart = jnp.maximum(lengths[:, None] + lengths - 2 * products, 0.0)
    others = (ids >= 0) & ~jnp.eye(len(ids), dtype=bool)
    same = others & (ids[:, None] == ids)
    anchors = (ids >= 0) & same.any(axis=1)
    share = _log_sum(-gamma * apart, same) - _log_sum(-gamma * apart, others)
    return -weighted_mean(jnp.where(anchors, share, 0.0), anchors.astype(features.dtype))


def _log_sum(logs: Float[Array, "n n"], of: Bool[Array, "n n"]) -> Float[Array, "n"]:
    """Log-sum-exp of the selected entries of each row; 0 for a row without any."""
    some = of.any(axis=1)
    chosen = jnp.where(of, logs, -jnp.inf)
    return jax.nn.logsumexp(jnp.where(some[:, None], chosen, 0.0), axis=1) * some
