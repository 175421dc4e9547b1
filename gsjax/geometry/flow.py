"""Optical flow: displacements (x, y) of pixels from one image to another, in pixels; NaN where unknown."""

import numpy as np
from jaxtyping import Bool, Float, Shaped
from scipy.ndimage import map_coordinates

# Thresholds on squared lengths in pixels, as in Sundaram, Brox and Keutzer (2010) and Lai et al. (2018).
_ROUND_TRIP, _ROUND_TRIP_LEAST = 0.01, 0.5
_EDGE, _EDGE_LEAST = 0.01, 0.002


def warp(
    image: Shaped[np.ndarray, "H W *channels"], flow: Float[np.ndarray, "H W 2"]
) -> Float[np.ndarray, "H W *channels"]:
    """Warp an image back along a flow: pixel x of the result is image(x + flow(x)), interpolated bilinearly.

    NaN where the flow is unknown or leaves the image, and where it ends on or next to a NaN pixel.

    Args:
        image: the image to which the flow leads. For a mask, the result is the fraction that is True.
        flow: flow from each pixel of the result to `image`, pixels.
    """
    rows, columns = np.indices(flow.shape[:2])
    known = np.isfinite(flow).all(-1)
    ends = np.where(known[..., None], np.stack([rows + flow[..., 1], columns + flow[..., 0]], axis=-1), -9.0)
    planes = np.asarray(image, np.float64).reshape(*flow.shape[:2], -1)
    places = ends.transpose(2, 0, 1)
    warped = [
        map_coordinates(plane, places, order=1, mode="constant", cval=np.nan)
        for plane in np.moveaxis(planes, -1, 0)
    ]
    return np.stack(warped, axis=-1).reshape(np.shape(image))


def seen_in_both(
    forward: Float[np.ndarray, "H W 2"], backward: Float[np.ndarray, "H W 2"]
) -> Bool[np.ndarray, "H W"]:
    """Pixels of the first image that are visible in both: forward and backward flow agree, and the flow has
    no edge there.

        |f + b'|^2 <= 0.01 (|f|^2 + |b'|^2) + 0.5    and    |grad u|^2 + |grad v|^2 <= 0.01 |f|^2 + 0.002

    with f = (u, v) the forward flow, and b' the backward flow where f ends. These are the thresholds with
    which Lai et al., "Learning Blind Video Temporal Consistency" (ECCV 2018), exclude occlusions, after
    Sundaram, Brox and Keutzer (ECCV 2010). Pixels that leave the image are not visible in both.

    Args:
        forward: flow from the first image to the second.
        backward: flow from the second image to the first.
    """
    back = warp(backward, forward)
    squared = _squared(forward)
    closed = _squared(forward + back) <= _ROUND_TRIP * (squared + _squared(back)) + _ROUND_TRIP_LEAST
    steps = sum(_squared(np.diff(forward, axis=axis, append=_last(forward, axis))) for axis in (0, 1))
    return closed & (steps <= _EDGE * squared + _EDGE_LEAST)


def _squared(flow: np.ndarray) -> np.ndarray:
    return np.sum(np.square(flow, dtype=np.float64), axis=-1)


def _last(flow: np.ndarray, axis: int) -> np.ndarray:
    """The last row or column; appended, it makes the last difference zero."""
    return np.take(flow, [-1], axis=axis)
