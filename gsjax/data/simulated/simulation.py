"""A simulated scene as a sequence."""

from functools import lru_cache

import numpy as np
from jaxtyping import Float

from gsjax.data.objects import Truth
from gsjax.data.sequence import Sequence
from gsjax.data.simulated.raycaster import (
    Scene,
    render_color,
    render_depth,
    render_flow,
    render_labels,
    trace,
)
from gsjax.geometry.cameras import look_at
from gsjax.geometry.joints import Joint

CACHED_IMAGES = 16
"""Rendered images, and traced views, that a simulated sequence keeps."""


def expect_counts(**counts: int) -> None:
    """Raises ValueError for a count below 1."""
    for name, value in counts.items():
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")


def viewmats_around(
    target: Float[np.ndarray, "3"], distance: float, cameras: int, *, low: float, high: float = 42.0
) -> Float[np.ndarray, "c 4 4"]:
    """Cameras in a circle around `target`, `distance` metres away, by turns `low` and `high` degrees up."""
    azimuths = 2 * np.pi * np.arange(cameras) / cameras
    heights = np.deg2rad(np.where(np.arange(cameras) % 2 == 0, low, high))
    flat = np.stack([np.cos(azimuths), np.sin(azimuths)], axis=1) * np.cos(heights)[:, None]
    eyes = target + distance * np.concatenate([flat, np.sin(heights)[:, None]], axis=1)
    return np.array([look_at(eye, target) for eye in eyes])


def simulated_sequence(
    name: str,
    scene: Scene,
    times: Float[np.ndarray, "frames"],
    objects: dict[str, int],
    robot: int | None = None,
    joints: tuple[Joint | None, ...] = (),
    tracks: Float[np.ndarray, "frames points 3"] | None = None,
) -> Sequence:
    """The sequence of a scene. Frames are rendered when asked for; the last few are kept.

    Args:
        name: what to call it.
        scene: what is seen, by which cameras.
        times: seconds, increasing.
        objects: the body of each object whose pose is reported as truth.
        robot: the mask value of the robot.
        joints: of each object, as `Truth` has them.
        tracks: of points of what deforms, as `Truth` has them.
    """
    color = lru_cache(CACHED_IMAGES)(lambda t, c: render_color(scene, t, c))
    hits = lru_cache(CACHED_IMAGES)(lambda t, c: trace(scene, t, c))
    bodies = list(objects.values())
    truth = Truth(
        names=tuple(objects),
        label_ids=scene.labels[bodies],
        poses=scene.poses[:, bodies],
        robot=robot,
        joints=joints,
        tracks=tracks,
    )
    return Sequence(
        name=name,
        camera_ids=tuple(range(scene.Ks.shape[1])),
        width=scene.width,
        height=scene.height,
        times=times,
        frame_ids=tuple(range(len(times))),
        Ks=scene.Ks,
        viewmats=scene.viewmats,
        load_image=lambda t, c: color(t, c).copy(),
        load_depth=lambda t, c: render_depth(hits(t, c)),
        load_mask=lambda t, c: render_labels(scene, hits(t, c)),
        load_flow=lambda t, u, c: render_flow(scene, t, u, c, hits(t, c)),
        truth=truth,
    )
