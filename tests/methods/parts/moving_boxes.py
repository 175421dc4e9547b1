"""Boxes of Gaussians that move over a floor by given motions, seen by cameras around it, with full truth."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import equinox as eqx
import jax
import numpy as np
from scipy.spatial.transform import Rotation

from gsjax.geometry.cameras import Camera, intrinsics, look_at
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians, gaussians_from_activated
from gsjax.scene.render import plan_render, render

WIDTH, HEIGHT = 64, 48
_SPACING = 0.02


@dataclass(frozen=True)
class Box:
    """A box and its motion.

    Attributes:
        center, size: metres, at the canonical frame.
        turns: [T, 3] rotation vectors about `pivot`, relative to the canonical frame.
        shifts: [T, 3] translations relative to the canonical frame, metres.
        pivot: the middle of the box unless given.
        gone: frames from which it is absent.
    """

    center: tuple[float, float, float]
    size: tuple[float, float, float]
    turns: np.ndarray
    shifts: np.ndarray
    pivot: tuple[float, float, float] | None = None
    gone: tuple[int, ...] = ()

    def motions(self) -> np.ndarray:
        """[T, 4, 4] transforms from the canonical frame to each frame."""
        motions = np.tile(np.eye(4), (len(self.turns), 1, 1))
        rotations = Rotation.from_rotvec(self.turns).as_matrix()
        pivot = np.array(self.center if self.pivot is None else self.pivot)
        motions[:, :3, :3] = rotations
        motions[:, :3, 3] = pivot + self.shifts - rotations @ pivot
        return motions

    def points(self) -> np.ndarray:
        """Points on its surface except the underside, which no camera sees, [n, 3]."""
        axes = [np.arange(-s / 2 + _SPACING / 2, s / 2, _SPACING) for s in self.size]
        found = []
        for k in range(3):
            a, b = (axes[i] for i in range(3) if i != k)
            for sign in (-1, 1) if k < 2 else (1,):
                grid = np.stack(np.meshgrid(a, b, indexing="ij"), -1).reshape(-1, 2)
                found.append(np.insert(grid, k, sign * self.size[k] / 2, axis=1))
        return np.concatenate(found) + self.center


class MovingBoxes:
    """A recording of boxes at 15 frames a second; a `gsjax.methods.protocols.SequenceLike`.

    Attributes:
        gaussians: those of the canonical frame, the floor's first.
        bodies: the body of each Gaussian: 0 for the floor, 1 and above for the boxes.
    """

    def __init__(self, boxes: Sequence[Box], cameras: int = 3, seed: int = 0):
        self.boxes, self.num_cameras = tuple(boxes), cameras
        self.num_frames = len(boxes[0].turns)
        self.times = np.arange(self.num_frames) / 15
        rng = np.random.default_rng(seed)
        side = np.arange(-0.3, 0.3, 1.5 * _SPACING)
        floor = np.stack(np.meshgrid(side, side, [0.0], indexing="ij"), -1).reshape(-1, 3)
        points = [floor, *(box.points() for box in boxes)]
        self.bodies = np.repeat(np.arange(len(points)), [len(p) for p in points])
        means, count = np.concatenate(points), sum(map(len, points))
        paints = np.array([[0.5, 0.5, 0.5], [0.8, 0.3, 0.2], [0.2, 0.4, 0.8], [0.3, 0.7, 0.3]])
        colors = np.clip(paints[self.bodies] + rng.uniform(-0.2, 0.2, (count, 3)), 0, 1)
        scales = np.where(self.bodies[:, None] == 0, 0.9 * _SPACING, 0.6 * _SPACING) * np.ones((1, 3))
        quats = np.tile([1.0, 0, 0, 0], (count, 1))
        self.gaussians = gaussians_from_activated(means, quats, scales, np.full(count, 0.95), colors)
        angles = 2 * np.pi * np.arange(cameras) / cameras + 0.3
        eyes = 0.75 * np.stack([np.cos(angles), np.sin(angles), np.full(cameras, 0.8)], -1)
        viewmats = np.stack([look_at(eye, np.array([0, 0, 0.03])) for eye in eyes])
        Ks = np.tile(intrinsics(0.95 * WIDTH, WIDTH, HEIGHT), (cameras, 1, 1))
        self.cameras = Camera(*jax.device_put((np.float32(viewmats), np.float32(Ks))), WIDTH, HEIGHT)

    def at(self, t: int) -> Gaussians:
        """The scene at frame t."""
        means, quats = np.asarray(self.gaussians.means).copy(), np.asarray(self.gaussians.quats).copy()
        logits = np.asarray(self.gaussians.logit_opacities).copy()
        for k, box in enumerate(self.boxes, 1):
            motion, mine = box.motions()[t], self.bodies == k
            means[mine] = means[mine] @ motion[:3, :3].T + motion[:3, 3]
            quats[mine] = Rotation.from_matrix(motion[:3, :3]).as_quat(scalar_first=True)
            logits[mine] = -30.0 if t in box.gone else logits[mine]
        there = jax.device_put((means, quats, logits))
        return eqx.tree_at(lambda g: (g.means, g.quats, g.logit_opacities), self.gaussians, there)

    @cached_property
    def _plan(self):
        plans = [plan_render(self.at(t), self.cameras) for t in (0, self.num_frames - 1)]
        return max(plans, key=lambda plan: plan.capacity).grown(0, 2.0)

    @cached_property
    def _frames(self) -> list[Frame]:
        plan = self._plan
        draw = jax.jit(lambda g: render(g, self.cameras, plan))
        drawn = [draw(self.at(t)) for t in range(self.num_frames)]
        assert not any(bool(d.meta.overflow.any()) for d in drawn)
        images = [np.round(np.clip(d.colors, 0, 1) * 255) / np.float32(255) for d in drawn]
        return [Frame(jax.device_put(image), None, self.cameras) for image in images]

    def frame(self, t: int) -> Frame:
        return self._frames[t]

    def image(self, t: int, c: int) -> np.ndarray:
        return np.round(255 * np.asarray(self._frames[t].images[c])).astype(np.uint8)

    def masks(self, pieces: np.ndarray) -> np.ndarray:
        """[C, H, W]: the piece that each pixel of the canonical frame shows.

        Args:
            pieces: the piece of each Gaussian.
        """
        one_hot = jax.device_put(np.eye(int(pieces.max()) + 1, dtype=np.float32)[pieces])
        drawn = render(self.gaussians, self.cameras, self._plan, features=one_hot)
        return np.asarray(drawn.features).argmax(-1).astype(np.int32)


def linear(frames: int, end: Sequence[float], begin: int = 0) -> np.ndarray:
    """[T, 3]: constant speed from 0 at frame `begin` to `end` at the last frame."""
    share = np.clip((np.arange(frames) - begin) / max(frames - 1 - begin, 1), 0, None)
    return share[:, None] * np.array(end, float)
