"""Faults of recordings, applied to sound ones."""

from dataclasses import replace

import numpy as np

from gsjax.data import Sequence


def noisy_depth(sequence: Sequence, times: float) -> Sequence:
    """Depth as a structured-light camera measures it, its errors `times` as large.

    Disparity in steps of 1/8 pixel (focal length 580 pixels, baseline 75 mm), noise of a third of a step, no
    depth within 2 pixels of an edge of 3 cm, and none at 2 % of the pixels.
    Source: Khoshelham, Elberink, Accuracy and resolution of Kinect depth data, 2012.
    """
    step = times / (8 * 580 * 0.075)  # of inverse depth, 1/metres

    def load(t: int, c: int) -> np.ndarray:
        depth = np.asarray(sequence.load_depth(t, c), np.float64)
        rng = np.random.default_rng([t, c])
        inverse = 1 / np.maximum(depth, 1e-3) + rng.normal(0, step / 3, depth.shape)
        measured = 1 / np.maximum(step * np.round(inverse / step), 1e-3)
        near, far = depth.copy(), depth.copy()
        for dy in range(-2, 3):
            for dx in range(-2, 3):
                shifted = np.roll(depth, (dy, dx), axis=(0, 1))
                near, far = np.minimum(near, shifted), np.maximum(far, shifted)
        holes = (far - near > 0.03) | (rng.uniform(size=depth.shape) < 0.02) | (depth <= 0)
        return np.where(holes, 0.0, measured).astype(np.float32)

    return replace(sequence, load_depth=load)


def without_cameras(sequence: Sequence, lost: tuple[int, ...], frames: range) -> Sequence:
    """Some cameras deliver black pictures and no depth during `frames`."""

    def image(t: int, c: int) -> np.ndarray:
        picture = sequence.load_image(t, c)
        return np.zeros_like(picture) if c in lost and t in frames else picture

    def depth(t: int, c: int) -> np.ndarray:
        measured = sequence.load_depth(t, c)
        return np.zeros_like(measured) if c in lost and t in frames else measured

    def mask(t: int, c: int) -> np.ndarray:  # objects that only a dead camera would show are unseen
        labels = sequence.load_mask(t, c)
        return np.zeros_like(labels) if c in lost and t in frames else labels

    return replace(sequence, load_image=image, load_depth=depth, load_mask=mask)


def without_frames(sequence: Sequence, lost: set[int]) -> Sequence:
    """Some frames never arrive."""
    return sequence.select([t for t in range(sequence.num_frames) if t not in lost])
