"""Conversion between tiles and the image that they form.

The pixels of a tile lie along one axis, row by row. Few channels are composited as [channels, pixels], many
as [pixels, channels], which is also their layout in the image: there, a row of a tile is contiguous.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.rasterize.plan import Plan


def tile_pixels(plan: Plan, dtype) -> Float[Array, "pixels 2"]:
    """Pixel centres relative to the tile's centre: small numbers, whose squares are exact in float32."""
    offsets = np.arange(plan.tile_size) + 0.5 - plan.tile_size / 2
    x, y = np.meshgrid(offsets, offsets)
    return jnp.asarray(np.stack([x.ravel(), y.ravel()], axis=-1), dtype)


def write_tiles(
    image: Float[Array, "high wide channels"],
    tiles: Int[Array, "batch"],
    values: Float[Array, "batch pixels channels"],
    count: Int[Array, ""] | int,
    plan: Plan,
) -> Float[Array, "high wide channels"]:
    """The image with some of its tiles replaced, one after another: for CPUs.

    Args:
        image: the image of all tiles.
        tiles: indices of the tiles to replace.
        values: their new values.
        count: how many of them to replace, from the first on. Under vmap it should not be batched, or each
            tile costs a copy.
        plan: determines the size of a tile.
    """
    edge = plan.tile_size

    def write(i, image):
        tile = values[i].reshape(edge, edge, image.shape[-1])
        return jax.lax.dynamic_update_slice(image, tile, _corner(tiles[i], plan))

    return jax.lax.fori_loop(0, count, write, image)


def read_tiles(
    image: Float[Array, "high wide channels"], tiles: Int[Array, "batch"], plan: Plan
) -> Float[Array, "batch pixels channels"]:
    """Some tiles of an image.

    Args:
        image: the image of all tiles.
        tiles: indices of the wanted tiles.
        plan: determines the size of a tile.
    """
    size = plan.tile_size, plan.tile_size, image.shape[-1]

    def read(tile):
        part = jax.lax.dynamic_slice(image, _corner(tile, plan), size)
        return part.reshape(plan.tile_pixels, image.shape[-1])

    return jax.vmap(read)(tiles)


def _corner(tile: Int[Array, ""], plan: Plan):
    """Where a tile begins in the image: row, column, channel."""
    row, column = tile // plan.tiles_x, tile % plan.tiles_x
    return row * plan.tile_size, column * plan.tile_size, jnp.zeros_like(tile)


def untile(tiles: Float[Array, "tiles channels pixels"], plan: Plan) -> Float[Array, "high wide channels"]:
    """The image of all tiles, with those of several views one below another."""
    edge, wide = plan.tile_size, plan.tiles_x
    num_tiles, channels, _ = tiles.shape
    apart = tiles.reshape(num_tiles // wide, wide, channels, edge, edge)
    return apart.transpose(0, 3, 1, 4, 2).reshape(num_tiles // wide * edge, wide * edge, channels)


def in_tiles(image: Float[Array, "high wide channels"], plan: Plan) -> Float[Array, "tiles channels pixels"]:
    """All tiles of an image; the inverse of `untile`."""
    edge, wide = plan.tile_size, plan.tiles_x
    high, _, channels = image.shape
    apart = image.reshape(high // edge, edge, wide, edge, channels)
    return apart.transpose(0, 2, 4, 1, 3).reshape(high // edge * wide, channels, edge * edge)


def split_views(
    image: Float[Array, "high wide channels"], shape: tuple[int, ...], plan: Plan
) -> Float[Array, "*shape height width channels"]:
    """The images of the views, [*shape] of them, cropped to the plan's size."""
    apart = image.reshape(*shape, plan.tiles_y * plan.tile_size, *image.shape[1:])
    return apart[..., : plan.height, : plan.width, :]
