"""A ball of coloured Gaussians in front of a wall, as input of the tracker's refinement."""

import jax
import numpy as np

from gsjax.geometry.cameras import Camera, intrinsics, look_at
from gsjax.methods.track.motion import Motion, first_pose, group_means, move, place
from gsjax.methods.track.refine import RefineBatch
from gsjax.methods.track.scene import TrackedScene
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import gaussians_from_activated
from gsjax.scene.render import plan_render, render
from tests.methods.parts.made_up_parts import floats

OBJECT, BACKGROUND = 150, 200


def batch_after(twist) -> RefineBatch:
    """The ball at rest in front of the wall, and what two cameras see after it moved by `twist`."""
    rng = np.random.default_rng(0)
    on_ball = rng.normal(size=(OBJECT, 3))
    ball = 0.1 * on_ball / np.linalg.norm(on_ball, axis=1, keepdims=True)
    wall = np.c_[rng.uniform(-0.5, 0.5, (BACKGROUND, 2)), np.full(BACKGROUND, -0.3)]
    count = OBJECT + BACKGROUND
    quats = np.broadcast_to([1.0, 0.0, 0.0, 0.0], (count, 4))
    scales = np.repeat([[0.015] * 3, [0.05] * 3], (OBJECT, BACKGROUND), axis=0)
    values = (np.r_[ball, wall], quats, scales, np.full(count, 0.9), rng.uniform(0, 1, (count, 3)))
    gaussians = gaussians_from_activated(*(floats(value) for value in values))
    labels = jax.device_put(np.repeat(np.int32([1, 0]), (OBJECT, BACKGROUND)))
    scene = TrackedScene(gaussians, floats(np.zeros((OBJECT, 3))), labels, (0, 1), OBJECT)
    viewmats = np.stack([look_at(np.array(eye), np.zeros(3)) for eye in ((0.2, 0.0, 0.7), (-0.2, 0.1, 0.7))])
    Ks = np.broadcast_to(intrinsics(60.0, 64, 48), (2, 3, 3))
    cameras = Camera(floats(viewmats), floats(Ks), 64, 48)
    pose = first_pose(scene)
    centers = group_means(pose.means, scene.groups, 1)
    motion = Motion(floats([twist]), floats(np.zeros((OBJECT, 3))))
    moved = place(scene, move(pose, motion, centers, scene.groups))
    seen = render(moved, cameras)
    plan = plan_render(gaussians, cameras, headroom=3.0, derivative="forward")
    everywhere = jax.device_put(np.ones((2, 48, 64), bool))
    return RefineBatch(scene, Frame(seen.colors, seen.depths, cameras), plan, pose, centers, everywhere)
