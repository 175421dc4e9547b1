"""The initial Gaussians: from a point cloud (the data's own, or points matched between photographs), from
depth, or at random in front of the cameras. On the host."""

import warnings

import jax
import numpy as np
from jaxtyping import Float, Int

from gsjax.geometry.extent import extent_of
from gsjax.geometry.sight import pixels_at, rays
from gsjax.methods.fit.config import StartConfig
from gsjax.methods.fit.model import in_slots
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.initialize import gaussians_from_points, points_from_rgbd

_MIN_VISIBLE = 0.1  # share of visible points below which something is wrong
_FLAT_PX = 1.0  # disparity between cameras below which the points show no depth


def start_points(
    frames: list[Frame], cloud: tuple[np.ndarray, np.ndarray] | None, config: StartConfig, seed: int
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"], str]:
    """Points, their colours, and their source.

    Args:
        frames: the photographs.
        cloud: points and their colours: those of the data or, if `config.source` is "matches", matched ones.
        config: the source, and the number of points.
        seed: random seed.

    Raises:
        ValueError: the requested source is not available.
    """
    random = np.random.default_rng(seed)
    has_depth = any(frame.known_depths[0].any() for frame in frames)
    source = config.source
    if cloud is not None and not len(cloud[0]):
        cloud = None
    is_seen = cloud is not None and source in ("auto", "cloud") and _is_seen(cloud[0], frames)
    if source == "auto":
        source = "cloud" if is_seen else "depth" if has_depth else "random"
    if source in ("cloud", "matches"):
        if cloud is None:
            lacks = "the data has no points" if source == "cloud" else "no points were matched"
            raise ValueError(f"start.source: {lacks}; use depth, random or auto")
        return *cloud, source
    if source == "depth":
        if not has_depth:
            raise ValueError("start.source: the data has no depth; use cloud, random or auto")
        return *_from_depth(frames, config.count, random), source
    return *_at_random(frames, config.count, random), source


def _is_seen(points: Float[np.ndarray, "m 3"], frames: list[Frame]) -> bool:
    """Whether any of the points is visible in a photograph; warns if few are."""
    seen, disparities = np.zeros(len(points), bool), np.zeros(len(points))
    extent = extent_of(np.concatenate([frame.cameras.viewmat for frame in frames]))
    for frame in frames:
        height, width = frame.images[0].shape[:2]
        local = points @ frame.cameras.viewmat[0][:3, :3].T + frame.cameras.viewmat[0][:3, 3]
        camera = jax.tree.map(lambda a: a[0], frame.cameras)
        pixels, depths = pixels_at(local, camera.K, camera.fisheye)
        shown = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
        seen |= shown
        disparities[shown] = camera.K[0, 0] * extent.radius / depths[shown]
    if seen.mean() < _MIN_VISIBLE:
        warnings.warn(
            f"of the data's {len(points)} points the photographs show {seen.sum()}: are they in the axes and "
            "the unit of the poses?",
            stacklevel=2,
        )
    elif (flat := np.median(disparities[seen])) < _FLAT_PX and not extent.is_point:
        warnings.warn(
            f"the data's points lie so far away that cameras {extent.radius:.3g} apart see them shifted by "
            f"{flat:.2g} pixels: are they in the unit of the poses?",
            stacklevel=2,
        )
    return bool(seen.any())


def _from_depth(frames, count, random):
    """Points at random pixels with depth, equally many from each frame where it has enough."""
    each = -(-count // len(frames))
    points, colors = [], []
    for frame in frames:
        known = frame.known_depths[0]
        if not known.any():
            continue
        camera = jax.tree.map(lambda a: a[0], frame.cameras)
        some = points_from_rgbd(frame.images[0], known, camera.viewmat, camera.K, fisheye=camera.fisheye)
        kept = random.permutation(len(some[0]))[:each]
        points.append(some[0][kept])
        colors.append(some[1][kept])
    return np.concatenate(points), np.concatenate(colors)


def _at_random(frames, count, random):
    """Random pixels of the frames, at random depths around that of the focus, with the colours of the
    pixels."""
    extent = extent_of(np.concatenate([frame.cameras.viewmat for frame in frames]))
    points, colors = np.zeros((count, 3)), np.zeros((count, 3))
    chosen: Int[np.ndarray, "count"] = random.integers(len(frames), size=count)
    for v in np.unique(chosen):
        frame, rows = frames[v], np.flatnonzero(chosen == v)
        height, width = frame.images[0].shape[:2]
        row, column = random.integers(height, size=len(rows)), random.integers(width, size=len(rows))
        rotation, shift = frame.cameras.viewmat[0][:3, :3], frame.cameras.viewmat[0][:3, 3]
        middle = max(float((rotation @ extent.focus + shift)[2]), 0.3 * extent.radius)
        # Uniform in disparity, from 0.4 to 4 times the depth of the focus.
        depth = middle / random.uniform(1 / 4, 1 / 0.4, len(rows))
        camera = jax.tree.map(lambda a: a[0], frame.cameras)
        looks = rays(np.stack([column + 0.5, row + 0.5], axis=-1), camera.K, camera.fisheye)
        looks = np.where(np.isfinite(looks), looks, [0.0, 0.0, 1.0])  # the edges of a fisheye's photograph
        points[rows] = (looks * depth[:, None] - shift) @ rotation
        picked = frame.images[0][row, column]
        colors[rows] = picked / 255 if picked.dtype == np.uint8 else picked
    return points, colors


def initial_gaussians(
    points: np.ndarray, colors: np.ndarray, slots: int, config: StartConfig, seed: int
) -> Gaussians:
    """Spheres at the points, or at a random subset of them if they outnumber the slots; then empty slots.

    Args:
        points: [M, 3], metres.
        colors: [M, 3], 0 to 1.
        slots: number of slots.
        config: opacity and scale.
        seed: random seed.
    """
    if len(points) > slots:
        chosen = np.sort(np.random.default_rng(seed).permutation(len(points))[:slots])
        points, colors = points[chosen], colors[chosen]
    started = gaussians_from_points(points, colors, opacity=config.opacity, scale_factor=config.scale)
    return in_slots(started, slots)
