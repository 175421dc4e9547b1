"""Shared by tests of the viewer: clouds, a moving scene, photographs around it, a stand-in for viser."""

import numpy as np

from gsjax.geometry.cameras import look_at
from gsjax.scene.gaussians import gaussians_from_activated
from gsjax.viz.viewer import Shots, Viewable, moved
from gsjax.viz.viewer.cameras import browser_camera


def cloud(count=24, seed=0, **more):
    """Gaussians of all shapes, about two metres in front of the camera of `ahead`."""
    rng = np.random.default_rng(seed)
    return gaussians_from_activated(
        np.array([0, 0, 2]) + rng.normal(0, 0.3, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.uniform(0.02, 0.2, (count, 3)),
        rng.uniform(0.3, 0.95, count),
        rng.uniform(0, 1, (count, 3)),
        **more,
    )


def ahead(width=48, height=40, fov=0.6):
    """A camera at the origin that looks along +z, +y down."""
    return browser_camera(np.array([1.0, 0, 0, 0]), np.zeros(3), fov, width, height)


def made(means, quats, scales, opacities, colors):
    """Gaussians from lists."""
    return gaussians_from_activated(*map(np.array, (means, quats, scales, opacities, colors)))


class Api:
    """A stand-in for viser's scene: keeps what is added, records what is sent."""

    def __init__(self):
        self.nodes, self.sent = {}, []

    def add_gaussian_splats(self, name, centers, covariances, rgbs, opacities, *, scale):
        api = self

        class Node:
            def set_gaussians(self, *arrays):
                api.sent.append(name)
                api.nodes[name] = arrays

            def remove(self):
                del api.nodes[name]

        self.nodes[name] = (centers, covariances, rgbs, opacities)
        self.sent.append(name)
        return Node()


def moving_scene(frames=4, moving=8):
    gaussians = cloud()
    steps = np.linspace(0, 0.6, frames)[:, None, None] * [1.0, 0, 0]
    means = np.asarray(gaussians.means)[None, :moving] + steps
    quats = np.repeat(np.asarray(gaussians.quats)[None, :moving], frames, axis=0)
    times = np.arange(frames) / 10.0
    return Viewable("x", gaussians, motion=moved(gaussians, means.astype(np.float32), quats), times=times)


def shots_around(up, count=6, height=0.6):
    """Level cameras on a circle about the origin; 640x480, vertical field of view 2 atan(1/2)."""
    up = np.asarray(up, float)
    side = np.eye(3)[np.abs(up).argmin()]
    other = np.cross(up, side)
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    eyes = 3 * (np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * other) + height * up
    viewmats = np.stack([look_at(eye, np.zeros(3), up) for eye in eyes])
    K = np.array([[480.0, 0, 320], [0, 480, 240], [0, 0, 1]])
    names = tuple(f"{i}.jpg" for i in range(count))
    return Shots(names, viewmats[None], np.tile(K, (1, count, 1, 1)), np.tile([640, 480], (count, 1)))
