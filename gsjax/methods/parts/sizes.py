"""Sizes of the pictures used for tracking, and the width of a pixel, the unit of distances. Recordings with
larger pictures are tracked at about the same sizes; only the refinement uses their full resolution."""

import math

import numpy as np
from jaxtyping import Float

from gsjax.geometry.cameras import Camera

COARSE, FINE = "coarse", "fine"
"""Sizes of the pictures used for tracking: smaller than in the data by `coarse_factor`, and twice as large as
that. Their render plans have the same names."""
COARSE_TILE = 8
"""Edge of the square blocks that make up the masks around parts, in pixels of coarse pictures."""
_COARSE_PIXELS = 160 * 120


def coarse_factor(width: int, height: int) -> int:
    """The factor by which coarse pictures are smaller than those of the data: the power of two, at least 2,
    that comes closest to 160x120 pixels.

    Args:
        width, height: size of the pictures of the data, pixels.
    """
    return 2 ** max(1, round(math.log2(width * height / _COARSE_PIXELS) / 2))


def pixel_width(points: Float[np.ndarray, "n 3"], cameras: Camera) -> float:
    """The width of a pixel of fine pictures at the depth of the points, metres; the median over cameras."""
    viewmats, Ks = np.asarray(cameras.viewmat), np.asarray(cameras.K)
    depths = np.median(points @ viewmats[:, 2, :3].T + viewmats[:, 2, 3], axis=0)
    factor = coarse_factor(cameras.width, cameras.height) // 2
    return factor * float(np.median(np.maximum(depths, 1e-6) / Ks[:, 0, 0]))
