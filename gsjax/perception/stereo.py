"""Stereo depth without weights: images are rectified, matched row by row with OpenCV's semi-global matching
(Hirschmueller, PAMI 2008), and the matches are refined (Lucas and Kanade, IJCAI 1981)."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Num

from gsjax.perception.pictures import to_bytes

_FRACTION = 16  # OpenCV's disparities are integers in units of 1/16 pixel
_ROUNDS, _WINDOW_PX = 3, 2.5  # iterations of the refinement; standard deviation of its window
_MIN_GRADIENT = 0.3  # grey values per pixel; the level of noise
_LARGEST = 6  # largest area of a rectified image, relative to the original


@dataclass(frozen=True)
class StereoConfig:
    """Options of stereo matching."""

    range_share: float = 0.25
    """Largest disparity, as a fraction of the image's width; anything nearer gets no depth."""
    block: int = 5
    """Side of the matching window, pixels; odd."""
    uniqueness: int = 10
    """Margin, in per cent, by which the best match has to beat the second best."""
    speckle: int = 100
    """Isolated regions with fewer pixels than this get no depth."""

    def __post_init__(self):
        if not 0 < self.range_share <= 1:
            raise ValueError(f"range_share: expected above 0 and at most 1, found {self.range_share}")
        if self.block < 1 or self.block % 2 == 0:
            raise ValueError(f"block: expected an odd number of pixels, found {self.block}")


def stereo_depth(
    left: Num[np.ndarray, "H W 3"],
    right: Num[np.ndarray, "..."],
    viewmats: Float[np.ndarray, "2 4 4"],
    Ks: Float[np.ndarray, "2 3 3"],
    config: StereoConfig | None = None,
) -> Float[np.ndarray, "H W"]:
    """Depth along the left camera's axis, in the unit of the poses; 0 where there is no reliable match.

    Args:
        left, right: RGB, [H,W,3] each, uint8 or floats 0 to 1.
        viewmats: world to camera of both, OpenCV axes. Cameras that are not parallel, or one above the other,
            are rectified.
        Ks: intrinsics of both in pixels, pixel centres at +0.5.
        config: options; default: `StereoConfig()`.

    Raises:
        ValueError: the images differ in size, or the cameras coincide or diverge too much.
    """
    if left.shape != right.shape:
        raise ValueError(f"right: expected shape {left.shape} to match left, found {right.shape}")
    config = config or StereoConfig()
    pair = _rectified(left.shape[:2], viewmats, Ks)
    cameras = list(zip(pair.rotations, Ks, strict=True))
    images = zip((left, right), cameras, strict=True)
    seen = [_warped(to_bytes(image), *camera, pair) for image, camera in images]
    white = np.full(left.shape[:2], 255, np.uint8)
    inside = [_warped(white, *camera, pair) == 255 for camera in cameras]
    disparity = _refined(_disparity(*seen, config), *seen)
    disparity[~inside[0] | ~_match_inside(disparity, inside[1]) | ~_textured(seen[0])] = 0
    return _to_left_view(disparity, pair, Ks[0], left.shape[:2])


class _Pair(NamedTuple):
    """A rectified pair: two parallel cameras side by side, with the same K.

    Attributes:
        rotations: rotations from each camera's own frame to that of its rectified camera.
        K: intrinsics of both rectified cameras, pixel centres at +0.5.
        size: (width, height) of the rectified images.
        baseline: distance between the cameras, in the unit of the poses.
    """

    rotations: tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]]
    K: Float[np.ndarray, "3 3"]
    size: tuple[int, int]
    baseline: float


def _rectified(
    shape: tuple[int, int], viewmats: Float[np.ndarray, "2 4 4"], Ks: Float[np.ndarray, "2 3 3"]
) -> _Pair:
    """Rectify: x along the baseline, z as close as possible to both optical axes, both images in full view.
    Images that are already rectified keep their pixels: K is the left one's, shifted by whole pixels."""
    between = viewmats[1, :3, :3] @ viewmats[0, :3, :3].T
    # Position of the right camera in the left one's frame.
    away = -between.T @ (viewmats[1, :3, 3] - between @ viewmats[0, :3, 3])
    baseline = float(np.linalg.norm(away))
    if not baseline > 1e-9:
        raise ValueError("viewmats: expected two cameras at different places, found both at one place")
    x = away / baseline
    ahead = np.array([0.0, 0.0, 1.0]) + between[2]  # the sum of both optical axes, in the left camera's frame
    y = np.cross(ahead, x)
    if np.linalg.norm(y) < 1e-3:
        raise ValueError("viewmats: expected cameras side by side, found one in front of the other")
    y /= np.linalg.norm(y)
    turn = np.stack([x, y, np.cross(x, y)])
    rotations, K = (turn, turn @ between.T), Ks[0].copy()
    height, width = shape
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], float)
    cameras = zip(rotations, Ks, strict=True)
    rays = np.concatenate([corners @ np.linalg.inv(own).T @ turn.T for turn, own in cameras])
    if (rays[:, 2] < 1e-3).any():
        raise ValueError(
            "viewmats: expected two cameras that look in similar directions, found a large angle"
        )
    places = rays @ K.T / rays[:, 2:]
    low, high = (round_(end(places[:, :2], axis=0)) for round_, end in ((_down, np.min), (_up, np.max)))
    size = (high - low).astype(int)
    if size.prod() > _LARGEST * width * height:
        raise ValueError(
            f"viewmats: expected two cameras that look in similar directions, found a pair whose images of "
            f"{width}x{height} pixels would be {size[0]}x{size[1]} when rectified"
        )
    K[:2, 2] -= low
    return _Pair(rotations, K, (int(size[0]), int(size[1])), baseline)


def _down(places: np.ndarray) -> np.ndarray:
    return np.floor(places + 1e-6)


def _up(places: np.ndarray) -> np.ndarray:
    return np.ceil(places - 1e-6)


def _warped(image: np.ndarray, turn: Float[np.ndarray, "3 3"], K: Float[np.ndarray, "3 3"], pair: _Pair):
    """An image resampled to the rectified camera; black outside."""
    width, height = pair.size
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    there = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ (K @ turn.T @ np.linalg.inv(pair.K)).T
    x, y = (np.float32(there[..., i] / np.maximum(there[..., 2], 1e-9) - 0.5) for i in range(2))
    return cv2.remap(image, x, y, cv2.INTER_LINEAR)


def _disparity(
    left: Num[np.ndarray, "h w 3"], right: Num[np.ndarray, "h w 3"], config: StereoConfig
) -> Float[np.ndarray, "h w"]:
    """Shift of each pixel to the left in the right image, pixels; 0 where there is no reliable match."""
    count = max(16, 16 * round(config.range_share * left.shape[1] / 16))
    area = left.shape[2] * config.block**2
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=count,
        blockSize=config.block,
        P1=8 * area,
        P2=32 * area,
        disp12MaxDiff=1,
        uniquenessRatio=config.uniqueness,
        speckleWindowSize=config.speckle,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    # The matcher skips as many columns as there are disparities; these are padding, cut off again below.
    padded = [cv2.copyMakeBorder(image, 0, 0, count, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
    found = matcher.compute(*padded)[:, count:].astype(np.float64) / _FRACTION
    return np.where(found > 0, found, 0.0)


def _refined(
    disparity: Float[np.ndarray, "h w"], left: Num[np.ndarray, "h w 3"], right: Num[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "h w"]:
    """Disparities refined by least squares on grey values around each pixel, by at most one pixel, because
    semi-global matching is biased towards certain subpixel fractions."""
    ours, theirs = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in (left, right))
    rows, columns = np.indices(disparity.shape).astype(np.float32)
    known, found = disparity > 0, disparity.astype(np.float32)
    for _ in range(_ROUNDS):
        there = cv2.remap(theirs, columns - found, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        slopes = known * cv2.Scharr(ours + there, cv2.CV_32F, 1, 0) / 64
        steps = _blur((there - ours) * slopes) / (_blur(slopes**2) + 1.0)
        found = np.clip(found + np.clip(steps, -0.5, 0.5), disparity - 1, disparity + 1).astype(np.float32)
    return np.where(known, np.maximum(found, 1 / _FRACTION), 0.0)


def _textured(image: Num[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Where grey values vary along a row; elsewhere matches are ambiguous and follow the neighbours."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return _blur((cv2.Scharr(grey, cv2.CV_32F, 1, 0) / 32) ** 2) > _MIN_GRADIENT**2


def _blur(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    return cv2.GaussianBlur(values, (0, 0), _WINDOW_PX)


def _match_inside(
    disparity: Float[np.ndarray, "h w"], inside: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Pixels whose match lies inside the right image."""
    rows, columns = np.indices(disparity.shape)
    there: Int[np.ndarray, "h w"] = np.rint(columns - disparity).astype(int)
    return (disparity > 0) & (there >= 0) & inside[rows, np.maximum(there, 0)]


def _to_left_view(
    disparity: Float[np.ndarray, "h w"], pair: _Pair, K: Float[np.ndarray, "3 3"], shape: tuple[int, int]
) -> Float[np.ndarray, "H W"]:
    """Depth at the left camera's own pixels, each taken from the rectified pixel into which it falls."""
    columns, rows = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(K).T @ pair.rotations[0].T
    places = rays @ pair.K.T / rays[..., 2:]
    x, y = (np.clip(places[..., i].astype(int), 0, pair.size[i] - 1) for i in range(2))
    found = disparity[y, x]
    # Depth along the rectified axis is f b / d; a ray with z = 1 in its own frame has rays[2] there.
    along = pair.K[0, 0] * pair.baseline / np.where(found > 0, found, 1.0)
    return np.where(found > 0, along / rays[..., 2], 0.0).astype(np.float32)
