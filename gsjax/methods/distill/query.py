"""Scores of a query: per Gaussian, directly in 3D, or per pixel of a view (FD-3DGS, section 3.5).

The score is the cosine; the quotient that the paper prints, F'.q / |F'.q|, is +-1. It is exact in 3D as in
2D: W f_i is compared with q, through W^T q and W^T W. The paper's way back, an inverse of the convolution
that takes q to the field's own channels, is there for comparison: the pseudo-inverse, or a learned one
(`gsjax.methods.distill.inverse`).

Against negatives a score is the share of the query in a softmax of two, with the negative that takes most of
it: `gsjax.methods.query`.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gsjax.methods.distill.field import FeatureField, RenderedFeatures, rendered_features
from gsjax.rasterize.frozen import FrozenView, paint, paint_shown
from gsjax.rasterize.plan import Plan
from gsjax.scene.feature_grid import Located

_LEAST_NORM = 1e-12
_OPAQUE = 0.5  # a pixel to which the scene sends less of its light shows nothing


def gaussian_cosines(
    field: FeatureField, located: Located | None, queries: Float[Array, "q d"]
) -> Float[Array, "n q"]:
    """cos(W f_i, q) of each Gaussian and query, exactly; 0 where one of them has no length.

    Args:
        field: of all Gaussians.
        located: where they lie in its grid; None for a vector per Gaussian.
        queries: vectors in the teacher's channels.
    """
    parts = rendered_features(field, located)
    rendered = parts.joined(parts.values, jnp.ones(len(parts.values), parts.values.dtype))
    return _cosines(rendered, parts.lifted(field.lift), queries)


def pixel_cosines(
    field: FeatureField,
    located: Located | None,
    view: FrozenView,
    plan: Plan,
    queries: Float[Array, "q d"],
) -> tuple[Float[Array, "height width q"], Float[Array, "height width"]]:
    """cos(W F', q) of each pixel and query, and the alphas of the view.

    Args:
        field, located: as for `gaussian_cosines`.
        view, plan: from `gsjax.rasterize.frozen.freeze_views`.
        queries: vectors in the teacher's channels.
    """
    return painted_cosines(field, rendered_features(field, located, view.rows), view, plan, queries)


def painted_cosines(
    field: FeatureField, parts: RenderedFeatures, view: FrozenView, plan: Plan, queries: Float[Array, "q d"]
) -> tuple[Float[Array, "height width q"], Float[Array, "height width"]]:
    """`pixel_cosines` with given rendered features of the view's Gaussians, for several strips of it, say.

    Args:
        field: of all Gaussians.
        parts: from `rendered_features`, with the rows of the view.
        view, plan: the view, or a strip of it.
        queries: vectors in the teacher's channels.
    """
    image, alphas = paint_shown(view, parts.values, plan)
    rendered = parts.joined(image.reshape(alphas.size, -1), alphas.ravel())
    cosines = _cosines(rendered, parts.lifted(field.lift), queries)
    return cosines.reshape(*alphas.shape, len(queries)), alphas


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


def back_projected_cosines(
    field: FeatureField,
    located: Located | None,
    queries: Float[Array, "q d"],
    inverse: Float[Array, "channels d"],
) -> Float[Array, "n q"]:
    """cos(f_i, W' q) with an inverse W' of the convolution, in the field's own channels (the paper's).

    Args:
        field, located: as for `gaussian_cosines`.
        queries: vectors in the teacher's channels.
        inverse: W', for example from `learned_inverse`.
    """
    parts = rendered_features(field, located)
    rendered = parts.joined(parts.values, jnp.ones(len(parts.values), parts.values.dtype))
    features = parts.channels_of(rendered)
    back = jnp.matmul(queries, inverse.T, precision="highest")
    return jnp.matmul(_normalised(features), _normalised(back).T, precision="highest")


def selection_mask(view: FrozenView, plan: Plan, selected: Bool[Array, "n"]) -> Bool[Array, "height width"]:
    """Where selected Gaussians send more than half of a pixel's light; others in front of them hide them."""
    share, _ = paint(view, selected.astype(view.opacities.dtype)[:, None], plan)
    return share[..., 0] > _OPAQUE


def pixel_mask(
    scores: Float[Array, "height width"], alphas: Float[Array, "height width"], threshold: float
) -> Bool[Array, "height width"]:
    """Where a view's own scores are above the threshold, and the scene sends more than half of the light.

    Args:
        scores: of pixels.
        alphas: of the same pixels.
        threshold: score above which a pixel is selected.
    """
    return (scores > threshold) & (alphas > _OPAQUE)


def _cosines(
    rendered: Float[Array, "n r"], lifted: Float[Array, "d r"], queries: Float[Array, "q d"]
) -> Float[Array, "n q"]:
    gram = jnp.matmul(lifted.T, lifted, precision="highest")
    squared = jnp.sum(jnp.matmul(rendered, gram, precision="highest") * rendered, axis=-1, keepdims=True)
    toward = jnp.matmul(_normalised(queries), lifted, precision="highest")
    product = jnp.matmul(rendered, toward.T, precision="highest")
    return jnp.where(squared > _LEAST_NORM, product / jnp.sqrt(jnp.maximum(squared, _LEAST_NORM)), 0.0)


def _normalised(rows: Float[Array, "n d"]) -> Float[Array, "n d"]:
    squared = jnp.sum(rows**2, axis=-1, keepdims=True)
    return jnp.where(squared > _LEAST_NORM, rows * jax.lax.rsqrt(jnp.maximum(squared, _LEAST_NORM)), 0.0)
