"""One optimisation step of a distillation: render the features of a view and compare them with its teacher
(FD-3DGS, section 3.4).
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from gsjax.losses.features import (
    contrastive_loss,
    cosine_error,
    feature_error,
    likeness,
    likeness_to_map,
    max_pooled,
    pooled_ids,
)
from gsjax.losses.regularization import total_variation
from gsjax.methods.distill.config import DistillConfig
from gsjax.methods.distill.field import FeatureField, RenderedFeatures, rendered_features
from gsjax.methods.distill.views import Batch, resized_rows
from gsjax.optim.step import Step, gradient_step, per_field_adam
from gsjax.rasterize.frozen import paint_shown, rows_within, strip_of

_FINAL_RATE = 0.1


class _Sums(NamedTuple):
    """Losses summed over the pixels of a strip, and the (weighted) number of pixels with a teacher."""

    rec: Float[Array, ""]
    cos: Float[Array, ""]
    pixels: Float[Array, ""]
    tv: Float[Array, ""]


def distill_step(config: DistillConfig) -> Step:
    """A step of Adam on a `FeatureField`.

    `batch` is a `Batch`; `step` determines when the contrastive loss begins, and `key` selects its patch.
    `info` has each loss by name, unweighted, in addition to what every step reports.

    Args:
        config: configuration of the distillation.
    """
    rates, decay = config.rates, optax.exponential_decay(1.0, config.iterations, _FINAL_RATE)
    by_field = {"encoding": rates.table, "layers": rates.layers, "lift": rates.lift}
    if config.encoding == "table":  # without a network
        del by_field["layers"]
    schedules = {name: lambda count, rate=rate: rate * decay(count) for name, rate in by_field.items()}
    return gradient_step(distill_loss(config), per_field_adam(schedules))


def contrast_begins(config: DistillConfig) -> int:
    """The training step from which the contrastive loss counts."""
    return math.ceil(config.contrast_after * config.iterations)


def distill_loss(config: DistillConfig) -> Callable:
    """`loss(field, batch, *, step, key)` of one view (FD-3DGS, eq. 8).

    Args:
        config: configuration, with the weights.
    """
    weights, edge = config.weights, config.contrast_pool

    def loss(field: FeatureField, batch: Batch, *, step: Any, key: Any):
        corner = _corner(key, batch.ids.shape, config) if weights.contrast else None
        sums, pooled = _drawn(field, batch, corner, config)
        channels = field.channels
        height, width = batch.ids.shape
        known = jnp.maximum(sums.pixels, 1.0)
        aux = {"rec": sums.rec / known, "cos": sums.cos / known}
        value = weights.rec * aux["rec"] + weights.cos * aux["cos"]
        if weights.tv:
            aux["tv"] = sums.tv / (height * width * channels)
            value += weights.tv * aux["tv"]
        if weights.contrast:
            assert pooled is not None
            aux["contrast"] = jax.lax.cond(
                jnp.asarray(step) - batch.begun >= contrast_begins(config),
                lambda: _contrast(pooled, pooled_ids(batch.ids, edge), corner, config),
                lambda: jnp.zeros((), pooled.dtype),
            )
            value += weights.contrast * aux["contrast"]
        return value, aux

    return loss


def strip_rows(config: DistillConfig, hidden: int, batch: Batch) -> int:
    """Number of rows of tiles in a strip, within `config.strip_megabytes`.

    Args:
        config: configuration of the distillation.
        hidden: number of rendered channels.
        batch: batch of one view.
    """
    numbers = hidden + config.channels
    numbers += 0 if batch.codebook is None else len(batch.codebook)
    numbers += 0 if batch.map is None else 2 * batch.map.shape[-1]  # the teacher's features and the field's
    return rows_within(config.strip_megabytes, numbers, batch.plan)


def _drawn(
    field: FeatureField, batch: Batch, corner: Any, config: DistillConfig
) -> tuple[_Sums, Float[Array, "h_ patch channels"] | None]:
    """The losses of a view, and pooled features of the columns of the contrastive loss's patch.

    The image is processed strip by strip. The pixels of a strip are not kept but rendered again in the
    backward pass, so the memory is that of one strip.
    """
    # Only for visible Gaussians: occluded ones need no features.
    parts, plan = rendered_features(field, batch.located, batch.view.rows), batch.plan
    rows = strip_rows(config, parts.values.shape[1], batch)
    strips = -(-plan.tiles_y // rows)
    high = rows * plan.tile_size
    ids = jnp.pad(batch.ids, ((0, strips * high - plan.height), (0, 0)), constant_values=-1)
    padded = batch._replace(ids=ids)

    def strip(above, number):
        return _strip(field, parts, padded, above, number, rows, corner, config)

    above = jnp.zeros((plan.width, field.channels), parts.values.dtype)
    if strips == 1:
        _, (sums, pooled) = strip(above, 0)
        return sums, pooled
    _, (sums, pooled) = jax.lax.scan(jax.checkpoint(strip), above, jnp.arange(strips))
    if pooled is not None:
        pooled = pooled.reshape(-1, *pooled.shape[2:])[: plan.height // config.contrast_pool]
    return jax.tree.map(jnp.sum, sums), pooled


def _strip(
    field: FeatureField,
    parts: RenderedFeatures,
    batch: Batch,
    above: Float[Array, "width channels"],
    number: Int[Array, ""] | int,
    rows: int,
    corner: Any,
    config: DistillConfig,
):
    """The last row of a strip, its sums, and pooled features of the patch's columns."""
    plan, weights = batch.plan, config.weights
    high = rows * plan.tile_size
    view, strip_plan = strip_of(batch.view, plan, number * rows, rows)
    image, alphas = paint_shown(view, parts.values, strip_plan)
    # Pixels on one axis: for two, XLA:CPU takes ten times as long for the gradient of the weights.
    alphas = alphas.ravel()
    rendered = parts.joined(image.reshape(len(alphas), -1), alphas)
    inside = number * high + jnp.arange(high) < plan.height
    sums = _teacher_sums(field, parts, batch, rendered, alphas, number * high, inside, weights.map)
    if not weights.tv and not weights.contrast:
        return above, (sums, None)
    channels = parts.channels_of(rendered).reshape(high, plan.width, -1)
    if weights.tv:
        before = jnp.where(number == 0, channels[0], above)
        sums = sums._replace(tv=total_variation(channels, before, inside))
    if not weights.contrast:
        return channels[-1], (sums, None)
    edge, (_, wide) = config.contrast_pool, _patch_shape(batch.ids.shape, config)
    columns = jax.lax.dynamic_slice_in_dim(channels, corner[1] * edge, wide * edge, axis=1)
    pooled = max_pooled(columns, edge)
    if rows == plan.tiles_y:
        pooled = pooled[: plan.height // edge]
    return channels[-1], (sums, pooled)


def _teacher_sums(
    field: FeatureField,
    parts: RenderedFeatures,
    batch: Batch,
    rendered,
    alphas,
    first_row,
    inside,
    map_weight: float,
) -> _Sums:
    """Errors of a strip's flattened pixels against the teacher's features. A pixel of a map has the weight
    `map_weight` if there are masks too."""
    lifted = parts.lifted(field.lift)
    zero = jnp.zeros((), rendered.dtype)
    rec, cos, pixels = zero, zero, zero
    if batch.codebook is not None:
        ids = jax.lax.dynamic_slice_in_dim(batch.ids, first_row, len(inside)).ravel()
        like, known = likeness(rendered, lifted, batch.codebook, ids), ids >= 0
        rec += jnp.where(known, feature_error(like, alphas, field.dimension), 0.0).sum()
        cos += jnp.where(known, cosine_error(like), 0.0).sum()
        pixels += known.sum(dtype=zero.dtype)
    if batch.map is not None:
        wanted = resized_rows(jnp.asarray(batch.map), first_row, len(inside), batch.plan)
        like = likeness_to_map(rendered, lifted, wanted.reshape(len(alphas), -1))
        known = jnp.repeat(inside, batch.plan.width)
        weight = jnp.where(known, 1.0 if batch.codebook is None else map_weight, 0.0)
        rec += (weight * feature_error(like, alphas, field.dimension)).sum()
        cos += (weight * cosine_error(like)).sum()
        pixels += weight.sum()
    return _Sums(rec, cos, pixels, zero)


def _patch_shape(shape: tuple[int, ...], config: DistillConfig) -> tuple[int, int]:
    """Number of windows, down and across, of a patch in a view of this shape."""
    high, wide = (min(config.contrast_patch, side // config.contrast_pool) for side in shape)
    return high, wide


def _corner(key: Any, shape: tuple[int, ...], config: DistillConfig) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """The first window, down and across, of a random patch."""
    (first, second), size = jax.random.split(key), _patch_shape(shape, config)
    down, across = (side // config.contrast_pool - some for side, some in zip(shape, size, strict=True))
    return jax.random.randint(first, (), 0, down + 1), jax.random.randint(second, (), 0, across + 1)


def _contrast(
    columns: Float[Array, "h patch channels"], ids: Int[Array, "h w"], corner: Any, config: DistillConfig
) -> Float[Array, ""]:
    """The contrastive loss of a patch of pooled features; `columns` are its columns, in all rows."""
    high, wide = min(config.contrast_patch, ids.shape[0]), columns.shape[1]
    patch = jax.lax.dynamic_slice_in_dim(columns, corner[0], high)
    seen = jax.lax.dynamic_slice(ids, corner, (high, wide))
    return contrastive_loss(patch.reshape(high * wide, -1), seen.ravel(), config.contrast_gamma)
