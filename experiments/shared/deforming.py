"""What experiments with deforming scenes share: training frames, held-out frames, scores against the
truth."""

from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

import gsjax
from experiments.shared.recordings import recorded
from experiments.shared.timing import run_through
from gsjax.data import Sequence
from gsjax.data.files import read_arrays
from gsjax.engine.deform.data import unit_times
from gsjax.engine.deform.scores import Drawn, draw
from gsjax.engine.drive import drive
from gsjax.geometry.cameras import NEAR, Camera, PointPixels, pixels_of
from gsjax.methods.deform import Deform, DeformConfig, Lesson, Problem
from gsjax.methods.deform.method import PLAN
from gsjax.metrics.image import psnr, ssim
from gsjax.metrics.tracking import carried_points
from gsjax.optim.method import Run
from gsjax.scene.frame import Frame

EVERY = 8  # frame i is held out if (i - 1) mod 8 is 0, as for EndoNeRF
TOOL = 1
NEAR_TOOL_PX = 20
_SEEN_WITHIN_M = 1e-3


@dataclass(frozen=True, eq=False)
class Dataset:
    """A recording with its frames split into training and held-out ones.

    Attributes:
        sequence: camera 0 is the left eye, camera 1 the right one.
        train: indices of the training frames.
        test: indices of the held-out frames.
        truth: arrays of the simulation.
    """

    sequence: Sequence
    train: list[int]
    test: list[int]
    truth: dict[str, np.ndarray]

    def classes(self, t: int) -> np.ndarray:
        """True classes of the left eye's pixels: rows of a codebook of background and tissue, -1 at the
        tool."""
        seg = self.truth["seg"][t].astype(np.int32)
        return np.where(seg < 2, seg, -1)

    def frame(self, t: int, camera: int = 0, tools: bool = False) -> Frame:
        """The frame of one camera; pixels of tools are masked out unless `tools` is set."""
        s = self.sequence
        mask = None if tools else s.mask(t, camera) != TOOL
        pose, time = (s.viewmats[t, camera], s.Ks[t, camera]), float(unit_times(s)[t])
        return one_frame(s.image(t, camera), *pose, time, s.depth(t, camera), mask)


def one_frame(
    image: np.ndarray,
    viewmat: np.ndarray,
    K: np.ndarray,
    time: float,
    depth: np.ndarray | None = None,
    mask: np.ndarray | None = None,
    near: float = NEAR,
) -> Frame:
    """The frame of one camera at a time from 0 to 1, on the host."""
    height, width = image.shape[:2]
    depths, masks = (None if pixels is None else pixels[None] for pixels in (depth, mask))
    camera = Camera(viewmat[None], K[None], width, height, near)
    return Frame(image[None], depths, camera, masks, np.asarray(time))


def split(num_frames: int) -> tuple[list[int], list[int]]:
    """Indices of the training frames, and of the held-out ones."""
    test = [i for i in range(num_frames) if (i - 1) % EVERY == 0]
    return [i for i in range(num_frames) if i not in test], test


def dataset(name: str = "tissue_0", scale: float = 1.0) -> Dataset:
    """A recording by its name, its pictures scaled down to a fraction of their width and height."""
    sequence = gsjax.open_sequence(recorded(name)).scaled(scale)
    return Dataset(sequence, *split(sequence.num_frames), read_arrays(recorded(name) / "truth.npz"))


@dataclass(frozen=True, eq=False)
class Reconstructed:
    """A reconstructed deforming scene, with the seconds of its steps and of compiling."""

    config: DeformConfig
    problem: Problem
    run: Run
    seconds: float
    compile_seconds: float


def learned(
    frames: list[Frame], config: DeformConfig, lesson: Lesson | None = None, first: int | None = None
) -> Reconstructed:
    """A scene reconstructed from these frames, starting at the frame `first`; no step may be skipped."""
    method = Deform(config)
    problem, run = method.start(frames, lesson, first=first)
    ticks = drive(method, problem, run)
    seconds, compiling = run_through(ticks)
    return Reconstructed(config, problem, ticks.run, seconds, compiling)


def seen_as(found: Reconstructed, frame: Frame) -> Drawn:
    """The scene rendered at the pose and time of a frame."""
    return draw(found.run.params, found.run.kept.moving, frame, found.run.plans[PLAN])


def drawn(found: Reconstructed, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Colours and depth of the scene at the pose and time of a frame."""
    got = seen_as(found, frame)
    return got.colors, got.depths


def frames_per_second(found: Reconstructed, frame: Frame, repeats: int = 20) -> float:
    """Frames a second of deforming the scene, rendering it and copying it to the host: the median over
    times."""
    took = []
    for i in range(repeats + 2):
        begun = perf_counter()
        drawn(found, replace(frame, time=np.asarray(i / (repeats + 2))))
        took.append(perf_counter() - begun)
    return 1 / float(np.median(took[2:]))


def scores(found: Reconstructed, data: Dataset) -> dict[str, float]:
    """Scores of the held-out frames within their masks: PSNR, SSIM, depth, PSNR near the tool and of the
    right eye.

    Means over frames; `psnr_pooled` is computed from the mean squared error of all their pixels, in which the
    worst frame counts most.
    """
    rows = []
    for t in data.test:
        frame = data.frame(t)
        colors, depths = drawn(found, frame)
        true, counts, depth = frame.images[0] / 255.0, frame.masks[0], frame.depths[0]
        known = counts & (depth > 0)
        row = {
            "psnr": psnr(colors, true, counts),
            "mse": _mse(colors, true, counts),
            "ssim": ssim(colors, true, counts),
            "depth_mm": 1e3 * float(np.abs(depths - depth)[known].mean()),
            "psnr_near_tool": psnr(colors, true, counts & near_tool(frame)),
        }
        if data.sequence.num_cameras > 1:
            right = data.frame(t, camera=1)
            row["psnr_right"] = psnr(drawn(found, right)[0], right.images[0] / 255.0, right.masks[0])
        rows.append(row)
    means = {name: float(np.nanmean([row[name] for row in rows])) for name in rows[0]}
    return means | {"psnr_pooled": -10 * np.log10(means.pop("mse"))}


def _mse(image: np.ndarray, true: np.ndarray, counts: np.ndarray) -> float:
    return float(np.square(image - true)[counts].mean())


def near_tool(frame: Frame) -> Bool[np.ndarray, "h w"]:
    """Pixels within `NEAR_TOOL_PX` of the tool."""
    from scipy.ndimage import distance_transform_edt

    return distance_transform_edt(frame.masks[0]) <= NEAR_TOOL_PX


def copies_of(sequence: Sequence, t: int) -> dict[str, Float[np.ndarray, "h w 3"]]:
    """A frame of the first camera guessed as copies of others: the frame before, the mean of both neighbours,
    and the first frame."""

    def image(t):
        return sequence.image(min(max(t, 0), sequence.num_frames - 1), 0) / 255.0

    return {"previous": image(t - 1), "neighbors": (image(t - 1) + image(t + 1)) / 2, "first": image(0)}


def copies(data: Dataset) -> dict[str, float]:
    """PSNR of copies of other frames within the masks of the held-out ones: means, and pooled as in
    `scores`."""
    errors: dict[str, list[float]] = {}
    for t in data.test:
        true, counts = data.sequence.image(t, 0) / 255.0, data.frame(t).masks[0]
        for name, guess in copies_of(data.sequence, t).items():
            errors.setdefault(name, []).append(_mse(guess, true, counts))
    found = {}
    for name, each in errors.items():
        found[f"psnr_{name}"] = float(np.mean(-10 * np.log10(each)))
        found[f"pooled_{name}"] = float(-10 * np.log10(np.mean(each)))
    return found


def track_errors(found: Reconstructed, data: Dataset) -> dict[str, float]:
    """Errors of the tracks of vertices that frame 0 shows, each moved by the displacement of the four
    Gaussians nearest to it in frame 0; and the errors if nothing moved. Millimetres."""
    tracks, frames = data.sequence.truth.tracks, data.sequence.num_frames
    seen = _seen(tracks[0], data.frame(0))
    start = tracks[0][seen]
    at = jax.jit(lambda scene, moving, time: scene.at(time, moving).means)
    scene, moving = found.run.params, found.run.kept.moving
    times = jnp.asarray(unit_times(data.sequence), jnp.float32)
    means = [np.asarray(at(scene, moving, time)) for time in times]
    carried = carried_points(start, np.stack(means))
    errors, still, close = [], [], []
    for t in range(1, frames):
        true = tracks[t][seen]
        errors.append(1e3 * np.linalg.norm(carried[t] - true, axis=1))
        still.append(1e3 * np.linalg.norm(start - true, axis=1))
        close.append(_near_tool_at(true, data, t))
    errors, still, close = (np.stack(a) for a in (errors, still, close))
    return {
        "track_median_mm": float(np.median(errors)),
        "track_p95_mm": float(np.quantile(errors, 0.95)),
        "track_near_tool_mm": float(np.median(errors[close])) if close.any() else np.nan,
        "still_median_mm": float(np.median(still)),
        "still_p95_mm": float(np.quantile(still, 0.95)),
    }


def lifted(
    depth: Float[np.ndarray, "h w"], which: Bool[np.ndarray, "h w"], viewmat: np.ndarray, K: np.ndarray
) -> Float[np.ndarray, "n 3"]:
    """World points of the chosen pixels of a depth image."""
    rows, columns = np.nonzero(which)
    rays = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=1) @ np.linalg.inv(K).T
    return (rays * depth[rows, columns, None] - viewmat[:3, 3]) @ viewmat[:3, :3]


def pixels_in(points: Float[np.ndarray, "n 3"], frame: Frame) -> PointPixels:
    """The pixels onto which points project in a frame."""
    camera = frame.cameras
    return pixels_of(points, camera.viewmat[0], camera.K[0], camera.width, camera.height)


def _seen(points: Float[np.ndarray, "n 3"], frame: Frame) -> Bool[np.ndarray, "n"]:
    """Which points are visible in a frame, by its depth and mask."""
    x, y, depth, inside = pixels_in(points, frame)
    return inside & frame.masks[0][y, x] & (np.abs(frame.depths[0][y, x] - depth) < _SEEN_WITHIN_M)


def _near_tool_at(points: Float[np.ndarray, "n 3"], data: Dataset, t: int) -> Bool[np.ndarray, "n"]:
    frame = data.frame(t)
    at = pixels_in(points, frame)
    return at.inside & near_tool(frame)[at.rows, at.columns]


def summary(found: Reconstructed) -> dict[str, Any]:
    """Size of the scene and time that it took."""
    return {
        "gaussians": found.run.params.gaussians.num,
        "minutes": (found.seconds + found.compile_seconds) / 60,
        "step_ms": 1e3 * found.seconds / max(1, found.config.warmup + found.config.iterations),
    }
