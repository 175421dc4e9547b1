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
"""Number of rendered images, and of traced views, that a simulated sequence caches."""


def check_counts(**counts: int) -> None:
    """Raises ValueError for a count below 1."""
    for name, value in counts.items():
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")


def viewmats_around(
    target: Float[np.ndarray, "3"], distance: float, cameras: int, *, low: float, high: float = 42.0
) -> Float[np.ndarray, "c 4 4"]:
    """View matrices of cameras on a circle around `target`, at a distance of `distance` metres and, in
    alternation, `low` and `high` degrees of elevation."""
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
    """The sequence of a scene. Frames are rendered on demand; the last few are cached.

    Args:
        name: name of the sequence.
        scene: solids, light and cameras.
        times: seconds, increasing.
        objects: body index of each object whose poses are part of the truth, by name.
        robot: the mask value of the robot.
        joints: the joint of each object, see `Truth`.
        tracks: trajectories of points on deformable surfaces, see `Truth`.
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
