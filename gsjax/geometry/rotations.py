"""Quaternions as this package stores them: [w, x, y, z], of any non-zero length.

Rigid motions are `jaxlie.SE3`; this module has only what jaxlie lacks.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

MIN_SQUARED_NORM = 1e-12
"""Below this |q|^2 a quaternion does not define a rotation, and the rasterizer culls its Gaussian."""


@partial(jax.jit, inline=True)
def normalize_quats(quats: Float[Array, "*batch 4"]) -> Float[Array, "*batch 4"]:
    """Unit quaternions. One too short to define a rotation becomes the identity, with zero gradient."""
    squared = jnp.sum(quats * quats, axis=-1, keepdims=True)
    usable = squared >= MIN_SQUARED_NORM
    identity = jnp.zeros_like(quats).at[..., 0].set(1.0)
    safe = jnp.where(usable, quats, identity)
    return safe / jnp.sqrt(jnp.where(usable, squared, 1.0))


@partial(jax.jit, inline=True)
def quats_to_matrices(quats: Float[Array, "*batch 4"]) -> Float[Array, "*batch 3 3"]:
    """Rotation matrices of (not necessarily unit) quaternions [w, x, y, z]."""
    w, x, y, z = jnp.moveaxis(normalize_quats(quats), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


_SKEW = np.cross(np.eye(3)[:, None], -np.eye(3))  # [k, i, j]: -epsilon_kij


@partial(jax.jit, inline=True)
def matrix_of(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Rotation matrix of a rotation vector, radians. Equal to `jaxlie.SO3.exp(vector).as_matrix()`, but
    without its stack of nine numbers, which takes XLA:CPU long to compile."""
    squared = jnp.sum(vector * vector)
    small = squared < 1e-12
    angle = jnp.sqrt(jnp.where(small, 1.0, squared))
    half = jnp.where(small, 0.5 - squared / 48, jnp.sin(angle / 2) / angle) * vector
    real = jnp.where(small, 1 - squared / 8, jnp.cos(angle / 2))
    skew = sum(_SKEW[k] * half[k] for k in range(3))
    return (1 - 2 * half @ half) * jnp.eye(3) + 2 * half[:, None] * half + 2 * real * skew


@partial(jax.jit, inline=True)
def multiply_quats(a: Float[Array, "*#batch 4"], b: Float[Array, "*#batch 4"]) -> Float[Array, "*batch 4"]:
    """Hamilton product: the rotation `b` followed by `a`."""
    aw, ax, ay, az = jnp.moveaxis(a, -1, 0)
    bw, bx, by, bz = jnp.moveaxis(b, -1, 0)
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )
