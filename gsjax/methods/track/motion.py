"""x_t = D_k x_{t-1} + delta_i: the motion of groups and of their Gaussians (Object-Aware Gaussian Splatting
for Robotic Manipulation, section II-C)."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.rotations import multiply_quats, quats_to_matrices
from gsjax.methods.track.scene import TrackedScene
from gsjax.scene.gaussians import Gaussians


class Pose(eqx.Module):
    """Positions, metres, and orientations (w x y z) of the M moving Gaussians."""

    means: Float[Array, "m 3"]
    quats: Float[Array, "m 4"]


class Motion(eqx.Module):
    """The motion of one frame.

    Attributes:
        twists: translation, metres, and rotation vector, radians, of each group about its centroid.
        delta: displacement of each Gaussian, metres.
    """

    twists: Float[Array, "k 6"]
    delta: Float[Array, "m 3"]


@partial(jax.jit, static_argnums=2, inline=True)
def group_means(
    values: Float[Array, "m *d"], groups: Int[Array, "m"], num_groups: int
) -> Float[Array, "k *d"]:
    """Mean of the `values` of Gaussians over each of the groups 1..K; `num_groups` is K, static."""
    total = jax.ops.segment_sum(values, groups - 1, num_groups)
    count = jax.ops.segment_sum(jnp.ones(groups.shape, values.dtype), groups - 1, num_groups)
    return total / jnp.maximum(count, 1).reshape(-1, *[1] * (values.ndim - 1))


@partial(jax.jit, inline=True)
def move(pose: Pose, motion: Motion, centers: Float[Array, "k 3"], groups: Int[Array, "m"]) -> Pose:
    """The pose after each group is rotated about its centre (`centers`, metres) and translated, and each
    Gaussian is displaced; `groups` has the group of each Gaussian, 1..K."""
    rotation = jaxlie.SO3.exp(motion.twists[:, 3:])
    member = groups - 1
    center = centers[member]
    turned = jnp.einsum("mij,mj->mi", rotation.as_matrix()[member], pose.means - center)
    means = center + turned + motion.twists[member, :3] + motion.delta
    return Pose(means, multiply_quats(rotation.wxyz[member], pose.quats))


def select_motion(chosen: Bool[Array, "k"], a: Motion, b: Motion, groups: Int[Array, "m"]) -> Motion:
    """The motion `a` for the chosen groups, `b` for the others; `groups` has the group of each Gaussian."""
    return Motion(
        jnp.where(chosen[:, None], a.twists, b.twists),
        jnp.where(chosen[groups - 1][:, None], a.delta, b.delta),
    )


@partial(jax.jit, inline=True)
def place(scene: TrackedScene, pose: Pose) -> Gaussians:
    """The scene's Gaussians, with the moving ones at `pose`."""
    still = scene.num_moving
    gaussians = scene.gaussians
    means = jnp.concatenate([pose.means, gaussians.means[still:]])
    quats = jnp.concatenate([pose.quats, gaussians.quats[still:]])
    return eqx.tree_at(lambda g: (g.means, g.quats), gaussians, (means, quats))


@partial(jax.jit, inline=True)
def first_pose(scene: TrackedScene) -> Pose:
    """The pose in the first frame."""
    return Pose(scene.gaussians.means[: scene.num_moving], scene.gaussians.quats[: scene.num_moving])


def facing(scene: TrackedScene, pose: Pose, eyes: Float[Array, "c 3"]) -> Float[Array, "c n"]:
    """How far the outer side of each Gaussian faces each camera, 0 to 1; 1 without a normal.

    Without this factor, the front of a box that has turned away would be compared with images of its back. It
    fades from 1 to 0 as the angle between normal and ray passes 90 degrees, and has no gradient. `eyes` are
    the positions of the cameras, metres.
    """
    normals = jnp.einsum("mij,mj->mi", quats_to_matrices(pose.quats), scene.normals)
    rays = eyes[:, None] - pose.means
    cosine = jnp.sum(normals * rays, axis=-1) / jnp.maximum(jnp.linalg.norm(rays, axis=-1), 1e-9)
    one_sided = jnp.any(scene.normals != 0, axis=-1)
    share = jnp.where(one_sided, jnp.clip(0.5 + cosine / 0.3, 0.0, 1.0), 1.0)
    still = jnp.ones((len(eyes), scene.gaussians.num - scene.num_moving), share.dtype)
    return jax.lax.stop_gradient(jnp.concatenate([share, still], axis=1))
