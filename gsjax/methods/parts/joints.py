"""Rigid motions of parts in the world, and the joints that explain them."""

import numpy as np
from jaxtyping import Bool, Float

from gsjax.geometry.joints import FittedJoint, fit_joint
from gsjax.geometry.rotations import quats_to_matrices
from gsjax.methods.parts.trajectory import BACKGROUND, PartScene, Trajectory
from gsjax.methods.parts.unify import motions_of

_POINTS = 500  # of a part, by which its joint is fitted ...
_FAR = 3.0  # ... none this many times as far from its middle as half of them: there, noise of a turn is large
_OFF_JOINT = 0.15  # share of its way that a part may be off its joint: small ones are followed no better


def motions_in_world(scene: PartScene, trajectory: Trajectory) -> Float[np.ndarray, "T P 4 4"]:
    """The rigid motions of all parts against the canonical scene."""
    rotations, shifts, centers = (
        np.asarray(array, np.float64)
        for array in (
            quats_to_matrices(trajectory.poses.quats),
            trajectory.poses.translations,
            scene.centers,
        )
    )
    motions = np.broadcast_to(np.eye(4), (*rotations.shape[:2], 4, 4)).copy()
    motions[..., :3, :3], motions[..., :3, 3] = motions_of(rotations, shifts, centers)
    return motions


def joints_of(
    scene: PartScene, trajectory: Trajectory, done: Bool[np.ndarray, "T"], noise_m: float
) -> dict[int, FittedJoint]:
    """The joint that explains the motion of each part best, by part, over the frames that were found.

    Args:
        scene: the parts.
        trajectory: where they went.
        done: frames that were found.
        noise_m: error of the poses, metres: what moves less is fixed.
    """
    motions, labels = motions_in_world(scene, trajectory)[done], np.asarray(scene.labels)
    means = np.asarray(scene.gaussians.means, np.float64)
    found = {}
    for part in range(BACKGROUND + 1, scene.num_parts):
        mine = means[labels == part]
        far = np.linalg.norm(mine - np.median(mine, axis=0), axis=1)
        mine = mine[far <= _FAR * np.median(far)]
        some = mine[:: max(1, len(mine) // _POINTS)]
        found[part] = fit_joint(motions[:, part], some, noise_m=noise_m, tolerance=_OFF_JOINT)
    return found
