"""Poses of handles as rigid motions, and operations on these that jaxlie lacks."""

from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from gsjax.geometry.rotations import normalize_quats
from gsjax.scene.handles import HandlePose


def motions_of(poses: HandlePose) -> jaxlie.SE3:
    """The rigid motions x -> R x + T of points x relative to the handles' centres in the canonical scene."""
    rotation = jaxlie.SO3(normalize_quats(poses.quats))
    return jaxlie.SE3.from_rotation_and_translation(rotation, poses.translations)


def pose_of(motions: jaxlie.SE3) -> HandlePose:
    """The inverse of `motions_of`."""
    return HandlePose(normalize_quats(motions.rotation().wxyz), motions.translation())


def pose_from(motions: Float[Array, "P 4 4"], centers: Float[Array, "P 3"]) -> HandlePose:
    """The pose of handles at `centers` that moves the canonical scene by these motions of the world."""
    rotations = motions[:, :3, :3]
    turned = jnp.einsum("pij,pj->pi", rotations, centers, precision="highest")
    shifts = turned + motions[:, :3, 3] - centers
    return HandlePose(normalize_quats(jaxlie.SO3.from_matrix(rotations).wxyz), shifts)


def turned_about(
    points: Float[Array, "... 3"], share: Float[Array, "T 1"], turn: Float[Array, "3"]
) -> jaxlie.SE3:
    """Rotations by a share of `turn`, axis times angle in radians, about points."""
    rotation = jaxlie.SO3.exp(jnp.broadcast_to(share[..., None] * turn, (len(share), points.shape[-2], 3)))
    return jaxlie.SE3.from_rotation_and_translation(rotation, points - rotation.apply(points))


@partial(jax.jit, inline=True)
def unwound(since: jaxlie.SE3) -> Float[Array, "T P 6"]:
    """Logarithms of consecutive motions, one of which is close to the identity, unwound over time: a rotation
    of more than half a turn from there, up to a full one, does not become the shorter one the other way."""
    quats = since.rotation().wxyz
    flips = jnp.where(jnp.sum(quats[1:] * quats[:-1], axis=-1) < 0, -1.0, 1.0)
    real = quats[..., 0] * jnp.concatenate([jnp.ones_like(flips[:1]), jnp.cumprod(flips, axis=0)])
    nearest = jnp.argmax(jnp.abs(real), axis=0)  # to the identity
    far = (real * jnp.take_along_axis(real, nearest[None], axis=0) < 0)[..., None]
    going, turning = jnp.split(since.log(), 2, axis=-1)
    safe = jnp.where(far, turning, jnp.array([1.0, 0.0, 0.0]))
    angle = jnp.linalg.norm(safe, axis=-1, keepdims=True)
    along = jnp.sum(going * safe, axis=-1, keepdims=True) / angle**2 * safe
    longer = 1 - 2 * jnp.pi / angle
    # A twist's translation perpendicular to its axis scales with the angle; along the axis it stays.
    whole = jnp.concatenate([along + longer * (going - along), longer * turning], axis=-1)
    return jnp.where(far, whole, since.log())
