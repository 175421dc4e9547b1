"""Initial Gaussians of a deforming scene without depth that a camera goes around: random points within its
visual hull. On the host."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from gsjax.geometry.cameras import PointPixels, pixels_of
from gsjax.geometry.extent import extent_of
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.initialize import gaussians_from_points

_TURNED = 0.1  # mean squared sine of the angles between optical axes and their mean
_MAX_MISS = 0.25  # share of the distance to the focus by which an optical axis may miss it
_VIEWS = 48  # views that carve the hull, evenly spread over time
_CELLS = 64  # along each edge of the box that is carved
_LEAST_SHARE = 0.6  # of the best cell's number of views; below 1, as what moves does not stay in one place
_DIFFERS = 0.02  # difference of a colour from the background above which it is another
_OPACITY = 0.1  # as in 3DGS; low, so that the interior is visible and can be learned


def goes_around(viewmats: Float[np.ndarray, "n 4 4"]) -> bool:
    """Whether a camera goes around what it looks at: its optical axes meet in front of it, and their
    directions differ by tens of degrees.

    Args:
        viewmats: world to camera, OpenCV axes.
    """
    extent, axes = extent_of(viewmats), viewmats[:, 2, :3]
    if extent.is_point:
        return False
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    towards = viewmats[:, :3, :3] @ extent.focus + viewmats[:, :3, 3]
    missed = np.linalg.norm(towards[:, :2], axis=1)
    meet = np.median(missed) < _MAX_MISS * np.median(towards[:, 2])
    return bool(meet and np.linalg.eigvalsh(across.mean(0))[0] > _TURNED)


def hull_gaussians(
    frames: Sequence[Frame], background: tuple[float, float, float] | None, count: int, seed: int
) -> Gaussians:
    """Gaussians at random positions in the visual hull, coloured by the mean of the pixels that show them.

    A cell of a cube around the focus, as wide as the view there, is in the hull if it projects to something
    other than the background in 0.6 times as many views as the best cell, or more. Without a background,
    every pixel shows something.

    Args:
        frames: frames of one camera over time; pixels outside their masks may show anything.
        background: RGB, 0 to 1; None if the images have none.
        count: number of Gaussians.
        seed: random seed.

    Raises:
        ValueError: no view shows anything but the background.
    """
    some = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), _VIEWS)).astype(int))
    views = [frames[i] for i in some]
    shown = [_shown(view, background) for view in views]
    box = _box(frames)
    edge = (box[1] - box[0]) / _CELLS
    axis = np.arange(_CELLS)
    corners = box[0] + edge * np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    share = np.zeros(len(corners))
    for view, inside in zip(views, shown, strict=True):
        at = _pixels(corners + edge / 2, view)
        share += at.inside & inside[at.rows, at.columns]
    if not share.any():
        raise ValueError(
            f"frames: expected something before the background {background}, found nothing else in "
            f"{len(views)} views; are they empty?"
        )
    random = np.random.default_rng(seed)
    cells = random.choice(np.flatnonzero(share >= _LEAST_SHARE * share.max()), count)
    points = corners[cells] + edge * random.uniform(size=(count, 3))
    colors, seen = np.zeros((count, 3)), np.zeros((count, 1))
    for view, inside in zip(views, shown, strict=True):
        at = _pixels(points, view)
        now = (at.inside & inside[at.rows, at.columns])[:, None]
        colors += now * _colors(view)[at.rows, at.columns]
        seen += now
    return gaussians_from_points(points, colors / np.maximum(seen, 1), opacity=_OPACITY)


def _box(frames: Sequence[Frame]) -> Float[np.ndarray, "2 3"]:
    """A cube around the focus, as wide as the median view there."""
    viewmats, Ks = (
        np.concatenate([np.asarray(getattr(frame.cameras, name), np.float64) for frame in frames])
        for name in ("viewmat", "K")
    )
    camera, focus = frames[0].cameras, extent_of(viewmats).focus
    away = viewmats[:, 2, :3] @ focus + viewmats[:, 2, 3]
    widest = np.maximum(camera.width / Ks[:, 0, 0], camera.height / Ks[:, 1, 1])
    half = float(np.median(away * widest)) / 2
    return np.stack([focus - half, focus + half])


def _shown(view: Frame, background: tuple[float, float, float] | None) -> Bool[np.ndarray, "h w"]:
    """The pixels that may show the scene."""
    if background is None:
        return np.ones(view.images.shape[1:3], bool)
    differs = np.any(np.abs(_colors(view) - np.array(background)) > _DIFFERS, axis=-1)
    return differs if view.masks is None else differs | ~np.asarray(view.masks[0])


def _colors(view: Frame) -> Float[np.ndarray, "h w 3"]:
    """The image of a frame of one camera, 0 to 1."""
    image = np.asarray(view.images[0])
    return image / 255 if np.issubdtype(image.dtype, np.integer) else image


def _pixels(points: Float[np.ndarray, "n 3"], view: Frame) -> PointPixels:
    camera = view.cameras
    viewmat, K = (np.asarray(one[0], np.float64) for one in (camera.viewmat, camera.K))
    return pixels_of(points, viewmat, K, camera.width, camera.height)
