"""Front-to-back alpha compositing (Kerbl et al. 2023, eq. 3) of one tile, and of all tiles.

Arrays are [Gaussian, pixel] within a tile and [tile, Gaussian, pixel] within a batch of tiles. XLA:CPU cannot
write two results from one loop, so the work is split as follows: the alphas of a chunk of Gaussians are
stored once, in a stack that stays in cache, and whatever is computed from them (the remaining light, colours,
gradients) is a pass of cheap multiply-adds over that stack.

Tiles are processed in batches. A batch walks its lists chunk by chunk until each list has ended or all its
pixels are opaque. So lists can have any length, and one compiled program serves them all.
"""

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.rasterize.checks import check_tile
from gsjax.rasterize.plan import DEFAULT_LIMITS, FEW_CHANNELS, Limits, Plan
from gsjax.rasterize.sorting import argsort_keys
from gsjax.rasterize.tiles import tile_pixels, untile, write_tiles

SATURATION = 1e-6  # relative distance to alpha_max within which an alpha counts as saturated
CHUNK = 8  # Gaussians whose alphas are stored together
MANY_CHUNK = 32  # the same where many channels are composited, by matmul


class Splats(NamedTuple):
    """A list of projected Gaussians, front to back. An opacity of 0 marks an empty slot."""

    means2d: Float[Array, "*list 2"]  # pixels
    conics: Float[Array, "*list 3"]
    opacities: Float[Array, "*list"]
    values: Float[Array, "*list channels"]  # the composited values: colours, depth, features


class Columns(NamedTuple):
    """Splats as loops read them: in columns, because gathers of scalars are fast, with opacities as logs."""

    u: Float[Array, "*list"]  # means2d
    v: Float[Array, "*list"]
    a: Float[Array, "*list"]  # conics
    b: Float[Array, "*list"]
    c: Float[Array, "*list"]
    log_opacities: Float[Array, "*list"]  # -inf marks an empty slot
    values: tuple[Float[Array, "*list"], ...] | Float[Array, "*list channels"]  # many channels stay together


SHAPE = len(Columns._fields) - 1  # numbers per Gaussian before its values


def in_columns(splats: Splats, limits: Limits) -> Columns:
    """The same list in columns. Opacities are bounded below alpha_min, where they have no effect, so that the
    logarithm has a derivative."""
    logs = jnp.log(jnp.maximum(splats.opacities, 0.5 * limits.alpha_min))
    shapes = (*jnp.moveaxis(splats.means2d, -1, 0), *jnp.moveaxis(splats.conics, -1, 0))
    few = splats.values.shape[-1] <= FEW_CHANNELS
    return Columns(*shapes, logs, tuple(jnp.moveaxis(splats.values, -1, 0)) if few else splats.values)


class TileState(NamedTuple):
    """The compositing state of P pixels. Within loops, more than FEW_CHANNELS channels are the last axis."""

    values: Float[Array, "*tiles channels pixels"] | Float[Array, "*tiles pixels channels"]
    light: Float[Array, "*tiles pixels"]  # the transmittance; its negative once the pixel has ended

    @property
    def transmittance(self) -> Float[Array, "*tiles pixels"]:
        """The fraction of light that still passes."""
        return jnp.abs(self.light)


def start_tile(num_pixels: int, channels: int, dtype=jnp.float32) -> TileState:
    """The initial state of pixels, which nothing covers yet.

    Args:
        num_pixels: number of pixels, P.
        channels: number of composited channels.
        dtype: type of values and light.
    """
    return TileState(jnp.zeros((channels, num_pixels), dtype), jnp.ones(num_pixels, dtype))


def splat_alphas(
    columns: Columns, pixels: Float[Array, "pixels 2"], limits: Limits
) -> Float[Array, "list pixels"]:
    """min(alpha_max, o exp(-d^T conic d / 2)) of a list at every pixel; 0 where that is below alpha_min."""
    u, v, a, b, c, log_opacities = (column[:, None] for column in columns[:6])
    dx, dy = pixels[:, 0] - u, pixels[:, 1] - v
    power = -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy
    # In logarithms, because XLA:CPU stores the result of the exponential; it would recompute anything else.
    log_alpha = log_opacities + jnp.minimum(power, 0.0)
    ceiling = math.log(limits.alpha_max)
    saturated = log_alpha >= ceiling - SATURATION  # no gradient, also where both are equal
    clamped = jnp.where(saturated, ceiling, log_alpha)
    return jnp.exp(jnp.where(log_alpha >= math.log(limits.alpha_min), clamped, -jnp.inf))


def light_behind(
    light: Float[Array, "*pixels"], alphas: Float[Array, "list *pixels"], limits: Limits
) -> Float[Array, "*pixels"]:
    """The light, as in a TileState, behind a list.

    Args:
        light: light in front of the list, as in a TileState.
        alphas: alphas of the list, front to back.
        limits: thresholds that determine where a pixel ends.
    """
    for alpha in alphas:
        after = light * (1 - alpha)
        light = jnp.where(after > limits.min_transmittance, after, -jnp.abs(light))
    return light


def splat_weights(
    alphas: Float[Array, "list pixels"], light: Float[Array, "pixels"], limits: Limits
) -> Float[Array, "list pixels"]:
    """w_i = alpha_i T_i, and 0 from where the pixel has ended.

    Every row computes its own product T_i, in list order and therefore bit for bit as `light_behind`. For a
    short list this is cheaper than storing them all.

    Args:
        alphas: from `splat_alphas`.
        light: light in front of the list, as in a TileState.
        limits: thresholds that determine where a pixel ends.
    """
    length = alphas.shape[0]
    row = np.arange(length)[:, None]
    before = jnp.broadcast_to(light, alphas.shape)
    for j in range(length - 1):
        before = before * jnp.where(row > j, 1 - alphas[j], 1.0)
    return jnp.where(before * (1 - alphas) > limits.min_transmittance, alphas * before, 0.0)


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def weights_of_many(alphas, light, limits: Limits):
    """`splat_weights` [list, pixels] of a longer list, chunk by chunk, and the light [pixels] behind it.

    Arguments as for `splat_weights`. The derivative is written by hand: one Gaussian after another.
    """
    weights = []
    for i in range(0, alphas.shape[0], CHUNK):
        piece = alphas[i : i + CHUNK]
        weights.append(splat_weights(piece, light, limits))
        light = light_behind(light, piece, limits)
    return jnp.concatenate(weights), light


@weights_of_many.defjvp
def _weights_of_many_jvp(limits: Limits, primals, tangents):
    """Tangents one Gaussian after another: the tangents of the products above would be nested products."""

    def step(carry, entry):
        (light, d_light), (alpha, d_alpha) = carry, entry
        after, d_after = light * (1 - alpha), d_light * (1 - alpha) - light * d_alpha
        live = after > limits.min_transmittance
        d_weight = jnp.where(live, d_alpha * light + alpha * d_light, 0.0)
        ended = -jnp.abs(light), jnp.where(light > 0, -d_light, d_light)
        return (jnp.where(live, after, ended[0]), jnp.where(live, d_after, ended[1])), d_weight

    (alphas, light), (d_alphas, d_light) = primals, tangents
    (_, d_light), d_weights = jax.lax.scan(step, (light, d_light), (alphas, d_alphas))
    return weights_of_many(alphas, light, limits), (d_weights, d_light)


def composite_tile(
    splats: Splats,
    pixels: Float[Array, "..."],
    state: TileState | None = None,
    *,
    limits: Limits = DEFAULT_LIMITS,
) -> TileState:
    """Composite one list of Gaussians, front to back, over the pixels of one tile.

    alpha_i = min(alpha_max, o_i exp(-d^T conic d / 2)) with contributions below alpha_min skipped; the pixel
    ends before the Gaussian that would reduce its transmittance to min_transmittance. A pure function for one
    tile: vmap it over many, and pass the state on to process a long list piece by piece.

    Args:
        splats: the list, [L] of each field.
        pixels: positions of the pixels [P, 2], in the same coordinates as `splats.means2d`.
        state: the state after an earlier piece of the list (default: an empty tile).
        limits: where contributions start and saturate (their opacity then gets no gradient) and pixels end.

    Returns:
        The new state: values `sum_i w_i v_i` and the transmittance left for a background.

    Raises:
        ValueError: a shape is wrong; the message names the argument.
    """
    check_tile(splats.means2d, splats.conics, splats.opacities, splats.values, pixels)
    length, channels = splats.values.shape
    dtype = splats.opacities.dtype
    if state is None:
        state = start_tile(pixels.shape[0], channels, dtype)
    if length == 0:
        return state
    chunk, state = chunk_length(channels), _loop_layout(state, channels)
    if length <= chunk:
        state = composite_columns(in_columns(splats, limits), pixels, state, limits)
    else:

        def padded(a):  # with empty slots
            return jnp.pad(a, [(0, -length % chunk)] + [(0, 0)] * (a.ndim - 1))

        columns = in_columns(jax.tree.map(padded, splats), limits)
        pieces = jax.tree.map(lambda a: a.reshape(-1, chunk, *a.shape[1:]), columns)
        state = jax.lax.scan(
            lambda state, piece: (composite_columns(piece, pixels, state, limits), None), state, pieces
        )[0]
    return _loop_layout(state, channels)


def _loop_layout(state: TileState, channels: int) -> TileState:
    """A state in the layout of the loops, or back: many channels last, as rows of a matrix product."""
    return state._replace(values=state.values.T) if channels > FEW_CHANNELS else state


def composite_columns(columns: Columns, pixels, state: TileState, limits: Limits) -> TileState:
    """`composite_tile` for one chunk.

    Args:
        columns: the chunk.
        pixels: [P, 2], in the same coordinates as the means in `columns`.
        state: the state before the chunk, in the layout of the loops.
        limits: thresholds of alphas and transmittance.
    """
    alphas, dtype = splat_alphas(columns, pixels, limits), state.light.dtype
    if not isinstance(columns.values, tuple):
        weights, light = weights_of_many(alphas, state.light, limits)
        painted = jnp.matmul(weights.T, columns.values.astype(dtype), precision="highest")
        return TileState(state.values + painted, light)
    # Every channel recomputes the light itself, which is cheaper than storing the weights.
    values, light = state.values, jnp.broadcast_to(state.light, state.values.shape)
    for alpha, value in zip(alphas, jnp.stack(columns.values).T.astype(dtype), strict=True):
        after = light * (1 - alpha)
        live = after > limits.min_transmittance
        values = values + jnp.where(live, alpha * light, 0.0) * value[:, None]
        light = jnp.where(live, after, -jnp.abs(light))
    return TileState(values, light_behind(state.light, alphas, limits))


def chunk_length(channels: int) -> int:
    """Number of Gaussians per pass over a tile's pixels."""
    return CHUNK if channels <= FEW_CHANNELS else MANY_CHUNK


class Lists(NamedTuple):
    """The lists of all tiles of all cameras, as rows into the splats of all cameras."""

    ids: Int[Array, "pairs"]
    starts: Int[Array, "tiles"]
    counts: Int[Array, "tiles"]


class Batches(NamedTuple):
    """Tiles grouped by similar numbers of entries read: [batches, batch, ...]."""

    tiles: Int[Array, "batches batch"]  # -1 where a batch is not full
    centers: Float[Array, "batches batch 2"]  # pixels
    starts: Int[Array, "batches batch"]
    counts: Int[Array, "batches batch"]


def batch_tiles(lists: Lists, length: Int[Array, "tiles"], channels: int, plan: Plan) -> Batches:
    """All tiles in order of decreasing `length`, an estimate of the entries read, which affects only speed.

    Args:
        lists: lists of all tiles.
        length: estimated number of entries read from each list.
        channels: number of composited channels; more channels make batches smaller.
        plan: determines the size of a batch.
    """
    order = argsort_keys(jnp.iinfo(jnp.int32).max - length.astype(jnp.uint32), plan.sort)
    size = min(plan.batch_size(channels), order.shape[0])
    order = jnp.pad(order, (0, -order.shape[0] % size), constant_values=-1).reshape(-1, size)
    tile = jnp.maximum(order, 0)
    within = tile % plan.num_tiles
    corner = jnp.stack([within % plan.tiles_x, within // plan.tiles_x], axis=-1) * plan.tile_size
    counts = jnp.where(order >= 0, lists.counts[tile], 0)
    return Batches(order, corner + plan.tile_size / 2, lists.starts[tile], counts)


def read_chunk(columns: Columns, lists: Lists, batch: Batches, first: Int[Array, ""], chunk: int):
    """Ids and columns of entries `first .. first + chunk - 1` of each tile of a batch; means are relative to
    the tile's centre."""
    entry = first + jnp.arange(chunk, dtype=jnp.int32)
    ids = lists.ids[jnp.minimum(batch.starts[:, None] + entry, lists.ids.shape[0] - 1)]
    piece = jax.tree.map(lambda column: column[ids], columns)
    centers = batch.centers.astype(piece.u.dtype)
    return ids, piece._replace(
        u=piece.u - centers[:, :1],
        v=piece.v - centers[:, 1:],
        log_opacities=jnp.where(entry < batch.counts[:, None], piece.log_opacities, -jnp.inf),
    )


def still_read(
    batch: Batches, first: Int[Array, ""], light: Float[Array, "batch pixels"]
) -> Bool[Array, "batch"]:
    """Tiles with entries from `first` on, and a pixel that is not opaque.

    Args:
        batch: the tiles.
        first: number of entries of each list that have been read.
        light: remaining light of the pixels of each tile.
    """
    return (first < batch.counts) & jnp.any(light > 0, axis=1)


def composite_forward(splats: Splats, lists: Lists, reads: Int[Array, "tiles"] | None, plan: Plan):
    """The image of all tiles [tile rows x edge, tile columns x edge, channels], the transmittance of each
    tile [tiles, pixels], and the number of entries read from each list [tiles].

    `reads` from an earlier call groups tiles that end equally early; it does not change the result.
    """
    dtype, channels = splats.opacities.dtype, splats.values.shape[1]
    chunk, pixels, is_wide = chunk_length(channels), tile_pixels(plan, dtype), channels > FEW_CHANNELS
    length = lists.counts if reads is None else jnp.minimum(lists.counts, reads)
    batches = batch_tiles(lists, length, channels, plan)
    columns = in_columns(splats, plan.limits)
    compose = jax.vmap(partial(composite_columns, limits=plan.limits), in_axes=(0, None, 0))

    def start(_):
        return _loop_layout(start_tile(plan.tile_pixels, channels, dtype), channels)

    def one_batch(image, at):
        number, batch = at

        def step(carry):
            first, state, reading, read = carry
            _, piece = read_chunk(columns, lists, batch, first, chunk)
            first, state = first + chunk, compose(piece, pixels, state)
            return first, state, still_read(batch, first, state.light), jnp.where(reading, first, read)

        begin = (jnp.int32(0), jax.vmap(start)(batch.counts), batch.counts > 0, jnp.zeros_like(batch.counts))
        _, state, _, read = jax.lax.while_loop(lambda carry: jnp.any(carry[2]), step, begin)
        others = state.transmittance, jnp.minimum(read, batch.counts)
        if image is None:
            return None, (state.values, *others)
        left = jnp.minimum(batch.tiles.shape[0], num_tiles - number * batch.tiles.shape[0])
        return write_tiles(image, batch.tiles, state.values, left, plan), (None, *others)

    num_tiles = lists.counts.shape[0]
    edges = num_tiles // plan.tiles_x * plan.tile_size, plan.tiles_x * plan.tile_size
    # On a CPU, many channels are written in place at once: reordering tiles later takes half as long again.
    at_once = is_wide and jax.default_backend() == "cpu"
    image = jnp.zeros((*edges, channels), dtype) if at_once else None
    numbers = jnp.arange(batches.tiles.shape[0], dtype=jnp.int32)
    image, outputs = jax.lax.scan(one_batch, image, (numbers, batches))
    # The position of each tile in the batches; the padding of the last batch, -1, is the largest key.
    place = argsort_keys(batches.tiles.ravel().astype(jnp.uint32), plan.sort)[:num_tiles]
    values, light, read = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[place], outputs)
    if image is None:
        image = untile(values.swapaxes(1, 2) if is_wide else values, plan)
    return image, light, read
