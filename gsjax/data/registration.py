"""Registration: depth reprojected from the camera that measured it to another one beside it."""

import numpy as np
from jaxtyping import Float

_FINEST = 16  # parts of a pixel per side: more than cameras beside each other need
_AT_ONCE = 2**20  # points: about 100 MB


def register_depth(
    depth: Float[np.ndarray, "rows columns"],
    K: Float[np.ndarray, "3 3"],
    other_K: Float[np.ndarray, "3 3"],
    to_other: Float[np.ndarray, "4 4"],
    width: int,
    height: int,
) -> Float[np.ndarray, "height width"]:
    """Depth as another camera would measure it: reprojected point by point with a z-buffer; 0 where no point
    falls.

    If the other camera's pixels are narrower, each measured pixel is divided into as many points as it covers
    of them, so that surfaces that face the camera have no holes.

    Args:
        depth: metres, 0 = invalid.
        K: intrinsics of the camera that measured it, pixel centres at +0.5.
        other_K: those of the other camera.
        to_other: from coordinates of the first camera to those of the other one, OpenCV axes, metres.
        width, height: size of the other camera's pictures, pixels.
    """
    ratios = (other_K[i, i] / K[i, i] for i in (0, 1))
    finer = [int(np.clip(np.ceil(ratio - 1e-9), 1, _FINEST)) for ratio in ratios]
    nearest = np.full(height * width, np.inf, np.float32)
    across = (np.arange(depth.shape[1] * finer[0]) + 0.5) / finer[0]
    down = (np.arange(depth.shape[0] * finer[1]) + 0.5) / finer[1]
    band = max(1, _AT_ONCE // max(1, len(across)))
    for start in range(0, len(down), band):  # bands of rows: the points take far more memory than the depth
        y = down[start : start + band]
        fine = depth[y.astype(int)].repeat(finer[0], axis=1)
        rows, columns = np.nonzero(fine)
        z = fine[rows, columns]
        rays = [(places - K[i, 2]) / K[i, i] for i, places in enumerate((across, y))]
        local = np.stack([rays[0][columns] * z, rays[1][rows] * z, z])
        there = to_other[:3, :3] @ local + to_other[:3, 3:]
        there = there[:, there[2] > 0]
        column, row = (np.floor(other_K[i, i] * there[i] / there[2] + other_K[i, 2]) for i in (0, 1))
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        pixels = (row[inside] * width + column[inside]).astype(int)
        np.minimum.at(nearest, pixels, there[2, inside].astype(np.float32))
    return np.where(np.isfinite(nearest), nearest, np.float32(0)).reshape(height, width)
