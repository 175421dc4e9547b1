"""Depth of what two eyes see, without weights: both pictures are brought into one plane, matched row by row
by semi-global matching (Hirschmueller, PAMI 2008) as OpenCV has it, and the matches are refined (Lucas and
Kanade, IJCAI 1981)."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Num

from gsjax.perception.pictures import to_bytes

_FRACTION = 16  # of a pixel: OpenCV's disparities are integers of these
_ROUNDS, _WINDOW_PX = 3, 2.5  # of the refinement; the window's standard deviation
_LEAST_SLOPE = 0.3  # grey values a pixel: that of noise
_LARGEST = 6  # areas of the picture that a rectified one may take


@dataclass(frozen=True)
class StereoConfig:
    """How two eyes are matched."""

    range_share: float = 0.25
    """Largest disparity, as a share of the picture's width: what is nearer gets no depth."""
    block: int = 5
    """Pixels a side of what is compared; odd."""
    uniqueness: int = 10
    """Per cent by which the best match is to beat the next."""
    speckle: int = 100
    """Pixels: islands of other depth that are smaller have none."""

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
    """Depth along the left eye's axis, in the unit of the poses; 0 where no match is sure.

    Args:
        left, right: RGB, [H,W,3] both, uint8 or floats 0 to 1.
        viewmats: world to camera of both, OpenCV axes. Eyes that do not look the same way, or stand one above
            the other, are turned until they do.
        Ks: intrinsics of both in pixels, pixel centres at +0.5.
        config: how; the defaults unless given.

    Raises:
        ValueError: pictures differ in size, both eyes stand at one place, or look too far apart.
    """
    if left.shape != right.shape:
        raise ValueError(f"right: expected pixels {left.shape} like left, found {right.shape}")
    config = config or StereoConfig()
    pair = _rectified(left.shape[:2], viewmats, Ks)
    eyes = list(zip(pair.turns, Ks, strict=True))
    seen = [_warped(to_bytes(image), *eye, pair) for image, eye in zip((left, right), eyes, strict=True)]
    white = np.full(left.shape[:2], 255, np.uint8)
    inside = [_warped(white, *eye, pair) == 255 for eye in eyes]
    disparity = _refined(_disparity(*seen, config), *seen)
    disparity[~inside[0] | ~_lands(disparity, inside[1]) | ~_textured(seen[0])] = 0
    return _back(disparity, pair, Ks[0], left.shape[:2])


class _Pair(NamedTuple):
    """Two cameras of one K, side by side, that look the same way.

    Attributes:
        turns: from each eye's own frame to that of its rectified camera.
        K: of both rectified cameras, pixel centres at +0.5.
        size: (width, height) of the rectified pictures.
        baseline: between them, in the unit of the poses.
    """

    turns: tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]]
    K: Float[np.ndarray, "3 3"]
    size: tuple[int, int]
    baseline: float


def _rectified(
    shape: tuple[int, int], viewmats: Float[np.ndarray, "2 4 4"], Ks: Float[np.ndarray, "2 3 3"]
) -> _Pair:
    """x along the way from eye to eye, z as near as can be to where both look; all of both pictures in view.
    Eyes that are rectified already keep their pixels: K is the left one's but for whole pixels."""
    between = viewmats[1, :3, :3] @ viewmats[0, :3, :3].T
    # The right eye, in the left one's frame.
    away = -between.T @ (viewmats[1, :3, 3] - between @ viewmats[0, :3, 3])
    baseline = float(np.linalg.norm(away))
    if not baseline > 1e-9:
        raise ValueError("viewmats: expected two eyes apart from each other, found both at one place")
    x = away / baseline
    ahead = np.array([0.0, 0.0, 1.0]) + between[2]  # the sum of both axes, in the left's frame
    y = np.cross(ahead, x)
    if np.linalg.norm(y) < 1e-3:
        raise ValueError("viewmats: expected eyes side by side, found one before the other")
    y /= np.linalg.norm(y)
    turn = np.stack([x, y, np.cross(x, y)])
    turns, K = (turn, turn @ between.T), Ks[0].copy()
    height, width = shape
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], float)
    eyes = zip(turns, Ks, strict=True)
    rays = np.concatenate([corners @ np.linalg.inv(own).T @ turn.T for turn, own in eyes])
    if (rays[:, 2] < 1e-3).any():
        raise ValueError("viewmats: expected two eyes that look about the same way, found them far apart")
    places = rays @ K.T / rays[:, 2:]
    low, high = (round_(end(places[:, :2], axis=0)) for round_, end in ((_down, np.min), (_up, np.max)))
    size = (high - low).astype(int)
    if size.prod() > _LARGEST * width * height:
        raise ValueError(
            f"viewmats: expected two eyes that look about the same way; rectified, pictures of "
            f"{width}x{height} would need {size[0]}x{size[1]}"
        )
    K[:2, 2] -= low
    return _Pair(turns, K, (int(size[0]), int(size[1])), baseline)


def _down(places: np.ndarray) -> np.ndarray:
    return np.floor(places + 1e-6)


def _up(places: np.ndarray) -> np.ndarray:
    return np.ceil(places - 1e-6)


def _warped(image: np.ndarray, turn: Float[np.ndarray, "3 3"], K: Float[np.ndarray, "3 3"], pair: _Pair):
    """A picture as the rectified camera sees it; black outside."""
    width, height = pair.size
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    there = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ (K @ turn.T @ np.linalg.inv(pair.K)).T
    x, y = (np.float32(there[..., i] / np.maximum(there[..., 2], 1e-9) - 0.5) for i in range(2))
    return cv2.remap(image, x, y, cv2.INTER_LINEAR)


def _disparity(
    left: Num[np.ndarray, "h w 3"], right: Num[np.ndarray, "h w 3"], config: StereoConfig
) -> Float[np.ndarray, "h w"]:
    """Pixels by which what is seen lies further left in the right picture; 0 where that is not sure."""
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
    # It leaves out as many columns as there are disparities; these are of the border, and cut off again.
    padded = [cv2.copyMakeBorder(image, 0, 0, count, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
    found = matcher.compute(*padded)[:, count:].astype(np.float64) / _FRACTION
    return np.where(found > 0, found, 0.0)


def _refined(
    disparity: Float[np.ndarray, "h w"], left: Num[np.ndarray, "h w 3"], right: Num[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "h w"]:
    """Disparities at which grey values agree best around each pixel, by least squares, within a pixel of
    those found: semi-global matching itself prefers some fractions of a pixel to others."""
    ours, theirs = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in (left, right))
    rows, columns = np.indices(disparity.shape).astype(np.float32)
    known, found = disparity > 0, disparity.astype(np.float32)
    for _ in range(_ROUNDS):
        there = cv2.remap(theirs, columns - found, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        slopes = known * cv2.Scharr(ours + there, cv2.CV_32F, 1, 0) / 64
        steps = _around((there - ours) * slopes) / (_around(slopes**2) + 1.0)
        found = np.clip(found + np.clip(steps, -0.5, 0.5), disparity - 1, disparity + 1).astype(np.float32)
    return np.where(known, np.maximum(found, 1 / _FRACTION), 0.0)


def _textured(image: Num[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Where grey values change along a row: elsewhere all matches are as good, and a neighbour takes over."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return _around((cv2.Scharr(grey, cv2.CV_32F, 1, 0) / 32) ** 2) > _LEAST_SLOPE**2


def _around(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    return cv2.GaussianBlur(values, (0, 0), _WINDOW_PX)


def _lands(disparity: Float[np.ndarray, "h w"], inside: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Where the right picture has what was matched."""
    rows, columns = np.indices(disparity.shape)
    there: Int[np.ndarray, "h w"] = np.rint(columns - disparity).astype(int)
    return (disparity > 0) & (there >= 0) & inside[rows, np.maximum(there, 0)]


def _back(
    disparity: Float[np.ndarray, "h w"], pair: _Pair, K: Float[np.ndarray, "3 3"], shape: tuple[int, int]
) -> Float[np.ndarray, "H W"]:
    """Depth in the left eye's own pixels, each from the rectified pixel that it falls in."""
    columns, rows = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(K).T @ pair.turns[0].T
    places = rays @ pair.K.T / rays[..., 2:]
    x, y = (np.clip(places[..., i].astype(int), 0, pair.size[i] - 1) for i in range(2))
    found = disparity[y, x]
    # Along the rectified axis it is f b / d; a ray whose own z is 1 has rays[2] of that.
    along = pair.K[0, 0] * pair.baseline / np.where(found > 0, found, 1.0)
    return np.where(found > 0, along / rays[..., 2], 0.0).astype(np.float32)
