"""Front-to-back alpha compositing (Kerbl et al. 2023, eq. 3), and its hand-written VJP.

Tiles are sorted by the length of their lists and taken in batches; a batch walks its lists in chunks of 16
Gaussians until its longest list ends or all its pixels are opaque. So lists have any length, one compiled
program serves them all, and no tile waits for a much longer one. Arrays are [tile, pixel], pixels last.

The backward pass walks the chunks in reverse. It recovers the transmittance by dividing by 1 - alpha, keeps
the suffix sum S of what lies behind, and reduces the pixels' gradients to Gaussians with two matmuls: one
against the monomials 1, x, y, x^2, xy, y^2 of the tile's pixels, one against the gradient of the image.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.rasterize.plan import TILE, Plan
from gsjax.rasterize.projection import ALPHA_MIN

MIN_TRANSMITTANCE = 1e-4  # a pixel is opaque when the next Gaussian would take it to this
CHUNK = 16  # Gaussians that one pass over a tile's pixels takes
_UNROLLED_CHANNELS = 8  # up to here multiply-adds are cheaper than many tiny matmuls
_SMALL = 1e-6


class Splats(NamedTuple):
    """A list of projected Gaussians, front to back. An opacity of 0 is an empty slot."""

    means2d: Float[Array, "*list 2"]  # pixels
    conics: Float[Array, "*list 3"]
    opacities: Float[Array, "*list"]
    values: Float[Array, "*list channels"]  # whatever is composited: colours, depth, features


class TileState(NamedTuple):
    """Compositing of P pixels, as far as it has come."""

    values: Float[Array, "*tiles channels pixels"]
    transmittance: Float[Array, "*tiles pixels"]  # what light still passes
    product: Float[Array, "*tiles pixels"]  # the same without the early stop, which it decides
    read: Int[Array, "*tiles pixels"]  # list entries before the one that ended the pixel
    position: Int[Array, "*tiles"]  # list entries seen


def start_tile(num_pixels: int, channels: int, dtype=jnp.float32) -> TileState:
    """The state of pixels that nothing covers yet."""
    ones = jnp.ones(num_pixels, dtype)
    return TileState(
        values=jnp.zeros((channels, num_pixels), dtype),
        transmittance=ones,
        product=ones,
        read=jnp.zeros(num_pixels, jnp.int32),
        position=jnp.int32(0),
    )


def _alpha(mean, conic, opacity, pixels, alpha_max):
    """(clamped alpha, unclamped alpha, whether it is drawn) at `pixels`; coordinates on the last axis."""
    dx, dy = pixels[..., 0] - mean[..., 0], pixels[..., 1] - mean[..., 1]
    power = -0.5 * (conic[..., 0] * dx * dx + conic[..., 2] * dy * dy) - conic[..., 1] * dx * dy
    raw = opacity * jnp.exp(power)
    alpha = jnp.where(raw < alpha_max, raw, alpha_max)  # at the clamp itself the gradient is 0, not 1/2
    return alpha, raw, (power <= 0) & (alpha >= ALPHA_MIN)


def composite_tile(
    splats: Splats,
    pixels: Float[Array, "pixels 2"],
    state: TileState | None = None,
    *,
    alpha_max: float = 0.99,
) -> TileState:
    """Composite one list of Gaussians, front to back, over the pixels of one tile.

    alpha_i = min(alpha_max, o_i exp(-d^T conic d / 2)) with contributions under 1/255 skipped; the pixel ends
    before the Gaussian that would take its transmittance to 1e-4. A pure function for one tile: vmap it over
    many, and pass the state on to go through a long list piece by piece.

    Args:
        splats: the list, [L] of each field.
        pixels: positions of the pixels, in the same coordinates as `splats.means2d`.
        state: where an earlier piece of the list ended; an empty tile unless given.
        alpha_max: where a contribution saturates; its opacity then gets no gradient.

    Returns:
        The new state: values `sum_i w_i v_i` and the transmittance left for a background.
    """
    length, channels = splats.values.shape
    if state is None:
        state = start_tile(pixels.shape[0], channels, splats.values.dtype)
    if length == 0:
        return state
    if length > CHUNK:
        return _composite_long(splats, pixels, state, alpha_max)

    values, transmittance, product, read, position = state
    splat = (splats.means2d[:, None], splats.conics[:, None], splats.opacities[:, None])
    alpha, _, drawn = _alpha(*splat, pixels, alpha_max)
    alpha = jnp.where(drawn, alpha, 0.0)
    products = [product]
    for i in range(length):  # unrolled: the one thing that must go in order is this product
        products.append(products[-1] * (1 - alpha[i]))
    before, after = jnp.stack(products[:-1]), jnp.stack(products[1:])
    live = after > MIN_TRANSMITTANCE  # once false, false for good, since the product only falls
    weights = jnp.where(live, alpha * before, 0.0)
    if channels <= _UNROLLED_CHANNELS:
        values = values + jnp.sum(weights[None] * splats.values.T[:, :, None], axis=1)
    else:
        values = values + jnp.matmul(splats.values.T, weights, precision="highest")
    return TileState(
        values=values,
        transmittance=jnp.minimum(transmittance, jnp.min(jnp.where(live, after, jnp.inf), axis=0)),
        product=products[-1],
        read=read + live.sum(axis=0, dtype=jnp.int32),
        position=position + length,
    )


def _composite_long(splats: Splats, pixels, state: TileState, alpha_max: float) -> TileState:
    length = splats.opacities.shape[0]
    padding = -length % CHUNK

    def chunked(a):
        return jnp.pad(a, [(0, padding)] + [(0, 0)] * (a.ndim - 1)).reshape(-1, CHUNK, *a.shape[1:])

    def body(state, chunk):
        return composite_tile(chunk, pixels, state, alpha_max=alpha_max), None

    return jax.lax.scan(body, state, jax.tree.map(chunked, splats))[0]


class Lists(NamedTuple):
    """The lists of all tiles of all cameras, as rows into the splats of all cameras."""

    ids: Int[Array, "pairs"]
    starts: Int[Array, "tiles"]
    counts: Int[Array, "tiles"]


def _tile_pixels(dtype) -> np.ndarray:
    """Pixel centres relative to the tile's centre: small numbers, whose squares float32 holds exactly."""
    offsets = np.arange(TILE) + 0.5 - TILE / 2
    x, y = np.meshgrid(offsets, offsets)
    return np.stack([x.ravel(), y.ravel()], axis=-1).astype(dtype)


def _batches(lists: Lists, plan: Plan):
    """Tiles by falling list length, in batches: (order, per-batch tile centres, starts, counts)."""
    order = jnp.argsort(-lists.counts).astype(jnp.int32)
    size = min(plan.tiles_per_batch, order.shape[0])
    order = jnp.pad(order, (0, -order.shape[0] % size), constant_values=-1)
    real = order >= 0
    tile = jnp.maximum(order, 0)
    within = tile % plan.num_tiles
    centers = jnp.stack([within % plan.tiles_x, within // plan.tiles_x], axis=-1) * TILE + TILE / 2
    counts = jnp.where(real, lists.counts[tile], 0)
    batched = (centers, lists.starts[tile], counts)
    return order, jax.tree.map(lambda a: a.reshape(-1, size, *a.shape[1:]), batched)


def _chunk(splats: Splats, lists: Lists, centers, starts, counts, first):
    """Rows and splats `first .. first + 15` of each tile of a batch, means relative to the tile's centre."""
    entry = first + jnp.arange(CHUNK, dtype=jnp.int32)
    slots = jnp.minimum(starts[:, None] + entry, lists.ids.shape[0] - 1)
    ids = lists.ids[slots]
    real = entry < counts[:, None]
    # Column by column: a gather of scalars is the quick one on a CPU.
    mean = jnp.stack([splats.means2d[:, i][ids] for i in range(2)], axis=-1)
    conic = jnp.stack([splats.conics[:, i][ids] for i in range(3)], axis=-1)
    opacity = jnp.where(real, splats.opacities[ids], 0.0)
    mean = mean - centers[:, None, :].astype(mean.dtype)
    return ids, Splats(mean, conic, opacity, splats.values[ids])


def _forward(splats: Splats, lists: Lists, plan: Plan):
    """Every tile's values [tiles, channels, pixels], transmittance and entries read [tiles, pixels]."""
    dtype, channels = splats.values.dtype, splats.values.shape[1]
    pixels = jnp.asarray(_tile_pixels(dtype))
    order, batches = _batches(lists, plan)
    compose = jax.vmap(partial(composite_tile, alpha_max=plan.alpha_max), in_axes=(0, None, 0))

    def one_batch(_, batch):
        centers, starts, counts = batch
        longest = counts.max()
        state = jax.vmap(lambda _: start_tile(TILE * TILE, channels, dtype))(counts)

        def unfinished(state):
            return (state.position[0] < longest) & jnp.any(state.product > MIN_TRANSMITTANCE)

        def step(state):
            _, chunk = _chunk(splats, lists, centers, starts, counts, state.position[0])
            return compose(chunk, pixels, state)

        state = jax.lax.while_loop(unfinished, step, state)
        return None, (state.values, state.transmittance, state.read)

    _, outputs = jax.lax.scan(one_batch, None, batches)
    num_tiles = lists.counts.shape[0]
    place = jnp.where(order >= 0, order, num_tiles)

    def unsort(a):
        a = a.reshape(-1, *a.shape[2:])
        empty = jnp.zeros((num_tiles, *a.shape[1:]), a.dtype)
        return empty.at[place].set(a, mode="drop", unique_indices=True)

    return jax.tree.map(unsort, outputs)


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def _composite_reverse(splats: Splats, lists: Lists, plan: Plan):
    values, transmittance, _ = _forward(splats, lists, plan)
    return values, transmittance


def _composite_fwd(splats, lists, plan):
    values, transmittance, read = _forward(splats, lists, plan)
    return (values, transmittance), (splats, lists, transmittance, read)


def _composite_bwd(plan: Plan, residuals, cotangents):
    splats, lists, transmittance, read = residuals
    d_values, d_transmittance = cotangents
    dtype = splats.values.dtype
    pixels = jnp.asarray(_tile_pixels(dtype))
    x, y = pixels[:, 0], pixels[:, 1]
    monomials = jnp.stack([jnp.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    order, batches = _batches(lists, plan)
    tiles = jnp.maximum(order, 0).reshape(batches[1].shape)

    def one_batch(total, batch):
        (centers, starts, counts), tile = batch
        after, ended, d_image = transmittance[tile], read[tile], d_values[tile]
        behind = d_transmittance[tile] * after  # S, begun with what the background receives

        def unfinished(carry):
            return carry[0] >= 0

        def step(carry):
            first, after, behind, total = carry
            ids, chunk = _chunk(splats, lists, centers, starts, counts, first)
            after, behind, rows = _chunk_vjp(
                chunk, pixels, monomials, d_image, after, behind, ended - first, plan.alpha_max
            )
            total = jax.tree.map(lambda t, r: t.at[ids.ravel()].add(r.reshape(-1, *t.shape[1:])), total, rows)
            return first - CHUNK, after, behind, total

        last = (jnp.max(jnp.where(counts[:, None] > 0, ended, 0)) - 1) // CHUNK * CHUNK
        *_, total = jax.lax.while_loop(unfinished, step, (last, after, behind, total))
        return total, None

    # One row a Gaussian: (u, v, A, B, C, opacity), and its values.
    zeros = (jnp.zeros((splats.opacities.shape[0], 6), dtype), jnp.zeros_like(splats.values))
    (geometry, d_splat_values), _ = jax.lax.scan(one_batch, zeros, (batches, tiles))
    d_splats = Splats(geometry[:, :2], geometry[:, 2:5], geometry[:, 5], d_splat_values)
    return d_splats, None


def _chunk_vjp(chunk: Splats, pixels, monomials, d_image, after, behind, ended, alpha_max):
    """Gradients of one chunk in each tile of a batch, and (T, S) in front of it.

    With q_i = sum_c v_ic dL/dI_c and S_i the sum of w_j q_j over j behind i (and the background's share):
    dL/dalpha_i = T_i q_i - S_i / (1 - alpha_i).
    """
    channels = chunk.values.shape[-1]
    unrolled = channels <= _UNROLLED_CHANNELS
    if not unrolled:
        along = jnp.einsum("bkc,bcp->bkp", chunk.values, d_image, precision="highest")
    d_power, weights = [None] * CHUNK, [None] * CHUNK
    for i in reversed(range(CHUNK)):
        splat = (chunk.means2d[:, i, None], chunk.conics[:, i, None], chunk.opacities[:, i, None])
        alpha, raw, drawn = _alpha(*splat, pixels, alpha_max)
        drawn &= i < ended
        alpha = jnp.where(drawn, alpha, 0.0)
        left = jnp.maximum(1 - alpha, _SMALL)
        after = after / left
        weight = alpha * after
        if unrolled:
            q = sum(chunk.values[:, i, c, None] * d_image[:, c] for c in range(channels))
        else:
            q = along[:, i]
        d_alpha = after * q - behind / left
        d_power[i] = jnp.where(drawn & (raw < alpha_max), d_alpha * alpha, 0.0)
        weights[i] = weight
        behind = behind + weight * q
    moments = jnp.einsum("bkp,pm->bkm", jnp.stack(d_power, axis=1), monomials, precision="highest")
    d_values = jnp.einsum("bkp,bcp->bkc", jnp.stack(weights, axis=1), d_image, precision="highest")
    return after, behind, (_gradient_rows(chunk, moments), d_values)


def _gradient_rows(chunk: Splats, moments):
    """Gradients of (u, v, A, B, C, opacity) from the six moments of dL/dpower over a tile's pixels."""
    u, v = chunk.means2d[..., 0], chunk.means2d[..., 1]
    a, b, c = jnp.moveaxis(chunk.conics, -1, 0)
    m, mx, my, mxx, mxy, myy = jnp.moveaxis(moments, -1, 0)
    # Moments about the Gaussian's own centre.
    sx, sy = mx - u * m, my - v * m
    sxx = mxx - 2 * u * mx + u * u * m
    sxy = mxy - u * my - v * mx + u * v * m
    syy = myy - 2 * v * my + v * v * m
    opacity = chunk.opacities
    d_opacity = jnp.where(opacity > 0, m / jnp.where(opacity > 0, opacity, 1.0), 0.0)
    return jnp.stack([a * sx + b * sy, b * sx + c * sy, -0.5 * sxx, -sxy, -0.5 * syy, d_opacity], axis=-1)


_composite_reverse.defvjp(_composite_fwd, _composite_bwd)


def composite(
    splats: Splats, lists: Lists, plan: Plan
) -> tuple[Float[Array, "tiles channels pixels"], Float[Array, "tiles pixels"]]:
    """Values of all tiles, and the transmittance left. Differentiable as the plan says."""
    if plan.derivative == "forward":
        values, transmittance, _ = _forward(splats, lists, plan)
        return values, transmittance
    return _composite_reverse(splats, lists, plan)
