"""Only what may change is refined: tiles a moving Gaussian touches, and the background that reaches them."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gsjax.methods.track.scene import TrackedScene
from gsjax.scene.gaussians import take
from gsjax.scene.region import TILE
from gsjax.scene.render import Rendered


def near_background(
    scene: TrackedScene, rendered: Rendered, tiles: Bool[Array, "c rows columns"]
) -> Bool[Array, "background"]:
    """Which background Gaussians reach a chosen tile in some camera: their box holds one, by summed areas."""
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


def near_scene(scene: TrackedScene, near: Bool[Array, "background"], num_near: int) -> TrackedScene:
    """The moving Gaussians and the chosen background: `num_near` rows, those left over invisible."""
    rows = jnp.nonzero(near, size=num_near, fill_value=0)[0] + scene.num_moving
    empty = jnp.arange(num_near) >= near.sum()
    background = take(scene.gaussians, rows)
    faint = jnp.where(empty, -30.0, background.logit_opacities)
    background = eqx.tree_at(lambda g: g.logit_opacities, background, faint)
    moving = jax.tree.map(lambda a: a[: scene.num_moving], scene.gaussians)
    gaussians = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), moving, background)
    labels = jnp.concatenate([scene.labels[: scene.num_moving], jnp.zeros(num_near, jnp.int32)])
    return TrackedScene(gaussians, scene.normals, labels, scene.label_ids, scene.num_moving)


def shift_background(scene: TrackedScene, shifts: Float[Array, "b 3"]) -> TrackedScene:
    """The scene with its background's Gaussians moved, each by its own."""
    means = scene.gaussians.means.at[scene.num_moving :].add(shifts)
    return eqx.tree_at(lambda s: s.gaussians.means, scene, means)


def spread(near: Bool[Array, "background"], values: Float[Array, "near 3"]) -> Float[Array, "background 3"]:
    """Values of the rows of `near_scene`, scattered to the whole background; 0 elsewhere."""
    rows = jnp.nonzero(near, size=len(values), fill_value=len(near))[0]
    return jnp.zeros((len(near), 3), values.dtype).at[rows].set(values, mode="drop")
