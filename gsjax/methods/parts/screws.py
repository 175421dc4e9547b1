"""Poses of handles as rigid motions, and what jaxlie leaves out of these."""

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from gsjax.geometry.rotations import normalize_quats
from gsjax.scene.handles import HandlePose


def motions_of(poses: HandlePose) -> jaxlie.SE3:
    """The rigid motions of points relative to the handles' places in the canonical scene: x -> R x + T."""
    rotation = jaxlie.SO3(normalize_quats(poses.quats))
    return jaxlie.SE3.from_rotation_and_translation(rotation, poses.translations)


def pose_of(motions: jaxlie.SE3) -> HandlePose:
    """The inverse of `motions_of`."""
    return HandlePose(normalize_quats(motions.rotation().wxyz), motions.translation())


def turned_about(
    points: Float[Array, "... 3"], share: Float[Array, "T 1"], turn: Float[Array, "3"]
) -> jaxlie.SE3:
    """Turns by a share of `turn`, axis times angle, about points."""
    rotation = jaxlie.SO3.exp(jnp.broadcast_to(share[..., None] * turn, (len(share), points.shape[-2], 3)))
    return jaxlie.SE3.from_rotation_and_translation(rotation, points - rotation.apply(points))


def unwound(since: jaxlie.SE3) -> Float[Array, "T P 6"]:
    """Twists of motions that follow one another, one of which is next to none. More than half a turn from
    there, up to a full one, stays as such, and is not less the other way round."""
    quats = since.rotation().wxyz
    flips = jnp.where(jnp.sum(quats[1:] * quats[:-1], axis=-1) < 0, -1.0, 1.0)
    real = quats[..., 0] * jnp.concatenate([jnp.ones_like(flips[:1]), jnp.cumprod(flips, axis=0)])
    nearest = jnp.argmax(jnp.abs(real), axis=0)  # to where the parts have not moved
    far = (real * jnp.take_along_axis(real, nearest[None], axis=0) < 0)[..., None]
    going, turning = jnp.split(since.log(), 2, axis=-1)
    safe = jnp.where(far, turning, jnp.array([1.0, 0.0, 0.0]))
    angle = jnp.linalg.norm(safe, axis=-1, keepdims=True)
    along = jnp.sum(going * safe, axis=-1, keepdims=True) / angle**2 * safe
    longer = 1 - 2 * jnp.pi / angle
    # About its axis a twist goes as far as it turns, along it as far as ever.
    whole = jnp.concatenate([along + longer * (going - along), longer * turning], axis=-1)
    return jnp.where(far, whole, since.log())
