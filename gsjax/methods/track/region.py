"""The refined region: tiles that moving Gaussians touch, and the background Gaussians that reach them."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gsjax.methods.track.scene import TrackedScene, emptied
from gsjax.scene.gaussians import take
from gsjax.scene.region import TILE
from gsjax.scene.render import Rendered


@partial(jax.jit, inline=True)
def near_background(
    scene: TrackedScene, rendered: Rendered, tiles: Bool[Array, "c rows columns"]
) -> Bool[Array, "background"]:
    """Background Gaussians whose bounding box reaches one of the tiles in some camera, tested with a
    summed-area table."""
    rows, columns = tiles.shape[1:]
    still = scene.num_moving

    def one(mean, radius, tiles):
        area = jnp.pad(jnp.cumsum(jnp.cumsum(tiles.astype(jnp.int32), axis=0), axis=1), ((1, 0), (1, 0)))
        limit = jnp.array([columns, rows])
        low = jnp.clip(jnp.floor((mean - radius) / TILE), 0, limit).astype(jnp.int32)
        high = jnp.clip(jnp.floor((mean + radius) / TILE) + 1, 0, limit).astype(jnp.int32)
        high = jnp.maximum(high, low)
        (x0, y0), (x1, y1) = low.T, high.T
        count = area[y1, x1] - area[y0, x1] - area[y1, x0] + area[y0, x0]
        return (count > 0) & (radius > 0).all(-1)

    means, radii = rendered.meta.means2d[:, still:], rendered.meta.radii[:, still:]
    return jax.vmap(one)(means, radii, tiles).any(0)


@partial(jax.jit, static_argnums=2, inline=True)
def near_scene(scene: TrackedScene, near: Bool[Array, "background"], num_near: int) -> TrackedScene:
    """The scene with only the near Gaussians of the background, in `num_near` rows; surplus rows are
    invisible."""
    rows = jnp.nonzero(near, size=num_near, fill_value=0)[0] + scene.num_moving
    background = emptied(take(scene.gaussians, rows), jnp.arange(num_near) >= near.sum())
    moving = jax.tree.map(lambda a: a[: scene.num_moving], scene.gaussians)
    gaussians = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), moving, background)
    labels = jnp.concatenate([scene.groups, jnp.zeros(num_near, jnp.int32)])
    return TrackedScene(gaussians, scene.normals, labels, scene.label_ids, scene.num_moving)


def shift_background(scene: TrackedScene, shifts: Float[Array, "b 3"]) -> TrackedScene:
    """The scene with each Gaussian of its background displaced, metres."""
    means = scene.gaussians.means.at[scene.num_moving :].add(shifts)
    return eqx.tree_at(lambda s: s.gaussians.means, scene, means)


def scatter(near: Bool[Array, "background"], values: Float[Array, "near 3"]) -> Float[Array, "background 3"]:
    """Values of the background rows of `near_scene`, scattered to the whole background; 0 elsewhere."""
    rows = jnp.nonzero(near, size=len(values), fill_value=len(near))[0]
    return jnp.zeros((len(near), 3), values.dtype).at[rows].set(values, mode="drop")
