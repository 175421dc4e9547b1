"""The location and size of a scene, estimated from the cameras that look at it. On the host, in float64."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class Extent(NamedTuple):
    """The location and size of a scene.

    Attributes:
        focus: the point nearest to all optical axes.
        radius: 1.1 times the largest distance of a camera from the centroid of all, the unit of learning
            rates; 1 if all cameras are in one place, and the focus then lies that far ahead of them.
        is_point: whether all cameras are in one place.
    """

    focus: Float[np.ndarray, "3"]
    radius: float
    is_point: bool = False


def extent_of(viewmats: Float[np.ndarray, "n 4 4"]) -> Extent:
    """The extent of a scene that these cameras look at."""
    rotations = viewmats[:, :3, :3]
    centers = -np.einsum("nji,nj->ni", rotations, viewmats[:, :3, 3])
    axes = rotations[:, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    middle, ahead = centers.mean(0), axes.mean(0)
    spread = float(np.linalg.norm(centers - middle, axis=1).max())
    if spread <= 1e-6 * max(1.0, float(np.abs(centers).max())):  # distances are unknown
        return Extent(middle + ahead, 1.0, is_point=True)
    # Parallel axes do not meet: a weak prior for the point one radius ahead of the centroid.
    weak = 1e-3 * np.eye(3) * len(centers)
    total = np.einsum("nij,nj->i", across, centers) + weak @ (middle + ahead * spread)
    return Extent(np.linalg.solve(across.sum(0) + weak, total), 1.1 * spread)
