"""Cameras that stand a little elsewhere than was said."""

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float


def twisted(
    viewmats: Float[Array, "c 4 4"], twist: Float[Array, "6"], radius: float
) -> Float[Array, "c 4 4"]:
    """View matrices of cameras that are turned about their own centres, and shifted.

    Args:
        viewmats: world to camera.
        twist: a turn (radians) and a shift (radii of the scene), in the world's axes.
        radius: of the scene.
    """
    turn = jaxlie.SO3.exp(twist[:3]).as_matrix()
    rotations = jnp.matmul(viewmats[:, :3, :3], turn.T, precision="highest")
    centers = -jnp.einsum("cji,cj->ci", viewmats[:, :3, :3], viewmats[:, :3, 3]) + radius * twist[3:]
    shifts = -jnp.einsum("cij,cj->ci", rotations, centers)
    return viewmats.at[:, :3, :3].set(rotations).at[:, :3, 3].set(shifts)
