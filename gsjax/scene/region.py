"""Where pictures may change: the tiles that Gaussians touch."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gsjax.geometry.cameras import project
from gsjax.scene.frame import Frame

TILE = 16  # edge, pixels; a multiple of the rasterizer's


def touched_tiles(positions: list[Float[Array, "m 3"]], frame: Frame) -> Bool[Array, "c rows columns"]:
    """All tiles that hold, or border on, a moving Gaussian in any of the given positions."""
    columns, rows = -(-frame.cameras.width // TILE), -(-frame.cameras.height // TILE)
    points = jnp.concatenate(positions)

    def one(viewmat, K):
        pixels, depth = project(points, viewmat, K)
        tile = jnp.floor(pixels / TILE)
        limit = jnp.array([columns, rows])
        inside = (depth > 1e-3) & (tile >= -1).all(-1) & (tile <= limit).all(-1)
        column, row = jnp.clip(tile, -1, limit).astype(jnp.int32).T
        touched = jnp.zeros((rows + 2, columns + 2), bool).at[row + 1, column + 1].max(inside)
        return jax.lax.reduce_window(touched, False, jnp.logical_or, (3, 3), (1, 1), "SAME")[1:-1, 1:-1]

    return jax.vmap(one)(frame.cameras.viewmat, frame.cameras.K)


def tiles_to_pixels(tiles: Bool[Array, "c rows columns"], frame: Frame) -> Bool[Array, "c height width"]:
    """The pixels of the chosen tiles."""
    pixels = jnp.repeat(jnp.repeat(tiles, TILE, axis=1), TILE, axis=2)
    return pixels[:, : frame.cameras.height, : frame.cameras.width]
