"""Scores of a query: per Gaussian, directly in 3D, or per pixel of a view (FD-3DGS, section 3.5).

The score is the cosine, as the paper's printed quotient F'.q / |F'.q| is always +-1. It is exact in 3D as in
2D: W f_i is compared with q, through W^T q and W^T W. The paper's own method, which maps q back to the
field's channels by an inverse of the convolution, is there for comparison (`back_projected_cosines`).

`gsjax.methods.query` turns cosines into scores against negatives.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from gsjax.methods.distill.field import FeatureField, RenderedFeatures, rendered_features
from gsjax.rasterize.frozen import FrozenView, paint, paint_shown
from gsjax.rasterize.plan import Plan
from gsjax.scene.feature_grid import Located

_LEAST_NORM = 1e-12


@partial(jax.jit, inline=True)
def gaussian_cosines(
    field: FeatureField, located: Located | None, queries: Float[Array, "q d"]
) -> Float[Array, "n q"]:
    """cos(W f_i, q) of each Gaussian and query, exactly; 0 where either vector has length 0.

    Args:
        field: the field of all Gaussians.
        located: their locations in its grid; None for a vector per Gaussian.
        queries: vectors in the teacher's channels.
    """
    return cosines_of(*directions_of(field, located), queries)


@partial(jax.jit, inline=True)
def directions_of(
    field: FeatureField, located: Located | None
) -> tuple[Float[Array, "n r"], Float[Array, "d r"]]:
    """The rendered features of Gaussians, scaled so that W f_i has length 1, or 0 where it has length 0; and
    the map from them to the teacher's channels. Many queries can share them.

    Args:
        field: the field of all Gaussians.
        located: their locations in its grid; None for a vector per Gaussian.
    """
    parts = rendered_features(field, located)
    lifted = parts.lifted(field.lift)
    return _unit(_of_gaussians(parts), lifted), lifted


@partial(jax.jit, inline=True)
def cosines_of(
    directions: Float[Array, "n r"], lifted: Float[Array, "d r"], queries: Float[Array, "q d"]
) -> Float[Array, "n q"]:
    """Cosines of Gaussians and queries.

    Args:
        directions, lifted: from `directions_of`.
        queries: vectors in the teacher's channels.
    """
    toward = jnp.matmul(_normalised(queries), lifted, precision="highest")
    return jnp.matmul(directions, toward.T, precision="highest")


def pixel_cosines(
    field: FeatureField, parts: RenderedFeatures, view: FrozenView, plan: Plan, queries: Float[Array, "q d"]
) -> tuple[Float[Array, "height width q"], Float[Array, "height width"]]:
    """cos(W F', q) of each pixel and query, and the alphas of the view.

    Args:
        field: the field of all Gaussians.
        parts: `rendered_features` of the view's Gaussians, `view.rows`.
        view, plan: a view from `gsjax.rasterize.frozen.freeze_views`, or a strip of it.
        queries: vectors in the teacher's channels.
    """
    image, alphas = paint_shown(view, parts.values, plan)
    rendered = parts.joined(image.reshape(alphas.size, -1), alphas.ravel())
    lifted = parts.lifted(field.lift)
    cosines = cosines_of(_unit(rendered, lifted), lifted, queries)
    return cosines.reshape(*alphas.shape, len(queries)), alphas


@partial(jax.jit, static_argnames="plan", inline=True)
def pixel_features(
    field: FeatureField,
    located: Located | None,
    view: FrozenView,
    plan: Plan,
    pixels: Int[Array, "p 2"],
) -> tuple[Float[Array, "p d"], Float[Array, "p"]]:
    """W F' at some pixels (x, y) of a view, in the teacher's channels, and the alphas there."""
    parts = rendered_features(field, located)
    image, alphas = paint(view, parts.values, plan)
    x, y = pixels[:, 0], pixels[:, 1]
    rendered = parts.joined(image[y, x], alphas[y, x])
    return jnp.matmul(rendered, parts.lifted(field.lift).T, precision="highest"), alphas[y, x]


@partial(jax.jit, inline=True)
def back_projected_cosines(
    field: FeatureField,
    located: Located | None,
    queries: Float[Array, "q d"],
    inverse: Float[Array, "channels d"],
) -> Float[Array, "n q"]:
    """cos(f_i, W' q) with an inverse W' of the convolution, in the field's channels, as in the paper.

    Args:
        field, located: as for `gaussian_cosines`.
        queries: vectors in the teacher's channels.
        inverse: W', from `learned_inverse` or `jnp.linalg.pinv`.
    """
    parts = rendered_features(field, located)
    features = parts.channels_of(_of_gaussians(parts))
    back = jnp.matmul(queries, inverse.T, precision="highest")
    return jnp.matmul(_normalised(features), _normalised(back).T, precision="highest")


def _of_gaussians(parts: RenderedFeatures) -> Float[Array, "n r"]:
    """The rendered features of pixels that each show a single opaque Gaussian."""
    return parts.joined(parts.values, jnp.ones(len(parts.values), parts.values.dtype))


def _unit(rendered: Float[Array, "n r"], lifted: Float[Array, "d r"]) -> Float[Array, "n r"]:
    """Rendered features, scaled to length 1 in the teacher's channels."""
    gram = jnp.matmul(lifted.T, lifted, precision="highest")
    squared = jnp.sum(jnp.matmul(rendered, gram, precision="highest") * rendered, axis=-1, keepdims=True)
    return jnp.where(squared > _LEAST_NORM, rendered / jnp.sqrt(jnp.maximum(squared, _LEAST_NORM)), 0.0)


def _normalised(rows: Float[Array, "n d"]) -> Float[Array, "n d"]:
    squared = jnp.sum(rows**2, axis=-1, keepdims=True)
    return jnp.where(squared > _LEAST_NORM, rows * jax.lax.rsqrt(jnp.maximum(squared, _LEAST_NORM)), 0.0)
