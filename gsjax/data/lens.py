"""Undistortion of photographs to an ideal pinhole camera, with OpenCV."""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from gsjax.data.errors import DataError
from gsjax.geometry.cameras import intrinsics
from gsjax.geometry.sight import radial_table

_SAME_SHAPE = 0.02  # largest relative difference of aspect ratios that rounding a size explains
_WIDEST = np.deg2rad(70)  # off axis: a wider pinhole view consists mostly of stretched edges

# OpenCV counts pixel centres at integers, and everything here at +0.5.
_HALF = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])


class Lens(NamedTuple):
    """Calibration of a camera.

    Attributes:
        K: intrinsics in pixels, pixel centres at +0.5, [3,3].
        coeffs: OpenCV distortion coefficients (see `gsjax.geometry.distortion`); empty for a pinhole camera.
        fisheye: whether they are for OpenCV's fisheye model, which even with 4 zeros is not a pinhole.
    """

    K: Float[np.ndarray, "3 3"]
    coeffs: tuple[float, ...] = ()
    fisheye: bool = False


def intrinsics_matrix(K: Float[np.ndarray, "..."] | tuple[float, ...]) -> Float[np.ndarray, "3 3"]:
    """The intrinsic matrix, from a matrix or from fx, fy, cx, cy.

    Args:
        K: [3, 3], or [4] with fx, fy, cx, cy; pixels.

    Raises:
        ValueError: `K` has another shape.
    """
    given = np.asarray(K, np.float64)
    if given.shape == (4,):
        matrix = intrinsics(given[0], 0, 0, (given[2], given[3]))
        matrix[1, 1] = given[1]
        return matrix
    if given.shape != (3, 3):
        raise ValueError(f"K must be 3x3 or fx, fy, cx, cy; got shape {given.shape}")
    return given


def scaled_intrinsics(
    K: Float[np.ndarray, "3 3"], calibrated: tuple[float, float], actual: tuple[int, int], where: object
) -> Float[np.ndarray, "3 3"]:
    """K of a calibrated image size, scaled to the actual size of the photograph: photographs are often
    downscaled after calibration.

    Args:
        K: intrinsics at the calibrated size.
        calibrated: width and height stated by the calibration, pixels.
        actual: width and height of the photograph, pixels.
        where: name of the photograph in messages.

    Raises:
        DataError: the calibrated size is not positive, or the aspect ratios differ.
    """
    if min(calibrated) <= 0:
        found = f"{calibrated[0]:g}x{calibrated[1]:g}"
        raise DataError(where, "a width and a height above 0", found, "Correct the calibration.")
    expected_ratio, ratio = calibrated[0] / calibrated[1], actual[0] / actual[1]
    if abs(ratio / expected_ratio - 1) > _SAME_SHAPE:
        is_rotated = abs(ratio * expected_ratio - 1) <= _SAME_SHAPE
        question = " Was it rotated by 90 degrees when it was copied?" if is_rotated else ""
        expected = f"{calibrated[0]:g}x{calibrated[1]:g} pixels or a downscaled copy"
        advice = f"Give the photographs that were calibrated.{question}"
        raise DataError(where, expected, f"{actual[0]}x{actual[1]}", advice)
    return np.diag([actual[0] / calibrated[0], actual[1] / calibrated[1], 1.0]) @ K


def undistort(
    lens: Lens, width: int, height: int
) -> tuple[Float[np.ndarray, "3 3"], Callable[[np.ndarray, int], np.ndarray]]:
    """A pinhole camera of the same image size whose view lies within the photograph, and the map to its view.

    Args:
        lens: the lens that distorted the photograph.
        width, height: size of the photograph, pixels.

    Returns:
        K of that camera, and (picture, OpenCV interpolation flag) -> picture as that camera sees it.
    """
    if not lens.fisheye and not any(lens.coeffs):
        return lens.K, lambda picture, interpolation: picture
    key = (tuple(lens.K.ravel().tolist()), lens.coeffs, lens.fisheye, width, height)

    def undistorted(picture: np.ndarray, interpolation: int) -> np.ndarray:
        # Rounding may reach slightly past the edge; the edge pixels are repeated there.
        return cv2.remap(picture, *_maps(*key), interpolation, borderMode=cv2.BORDER_REPLICATE)

    return _pinhole_K(*key) + _HALF, undistorted


@lru_cache(maxsize=64)
def _pinhole_K(
    K: tuple[float, ...], coeffs: tuple[float, ...], fisheye: bool, width: int, height: int
) -> Float[np.ndarray, "3 3"]:
    """K of the largest pinhole view without blank pixels, in OpenCV's convention."""
    lens_K = np.reshape(K, (3, 3)) - _HALF
    if fisheye:
        return _pinhole_of_fisheye(lens_K, np.array(coeffs), width, height)
    return cv2.getOptimalNewCameraMatrix(lens_K, np.array(coeffs), (width, height), 0)[0]


def _pinhole_of_fisheye(
    lens_K: Float[np.ndarray, "3 3"], coeffs: Float[np.ndarray, "4"], width: int, height: int
) -> Float[np.ndarray, "3 3"]:
    """Like `_pinhole_K`, but keeps the principal point: OpenCV's own estimate follows the mean of the edge
    midpoints, which diverges for a lens that sees almost 90 degrees off its axis."""
    angles, distances = radial_table(coeffs, _WIDEST)
    cx, cy = lens_K[0, 2], lens_K[1, 2]
    sides = np.array([cx, width - 1 - cx, cy, height - 1 - cy])  # from the principal point to the edges
    focals = np.array([lens_K[0, 0], lens_K[0, 0], lens_K[1, 1], lens_K[1, 1]])
    edge_angles = np.interp(sides / focals, distances, angles).clip(1e-3)
    K = np.eye(3)
    K[0, 0] = K[1, 1] = np.max(sides / np.tan(edge_angles))
    K[:2, 2] = cx, cy
    return K


@lru_cache(maxsize=2)  # each is as large as a photograph, and photographs mostly share a lens
def _maps(
    K: tuple[float, ...], coeffs: tuple[float, ...], fisheye: bool, width: int, height: int
) -> tuple[np.ndarray, np.ndarray]:
    lens_K, ideal = np.reshape(K, (3, 3)) - _HALF, _pinhole_K(K, coeffs, fisheye, width, height)
    maps = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
    return maps(lens_K, np.array(coeffs), np.eye(3), ideal, (width, height), cv2.CV_32FC1)
