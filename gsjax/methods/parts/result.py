"""The result of a discovery: a scene with parts, their poses, and the joints that explain their motions."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from gsjax.geometry.joints import FittedJoint, fit_joint
from gsjax.geometry.rotations import quats_to_matrices
from gsjax.methods.parts.film import Layer
from gsjax.methods.parts.trajectory import BACKGROUND, PartScene, Trajectory, gaussians_at, moment
from gsjax.methods.parts.unify import scene_motions
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.handles import Blend, HandlePose

_POINTS = 500  # of a part, to which its joint is fitted ...
_FAR = 3.0  # ... without those farther from its middle, in median distances: there, rotation noise is large
_OFF_JOINT = 0.15  # tolerated deviation from a joint, as a share of the part's motion


class PartsResult(NamedTuple):
    """A scene with parts, and their poses in all frames.

    Attributes:
        scene: the canonical Gaussians in their given order, and the weights of P parts, the background first.
        trajectory: poses of the parts at T frames, with times from 0; at rest in frames not yet found.
        done: the frames that were found.
        anchor: the canonical frame.
        pixel: width of a pixel of the pictures used for tracking, at the moving parts, metres; taken as the
            error of the poses.
        blend: how rotations are blended for a Gaussian that follows several parts.
    """

    scene: PartScene
    trajectory: Trajectory
    done: Bool[np.ndarray, "T"]
    anchor: int
    pixel: float
    blend: Blend

    def __repr__(self) -> str:
        parts, frames = self.scene.num_parts - 1, f"{int(self.done.sum())} of {len(self.done)} frames"
        return f"PartsResult({parts} parts of {self.scene.gaussians.num:,} Gaussians, {frames})"

    @property
    def weights(self) -> Float[Array, "N P"]:
        """The share of each part in the motion of each Gaussian; rows sum to 1."""
        return self.scene.weights

    @property
    def layer(self) -> Layer:
        """The scene and its trajectory over the frames that were found, the input of `timeline.apply` and
        edits."""
        poses = jax.tree.map(lambda leaf: leaf[np.flatnonzero(self.done)], self.trajectory)
        return Layer(self.scene, poses)

    def poses(self, t: int) -> HandlePose:
        """The poses of all parts at frame t, relative to the canonical scene; [P,4] and [P,3]."""
        return moment(self.trajectory, t).pose

    def at(self, t: int) -> Gaussians:
        """The scene at frame t."""
        return gaussians_at(self.scene, moment(self.trajectory, t), self.blend)

    def joints(self) -> dict[int, FittedJoint]:
        """The joint that explains the motion of each part best, by part, over the frames that were found and
        in which it is present."""
        motions, there = motions_in_world(self.scene, self.trajectory), np.asarray(self.trajectory.opacities)
        labels, means = np.asarray(self.scene.labels), np.asarray(self.scene.gaussians.means, np.float64)
        joints = {}
        for part in range(BACKGROUND + 1, self.scene.num_parts):
            points = means[labels == part]
            distances = np.linalg.norm(points - np.median(points, axis=0), axis=1)
            points = points[distances <= _FAR * np.median(distances)]
            points = points[:: max(1, len(points) // _POINTS)]
            joints[part] = fit_joint(
                motions[self.done & (there[:, part] > 0), part],
                points,
                noise_m=self.pixel,
                tolerance=_OFF_JOINT,
            )
        return joints


def motions_in_world(scene: PartScene, trajectory: Trajectory) -> Float[np.ndarray, "T P 4 4"]:
    """The rigid motions of all parts relative to the canonical scene, in the world's axes."""
    quats, translations = trajectory.poses.quats, trajectory.poses.translations
    rotations, shifts, centers = (
        np.asarray(array, np.float64) for array in (quats_to_matrices(quats), translations, scene.centers)
    )
    motions = np.broadcast_to(np.eye(4), (*rotations.shape[:2], 4, 4)).copy()
    motions[..., :3, :3], motions[..., :3, 3] = scene_motions(rotations, shifts, centers)
    return motions
