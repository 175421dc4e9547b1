"""Known properties of the objects of a sequence: their true motion, for scoring, and their shapes."""

from collections.abc import Sequence as Indices
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from gsjax.data.validation import check_poses, check_shape
from gsjax.geometry.joints import Joint

# Field shapes are in the docstrings: constructors check them, with better messages than an annotation's.


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """The model of an object in the frame of its true poses, for scoring only.

    Attributes:
        source: the file that it comes from, for reports.
        points: vertices, metres, [V,3].
        diameter: the largest distance between two vertices, metres.
        symmetries: rigid motions that map the model onto itself, the identity first, [S,4,4].

    Raises:
        ValueError: shapes are not as above.
    """

    source: str
    points: Float[np.ndarray, "..."]
    diameter: float
    symmetries: Float[np.ndarray, "..."]

    def __post_init__(self):
        check_shape("points", self.points, (len(self.points), 3))
        check_shape("symmetries", self.symmetries, (len(self.symmetries), 4, 4))


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of the objects of a sequence, for scoring only.

    Attributes:
        names: name of each object, K of them.
        label_ids: the mask value of each object, [K].
        poses: object-to-world transforms, [T,K,4,4] float64.
        robot: the mask value of the robot; None without a robot.
        joints: the joint of each object, None for one that moves freely; empty if joints are unknown.
        tracks: trajectories of material points on deformable surfaces, [T,V,3] float64, metres, world; None
            if unknown. Deformable things have no pose and are not among the objects.
        models: the model of each object, None for one without; empty if there are none.

    Raises:
        ValueError: shapes disagree, or a pose is not a rigid motion.
    """

    names: tuple[str, ...]
    label_ids: Int[np.ndarray, "..."]
    poses: Float[np.ndarray, "..."]
    robot: int | None = None
    joints: tuple[Joint | None, ...] = ()
    tracks: Float[np.ndarray, "..."] | None = None
    models: tuple[ObjectModel | None, ...] = ()

    def __post_init__(self):
        check_shape("label_ids", self.label_ids, (len(self.names),))
        if self.joints:
            check_shape("joints", np.zeros(len(self.joints)), (len(self.names),))
        if self.models:
            check_shape("models", np.zeros(len(self.models)), (len(self.names),))
        for name, joint in zip(self.names, self.joints, strict=False):
            if joint is not None:
                check_shape(f"values of the joint of {name}", joint.values, (len(self.poses),))
        check_shape("poses", self.poses, (len(self.poses), len(self.names), 4, 4))
        if self.tracks is not None:
            check_shape("tracks", self.tracks, (len(self.poses), *np.shape(self.tracks)[1:2], 3))
        advice = "Object poses are object-to-world transforms."
        check_poses("pose", self.poses, lambda t, k: f"object {self.names[k]} in frame {t}", advice)

    def select(self, frames: Indices[int]) -> "Truth":
        """The truth of these frames."""
        chosen = list(frames)
        joints = tuple(j and replace(j, values=j.values[chosen]) for j in self.joints)
        tracks = None if self.tracks is None else self.tracks[chosen]
        return replace(self, poses=self.poses[chosen], joints=joints, tracks=tracks)


@dataclass(frozen=True, eq=False)
class PointModel:
    """An object or background of known shape, as Gaussians in its own frame.

    Attributes:
        name: name of the object.
        means: centres in the model's frame, metres, [N,3].
        quats: [w,x,y,z], not necessarily normalised, [N,4].
        scales: standard deviations, metres, [N,3].
        opacities: 0 to 1, [N].
        colors: RGB, 0 to 1, [N,3].
        label: mask value of the object; 0 is the static background.
        pose: model-to-world transform [4,4] in the first frame; None if it has to be fitted to the first
            frames.
        plane: (n, d), the plane n.x + d = 0 in the world that it rests on, [4], or None.

    Raises:
        ValueError: shapes disagree.
    """

    name: str
    means: Float[np.ndarray, "..."]
    quats: Float[np.ndarray, "..."]
    scales: Float[np.ndarray, "..."]
    opacities: Float[np.ndarray, "..."]
    colors: Float[np.ndarray, "..."]
    label: int = 0
    pose: Float[np.ndarray, "..."] | None = None
    plane: Float[np.ndarray, "..."] | None = None

    def __post_init__(self):
        count = len(self.means)
        shapes = {"means": (count, 3), "quats": (count, 4), "scales": (count, 3)}
        shapes |= {"opacities": (count,), "colors": (count, 3)}
        if self.pose is not None:
            shapes["pose"] = (4, 4)
        if self.plane is not None:
            shapes["plane"] = (4,)
        for name, shape in shapes.items():
            check_shape(f"{self.name}: {name}", getattr(self, name), shape)
