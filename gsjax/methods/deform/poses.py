"""Refined camera poses, at the training frames and between them. On the host."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gsjax.geometry.cameras import perturbed
from gsjax.scene.frame import Frame


def refined_viewmats(
    viewmats: Float[np.ndarray, "T C 4 4"],
    times: Float[np.ndarray, "T"],
    twists: Float[Array, "frames 6"],
    learned: Float[np.ndarray, "frames"],
    radius: float,
) -> Float[np.ndarray, "T C 4 4"]:
    """View matrices at any times, from the twists of the training frames: interpolated linearly between
    neighbours in time, as the pose errors of a robot arm change slowly, and constant beyond the ends. The
    images of other frames are not used.

    Args:
        viewmats: given view matrices of C cameras; camera 0 is the training camera, and the others keep their
            pose relative to it.
        times: their times, 0 to 1.
        twists: twists of the training frames, as in `DeformingScene`.
        learned: times of the training frames, 0 to 1.
        radius: radius of the scene, the unit of translations.
    """
    order = np.argsort(learned)
    rows = np.asarray(twists, np.float64)[order]
    at = np.stack([np.interp(times, learned[order], column) for column in rows.T], axis=1)
    dtype = jnp.result_type(float)
    apply = jax.jit(jax.vmap(lambda viewmat, twist: perturbed(viewmat, twist, radius)))
    found = apply(jnp.asarray(viewmats[:, :1], dtype), jnp.asarray(at, dtype))
    first = np.asarray(found, np.float64)
    return (viewmats @ np.linalg.inv(viewmats[:, :1])) @ first


def times_of(frames: Sequence[Frame]) -> Float[np.ndarray, "frames"]:
    """Times of frames, 0 to 1; 0 for a frame without a time."""
    return np.array([0.0 if frame.time is None else float(frame.time) for frame in frames])
