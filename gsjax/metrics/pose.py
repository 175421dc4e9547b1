"""Errors of estimated object poses, as benchmarks of pose estimation and pose tracking define them.

With x a point of the object's model, and P_t its estimated and T_t its true pose at frame t (model to world):

    ADD    mean_x || P_t x - T_t x ||                            Hinterstoisser et al., ACCV 2012
    ADD-S  mean_x min_y || P_t y - T_t x ||                      Xiang et al., PoseCNN, RSS 2018
    MSSD   min_S max_x || P_t x - T_t S x ||                     Hodan et al., BOP Challenge 2020
    MSPD   min_S max_x || proj(P_t x) - proj(T_t S x) ||         the same

where S runs over the symmetries of the model. In float64, on the host.
"""

from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError, cKDTree
from scipy.spatial.distance import cdist

Poses = Float[np.ndarray, "T 4 4"]
Points = Float[np.ndarray, "V 3"]
Symmetries = Float[np.ndarray, "S 4 4"]

AUC_LIMIT_M = 0.1
"""Upper limit of the curves of ADD and ADD-S."""
ADD_SHARE = 0.1
"""Fraction of the diameter: a pose with a smaller ADD counts as correct."""
MSSD_SHARES = np.arange(1, 11) / 20
"""Fractions of the diameter: thresholds over which BOP averages the recall of MSSD."""
MSPD_PIXELS = 5.0 * np.arange(1, 11)
"""Thresholds over which BOP averages the recall of MSPD, in an image that is `MSPD_WIDTH` wide."""
MSPD_WIDTH = 640

_REST = 1e-9  # fraction of the points' spread: far above rounding, too small to affect rotations
_BLOCK = 1024  # points whose distances to all others are held at once
_BOUNDING = 64  # points that bound the largest distance from below


class PoseScore(NamedTuple):
    """The errors of one object's poses, over all frames.

    Attributes:
        add_mm, add_s_mm: mean ADD and ADD-S, millimetres.
        add_auc, add_s_auc: `accuracy_auc` of ADD and of ADD-S, 0 to 1.
        add_recall, add_s_recall: share of frames with an ADD, or ADD-S, below a tenth of the diameter.
        recall_5cm_5deg: share of frames with errors below 5 cm and below 5 degrees.
    """

    add_mm: float
    add_s_mm: float
    add_auc: float
    add_s_auc: float
    add_recall: float
    add_s_recall: float
    recall_5cm_5deg: float


def fitted_poses(means: Float[np.ndarray, "T N 3"], first: Float[np.ndarray, "4 4"]) -> Poses:
    """The poses of an object that moves from its `first` pose as its points do: E_t P_0, where the rigid
    motion E_t takes the points from frame 0 to frame t with the least sum of squared distances (Kabsch 1976).

    Where the points do not determine a rotation, such as about a line on which all of them lie, the smallest
    one is used.

    Args:
        means: positions of the object's points over time, world, metres; at least one point.
        first: pose of the object at frame 0, model to world.
    """
    means = np.asarray(means, np.float64)
    centers = means.mean(axis=1)
    around = means - centers[:, None]
    covariances = np.einsum("tni,nj->tij", around, around[0])
    rest = _REST * np.square(around[0]).sum() + np.finfo(np.float64).tiny
    u, _, vt = np.linalg.svd(covariances + rest * np.eye(3))
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    poses = np.tile(np.eye(4), (len(means), 1, 1))
    poses[:, :3, :3] = u @ vt
    poses[:, :3, 3] = centers - poses[:, :3, :3] @ centers[0]
    return poses @ first


def add_errors(estimated: Poses, true: Poses, points: Points) -> Float[np.ndarray, "T"]:
    """ADD of each frame, metres: the mean distance between model points in the estimated and true pose.

    Args:
        estimated, true: poses, model to world.
        points: points of the model, in its own frame, metres.
    """
    return np.array([np.linalg.norm(_placed(gap, points), axis=-1).mean() for gap in estimated - true])


def add_s_errors(estimated: Poses, true: Poses, points: Points) -> Float[np.ndarray, "T"]:
    """ADD-S of each frame, metres: the mean distance from each model point in the true pose to the nearest
    one in the estimated pose. It is the error for objects whose symmetries make poses indistinguishable.

    Args:
        estimated, true: poses, model to world.
        points: points of the model, in its own frame, metres.
    """
    tree = cKDTree(points)  # distances are the same in the model's frame
    return np.array(
        [tree.query(_placed(pose, points))[0].mean() for pose in np.linalg.solve(estimated, true)]
    )


def accuracy_auc(errors: Float[np.ndarray, "T"], limit: float = AUC_LIMIT_M) -> float:
    """The area under the curve of accuracy over thresholds from 0 to `limit`, 0 to 1.

    Accuracy is the share of frames whose error is at most the threshold. This is the sum that the
    YCB-Video toolbox (`VOCap` in `plot_accuracy_keyframe.m`) and BundleSDF's evaluation compute: with errors
    e_1 <= ... <= e_m below the limit, of n in all, and e_0 = 0,

        ( sum_i (e_i - e_i-1) i / n  +  (limit - e_m) m / n ) / limit

    Between two errors it takes the accuracy at the upper one, so it exceeds the exact area, which is
    mean(max(0, 1 - e / limit)), by e_m / (n limit), at most 1 / n. FoundationPose's code integrates the same
    curve by trapezoids of 1 mm.

    Args:
        errors: of each frame, metres; one at the limit or above counts as infinite. At least one.
        limit: the largest threshold, metres.

    Raises:
        ValueError: there are no errors.
    """
    if not len(errors):
        raise ValueError("accuracy_auc: expected errors of at least one frame, found none")
    below = np.sort(errors[errors < limit])
    accuracy = np.arange(1, len(below) + 1) / len(errors)
    steps = np.diff(below, prepend=0.0, append=limit)
    return float(steps @ np.append(accuracy, accuracy[-1:] if len(below) else 0.0)) / limit


def pose_errors(estimated: Poses, true: Poses) -> tuple[Float[np.ndarray, "T"], Float[np.ndarray, "T"]]:
    """The distance between the origins of the model, metres, and the angle between the rotations, degrees, of
    each frame.

    Args:
        estimated, true: poses, model to world.
    """
    gaps = estimated - true
    sines = np.linalg.norm(gaps[:, :3, :3], axis=(1, 2)) / np.sqrt(8)  # of half the angle
    return np.linalg.norm(gaps[:, :3, 3], axis=-1), np.degrees(2 * np.arcsin(np.clip(sines, 0, 1)))


def recall_within(estimated: Poses, true: Poses, metres: float = 0.05, degrees: float = 5.0) -> float:
    """The share of frames whose pose is off by less than a distance and less than an angle; by default the
    "5 cm 5 degrees" of Shotton et al., CVPR 2013, and Tjaden et al., TPAMI 2019.

    Args:
        estimated, true: poses, model to world.
        metres, degrees: the bounds.
    """
    distances, angles = pose_errors(estimated, true)
    return float(((distances < metres) & (angles < degrees)).mean())


def mssd(estimated: Poses, true: Poses, points: Points, symmetries: Symmetries) -> Float[np.ndarray, "T"]:
    """BOP's maximum symmetry-aware surface distance of each frame, metres.

    Args:
        estimated, true: poses, model to world.
        points: vertices of the model, in its own frame, metres.
        symmetries: motions of the model, in its own frame, that leave it unchanged; one is the identity.
    """
    pairs = zip(estimated, true, strict=True)
    return np.array([_least_maximum(pose, other @ symmetries, points, _placed) for pose, other in pairs])


def mspd(
    estimated: Poses,
    true: Poses,
    points: Points,
    symmetries: Symmetries,
    viewmats: Poses,
    Ks: Float[np.ndarray, "T 3 3"],
) -> Float[np.ndarray, "T"]:
    """BOP's maximum symmetry-aware projection distance of each frame, pixels; infinite where a vertex is
    behind the camera.

    Args:
        estimated, true: poses, model to world.
        points: vertices of the model, in its own frame, metres.
        symmetries: motions of the model, in its own frame, that leave it unchanged; one is the identity.
        viewmats, Ks: world to camera (OpenCV), and intrinsics, of one camera in each frame.
    """
    errors = []
    for pose, other, viewmat, K in zip(estimated, true, viewmats, Ks, strict=True):

        def project(poses: np.ndarray, some: np.ndarray, K: np.ndarray = K) -> np.ndarray:
            pixels = _placed(poses, some) @ K.T
            depths = pixels[..., 2:]
            return pixels[..., :2] / np.where(depths > 0, depths, np.nan)

        errors.append(_least_maximum(viewmat @ pose, viewmat @ other @ symmetries, points, project))
    return np.array(errors)


def average_recall(errors: Float[np.ndarray, "T"], thresholds: Float[np.ndarray, "thresholds"]) -> float:
    """The share of errors below a threshold, averaged over the thresholds, 0 to 1 (BOP's AR)."""
    return float((errors[:, None] < thresholds).mean())


def diameter(points: Points) -> float:
    """The largest distance between two of the points, in their unit; 0 for one point."""
    with suppress(QhullError, ValueError):  # the points are coplanar, or too few
        points = points[ConvexHull(points).vertices]
    blocks = np.array_split(points, -(-len(points) // _BLOCK))
    return float(max(cdist(block, points).max() for block in blocks))


def score_poses(
    estimated: Poses, true: Float[np.ndarray, "poses 4 4"], points: Points, diameter: float
) -> PoseScore:
    """Score the poses of one object over time.

    Args:
        estimated, true: poses, model to world.
        points: points of the model, in its own frame, metres; at least one.
        diameter: of the model, metres.

    Raises:
        ValueError: the numbers of frames differ, or there are no frames or no points.
    """
    if not len(estimated) == len(true) > 0:
        raise ValueError(
            f"estimated: expected as many frames as true, and at least one, found {len(estimated)} for "
            f"{len(true)}"
        )
    if not len(points):
        raise ValueError("points: expected at least one point of the model, found none")
    estimated, true, points = (np.asarray(each, np.float64) for each in (estimated, true, points))
    add, add_s = add_errors(estimated, true, points), add_s_errors(estimated, true, points)
    return PoseScore(
        add_mm=1000 * float(add.mean()),
        add_s_mm=1000 * float(add_s.mean()),
        add_auc=accuracy_auc(add),
        add_s_auc=accuracy_auc(add_s),
        add_recall=float((add < ADD_SHARE * diameter).mean()),
        add_s_recall=float((add_s < ADD_SHARE * diameter).mean()),
        recall_5cm_5deg=recall_within(estimated, true),
    )


def _placed(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The points [V,3] in each of the poses [...,4,4], [...,V,3]."""
    return points @ np.swapaxes(poses[..., :3, :3], -1, -2) + poses[..., None, :3, 3]


def _least_maximum(
    pose: np.ndarray,
    others: np.ndarray,
    points: np.ndarray,
    place: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> float:
    """The minimum, over the `others`, of the largest distance between a point in the pose and in the other.

    A few points bound this distance from below, so that most of the others need not be evaluated in full.
    """
    target, few = place(pose, points), slice(None, None, max(1, len(points) // _BOUNDING))

    def largest(poses: np.ndarray, some: slice) -> np.ndarray:
        distances = np.linalg.norm(place(poses, points[some]) - target[some], axis=-1)
        return np.where(np.isfinite(distances), distances, np.inf).max(axis=-1)

    bounds, least = largest(others, few), np.inf
    for i in np.argsort(bounds):
        if bounds[i] >= least:
            break
        least = min(least, float(largest(others[i : i + 1], slice(None))[0]))
    return float(least)
