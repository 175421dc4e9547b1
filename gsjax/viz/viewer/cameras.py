"""Cameras of a browser and of photographs: conversions between them, and the up direction."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from gsjax.geometry.cameras import NEAR, Camera, intrinsics
from gsjax.scene.gaussians import Gaussians
from gsjax.viz.viewer.pick import pick
from gsjax.viz.viewer.viewable import Shots, Viewable

_STEP = 8  # picture heights are multiples of this, so that similar window shapes share one program
_ALIKE = 0.02  # cameras whose right-hand axes vary less than this do not determine the up direction
_SNAP = np.cos(np.radians(12.0))  # "up" snaps to a world axis that is nearer than this
_FAR = 1e3
_SPACING, _FRUSTUM = 0.2, (0.02, 0.1)  # shares of the distance to the nearest camera, of the scene's radius


class Pose(NamedTuple):
    """Pose and field of view of a browser's camera.

    Attributes:
        position: position in the world.
        target: point that it looks at and orbits.
        up: up direction of its picture.
        fov: vertical field of view, radians.
    """

    position: Float[np.ndarray, "3"]
    target: Float[np.ndarray, "3"]
    up: Float[np.ndarray, "3"]
    fov: float


def browser_camera(
    wxyz: Float[np.ndarray, "4"],
    position: Float[np.ndarray, "3"],
    fov: float,
    width: int,
    height: int,
    near: float = NEAR,
) -> Camera:
    """A browser's camera as one camera [1] for our rasterizer.

    Args:
        wxyz: orientation, camera to world in OpenCV axes.
        position: position in the world.
        fov: vertical field of view, radians.
        width, height: size of the picture, pixels.
        near: distance of the near plane, metres.
    """
    rotation = Rotation.from_quat(np.asarray(wxyz, float), scalar_first=True).as_matrix().T
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ np.asarray(position, float)
    K = intrinsics(height / 2 / np.tan(fov / 2), width, height)
    viewmats, Ks = (jnp.asarray(matrix, jnp.float32)[None] for matrix in (viewmat, K))
    return Camera(viewmats, Ks, width, height, near)


def picture_size(width: int, window: tuple[int, int]) -> tuple[int, int]:
    """Width and height of a picture with about the aspect ratio of a window (width, height)."""
    wide, high = window
    height = width if min(window) < 1 else width * high / wide
    return width, int(np.clip(round(height / _STEP), 1, 3 * width // _STEP)) * _STEP


def vertical_fov(K: Float[np.ndarray, "3 3"], height: int) -> float:
    """Vertical field of view in radians of a photograph of `height` pixels."""
    return float(2 * np.arctan2(height / 2, K[1, 1]))


def pose_of(shots: Shots, frame: int, shot: int, distance: float) -> Pose:
    """The camera of a photograph, with its target at a given distance.

    Args:
        shots: all photographs.
        frame: frame of the scene.
        shot: index of the photograph in that frame.
        distance: distance to the target, in the scene's unit.
    """
    row = shots.at(frame)
    to_world = np.linalg.inv(shots.viewmats[row, shot])
    position, forward, up = to_world[:3, 3], to_world[:3, 2], -to_world[:3, 1]
    fov = vertical_fov(shots.Ks[row, shot], int(shots.sizes[shot, 1]))
    return Pose(position, position + distance * forward, up, fov)


def up_direction(viewmats: Float[np.ndarray, "v 4 4"]) -> Float[np.ndarray, "3"]:
    """The up direction of whoever held the cameras: perpendicular to the cameras' right-hand axes.

    If all cameras face the same way, it is the mean of their own up directions. It snaps to a nearby world
    axis.
    """
    rights, ups = viewmats[:, 0, :3], -viewmats[:, 1, :3]
    mean = ups.mean(0)
    values, axes = np.linalg.eigh(rights.T @ rights / len(rights))
    up = axes[:, 0] * np.sign(axes[:, 0] @ mean) if values[1] > _ALIKE else mean
    if np.linalg.norm(up) < 1e-6:  # the cameras contradict each other
        return np.array([0.0, 0.0, 1.0])
    up = up / np.linalg.norm(up)
    nearest = np.abs(up).argmax()
    return np.sign(up[nearest]) * np.eye(3)[nearest] if abs(up[nearest]) > _SNAP else up


def scene_up(scene: Viewable) -> Float[np.ndarray, "3"]:
    """The up direction: the scene's own, else that of its photographs, else +z."""
    if scene.up is not None:
        up = np.asarray(scene.up, float)
        return up / np.linalg.norm(up)
    if scene.shots is not None and len(scene.shots.names):
        return up_direction(scene.shots.viewmats.reshape(-1, 4, 4))
    return np.array([0.0, 0.0, 1.0])


def extent(gaussians: Gaussians) -> tuple[Float[np.ndarray, "3"], float]:
    """Centre and radius of the bulk of the opaque Gaussians, robust to a few outliers."""
    means = np.asarray(gaussians.means, np.float64)
    solid = means[np.asarray(gaussians.logit_opacities) > 0]
    means = solid if len(solid) > 10 else means
    middle = np.median(means, axis=0)
    radius = float(np.quantile(np.linalg.norm(means - middle, axis=1), 0.8))
    return middle, radius if radius > 0 else 1.0


def distance_along(gaussians: Gaussians, viewmat: Float[np.ndarray, "4 4"]) -> float:
    """Distance to what a camera sees in the middle of its picture, else to the centre of the scene."""
    to_world = np.linalg.inv(viewmat)
    seen = pick(gaussians, to_world[:3, 3], to_world[:3, 2])
    if seen is not None:
        return seen.depth
    middle, radius = extent(gaussians)
    return float(max(to_world[:3, 2] @ (middle - to_world[:3, 3]), radius))


def frustum_size(scene: Viewable) -> float:
    """Size at which to draw the frusta of photographs so that neighbours do not overlap."""
    _, radius = extent(scene.gaussians)
    if scene.shots is None or len(scene.shots.names) < 2:
        return _FRUSTUM[1] * radius
    eyes = np.linalg.inv(scene.shots.viewmats[0])[:, :3, 3]
    nearest, _ = cKDTree(eyes).query(eyes, k=2)
    low, high = (share * radius for share in _FRUSTUM)
    return float(np.clip(_SPACING * np.median(nearest[:, 1]), low, high))


def first_pose(scene: Viewable) -> Pose:
    """The initial camera: that of the first photograph, else from the side and above."""
    up = scene_up(scene)
    gaussians = scene.at(0)
    if scene.shots is not None and len(scene.shots.names):
        distance = distance_along(gaussians, scene.shots.viewmats[0, 0])
        return pose_of(scene.shots, 0, 0, distance)._replace(up=up)
    middle, radius = extent(gaussians)
    side = np.eye(3)[np.abs(up).argmin()]
    side -= (side @ up) * up
    towards = 0.9 * side / np.linalg.norm(side) + 0.45 * up
    fov = np.radians(50.0)
    return Pose(middle + 2.5 * radius * towards, middle, up, float(fov))


def far_plane(gaussians: Gaussians, pose: Pose) -> float:
    """Far clipping distance for the browser."""
    middle, radius = extent(gaussians)
    return max(_FAR, 20 * (radius + float(np.linalg.norm(pose.position - middle))))
