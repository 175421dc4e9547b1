"""Segmenters without weights: objects are what protrudes from planes, or regions of similar colour.

They use only geometry and colour, not semantics, and are named accordingly. Masks from a
foundation model or from files are better, where available.
"""

from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Num
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from skimage.color import rgb2lab
from skimage.segmentation import felzenszwalb

from gsjax.geometry.cameras import unproject
from gsjax.geometry.neighbors import valid_depth
from gsjax.perception.masks import name_by_size
from gsjax.perception.pictures import unit_floats
from gsjax.perception.planes import find_levels, find_planes, surface_normals


@dataclass(frozen=True)
class PlaneSegmenter:
    """Objects are what remains of a depth image once floor, walls and tables are removed.

    1. Planes are found one after the other by RANSAC; those with nothing behind them (floor, walls) are
       background. A large flat object, such as a lid, does have something behind it.
    2. Flat patches parallel to the floor are background too if they are large (a table), or if most of their
       rim rises (the bottom of a tray, as opposed to the top of an object).
    3. The remaining pixels are split at jumps of depth and, optionally, of colour, and labelled by size.

    Objects that touch are merged. The result depends only on the image and `seed`.
    """

    plane_distance: float = 0.008
    """Half the thickness of a plane at a distance of one metre, metres; it grows with depth like noise."""
    min_plane_fraction: float = 0.05
    """Smallest fraction of the image that counts as a wall, a floor or a table."""
    min_support_fraction: float = 0.005
    """Smallest fraction of the image that counts as a minor support, whose rim must rise."""
    min_rising: float = 0.5
    """Smallest fraction of a minor support's rim that must rise above it."""
    max_planes: int = 8
    """Largest number of planes to find."""
    depth_jump: float = 0.02
    """Largest relative difference of depth between neighbouring pixels of one object."""
    color_jump: float | None = None
    """Largest difference in smoothed CIELAB colour between neighbouring pixels of one object; None does not
    split by colour."""
    min_pixels: int = 60
    """Smaller components are dropped."""
    seed: int = 0

    def __call__(
        self,
        image: Num[np.ndarray, "image_H image_W 3"],
        depth: Num[np.ndarray, "H W"] | None,
        K: Float[np.ndarray, "3 3"] | None,
    ) -> Int[np.ndarray, "H W"]:
        """Labels of an image: 0 for background, then 1, 2, ... from the largest object to the smallest.

        Args:
            image: uint8, or floats 0 to 1.
            depth: z-depth in metres, 0 or NaN where unknown; such pixels are background.
            K: intrinsics, pixels.

        Raises:
            ValueError: depth or K is missing, sizes differ, or no pixel has depth.
        """
        if depth is None or K is None:
            raise ValueError("depth, K: expected both, found None; without depth use RegionSegmenter")
        if image.shape[:2] != depth.shape:
            raise ValueError(f"depth: expected shape {image.shape[:2]} to match image, found {depth.shape}")
        valid = valid_depth(depth)
        if not valid.any():
            raise ValueError(
                "depth: expected positive, finite pixels, found none; without depth use RegionSegmenter"
            )
        points = _camera_points(np.where(valid, depth, 1.0), K)
        foreground = valid & ~self._background(points, valid)
        jumps = _relative_jumps(points[..., 2])
        joined = [jump <= self.depth_jump for jump in jumps]
        if self.color_jump is not None:
            colors = _color_jumps(image)
            joined = [near & (jump <= self.color_jump) for near, jump in zip(joined, colors, strict=True)]
        return name_by_size(_components(foreground, *joined), self.min_pixels)

    def _background(
        self, points: Float[np.ndarray, "H W 3"], valid: Bool[np.ndarray, "H W"]
    ) -> Bool[np.ndarray, "H W"]:
        """Pixels of the planes that bound the scene or support objects."""
        tolerance = self.plane_distance * np.maximum(1.0, points[..., 2])
        normals = surface_normals(points)
        large = int(self.min_plane_fraction * valid.size)
        rng = np.random.default_rng(self.seed)
        planes = find_planes(
            points, normals, valid, tolerance, min_pixels=large, max_planes=self.max_planes, rng=rng
        )
        bounding = [plane for plane in planes if plane.fraction_behind(points, valid, tolerance) < 0.01]
        bounding = bounding or planes[:1]
        background = np.zeros(valid.shape, bool)
        if not bounding:
            return background
        for plane in bounding:
            background |= plane.pixels
        # Cameras are mostly upright, so the floor is the large bounding plane whose normal points up (-y).
        floor = max(bounding, key=lambda plane: plane.pixels.sum() * (0.2 + max(0.0, -plane.normal[1])))
        small = int(self.min_support_fraction * valid.size)
        for patch in find_levels(
            points, normals, valid & ~background, tolerance, floor.normal, min_pixels=small
        ):
            rises = patch.fraction_rising(points, valid, tolerance) >= self.min_rising
            if rises or patch.pixels.sum() >= large:
                background |= patch.pixels
        return background


@dataclass(frozen=True)
class RegionSegmenter:
    """Objects are regions of similar colour: Felzenszwalb's superpixels, merged while their means are close.

    Regions that are large, or cover much of the image's border, are background. Depth is not used.
    """

    scale: float = 150.0
    """Scale of Felzenszwalb's method; larger values give larger superpixels."""
    sigma: float = 0.8
    """Standard deviation of the blur before segmentation, pixels."""
    merge_distance: float = 12.0
    """Largest difference in mean CIELAB colour at which neighbouring regions are merged."""
    max_fraction: float = 0.25
    """A region that covers more than this fraction of the image is background."""
    max_border_fraction: float = 0.1
    """A region that covers more than this fraction of the image's border is background."""
    min_pixels: int = 60
    """Smaller regions are dropped."""

    def __call__(
        self,
        image: Num[np.ndarray, "H W 3"],
        depth: Num[np.ndarray, "..."] | None = None,
        K: Float[np.ndarray, "3 3"] | None = None,
    ) -> Int[np.ndarray, "H W"]:
        """Labels of an image: 0 for background, then 1, 2, ... from the largest region to the smallest.

        Args:
            image: uint8, or floats 0 to 1.
            depth, K: not used; present so that all segmenters have the same signature.
        """
        lab = rgb2lab(unit_floats(image))
        # In CIELAB / 100, the distance from black to white is 1, the range for which `scale` is meant.
        regions = felzenszwalb(
            lab / 100.0, scale=self.scale, sigma=self.sigma, min_size=self.min_pixels, channel_axis=-1
        )
        merged = _merge_regions(regions, lab, self.merge_distance)
        border = np.concatenate([merged[0], merged[-1], merged[1:-1, 0], merged[1:-1, -1]])
        count = merged.max() + 1
        large = np.bincount(merged.ravel(), minlength=count) > self.max_fraction * merged.size
        lining = np.bincount(border, minlength=count) > self.max_border_fraction * border.size
        return name_by_size(np.where((large | lining)[merged], 0, merged + 1), self.min_pixels)


@dataclass(frozen=True)
class PlaneOrRegionSegmenter:
    """`PlaneSegmenter` where there is depth, `RegionSegmenter` where there is none."""

    plane: PlaneSegmenter = field(default_factory=PlaneSegmenter)
    region: RegionSegmenter = field(default_factory=RegionSegmenter)

    def __call__(
        self,
        image: Num[np.ndarray, "image_H image_W 3"],
        depth: Num[np.ndarray, "H W"] | None = None,
        K: Float[np.ndarray, "3 3"] | None = None,
    ) -> Int[np.ndarray, "image_H image_W"]:
        """Labels of an image: 0 for background, then 1, 2, ... by size. Errors are the chosen segmenter's."""
        if depth is None or K is None or not valid_depth(depth).any():
            return self.region(image)
        return self.plane(image, depth, K)


@dataclass(frozen=True)
class PieceSegmenter:
    """Pieces of objects: regions of similar colour; with depth, only those that protrude from planes.

    For methods that merge pieces by other evidence, such as common motion: a door is a piece, and so is each
    side of a box.
    """

    plane: PlaneSegmenter = field(default_factory=PlaneSegmenter)
    region: RegionSegmenter = field(
        default_factory=lambda: RegionSegmenter(
            max_fraction=1.0, max_border_fraction=1.0, min_pixels=60, merge_distance=8.0
        )
    )
    min_pixels: int = 40
    """Smaller pieces are dropped."""

    def __call__(
        self,
        image: Num[np.ndarray, "image_H image_W 3"],
        depth: Num[np.ndarray, "H W"] | None = None,
        K: Float[np.ndarray, "3 3"] | None = None,
    ) -> Int[np.ndarray, "image_H image_W"]:
        """Labels of an image: 0 for background, then 1, 2, ... by size."""
        regions = self.region(image)
        if depth is not None and K is not None and valid_depth(depth).any():
            regions = np.where(self.plane(image, depth, K) > 0, regions, 0)
        return name_by_size(regions, self.min_pixels)


def _camera_points(depth: np.ndarray, K: np.ndarray) -> Float[np.ndarray, "H W 3"]:
    """The point of each pixel in the camera's own frame, metres."""
    rows, columns = np.indices(depth.shape)
    pixels = np.stack([columns, rows], axis=-1) + 0.5
    arrays = (jnp.asarray(array, float) for array in (pixels, depth, np.eye(4), K))
    return np.asarray(unproject(*arrays), np.float64)


def _relative_jumps(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """|difference| over the nearer depth, to the right [H, W-1] and to the lower [H-1, W] neighbour."""
    right = np.abs(np.diff(depth, axis=1)) / np.minimum(depth[:, 1:], depth[:, :-1])
    down = np.abs(np.diff(depth, axis=0)) / np.minimum(depth[1:], depth[:-1])
    return right, down


def _color_jumps(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances of smoothed CIELAB colour from each pixel to its right and lower neighbour."""
    lab = ndimage.gaussian_filter(rgb2lab(unit_floats(image)), (1, 1, 0))
    return np.linalg.norm(np.diff(lab, axis=1), axis=-1), np.linalg.norm(np.diff(lab, axis=0), axis=-1)


def _components(
    foreground: Bool[np.ndarray, "H W"], right: Bool[np.ndarray, "H W-1"], down: Bool[np.ndarray, "H-1 W"]
) -> Int[np.ndarray, "H W"]:
    """Connected components of the foreground, from 1; `right` and `down` are True where connected."""
    index = np.arange(foreground.size).reshape(foreground.shape)
    right = right & foreground[:, 1:] & foreground[:, :-1]
    down = down & foreground[1:] & foreground[:-1]
    start = np.concatenate([index[:, :-1][right], index[:-1][down]])
    end = np.concatenate([index[:, 1:][right], index[1:][down]])
    graph = coo_matrix((np.ones(len(start), bool), (start, end)), shape=(index.size, index.size))
    _, labels = connected_components(graph, directed=False)
    return np.where(foreground, labels.reshape(foreground.shape) + 1, 0)


def _merge_regions(regions: np.ndarray, lab: np.ndarray, distance: float) -> Int[np.ndarray, "H W"]:
    """Merge the pair of neighbours with the closest mean colours until none are closer than `distance`."""
    count = regions.max() + 1
    sizes = np.bincount(regions.ravel(), minlength=count).astype(float)
    means = np.stack([np.bincount(regions.ravel(), lab[..., i].ravel(), count) for i in range(3)], axis=1)
    means /= sizes[:, None]
    touching = np.zeros((count, count), bool)
    for a, b in ((regions[:, 1:], regions[:, :-1]), (regions[1:], regions[:-1])):
        touching[a, b] = touching[b, a] = True
    np.fill_diagonal(touching, False)
    names = np.arange(count)
    gaps = np.where(touching, np.linalg.norm(means[:, None] - means, axis=-1), np.inf)
    while count > 1:
        keep, lose = np.unravel_index(np.argmin(gaps), gaps.shape)
        if gaps[keep, lose] > distance:
            break
        names[names == lose] = keep
        means[keep] = np.average(means[[keep, lose]], axis=0, weights=sizes[[keep, lose]])
        sizes[keep] += sizes[lose]
        touching[keep] |= touching[lose]
        touching[lose], touching[:, lose], touching[keep, keep] = False, False, False
        touching[:, keep] = touching[keep]
        gaps[lose], gaps[:, lose] = np.inf, np.inf
        gaps[keep] = np.where(touching[keep], np.linalg.norm(means[keep] - means, axis=-1), np.inf)
        gaps[:, keep] = gaps[keep]
    return np.unique(names[regions], return_inverse=True)[1].reshape(regions.shape)
