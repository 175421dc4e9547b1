"""`composite`, the compositing of all tiles, with its hand-written VJP.

The backward pass reads the lists front to back like the forward pass, and computes the same weights from the
same alphas. With q_i = sum_c v_ic dL/dI_c, and the contribution behind Gaussian i,
S_i = sum_{j>i} w_j q_j + T dL/dT,

    dL/dalpha_i = T_i q_i - S_i / (1 - alpha_i),  so  dL/dpower_i = w_i q_i - S_i alpha_i / (1 - alpha_i),

where S starts as the total, which follows from the finished image: sum_c I_c dL/dI_c + T dL/dT. The pixels'
gradients are summed to Gaussians by two matmuls: dL/dpower against the monomials 1, x, y, x^2, xy, y^2 of the
tile's pixels, and w against dL/dI. If the gradients of the geometry are not needed, as when features are
learned on a fixed scene, only the last matmul remains.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, Int

from gsjax.rasterize import fused
from gsjax.rasterize.compositing import (
    CHUNK,
    SATURATION,
    Batches,
    Columns,
    Lists,
    Splats,
    batch_tiles,
    chunk_length,
    composite_forward,
    in_columns,
    read_chunk,
    splat_alphas,
    still_read,
    weights_of_many,
)
from gsjax.rasterize.plan import FEW_CHANNELS, Limits, Plan
from gsjax.rasterize.tiles import in_tiles, read_tiles, tile_pixels

SMALL = 1e-6  # lower bound of 1 - alpha as a divisor


def composite(
    splats: Splats, lists: Lists, reads: Int[Array, "tiles"] | None, plan: Plan
) -> tuple[Float[Array, "high wide channels"], Float[Array, "tiles pixels"], Int[Array, "tiles"]]:
    """The image of all tiles, the transmittance of their pixels, and the number of entries read from each
    list.

    Differentiable in the plan's mode. `reads` from an earlier, similar call makes this one faster; it does
    not change the result.
    """
    if plan.derivative == "forward":
        return composite_forward(splats, lists, reads, plan)
    return _composite(splats, lists, reads, plan)


def _forward(splats: Splats, lists: Lists, reads, plan: Plan):
    def in_kernels(splats, lists, _, lanes):
        return fused.composite_forward(splats, lists, plan, lanes)

    return fused.by_platform(partial(composite_forward, plan=plan), in_kernels, splats, lists, reads)


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def _composite(splats: Splats, lists: Lists, reads, plan: Plan):
    return _forward(splats, lists, reads, plan)


def _composite_fwd(splats, lists, reads, plan):
    shapes_move = any(leaf.perturbed for leaf in (splats.means2d, splats.conics, splats.opacities))
    splats, lists, reads = jax.tree.map(lambda leaf: leaf.value, (splats, lists, reads))
    image, transmittance, reads = _forward(splats, lists, reads, plan)
    kept = (image, transmittance) if shapes_move else None
    return (image, transmittance, reads), (splats, lists, reads, kept)


def _composite_bwd(plan: Plan, residuals, cotangents):
    splats, lists, reads, kept = residuals
    d_image, d_transmittance = (
        jnp.zeros(d.shape, d.dtype) if isinstance(d, SymbolicZero) else d for d in cotangents[:2]
    )
    if kept is None:
        in_xla, in_kernels = (partial(f, plan=plan) for f in (_values_gradients, fused.values_gradients))
        d_values = fused.by_platform(in_xla, in_kernels, splats, lists, reads, d_image)
        return Splats(None, None, None, d_values), None, None  # type: ignore[arg-type]
    in_xla, in_kernels = (partial(f, plan=plan) for f in (_gradients, fused.gradients))
    cotangents = (d_image, d_transmittance)
    return fused.by_platform(in_xla, in_kernels, splats, lists, reads, kept, cotangents), None, None


def _reader(image: Float[Array, "high wide channels"], plan: Plan):
    """A function that returns some tiles of an image, in the layout in which they are composited."""
    if image.shape[-1] > FEW_CHANNELS:
        return partial(read_tiles, image, plan=plan)
    tiles = in_tiles(image, plan)
    return lambda some: tiles[some]


def _gradients(splats: Splats, lists: Lists, reads, kept, cotangents, plan: Plan) -> Splats:
    """Gradients with respect to all fields of the splats."""
    (image, transmittance), (d_image, d_transmittance) = kept, cotangents
    dtype, channels = splats.opacities.dtype, splats.values.shape[1]
    chunk, pixels = chunk_length(channels), tile_pixels(plan, dtype)
    cotangent_of = _reader(d_image, plan)
    if channels > FEW_CHANNELS:
        behind = in_tiles((image * d_image).sum(axis=-1, keepdims=True), plan)[:, 0]
    else:  # channel by channel: along the last axis XLA:CPU adds four of them in another order
        behind = (in_tiles(image, plan) * in_tiles(d_image, plan)).sum(axis=1)
    behind += d_transmittance * transmittance
    constants = {"pixels": pixels, "monomials": _monomials(pixels), "limits": plan.limits}
    of_chunk = jax.vmap(partial(_chunk_gradients, **constants))
    columns = in_columns(splats, plan.limits)

    def one_batch(total, batch: Batches):
        tile = jnp.maximum(batch.tiles, 0)
        d_tiles = cotangent_of(tile)

        def unfinished(carry):
            first, light, *_ = carry
            return jnp.any(still_read(batch, first, light))

        def step(carry):
            first, light, behind, total = carry
            ids, piece = read_chunk(columns, lists, batch, first, chunk)
            light, behind, rows = of_chunk(piece, d_tiles, light, behind)
            total = total.at[ids.ravel()].add(rows.reshape(-1, 6 + channels))
            return first + chunk, light, behind, total

        start = (jnp.int32(0), jnp.ones((len(tile), plan.tile_pixels), dtype), behind[tile], total)
        return jax.lax.while_loop(unfinished, step, start)[3], None

    # One row per Gaussian: (u, v, A, B, C, log opacity), then its values.
    rows = jnp.zeros((splats.opacities.shape[0], 6 + channels), dtype)
    rows, _ = jax.lax.scan(one_batch, rows, batch_tiles(lists, reads, channels, plan))
    visible = splats.opacities > 0
    d_opacities = jnp.where(visible, rows[:, 5] / jnp.where(visible, splats.opacities, 1.0), 0.0)
    return Splats(rows[:, :2], rows[:, 2:5], d_opacities, rows[:, 6:].astype(splats.values.dtype))


def _values_gradients(
    splats: Splats, lists: Lists, reads, d_image: Float[Array, "high wide channels"], plan: Plan
) -> Float[Array, "n channels"]:
    """Gradients with respect to the values only: w^T dL/dI."""
    dtype, channels = splats.opacities.dtype, splats.values.shape[1]
    chunk, pixels, cotangent_of = chunk_length(channels), tile_pixels(plan, dtype), _reader(d_image, plan)
    columns = in_columns(splats._replace(values=splats.values[:, :0]), plan.limits)

    def of_chunk(piece: Columns, d_tile, light):
        alphas = splat_alphas(piece, pixels, plan.limits)
        weights, light = weights_of_many(alphas, light, plan.limits)
        d_tile = d_tile if channels > FEW_CHANNELS else d_tile.T
        return light, jnp.matmul(weights, d_tile, precision="highest")

    def one_batch(total, batch: Batches):
        d_tiles = cotangent_of(jnp.maximum(batch.tiles, 0))

        def step(carry):
            first, light, total = carry
            ids, piece = read_chunk(columns, lists, batch, first, chunk)
            light, rows = jax.vmap(of_chunk)(piece, d_tiles, light)
            return first + chunk, light, total.at[ids.ravel()].add(rows.reshape(-1, channels))

        start = (jnp.int32(0), jnp.ones((len(batch.tiles), plan.tile_pixels), dtype), total)
        return jax.lax.while_loop(lambda carry: jnp.any(still_read(batch, carry[0], carry[1])), step, start)[
            2
        ], None

    total = jnp.zeros((splats.opacities.shape[0], channels), dtype)
    total, _ = jax.lax.scan(one_batch, total, batch_tiles(lists, reads, channels, plan))
    return total.astype(splats.values.dtype)


def _monomials(pixels: Float[Array, "pixels 2"]) -> Float[Array, "pixels 8"]:
    """1, x, y, x^2, xy, y^2, and two columns of zeros: matmuls are efficient for a width of eight."""
    x, y = pixels[:, 0], pixels[:, 1]
    return jnp.stack([jnp.ones_like(x), x, y, x * x, x * y, y * y, 0 * x, 0 * x], axis=-1)


def _chunk_gradients(piece: Columns, d_tile, light, behind, *, pixels, monomials, limits: Limits):
    """(light, S) behind one chunk of one tile, and the chunk's rows of gradients: geometry, then values."""
    alphas = splat_alphas(piece, pixels, limits)
    weights, light = weights_of_many(alphas, light, limits)
    if isinstance(piece.values, tuple):
        toward = sum(
            value.astype(light.dtype)[:, None] * d for value, d in zip(piece.values, d_tile, strict=True)
        )
        d_tile = d_tile.T
    else:
        toward = jnp.matmul(piece.values.astype(light.dtype), d_tile.T, precision="highest")
    d_values = jnp.matmul(weights, d_tile, precision="highest")
    passed = weights * toward
    d_power = []
    for i in range(0, alphas.shape[0], CHUNK):
        some = slice(i, i + CHUNK)
        suffix = _suffix(behind, passed[some])
        slope = suffix * alphas[some] / jnp.maximum(1 - alphas[some], SMALL)
        moved = (weights[some] > 0) & (alphas[some] < limits.alpha_max * (1 - 0.5 * SATURATION))
        d_power.append(jnp.where(moved, passed[some] - slope, 0.0))
        for row in passed[some]:  # not .sum(), for which XLA:CPU calls a library
            behind = behind - row
    moments = jnp.matmul(jnp.concatenate(d_power), monomials, precision="highest")
    return light, behind, jnp.concatenate([_gradient_rows(piece, moments), d_values], axis=-1)


def _suffix(
    behind: Float[Array, "pixels"], passed: Float[Array, "list pixels"]
) -> Float[Array, "list pixels"]:
    """S_i: `behind` less the contributions of entries up to i."""
    row = np.arange(passed.shape[0])[:, None]
    suffix = jnp.broadcast_to(behind, passed.shape)
    for j in range(passed.shape[0]):
        suffix = suffix - jnp.where(row >= j, passed[j], 0.0)
    return suffix


def _gradient_rows(piece: Columns, moments: Float[Array, "list 8"]) -> Float[Array, "list 6"]:
    """Gradients of (u, v, A, B, C, log opacity) from the moments of dL/dpower over a tile's pixels."""
    u, v, a, b, c = piece[:5]
    m, mx, my, mxx, mxy, myy = (moments[:, i] for i in range(6))
    # Moments about the Gaussian's own centre.
    sx, sy = mx - u * m, my - v * m
    sxx = mxx - 2 * u * mx + u * u * m
    sxy = mxy - u * my - v * mx + u * v * m
    syy = myy - 2 * v * my + v * v * m
    return jnp.stack([a * sx + b * sy, b * sx + c * sy, -0.5 * sxx, -sxy, -0.5 * syy, m], axis=-1)


_composite.defvjp(_composite_fwd, _composite_bwd, symbolic_zeros=True)
