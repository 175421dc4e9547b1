"""Points of a scene from posed photographs alone, by triangulating matched features.

SIFT features (Lowe 2004, OpenCV's implementation) are extracted from each photograph and matched with those
of the nearest views. Matches that lie off the epipolar line of the known poses, or do not reproject to their
pixels, are rejected.
"""

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import cKDTree

_FEATURES = 4_000  # per photograph
_LARGEST = 1_000  # longer side for matching, pixels; larger photographs are downscaled
_CONTRAST = 0.01  # threshold of a feature; OpenCV's 0.04 rejects weakly textured surfaces
_NEIGHBORS = 6  # photographs with which each is matched
_RATIO = 0.85  # of the distances of the best and the second-best match (Lowe 2004, section 7.1)
_LEAST_PARALLAX = np.deg2rad(1.0)
_MAX_ANGLE = np.deg2rad(60.0)  # between two photographs; SIFT matches little beyond
_MAX_ERROR = 1.5  # pixels, from the epipolar line and of the reprojection
_NEAREST = 4  # points from which the depth of a pixel is interpolated


class Matched(NamedTuple):
    """Points that at least two photographs show.

    Attributes:
        points: positions in the unit of the poses.
        colors: RGB, 0 to 1.
        shown: for each photograph, the rows of the points found in it.
    """

    points: Float[np.ndarray, "m 3"]
    colors: Float[np.ndarray, "m 3"]
    shown: list[Int[np.ndarray, "..."]]


class _Features(NamedTuple):
    places: Float[np.ndarray, "k 2"]
    descriptors: Float[np.ndarray, "k 128"]


def match_points(
    pictures: Sequence[UInt8[np.ndarray, "..."]],
    viewmats: Float[np.ndarray, "n 4 4"],
    Ks: Float[np.ndarray, "n 3 3"],
    masks: Sequence[Bool[np.ndarray, "..."] | None] | None = None,
) -> Matched:
    """Triangulated points of a static scene. On the host; takes 0.2 s per photograph of 270x480 pixels.

    Args:
        pictures: RGB, [H,W,3] each, without lens distortion.
        viewmats: world to camera, OpenCV axes.
        Ks: intrinsics in pixels, pixel centres at +0.5.
        masks: pixels to use, [H,W] each; default: all.
    """
    counted = masks or [None] * len(pictures)
    small = [_shrunk(*each) for each in zip(pictures, Ks, counted, strict=True)]
    pictures, Ks = [picture for picture, _, _ in small], np.stack([K for _, K, _ in small])
    features = [_features(picture, mask) for picture, _, mask in small]
    points, colors = [np.zeros((0, 3))], [np.zeros((0, 3))]
    shown: list[list[np.ndarray]] = [[] for _ in pictures]
    total = 0
    for i, j in _pairs(viewmats):
        pairs = _matches(features[i], features[j])
        here, there = features[i].places[pairs[:, 0]], features[j].places[pairs[:, 1]]
        found, sound = _triangulated(here, there, viewmats[[i, j]], Ks[[i, j]])
        column, row = here[sound].astype(int).T
        points.append(found[sound])
        colors.append(pictures[i][row, column] / 255)
        for k in (i, j):
            shown[k].append(total + np.arange(sound.sum()))
        total += int(sound.sum())
    rows = [np.concatenate([np.zeros(0, int), *some]) for some in shown]
    return Matched(np.concatenate(points), np.concatenate(colors), rows)


def filled_up(
    matched: Matched,
    pictures: Sequence[UInt8[np.ndarray, "..."]],
    viewmats: Float[np.ndarray, "n 4 4"],
    Ks: Float[np.ndarray, "n 3 3"],
    count: int,
    seed: int = 0,
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
    """`count` points with their colours: a random subset of the matched points if there are more, else all of
    them plus random pixels, at a depth interpolated from the matched points nearby in the photograph.

    Args:
        matched: the matched points.
        pictures, viewmats, Ks: the photographs, [H,W,3] each, and their cameras, as for `match_points`.
        count: number of points to return; fewer only if no photograph shows enough matched points.
        seed: seed of the random draws.
    """
    rng = np.random.default_rng(seed)
    if len(matched.points) > count:
        some = np.sort(rng.permutation(len(matched.points))[:count])
        return matched.points[some], matched.colors[some]
    usable = [v for v, rows in enumerate(matched.shown) if len(rows) >= _NEAREST]
    points, colors = [matched.points], [matched.colors]
    chosen = rng.permutation(np.resize(usable, count - len(matched.points))) if usable else np.zeros(0, int)
    for v in np.unique(chosen):
        number, picture = int((chosen == v).sum()), pictures[v]
        rotation, shift, K = viewmats[v, :3, :3], viewmats[v, :3, 3], Ks[v]
        local = matched.points[matched.shown[v]] @ rotation.T + shift
        seen = (local @ K.T)[:, :2] / local[:, 2:]
        places = rng.uniform(0, 1, (number, 2)) * (picture.shape[1], picture.shape[0])
        far, near = cKDTree(seen).query(places, k=_NEAREST)
        share = 1 / np.maximum(far, 1.0) ** 2
        depths = share.sum(1) / np.sum(share / local[near, 2], axis=1)  # linear in disparity, as a plane is
        rays = np.concatenate([places, np.ones((number, 1))], axis=1) @ np.linalg.inv(K).T
        points.append((rays * depths[:, None] - shift) @ rotation)
        column, row = places.astype(int).T
        colors.append(picture[row, column] / 255)
    return np.concatenate(points), np.concatenate(colors)


def _shrunk(
    picture: UInt8[np.ndarray, "H W 3"], K: Float[np.ndarray, "3 3"], mask: Bool[np.ndarray, "H W"] | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """The photograph, its intrinsics and its mask at the resolution for matching."""
    height, width = picture.shape[:2]
    scale = min(1.0, _LARGEST / max(height, width))
    size = max(1, round(scale * width)), max(1, round(scale * height))
    if size == (width, height):
        return picture, K, mask
    if mask is not None:
        mask = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST_EXACT) > 0
    factors = np.array([size[0] / width, size[1] / height, 1.0])
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA), factors[:, None] * K, mask


def _features(picture: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"] | None) -> _Features:
    # Without `enable_precise_upscale`, OpenCV's positions are a quarter of a pixel too far to the lower
    # right.
    sift = cv2.SIFT_create(nfeatures=_FEATURES, contrastThreshold=_CONTRAST, enable_precise_upscale=True)
    where = None if mask is None else mask.astype(np.uint8)
    keypoints, descriptors = sift.detectAndCompute(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), where)
    if descriptors is None:
        return _Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    places = np.array([keypoint.pt for keypoint in keypoints]) + 0.5
    # Square roots of descriptors match better (RootSIFT, Arandjelovic and Zisserman 2012).
    shares = descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9)
    return _Features(places, np.sqrt(shares).astype(np.float32))


def _pairs(viewmats: Float[np.ndarray, "n 4 4"]) -> list[tuple[int, int]]:
    """Pairs of each view with its neighbours: of the views at other positions and less than `_MAX_ANGLE`
    away, those with the smallest sum of the angle between the optical axes, in radians, and the distance as a
    fraction of the largest."""
    rotations = viewmats[:, :3, :3]
    centers = -np.einsum("nji,nj->ni", rotations, viewmats[:, :3, 3])
    apart = np.linalg.norm(centers[:, None] - centers, axis=-1)
    angles = np.arccos(np.clip(rotations[:, 2] @ rotations[:, 2].T, -1, 1))
    near = np.where((apart > 1e-9) & (angles < _MAX_ANGLE), angles + apart / max(apart.max(), 1e-9), np.inf)
    best = np.argsort(near, axis=1)[:, :_NEIGHBORS]
    return [
        (i, j)
        for i, j in combinations(range(len(viewmats)), 2)
        if np.isfinite(near[i, j]) and (j in best[i] or i in best[j])
    ]


def _matches(one: _Features, other: _Features) -> Int[np.ndarray, "p 2"]:
    """Rows of features that are mutual best matches and pass the ratio test."""
    if min(len(one.places), len(other.places)) < 2:
        return np.zeros((0, 2), int)
    alike = one.descriptors @ other.descriptors.T
    first, back = alike.argmax(1), alike.argmax(0)
    best = alike.max(1)
    masked = alike.copy()
    masked[np.arange(len(alike)), first] = -np.inf
    squared = 2 - 2 * np.minimum(np.stack([best, masked.max(1)]), 1.0)
    kept = (back[first] == np.arange(len(first))) & (squared[0] < _RATIO**2 * squared[1])
    return np.stack([np.flatnonzero(kept), first[kept]], axis=1)


def _triangulated(
    here: Float[np.ndarray, "p 2"],
    there: Float[np.ndarray, "p 2"],
    viewmats: Float[np.ndarray, "2 4 4"],
    Ks: Float[np.ndarray, "2 3 3"],
) -> tuple[Float[np.ndarray, "p 3"], np.ndarray]:
    """Triangulated points of pairs of pixels, and which are sound: in front of both cameras, with enough
    parallax, and with a small reprojection error."""
    if not len(here):
        return np.zeros((0, 3)), np.zeros(0, bool)
    projections = Ks @ viewmats[:, :3]
    homogeneous = cv2.triangulatePoints(projections[0], projections[1], here.T, there.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = (homogeneous[:3] / homogeneous[3]).T
        sound = np.isfinite(points).all(1)
        ways = []
        for seen, viewmat, K in zip((here, there), viewmats, Ks, strict=True):
            local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
            again = (local @ K.T)[:, :2] / local[:, 2:]
            sound &= (local[:, 2] > 0) & (np.linalg.norm(again - seen, axis=1) <= _MAX_ERROR)
            ways.append(points + viewmat[:3, :3].T @ viewmat[:3, 3])
        lengths = [np.linalg.norm(way, axis=1) for way in ways]
        angle = np.arccos(np.clip(np.sum(ways[0] * ways[1], axis=1) / (lengths[0] * lengths[1]), -1, 1))
        sound &= angle >= _LEAST_PARALLAX
    return points, sound
