"""Cameras around the origin that look at it."""

from collections.abc import Iterable

import jax.numpy as jnp
import numpy as np

from gsjax.geometry.cameras import Camera, intrinsics, look_at

FOCAL, DISTANCE, ABOVE = 50.0, 3.0, 1.2  # pixels, metres


def cameras_around(angles: Iterable[float], width: int, height: int) -> list[Camera]:
    """One camera at each angle, radians."""
    K = jnp.asarray(intrinsics(FOCAL, width, height), jnp.float32)
    eyes = [np.array([DISTANCE * np.cos(a), DISTANCE * np.sin(a), ABOVE]) for a in angles]
    return [Camera(jnp.asarray(look_at(eye, np.zeros(3)), jnp.float32), K, width, height) for eye in eyes]
