"""Regions in which images may change: the tiles that Gaussians touch."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gsjax.geometry.cameras import project
from gsjax.scene.frame import Frame

TILE = 16
"""Edge of a tile in pixels; a multiple of the rasterizer's."""


@partial(jax.jit, static_argnums=2, inline=True)
def touched_tiles(
    positions: list[Float[Array, "m 3"]], frame: Frame, tile: int = TILE
) -> Bool[Array, "c rows columns"]:
    """Tiles, `tile` pixels wide, that contain or border on a Gaussian centre in any of the positions."""
    columns, rows = -(-frame.cameras.width // tile), -(-frame.cameras.height // tile)
    points = jnp.concatenate(positions)

    def one(viewmat, K):
        pixels, depth = project(points, viewmat, K)
        place = jnp.floor(pixels / tile)
        limit = jnp.array([columns, rows])
        inside = (depth > 1e-3) & (place >= -1).all(-1) & (place <= limit).all(-1)
        column, row = jnp.clip(place, -1, limit).astype(jnp.int32).T
        touched = jnp.zeros((rows + 2, columns + 2), bool).at[row + 1, column + 1].max(inside)
        return jax.lax.reduce_window(touched, False, jnp.logical_or, (3, 3), (1, 1), "SAME")[1:-1, 1:-1]

    return jax.vmap(one)(frame.cameras.viewmat, frame.cameras.K)


def tiles_to_pixels(
    tiles: Bool[Array, "c rows columns"], frame: Frame, tile: int = TILE
) -> Bool[Array, "c height width"]:
    """The pixels of the chosen tiles."""
    pixels = jnp.repeat(jnp.repeat(tiles, tile, axis=1), tile, axis=2)
    return pixels[:, : frame.cameras.height, : frame.cameras.width]
