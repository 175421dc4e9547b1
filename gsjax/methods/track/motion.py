"""x_t = D_k x_{t-1} + delta_i: how groups and their members move (section II-C)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.rotations import multiply_quats, quats_to_matrices
from gsjax.methods.track.scene import TrackedScene
from gsjax.scene.gaussians import Gaussians


class Pose(eqx.Module):
    """Where the M moving Gaussians are."""

    means: Float[Array, "m 3"]
    quats: Float[Array, "m 4"]


class Motion(eqx.Module):
    """One frame's motion: a twist a group, about the group's centroid, and a displacement a Gaussian.

    Attributes:
        twists: of each group: translation, metres, and axis times angle, radians.
        delta: of each Gaussian, metres.
    """

    twists: Float[Array, "k 6"]
    delta: Float[Array, "m 3"]


def group_means(
    values: Float[Array, "m *d"], groups: Int[Array, "m"], num_groups: int
) -> Float[Array, "k *d"]:
    """Mean of `values` over each group 1..K.

    Args:
        values: of Gaussians.
        groups: 1..K, of each.
        num_groups: K, static.
    """
    total = jax.ops.segment_sum(values, groups - 1, num_groups)
    count = jax.ops.segment_sum(jnp.ones(groups.shape, values.dtype), groups - 1, num_groups)
    return total / jnp.maximum(count, 1).reshape(-1, *[1] * (values.ndim - 1))


def move(pose: Pose, motion: Motion, centers: Float[Array, "k 3"], groups: Int[Array, "m"]) -> Pose:
    """Each group turned about its centre and shifted, then each Gaussian shifted by its delta.

    Args:
        pose: before.
        motion: a twist a group, a delta a Gaussian.
        centers: of groups, metres.
        groups: 1..K, of each Gaussian.
    """
    rotation = jaxlie.SO3.exp(motion.twists[:, 3:])
    member = groups - 1
    center = centers[member]
    turned = jnp.einsum("mij,mj->mi", rotation.as_matrix()[member], pose.means - center)
    means = center + turned + motion.twists[member, :3] + motion.delta
    return Pose(means, multiply_quats(rotation.wxyz[member], pose.quats))


def select_motion(chosen: Bool[Array, "k"], a: Motion, b: Motion, groups: Int[Array, "m"]) -> Motion:
    """The motion `a` of the chosen groups, and `b` of the others.

    Args:
        chosen: of all groups.
        a, b: motions of all groups and Gaussians.
        groups: 1..K, of each Gaussian.
    """
    return Motion(
        jnp.where(chosen[:, None], a.twists, b.twists),
        jnp.where(chosen[groups - 1][:, None], a.delta, b.delta),
    )


def place(scene: TrackedScene, pose: Pose) -> Gaussians:
    """The scene's Gaussians with the moving ones put where `pose` says."""
    still = scene.num_moving
    gaussians = scene.gaussians
    means = jnp.concatenate([pose.means, gaussians.means[still:]])
    quats = jnp.concatenate([pose.quats, gaussians.quats[still:]])
    return eqx.tree_at(lambda g: (g.means, g.quats), gaussians, (means, quats))


def first_pose(scene: TrackedScene) -> Pose:
    """Where the moving Gaussians are in the first frame."""
    return Pose(scene.gaussians.means[: scene.num_moving], scene.gaussians.quats[: scene.num_moving])


def facing(scene: TrackedScene, pose: Pose, eyes: Float[Array, "c 3"]) -> Float[Array, "c n"]:
    """How much of each Gaussian's outer side each camera sees, 0 to 1; a surface hides its own inside.

    Without this, the front of a box that has turned away would be compared with its back. It fades from 1 to
    0 as the angle between normal and ray passes 90 degrees. A constant: no gradient.

    Args:
        scene: with outward normals.
        pose: where the Gaussians are.
        eyes: places of the cameras, metres.
    """
    normals = jnp.einsum("mij,mj->mi", quats_to_matrices(pose.quats), scene.normals)
    rays = eyes[:, None] - pose.means
    cosine = jnp.sum(normals * rays, axis=-1) / jnp.maximum(jnp.linalg.norm(rays, axis=-1), 1e-9)
    one_sided = jnp.any(scene.normals != 0, axis=-1)
    share = jnp.where(one_sided, jnp.clip(0.5 + cosine / 0.3, 0.0, 1.0), 1.0)
    still = jnp.ones((len(eyes), scene.gaussians.num - scene.num_moving), share.dtype)
    return jax.lax.stop_gradient(jnp.concatenate([share, still], axis=1))
