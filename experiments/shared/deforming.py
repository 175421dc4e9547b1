"""What experiments with deforming scenes share: frames to learn from, held-out ones, scores against truth."""

from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

import gsjax
from experiments.shared.recordings import recorded
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
    """A recording with its frames parted.

    Attributes:
        sequence: camera 0 is the left eye, camera 1 the right one.
        train: frames to learn from.
        test: frames that are held out.
        truth: arrays of the simulation.
    """

    sequence: Sequence
    train: list[int]
    test: list[int]
    truth: dict[str, np.ndarray]

    def classes(self, t: int) -> np.ndarray:
        """What the left eye sees of the simulated scene, by its truth: rows of a codebook of background and
        tissue, -1 where there is the tool."""
        seg = self.truth["seg"][t].astype(np.int32)
        return np.where(seg < 2, seg, -1)

    def frame(self, t: int, camera: int = 0, tools: bool = False) -> Frame:
        """What a camera saw in a frame; tools do not count unless wanted."""
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
    """What one camera saw at a time, 0 to 1, on the host."""
    height, width = image.shape[:2]
    depths, masks = (None if pixels is None else pixels[None] for pixels in (depth, mask))
    camera = Camera(viewmat[None], K[None], width, height, near)
    return Frame(image[None], depths, camera, masks, np.asarray(time))


def dataset(name: str = "tissue_0", scale: float = 1.0) -> Dataset:
    """A recording by its name, in pictures of a fraction of their width and height."""
    sequence = gsjax.open_sequence(recorded(name)).scaled(scale)
    test = [i for i in range(sequence.num_frames) if (i - 1) % EVERY == 0]
    train = [i for i in range(sequence.num_frames) if i not in test]
    return Dataset(sequence, train, test, read_arrays(recorded(name) / "truth.npz"))


@dataclass(frozen=True, eq=False)
class Reconstructed:
    """A deforming scene that was learned, and what that took."""

    config: DeformConfig
    problem: Problem
    run: Run
    seconds: float
    compile_seconds: float


def learned(
    frames: list[Frame], config: DeformConfig, lesson: Lesson | None = None, first: int | None = None
) -> Reconstructed:
    """A scene of these frames, that begins with one of them; no step may be skipped."""
    method = Deform(config)
    problem, run = method.start(frames, lesson, first=first)
    ticks = drive(method, problem, run)
    seconds = compiling = skipped = 0.0
    for now in ticks:
        seconds, compiling = seconds + now.seconds, compiling + now.compile_seconds
        skipped += float(now.info["skipped"])
    assert not skipped, f"{skipped:.0f} steps were skipped"
    return Reconstructed(config, problem, ticks.run, seconds, compiling)


def seen_as(found: Reconstructed, frame: Frame) -> Drawn:
    """The scene where and when a frame was seen."""
    return draw(found.run.params, found.run.kept.moving, frame, found.run.plans[PLAN])


def drawn(found: Reconstructed, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Colours and depth of the scene where and when a frame was seen."""
    got = seen_as(found, frame)
    return got.colors, got.depths


def frames_per_second(found: Reconstructed, frame: Frame, repeats: int = 20) -> float:
    """How often a second the scene is deformed, drawn and brought to the host, over times; the median."""
    took = []
    for i in range(repeats + 2):
        begun = perf_counter()
        drawn(found, replace(frame, time=np.asarray(i / (repeats + 2))))
        took.append(perf_counter() - begun)
    return 1 / float(np.median(took[2:]))


def scores(found: Reconstructed, data: Dataset) -> dict[str, float]:
    """Of held-out frames, under the masks: PSNR, SSIM, depth, PSNR around the tool, and of the right eye.

    Means over frames; `psnr_pooled` is that of the mean squared error of all their pixels, in which the worst
    frame counts most.
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
    """Pixels within some of the tool."""
    from scipy.ndimage import distance_transform_edt

    return distance_transform_edt(frame.masks[0]) <= NEAR_TOOL_PX


def copies(data: Dataset) -> dict[str, float]:
    """PSNR of held-out frames as copies of others, under the same masks: means, and pooled as in `scores`."""
    s = data.sequence

    def of(name, guess):
        each = [_mse(guess(t), s.image(t, 0) / 255.0, data.frame(t).masks[0]) for t in data.test]
        mean, pooled = float(np.mean(-10 * np.log10(each))), float(-10 * np.log10(np.mean(each)))
        return {f"psnr_{name}": mean, f"pooled_{name}": pooled}

    def image(t):
        return s.image(min(max(t, 0), s.num_frames - 1), 0) / 255.0

    return (
        of("previous", lambda t: image(t - 1))
        | of("neighbors", lambda t: (image(t - 1) + image(t + 1)) / 2)
        | of("first", lambda t: image(0))
    )


def track_errors(found: Reconstructed, data: Dataset) -> dict[str, float]:
    """How far vertices that frame 0 sees are from where they truly are, each carried by the displacement of
    the four Gaussians nearest to it in frame 0; and how far if nothing moved. Millimetres."""
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


def _pixels(points: Float[np.ndarray, "n 3"], frame: Frame) -> PointPixels:
    """Where points fall in a frame."""
    camera = frame.cameras
    return pixels_of(points, camera.viewmat[0], camera.K[0], camera.width, camera.height)


def _seen(points: Float[np.ndarray, "n 3"], frame: Frame) -> Bool[np.ndarray, "n"]:
    """Which points a frame sees, by its depth and mask."""
    x, y, depth, inside = _pixels(points, frame)
    return inside & frame.masks[0][y, x] & (np.abs(frame.depths[0][y, x] - depth) < _SEEN_WITHIN_M)


def _near_tool_at(points: Float[np.ndarray, "n 3"], data: Dataset, t: int) -> Bool[np.ndarray, "n"]:
    frame = data.frame(t)
    at = _pixels(points, frame)
    return at.inside & near_tool(frame)[at.rows, at.columns]


def summary(found: Reconstructed) -> dict[str, Any]:
    """What it took."""
    return {
        "gaussians": found.run.params.gaussians.num,
        "minutes": (found.seconds + found.compile_seconds) / 60,
        "step_ms": 1e3 * found.seconds / max(1, found.config.warmup + found.config.iterations),
    }
