"""Photographs as an ideal pinhole camera would have taken them, through OpenCV."""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from gsjax.data.errors import DataError
from gsjax.geometry.cameras import intrinsics

_SAME_SHAPE = 0.02  # how far two aspect ratios may differ by rounding a size
_WIDEST = np.deg2rad(70)  # off axis: beyond it a pinhole view is mostly stretched edge

# OpenCV counts pixel centres at integers, and everything here at +0.5.
_HALF = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])


class Lens(NamedTuple):
    """A camera as a calibration gives it.

    Attributes:
        K: intrinsics in pixels, pixel centres at +0.5, [3,3].
        coeffs: OpenCV's of the distortion (see `gsjax.geometry.distortion`), or none for a pinhole camera.
        fisheye: whether they are of OpenCV's fisheye model, which is no pinhole with 4 zeros either.
    """

    K: Float[np.ndarray, "3 3"]
    coeffs: tuple[float, ...] = ()
    fisheye: bool = False


def matrix_of(K: Float[np.ndarray, "..."] | tuple[float, ...]) -> Float[np.ndarray, "3 3"]:
    """Intrinsics that were given as a matrix or as fx, fy, cx, cy.

    Args:
        K: [3, 3], or [4] with fx, fy, cx, cy; pixels.

    Raises:
        ValueError: they are neither.
    """
    given = np.asarray(K, np.float64)
    if given.shape == (4,):
        matrix = intrinsics(given[0], 0, 0, (given[2], given[3]))
        matrix[1, 1] = given[1]
        return matrix
    if given.shape != (3, 3):
        raise ValueError(f"K must be 3x3 or fx, fy, cx, cy; got shape {given.shape}")
    return given


def shrunk(
    K: Float[np.ndarray, "3 3"], said: tuple[float, float], actual: tuple[int, int], where: object
) -> Float[np.ndarray, "3 3"]:
    """K, which is of a photograph of the size that a calibration says, for the size that it has: photographs
    are often made smaller after calibration.

    Args:
        K: of the size that was calibrated.
        said: width and height that the calibration says, pixels.
        actual: width and height of the photograph, pixels.
        where: what messages name.

    Raises:
        DataError: the calibration's size is none, or of another shape.
    """
    if min(said) <= 0:
        found = f"{said[0]:g}x{said[1]:g}"
        raise DataError(where, "a width and a height above 0", found, "Correct the calibration.")
    then, now = said[0] / said[1], actual[0] / actual[1]
    if abs(now / then - 1) > _SAME_SHAPE:
        turned = (
            " Was it turned on its side when it was copied?" if abs(now * then - 1) <= _SAME_SHAPE else ""
        )
        expected, found = f"{said[0]:g}x{said[1]:g} pixels or a smaller copy", f"{actual[0]}x{actual[1]}"
        raise DataError(where, expected, found, f"Give the photographs that were calibrated.{turned}")
    return np.diag([actual[0] / said[0], actual[1] / said[1], 1.0]) @ K


def straighten(
    lens: Lens, width: int, height: int
) -> tuple[Float[np.ndarray, "3 3"], Callable[[np.ndarray, int], np.ndarray]]:
    """A pinhole camera that sees only what the photograph shows, of the same size, and how to get its view.

    Args:
        lens: that bent the photograph.
        width, height: of the photograph, pixels.

    Returns:
        K of that camera, and (picture, interpolation of OpenCV) -> picture as that camera sees it.
    """
    if not lens.fisheye and not any(lens.coeffs):
        return lens.K, lambda picture, how: picture
    key = (tuple(lens.K.ravel().tolist()), lens.coeffs, lens.fisheye, width, height)

    def straightened(picture: np.ndarray, how: int) -> np.ndarray:
        # Where rounding reaches a little past the edge, the edge goes on.
        return cv2.remap(picture, *_maps(*key), how, borderMode=cv2.BORDER_REPLICATE)

    return _pinhole_K(*key) + _HALF, straightened


@lru_cache(maxsize=64)
def _pinhole_K(
    K: tuple[float, ...], coeffs: tuple[float, ...], fisheye: bool, width: int, height: int
) -> Float[np.ndarray, "3 3"]:
    """K of the largest pinhole view without blank pixels, in OpenCV's convention."""
    own = np.reshape(K, (3, 3)) - _HALF
    if fisheye:
        return _pinhole_of_fisheye(own, np.array(coeffs), width, height)
    return cv2.getOptimalNewCameraMatrix(own, np.array(coeffs), (width, height), 0)[0]


def _pinhole_of_fisheye(
    own: Float[np.ndarray, "3 3"], coeffs: Float[np.ndarray, "4"], width: int, height: int
) -> Float[np.ndarray, "3 3"]:
    """As `_pinhole_K`, with the principal point where it was: OpenCV's own estimate follows the mean of the
    edges' middles, which runs away where a lens sees almost a right angle from its axis."""
    angles = np.linspace(1e-3, _WIDEST, 1000)
    bent = np.maximum.accumulate(angles * np.polyval([*coeffs[::-1], 1.0], angles**2))
    cx, cy = own[0, 2], own[1, 2]
    sides = np.array([cx, width - 1 - cx, cy, height - 1 - cy])  # from the principal point to the edges
    focals = np.array([own[0, 0], own[0, 0], own[1, 1], own[1, 1]])
    seen = np.interp(sides / focals, bent, angles)
    K = np.eye(3)
    K[0, 0] = K[1, 1] = np.max(sides / np.tan(seen))
    K[:2, 2] = cx, cy
    return K


@lru_cache(maxsize=2)  # one is as large as the photograph, and photographs mostly share their lens
def _maps(
    K: tuple[float, ...], coeffs: tuple[float, ...], fisheye: bool, width: int, height: int
) -> tuple[np.ndarray, np.ndarray]:
    own, ideal = np.reshape(K, (3, 3)) - _HALF, _pinhole_K(K, coeffs, fisheye, width, height)
    maps = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
    return maps(own, np.array(coeffs), np.eye(3), ideal, (width, height), cv2.CV_32FC1)
