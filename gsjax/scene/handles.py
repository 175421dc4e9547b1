"""Handles: a few rigid motions that move many Gaussians, each with its own weights (linear blend skinning).

A handle p has a centre c_p in the canonical scene, a rotation R_p about it and a translation T_p. A Gaussian
with weights w moves as in MotionSplicer, section 3.3:

    mean' = sum_p w_p (R_p (mean - c_p) + c_p + T_p)

The paper's formula for the orientation, quat(sum_p w_p R_p^T R(q)), rotates the wrong way, and a sum of
rotations is not a rotation; `Blend` selects how they are blended instead.
"""

from functools import partial
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from gsjax.geometry.rotations import MIN_SQUARED_NORM, multiply_quats, normalize_quats, quats_to_matrices
from gsjax.scene.gaussians import Gaussians

Blend = Literal["quaternion", "polar", "dual"]
"""How rotations are blended: the normalised sum of quaternions, with signs aligned to that of the largest
weight; the rotation nearest to the sum of matrices; or dual quaternions (Kavan et al. 2008), which also move
the means, along screws instead of straight lines, so that twisted parts keep their volume."""
_POLAR_ITERATIONS = 8  # each doubles the correct digits, from errors below 1
# Not in TF32 on GPUs that have it: it would move Gaussians by half a millimetre per metre.
_einsum = partial(jnp.einsum, precision="highest")
_matmul = partial(jnp.matmul, precision="highest")


class HandlePose(eqx.Module):
    """Poses of P handles.

    Attributes:
        quats: rotations about the handles' own centres, [w, x, y, z] of any non-zero length.
        translations: metres.
    """

    quats: Float[Array, "*t P 4"]
    translations: Float[Array, "*t P 3"]


@partial(jax.jit, static_argnums=0, inline=True)
def at_rest(num: int) -> HandlePose:
    """The pose of `num` handles that have not moved."""
    return HandlePose(jnp.zeros((num, 4)).at[:, 0].set(1.0), jnp.zeros((num, 3)))


def skin(
    gaussians: Gaussians,
    weights: Float[Array, "N P"],
    centers: Float[Array, "P 3"],
    pose: HandlePose,
    blend: Blend = "quaternion",
) -> Gaussians:
    """The Gaussians moved by their handles; only means and quats change.

    Args:
        gaussians: the canonical scene.
        weights: weights of each Gaussian, which sum to 1.
        centers: centres of the handles in the canonical scene, metres.
        pose: poses of the handles.
        blend: how rotations are blended.
    """
    moved = _skinned(gaussians.means, gaussians.quats, weights, centers, pose, blend)
    return eqx.tree_at(lambda g: (g.means, g.quats), gaussians, moved)


@partial(jax.jit, static_argnames="blend", inline=True)
def _skinned(
    means: Float[Array, "N 3"],
    quats: Float[Array, "N 4"],
    weights: Float[Array, "N P"],
    centers: Float[Array, "P 3"],
    pose: HandlePose,
    blend: Blend,
) -> tuple[Float[Array, "N 3"], Float[Array, "N 4"]]:
    if blend == "dual":
        turns, means = _dual(means, weights, centers, pose)
    else:
        turns = blend_quats(weights, pose.quats) if blend == "quaternion" else _polar(weights, pose.quats)
        means = skin_means(means, weights, centers, pose)
    return means, multiply_quats(turns, normalize_quats(quats))


@partial(jax.jit, inline=True)
def rigid_motions(
    centers: Float[Array, "P 3"], pose: HandlePose
) -> tuple[Float[Array, "P 3 3"], Float[Array, "P 3"]]:
    """The motion x -> R x + offset of each handle in the canonical scene, as R and offset."""
    rotations = quats_to_matrices(pose.quats)
    return rotations, centers + pose.translations - _einsum("pij,pj->pi", rotations, centers)


@partial(jax.jit, inline=True)
def skin_means(
    means: Float[Array, "N 3"],
    weights: Float[Array, "N P"],
    centers: Float[Array, "P 3"],
    pose: HandlePose,
) -> Float[Array, "N 3"]:
    """Points moved by linear blend skinning: two matrix products, nothing of size N x P x 3.

    Args:
        means: canonical points, metres.
        weights: rows that sum to 1.
        centers: canonical centres of the handles, metres.
        pose: poses of the handles.
    """
    rotations, offsets = rigid_motions(centers, pose)
    blended = _einsum("np,pij->nij", weights, rotations)
    return _einsum("nij,nj->ni", blended, means) + _matmul(weights, offsets)


@partial(jax.jit, inline=True)
def blend_quats(weights: Float[Array, "N P"], quats: Float[Array, "P 4"]) -> Float[Array, "N 4"]:
    """Unit quaternions of the blended rotations. The sign of a quaternion is arbitrary, so each is aligned
    with that of the largest weight, which is used alone if the sum still vanishes."""
    signed, leading = _aligned(weights, normalize_quats(quats))
    total = _einsum("np,npi->ni", weights, signed)
    vanishes = jnp.sum(total * total, axis=-1, keepdims=True) < MIN_SQUARED_NORM
    return normalize_quats(jnp.where(vanishes, leading, total))


def _aligned(
    weights: Float[Array, "N P"], quats: Float[Array, "P 4"]
) -> tuple[Float[Array, "N P 4"], Float[Array, "N 4"]]:
    """The quaternions flipped to the hemisphere of the one with the largest weight, and that one."""
    leading = quats[jnp.argmax(weights, axis=-1)]
    signs = jnp.where(_matmul(leading, quats.T) < 0, -1.0, 1.0).astype(quats.dtype)
    return signs[..., None] * quats, leading


def _polar(weights: Float[Array, "N P"], quats: Float[Array, "P 4"]) -> Float[Array, "N 4"]:
    """Quaternions of the rotations nearest to the blended matrices, by Newton's iteration X <- (X + X^-T) / 2
    (Higham 1986). If handles are so far apart that the blended matrix is not near any rotation, the
    rotation with the largest weight is used alone."""
    rotations = quats_to_matrices(quats)
    blended = _einsum("np,pij->nij", weights, rotations)
    lost = (jnp.linalg.det(blended) < 1e-3)[:, None, None]
    nearest = jnp.where(lost, rotations[jnp.argmax(weights, axis=-1)], blended)
    for _ in range(_POLAR_ITERATIONS):
        nearest = (nearest + jnp.swapaxes(_inverse(nearest), -1, -2)) / 2
    return jax.vmap(lambda matrix: jaxlie.SO3.from_matrix(matrix).wxyz)(nearest)


def _inverse(matrices: Float[Array, "N 3 3"]) -> Float[Array, "N 3 3"]:
    """Inverses by cofactors: a linear solver would cost more than all the rest."""
    a, b, c = jnp.moveaxis(matrices, -2, 0)
    rows = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=-1)
    return rows / jnp.sum(a * jnp.cross(b, c), axis=-1)[:, None, None]


def _dual(
    means: Float[Array, "N 3"],
    weights: Float[Array, "N P"],
    centers: Float[Array, "P 3"],
    pose: HandlePose,
) -> tuple[Float[Array, "N 4"], Float[Array, "N 3"]]:
    """Rotations and means given by blended dual quaternions."""
    real, (_, offsets) = normalize_quats(pose.quats), rigid_motions(centers, pose)
    dual = multiply_quats(jnp.pad(offsets, ((0, 0), (1, 0))), real) / 2
    signed, leading = _aligned(weights, real)
    signs = jnp.sum(signed * real, axis=-1, keepdims=True)
    turn, shift = (_einsum("np,npi->ni", weights, part) for part in (signed, signs * dual))
    squared = jnp.sum(turn * turn, axis=-1, keepdims=True)
    vanishes = squared < MIN_SQUARED_NORM
    length = jnp.sqrt(jnp.where(vanishes, 1.0, squared))
    turn = jnp.where(vanishes, leading, turn / length)
    shift = jnp.where(vanishes, dual[jnp.argmax(weights, axis=-1)], shift / length)
    moved = 2 * multiply_quats(shift, turn * jnp.array([1.0, -1.0, -1.0, -1.0], turn.dtype))[:, 1:]
    return turn, _einsum("nij,nj->ni", quats_to_matrices(turn), means) + moved
