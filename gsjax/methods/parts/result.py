"""What a discovery comes to: a scene with parts, and where these were."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from gsjax.geometry.joints import FittedJoint
from gsjax.methods.parts.film import Layer
from gsjax.methods.parts.joints import joints_of
from gsjax.methods.parts.trajectory import PartScene, Trajectory, gaussians_at, moment
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.handles import Blend, HandlePose


class PartsResult(NamedTuple):
    """A scene with parts, and where these were in all frames.

    Attributes:
        scene: the canonical Gaussians in the order in which they were given, and the weights of P parts, the
            background first.
        trajectory: poses of the parts at T frames; at rest in frames that were not found yet.
        done: which frames were found.
        anchor: the canonical frame.
        pixel: width of a pixel where things move, metres, which poses may be off by.
        blend: how rotations are blended where a Gaussian follows several parts.
    """

    scene: PartScene
    trajectory: Trajectory
    done: Bool[np.ndarray, "T"]
    anchor: int
    pixel: float
    blend: Blend

    @property
    def weights(self) -> Float[Array, "N P"]:
        """The share of each part in the motion of each Gaussian; rows sum to 1."""
        return self.scene.weights

    @property
    def layer(self) -> Layer:
        """The scene and its trajectory over the frames that were found, as `timeline.apply` and edits take
        them."""
        poses = jax.tree.map(lambda leaf: leaf[np.flatnonzero(self.done)], self.trajectory)
        return Layer(self.scene, poses)

    def poses(self, t: int) -> HandlePose:
        """The poses of all parts at frame t, against the canonical scene; [P,4] and [P,3]."""
        return moment(self.trajectory, t).pose

    def at(self, t: int) -> Gaussians:
        """The scene at frame t."""
        return gaussians_at(self.scene, moment(self.trajectory, t), self.blend)

    def joints(self) -> dict[int, FittedJoint]:
        """The joint that explains the motion of each part best, by part, over the frames that were found."""
        return joints_of(self.scene, self.trajectory, self.done, self.pixel)
