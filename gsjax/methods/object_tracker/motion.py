"""x_t = D_k x_{t-1} + delta_i: how groups and their members move (papers/000, section II-C)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, Int

from gsjax.geometry.rotations import multiply_quats
from gsjax.methods.object_tracker.scene import TrackedScene
from gsjax.scene.gaussians import Gaussians


class Pose(eqx.Module):
    """Where the M moving Gaussians are."""

    means: Float[Array, "m 3"]
    quats: Float[Array, "m 4"]


class Motion(eqx.Module):
    """One frame's motion: a twist a group, about the group's centroid, and a displacement a Gaussian.

    Attributes:
        translations: of each group, metres.
        rotations: of each group, axis times angle, radians.
        delta: of each Gaussian, metres.
    """

    translations: Float[Array, "k 3"]
    rotations: Float[Array, "k 3"]
    delta: Float[Array, "m 3"]


def group_means(
    values: Float[Array, "m *d"], groups: Int[Array, "m"], num_groups: int
) -> Float[Array, "k *d"]:
    """Mean of `values` over each group 1..K."""
    total = jax.ops.segment_sum(values, groups - 1, num_groups)
    count = jax.ops.segment_sum(jnp.ones(groups.shape, values.dtype), groups - 1, num_groups)
    return total / jnp.maximum(count, 1).reshape(-1, *[1] * (values.ndim - 1))


def move(pose: Pose, motion: Motion, centers: Float[Array, "k 3"], groups: Int[Array, "m"]) -> Pose:
    """Each group turned about its centre and shifted, then each Gaussian shifted by its delta."""
    member = groups - 1
    turn = jaxlie.SO3.exp(motion.rotations)
    matrix, quat = turn.as_matrix()[member], turn.wxyz[member]
    center = centers[member]
    offset = pose.means - center
    turned = jnp.einsum("mij,mj->mi", matrix, offset)
    means = center + turned + motion.translations[member] + motion.delta
    return Pose(means, multiply_quats(quat, pose.quats))


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
