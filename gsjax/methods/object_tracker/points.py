"""What is aligned of each group: coloured points, as many for each, that cameras may look for.

They are pixels of the last frame, which look most like the new one; pixels of a keyframe, carried along since
then; and centres of the Gaussians that the first mask named. The last frame alone would drift, and what once
slid off its object would take its neighbours' pixels for its own; the others remember what it was.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.cameras import pixel_grid, unproject
from gsjax.methods.object_tracker.config import AlignConfig
from gsjax.scene.frame import Frame


class Points(NamedTuple):
    """Points of the groups 1..K, one group a row."""

    means: Float[Array, "*k p 3"]
    colors: Float[Array, "*k p 3"]
    seen: Float[Array, "*k c p"]  # what a point counts in each camera, 0 to 1; 0 fills up a row


def join(a: Points, b: Points) -> Points:
    """The points of both."""
    rows = (jnp.concatenate([x, y], axis=1) for x, y in zip(a[:2], b[:2], strict=True))
    return Points(*rows, jnp.concatenate([a.seen, b.seen], axis=2))


def of_groups(chosen: Bool[Array, "k"], a: Float[Array, "k *d"], b: Float[Array, "k *d"]):
    """The rows of `a` for the chosen groups, and of `b` for the others."""
    return jnp.where(chosen.reshape(-1, *[1] * (a.ndim - 1)), a, b)


def carry(points: Points, twists: Float[Array, "k 6"], centers: Float[Array, "k 3"]) -> Points:
    """Each group's points after its twist (translation, rotation vector) about its centre."""
    center = centers[:, None]
    turned = jnp.einsum("kij,kpj->kpi", jaxlie.SO3.exp(twists[:, 3:]).as_matrix(), points.means - center)
    return points._replace(means=center + turned + twists[:, None, :3])


def sample_groups(
    means: Float[Array, "m 3"],
    colors: Float[Array, "m 3"],
    seen: Float[Array, "c m"],
    groups: Int[Array, "m"],
    num_groups: int,
    per_group: int,
) -> Points:
    """Up to `per_group` members of each group, spread over it; a large one needs no more."""
    shuffle = 1.0 + jax.random.permutation(jax.random.key(1), groups.shape[0]).astype(jnp.float32)
    size = min(per_group, groups.shape[0])

    def one(group):
        priority, rows = jax.lax.top_k(jnp.where(groups == group, shuffle, 0.0), size)
        return Points(means[rows], colors[rows], seen[:, rows] * (priority > 0))

    return jax.vmap(one)(jnp.arange(1, num_groups + 1))


def pixels_of_groups(
    frame: Frame,
    labels: Int[Array, "c h w"],
    depths: Float[Array, "c h w"],
    num_groups: int,
    config: AlignConfig,
) -> Points:
    """Up to `config.pixels` pixels of each group in each camera, as points that this camera looks for.

    Args:
        frame: what the cameras saw; for a camera without depth, the model's depth stands in.
        labels: the group of each pixel, 0 for none.
        depths: of the model at that pixel. What is measured further off
            than a group is thick is something else.
    """
    num_cameras, height, width = labels.shape
    grid = pixel_grid(width, height).reshape(-1, 2)
    # A fixed shuffle: any first few of the chosen pixels are spread over the whole group.
    shuffle = jax.random.permutation(jax.random.key(0), height * width).astype(jnp.float32)
    measured = depths
    if frame.depths is not None:
        with_depth = (frame.depths > 0).any((1, 2))[:, None, None]
        measured = jnp.where(with_depth, frame.depths, depths)
    usable = (measured > 0) & (jnp.abs(measured - depths) < config.max_thickness)

    def one(group, camera):
        chosen = (labels[camera].ravel() == group) & usable[camera].ravel()
        priority, rows = jax.lax.top_k(jnp.where(chosen, 1.0 + shuffle, 0.0), config.pixels)
        view = (frame.cameras.viewmat[camera], frame.cameras.K[camera])
        means = unproject(grid[rows], measured[camera].ravel()[rows], *view)
        return means, frame.images[camera].reshape(-1, 3)[rows], priority > 0

    groups, cameras = jnp.arange(1, num_groups + 1), jnp.arange(num_cameras)
    over_cameras = jax.vmap(one, in_axes=(None, 0))
    means, colors, real = jax.vmap(over_cameras, in_axes=(0, None))(groups, cameras)
    # Only the camera that saw a pixel looks for it.
    seen = jnp.einsum("kcp,cd->kdcp", real.astype(means.dtype), jnp.eye(num_cameras))
    return Points(
        means.reshape(num_groups, -1, 3),
        colors.reshape(num_groups, -1, 3),
        seen.reshape(num_groups, num_cameras, -1),
    )


class Keyframe(NamedTuple):
    """Pixels that showed each group in an earlier frame, where they would be now."""

    points: Points
    turned: Float[Array, "k 4"]  # how each group has turned since then, as a quaternion


def first_keyframe(pixels: Points) -> Keyframe:
    """The last frame's pixels as keyframe."""
    unturned = jnp.zeros((len(pixels.means), 4), pixels.means.dtype).at[:, 0].set(1.0)
    return Keyframe(pixels, unturned)


def turn_since(keyframe: Keyframe) -> Float[Array, "k"]:
    """By how much each group has turned since its keyframe, radians."""
    return 2 * jnp.arccos(jnp.clip(jnp.abs(keyframe.turned[:, 0]), 0.0, 1.0))


def faded(keyframe: Keyframe, max_turn: float) -> Points:
    """The keyframe's points, which count less the more a group has turned: it is lit differently by then."""
    share = jnp.clip(1 - turn_since(keyframe) / max(max_turn, 1e-9), 0.0, 1.0)
    return keyframe.points._replace(seen=keyframe.points.seen * share[:, None, None])


def renewed(keyframe: Keyframe, pixels: Points, max_turn: float) -> Keyframe:
    """`pixels` for the groups that have turned by more than `max_turn` radians: they show other sides now."""
    old = turn_since(keyframe) > max_turn
    return jax.tree.map(lambda new, kept: of_groups(old, new, kept), first_keyframe(pixels), keyframe)


def carry_keyframe(keyframe: Keyframe, twists: Float[Array, "k 6"], centers: Float[Array, "k 3"]) -> Keyframe:
    """The keyframe after each group's twist about its centre."""
    turned = jaxlie.SO3.exp(twists[:, 3:]) @ jaxlie.SO3(keyframe.turned)
    return Keyframe(carry(keyframe.points, twists, centers), turned.normalize().wxyz)
