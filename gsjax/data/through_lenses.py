"""Photographs through lenses: undistorted to pinhole views or, for fisheyes, kept as they were taken."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Integer, UInt8

from gsjax.data.errors import DataError, DataWarning
from gsjax.data.lens import Lens, undistort
from gsjax.geometry.cameras import pixels_of
from gsjax.geometry.sight import rays

Fisheye = Literal["undistort", "keep"]

_MAX_LOSS = 0.25  # share of a photograph's pixels: losing more causes a warning
_GRID = 64  # samples along each side of a photograph


@dataclass(frozen=True, eq=False)
class LensViews:
    """The cameras that see N photographs, and the maps from their files to the views of these cameras.

    Attributes:
        Ks: intrinsics in pixels, pixel centres at +0.5, [N,3,3].
        fisheye: k1 to k4 of each, [N,4]; None if all views are pinhole views.
        views: for each, a map (stored picture, OpenCV interpolation flag) -> picture in the view.
        coverage: for each, the pixels that its fisheye covers; None if all.
    """

    Ks: Float[np.ndarray, "n 3 3"]
    fisheye: Float[np.ndarray, "n 4"] | None
    views: Sequence[Callable[[np.ndarray, int], np.ndarray]] = field(repr=False)
    coverage: Sequence[Bool[np.ndarray, "height width"] | None] = field(repr=False)

    @property
    def has_edges(self) -> bool:
        """Whether some photograph has pixels that its lens does not cover."""
        return any(reached is not None for reached in self.coverage)

    def image(
        self, i: int, picture: UInt8[np.ndarray, "height width 3"]
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Colours of photograph `i`."""
        return self.views[i](picture, cv2.INTER_LINEAR)

    def mask(
        self, i: int, shades: Integer[np.ndarray, "height width"] | None
    ) -> Bool[np.ndarray, "height width"] | None:
        """Which pixels count: those whose shade is not 0 and that the lens covers; None if all."""
        reached = self.coverage[i]
        if shades is None:
            return reached
        counts = self.views[i]((shades != 0).astype(np.uint8), cv2.INTER_NEAREST) > 0
        return counts if reached is None else counts & reached

    def depth(self, i: int, depth: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
        """Depth as the view's camera defines it, from depth along the axis: for a fisheye, the distance."""
        seen = self.views[i](depth, cv2.INTER_NEAREST)
        if self.fisheye is None:
            return seen
        cosine = _rays(self.Ks[i], self.fisheye[i], *depth.shape[::-1])[..., 2]
        return np.where(cosine > 1e-3, seen / np.maximum(cosine, 1e-3), 0).astype(depth.dtype)


def through_lenses(
    lenses: Sequence[Lens], sizes: Sequence[tuple[int, int]], where: object, fisheye: Fisheye
) -> LensViews:
    """Undistort photographs to pinhole views, or keep them as fisheyes took them.

    Warns with DataWarning if undistorting loses more than a quarter of a fisheye photograph.

    Args:
        lenses: the lens of each photograph.
        sizes: width and height of each, pixels.
        where: name of the photographs in messages.
        fisheye: whether to undistort fisheye photographs, or to keep them.

    Raises:
        DataError: fisheyes are to be kept, and not all lenses are fisheyes.
    """
    if fisheye == "keep" and any(lens.fisheye for lens in lenses):
        if others := sum(not lens.fisheye for lens in lenses):
            found = f"{others} of {len(lenses)} by other lenses"
            advice = "Leave out fisheye (--read.fisheye), and all are undistorted."
            raise DataError(where, "photographs that are all by fisheyes", found, advice)
        coeffs = np.array([lens.coeffs for lens in lenses])
        seen = [_coverage(lens, *size) for lens, size in zip(lenses, sizes, strict=True)]
        return LensViews(np.stack([lens.K for lens in lenses]), coeffs, [_as_taken] * len(lenses), seen)
    ideal = [undistort(lens, *size) for lens, size in zip(lenses, sizes, strict=True)]
    distinct = {(str(lens), size): (lens, K) for lens, (K, _), size in zip(lenses, ideal, sizes, strict=True)}
    least = min((_kept_share(*seen, *size) for (_, size), seen in distinct.items()), default=1.0)
    if least < 1 - _MAX_LOSS:
        message = f"{where}: undistorting keeps {least:.0%} of a photograph by a fisheye"
        warnings.warn(
            f"{message}; to fit all of it, set fisheye to keep (--read.fisheye keep)",
            DataWarning,
            stacklevel=4,
        )
    views = [view for _, view in ideal]
    return LensViews(np.stack([K for K, _ in ideal]), None, views, [None] * len(lenses))


def _as_taken(picture: np.ndarray, interpolation: int) -> np.ndarray:
    del interpolation
    return picture


def _rays(K, coeffs, width: int, height: int) -> Float[np.ndarray, "height width 3"]:
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return rays(np.stack([x, y], axis=-1), K, np.asarray(coeffs))


def _coverage(lens: Lens, width: int, height: int) -> Bool[np.ndarray, "height width"] | None:
    reached = np.isfinite(_rays(lens.K, lens.coeffs, width, height)[..., 0])
    return None if reached.all() else reached


def _kept_share(lens: Lens, K: Float[np.ndarray, "3 3"], width: int, height: int) -> float:
    """Share of what a fisheye photograph shows that its pinhole view shows too."""
    if not lens.fisheye:
        return 1.0
    small = np.diag([_GRID / width, _GRID / height, 1.0])
    looks = _rays(small @ lens.K, lens.coeffs, _GRID, _GRID).reshape(-1, 3)
    looks = looks[np.isfinite(looks[:, 0])]
    return float(pixels_of(looks, np.eye(4), K, width, height).inside.mean()) if len(looks) else 1.0
