"""Planes in a depth image, found one after the other by RANSAC (Fischler and Bolles 1981).

A hypothesis is a pixel and its normal, and the normal of an inlier has to agree too: an infinite plane cuts
through any object that crosses it, and by distance alone those cuts would count as part of the plane.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from skimage.measure import label

_SAMPLES = (
    6000  # pixels that vote on hypotheses; enough to rank planes that cover a few per cent of the image
)
_HYPOTHESES = 400
_MIN_COSINE = np.cos(np.radians(25))  # between a pixel's normal, which is noisy, and its plane's
_EDGE = 4  # pixels; closer to an edge, a normal mixes two surfaces and cannot vote


@dataclass(frozen=True, eq=False)
class Plane:
    """The plane normal . x = offset in the camera's frame, and the pixels that lie on it.

    Attributes:
        normal: unit normal, towards the camera.
        offset: metres; at most 0, as the camera is at the origin on the side of the normal.
        pixels: the pixels of the plane.
    """

    normal: Float[np.ndarray, "3"]
    offset: float
    pixels: Bool[np.ndarray, "H W"]

    def fraction_behind(
        self,
        points: Float[np.ndarray, "H W 3"],
        valid: Bool[np.ndarray, "H W"],
        tolerance: Float[np.ndarray, "H W"],
    ) -> float:
        """The fraction of the valid points that lies clearly (by three tolerances) behind the plane.

        Args:
            points: points of all pixels, in the camera's frame, metres.
            valid: pixels with depth.
            tolerance: largest distance of a plane's own pixels from it, metres.
        """
        return float(np.mean((points @ self.normal - self.offset < -3 * tolerance)[valid]))

    def fraction_rising(
        self,
        points: Float[np.ndarray, "H W 3"],
        valid: Bool[np.ndarray, "H W"],
        tolerance: Float[np.ndarray, "H W"],
    ) -> float:
        """The fraction of the rim around the plane's pixels that rises above the plane: high for a surface on
        which or in which objects stand, low for the top of an object.

        Args:
            points: points of all pixels, in the camera's frame, metres.
            valid: pixels with depth.
            tolerance: height above the plane at which a pixel counts as rising, metres.
        """
        rim = ndimage.binary_dilation(self.pixels, iterations=3) & ~self.pixels & valid
        rising = points @ self.normal - self.offset > tolerance
        return float(np.mean(rising[rim])) if rim.any() else 0.0


def surface_normals(points: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    """Unit normals towards the camera, from differences of blurred points; zero where they are degenerate."""
    blurred = ndimage.uniform_filter(points, (5, 5, 1), mode="nearest")
    across, down = np.gradient(blurred, axis=1), np.gradient(blurred, axis=0)
    normals = np.cross(down, across)
    normals *= -np.sign(np.sum(normals * points, axis=-1, keepdims=True))
    lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.where(lengths > 1e-12, normals / np.maximum(lengths, 1e-12), 0.0)


def _opened(pixels: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """The pixels without thin structures (a morphological opening), dilated by `_EDGE`."""
    core = ndimage.binary_opening(pixels)
    return np.asarray(ndimage.binary_dilation(core, iterations=_EDGE))


def find_planes(
    points: Float[np.ndarray, "H W 3"],
    normals: Float[np.ndarray, "H W 3"],
    valid: Bool[np.ndarray, "H W"],
    tolerance: Float[np.ndarray, "H W"],
    *,
    min_pixels: int,
    max_planes: int,
    rng: np.random.Generator,
) -> list[Plane]:
    """Planes in descending order of size, each found among the pixels left over by the ones before.

    Args:
        points: points of all pixels, in the camera's frame, metres.
        normals: normals of the points (`surface_normals`).
        valid: pixels with depth.
        tolerance: largest distance of a pixel from its plane, metres.
        min_pixels: smallest size of a plane; the search ends at the first smaller one.
        max_planes: largest number of planes.
        rng: draws the hypotheses.
    """
    planes, free = [], valid.copy()
    while len(planes) < max_planes and free.sum() >= max(min_pixels, 3):
        normal, offset = _best_hypothesis(points[free], normals[free], tolerance[free], rng)
        for _ in range(3):  # each fit to all inliers adds some more
            near = free & (np.abs(points @ normal - offset) <= tolerance)
            agreeing = near & (normals @ normal > _MIN_COSINE)
            if agreeing.sum() < 3:
                return planes
            normal, offset = _fit(points[agreeing])
        if agreeing.sum() < min_pixels:
            break
        planes.append(Plane(normal, offset, near & _opened(agreeing)))
        free &= ~(planes[-1].pixels | agreeing)
    return planes


def find_levels(
    points: Float[np.ndarray, "H W 3"],
    normals: Float[np.ndarray, "H W 3"],
    free: Bool[np.ndarray, "H W"],
    tolerance: Float[np.ndarray, "H W"],
    up: Float[np.ndarray, "3"],
    *,
    min_pixels: int,
    max_levels: int = 20,
) -> list[Plane]:
    """Connected flat patches whose normal is `up`, found as peaks of a histogram of heights.

    Because the direction is known, patches can be much smaller than the planes that RANSAC finds reliably.

    Args:
        points, normals, tolerance: as in `find_planes`.
        free: the pixels to search.
        up: unit vector.
        min_pixels: smallest size of a patch.
        max_levels: largest number of heights to examine.
    """
    heights, free, patches = points @ up, free.copy(), []
    agreeing = free & (normals @ up > _MIN_COSINE)
    for _ in range(max_levels):
        if agreeing.sum() < max(min_pixels, 1):
            break
        width = float(np.median(tolerance[agreeing]))
        bins = np.floor((heights[agreeing] - heights[agreeing].min()) / width).astype(int)
        peak = bins == np.argmax(np.bincount(bins))
        offset = float(np.median(heights[agreeing][peak]))
        near = free & (np.abs(heights - offset) <= tolerance)
        labels = label(near & _opened(near & agreeing), connectivity=1)
        found = [labels == name for name in range(1, labels.max() + 1)]
        patches += [Plane(up, offset, patch) for patch in found if patch.sum() >= min_pixels]
        taken = near | (agreeing & (np.abs(heights - offset) <= width))
        free, agreeing = free & ~taken, agreeing & ~taken
    return patches


def _best_hypothesis(
    points: np.ndarray, normals: np.ndarray, tolerance: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, float]:
    """The tangent plane with the most votes."""
    chosen = rng.choice(len(points), min(_SAMPLES, len(points)), replace=False)
    points, normals, tolerance = points[chosen], normals[chosen], tolerance[chosen]
    tried = slice(0, _HYPOTHESES)  # `chosen` is already in random order
    offsets = np.sum(points[tried] * normals[tried], axis=1)
    near = np.abs(normals[tried] @ points.T - offsets[:, None]) <= tolerance
    votes = np.sum(near & (normals[tried] @ normals.T > _MIN_COSINE), axis=1)
    best = int(np.argmax(votes))
    return normals[best], float(offsets[best])


def _fit(points: np.ndarray) -> tuple[np.ndarray, float]:
    """The least-squares plane of points, its normal towards the camera."""
    center = points.mean(axis=0)
    _, vectors = np.linalg.eigh((points - center).T @ (points - center))
    normal = vectors[:, 0]
    offset = float(normal @ center)
    return (-normal, -offset) if offset > 0 else (normal, offset)
