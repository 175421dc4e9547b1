"""Observations of the can for policies: the tracked pose, the true pose, or images."""

from dataclasses import replace

import cv2
import numpy as np

import gsjax
from experiments.policies.bins import CAN, Bins
from experiments.shared.panda import as_frame, fed, motion_between, start
from gsjax.methods.track import PRESETS
from gsjax.scene.frame import Frame

FAST = PRESETS["fast"]
CONFIG = replace(FAST, grow=replace(FAST.grow, slots=0))  # a pose needs a fixed set of Gaussians
OWN, BACKGROUND = 256, 4096  # Gaussians of the can and of everything else
SMALL = (80, 60)  # width and height of the image policy's input


class Tracking:
    """The can tracked from the simulator's mask of the first frame."""

    def __init__(self, world: Bins):
        self.world, self.box, self.frames = world, [], None
        self.begun = world.can()

    def see(self, colors: np.ndarray, depths: np.ndarray) -> np.ndarray:
        """Object to world [4, 4]: axes of the first frame, origin at the centroid of its Gaussians."""
        frame = as_frame(colors, depths, self.world.cameras.cameras)
        if self.frames is None:
            return self._start(frame)
        self.box.append(frame)
        now = np.asarray(next(self.frames).result.pose.means)[self.rows]
        pose = motion_between(self.first, now)
        pose[:3, 3] = now.mean(0)
        return pose

    def _start(self, frame: Frame) -> np.ndarray:
        mask = self.world.cameras.mask(self.world.data, 0, [CAN])
        scene = start(frame, mask, 0, CONFIG.start, OWN, BACKGROUND)
        self.rows = np.flatnonzero(np.asarray(scene.labels) > 0)
        self.first = np.asarray(scene.gaussians.means)[self.rows]
        self.frames = gsjax.track(scene, frame, fed(self.box), CONFIG)
        pose = np.eye(4)
        pose[:3, 3] = self.first.mean(0)
        return pose


def small(colors: np.ndarray) -> np.ndarray:
    """Images of 8 bits [C, h, w, 3], scaled down to the image policy's input."""
    return np.stack([cv2.resize(image, SMALL, interpolation=cv2.INTER_AREA) for image in colors])


def described(pose: np.ndarray, first: np.ndarray, felt: np.ndarray) -> np.ndarray:
    """An object's pose as a policy's input: centre, offset from the tool, and rotation since the first frame
    (its first two columns, Zhou et al., On the continuity of rotation representations, CVPR 2019)."""
    center = pose[:3, 3]
    turn = pose[:3, :3] @ first[:3, :3].T
    return np.concatenate([center, center - felt[3:6], turn[:, 0], turn[:, 1]]).astype(np.float32)
