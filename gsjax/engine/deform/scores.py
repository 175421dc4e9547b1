"""Scores of a deforming scene: held-out frames and their neighbours in time, views of another camera,
classes, and tracks if the ground truth has any."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from time import perf_counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.engine.budget import Budget
from gsjax.engine.deform.data import DeformData, Tools
from gsjax.engine.folder import RunFolder
from gsjax.engine.machine import peak_memory_mb
from gsjax.engine.pictures import PANELS
from gsjax.engine.scores import mean_scores
from gsjax.geometry.cameras import Camera, on_device, pixels_of
from gsjax.io.pictures import write_png
from gsjax.methods.deform import (
    DeformingScene,
    DeformResult,
    Moving,
    counted_ids,
    on_grid,
    prompt_probabilities,
)
from gsjax.methods.deform.query import most_likely
from gsjax.metrics.features import feature_psnr
from gsjax.metrics.image import MS_SSIM_LEAST_SIDE, ms_ssim, psnr, ssim
from gsjax.metrics.segmentation import IGNORED_LABEL, LabelOverlap
from gsjax.metrics.temporal import temporal_scores
from gsjax.metrics.tracking import carried_points
from gsjax.perception.optical_flow import DisFlow
from gsjax.rasterize.plan import Plan, with_room
from gsjax.rasterize.rasterization import Meta
from gsjax.scene.frame import Frame
from gsjax.scene.render import render
from gsjax.viz.colors import in_rows, overlay_labels, to_uint8

OVER_TIME = ("t_ssim", "flow_warp_error", "warped_ssim")
"""Scores of a frame and its neighbour, named as in `temporal_scores`. For each there are also NAME_true, the
score of the recording, and NAME_gap, the absolute difference of the two."""
_OF_FRAMES = ("psnr_masked", "ssim", "depth_mm", "psnr_other", "ms_ssim", "f_psnr", "flow_warp_share")
_OF_FRAMES += tuple(f"{name}{end}" for name in OVER_TIME for end in ("", "_true", "_gap"))
_SHOWN = 8  # frames in the report
_PANEL_HEIGHT = 200  # pixels, at least
_TIMED = 12  # frames rendered to measure the frame rate
_SEEN_WITHIN = 0.01  # of the depth: a tracked point this close to the depth map is visible
_LEAST_SIDE = 11  # of SSIM's window
_LEAST_LONGER_SIDE = 12  # of DIS's patches


def judge(
    folder: RunFolder,
    result: DeformResult,
    plan: Plan,
    data: DeformData,
    tools: Tools,
    budget: Budget | None = None,
) -> dict[str, Any]:
    """Computes the scores of held-out frames, or of some training frames if none is held out, and writes
    pictures of them.

    Args:
        folder: of the run.
        result: the scene.
        plan: the plan that frames were rendered with.
        data: the data that it was learned from, with refined poses.
        tools: whether tools count.
        budget: the time that is left; if it does not allow all frames, some of them are scored.
    """
    memory = peak_memory_mb()  # of training, before anything is scored
    scene, moving, background = result.scene, result.moving, data.sequence.background
    drawn_at = partial(draw, scene, moving, plan=plan, background=background)
    which = data.test or data.train[:: max(1, len(data.train) // _SHOWN)][:_SHOWN]
    rows: list[dict[str, Any]] = []
    overlap = LabelOverlap()
    for t in which if budget is None else budget.affordable(which):
        frame = data.frame(t, 0, tools)
        drawn = drawn_at(frame)
        number = data.sequence.frame_ids[t]
        path = folder.path / "test" / f"{number:06d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, to_uint8(drawn.colors))
        row = {"frame": number, **_of_frame(drawn, frame), **_of_classes(drawn, frame, data, t, overlap)}
        neighbor = t + 1 if t + 1 < data.sequence.num_frames else t - 1
        if neighbor >= 0 and data.sequence.splits is None:  # frames of a split are seldom consecutive
            beside = data.frame(neighbor, 0, tools)
            pair = [(drawn.colors, frame), (drawn_at(beside).colors, beside)]
            row |= over_time(pair if neighbor > t else pair[::-1])
        if _other_counts(data, t, tools):
            other = data.frame(t, 1, tools)
            there = drawn_at(other).colors
            row["psnr_other"] = psnr(there, _photograph(other), _counted(other))
        if len(rows) < _SHOWN:
            panels = folder.render("held_out" if data.test else "learned", number)
            write_png(panels, _panels(drawn, frame, data))
            row["picture"] = str(panels.relative_to(folder.path))
        rows.append(row)
    test = mean_scores(rows, _OF_FRAMES)
    test |= _means_of_classes(overlap, len(data.names))
    return {
        "judged_by": "held out" if data.test else "learned",
        "test": test | {"fps": _fps(drawn_at, data.frame(0, 0, tools))},
        "tracks": track_errors(scene, moving, data, tools),
        "classes": _classes(overlap, data.names),
        "memory_mb": memory,
        "scores": rows,
    }


def _other_counts(data: DeformData, t: int, tools: Tools) -> bool:
    """Whether frame t can be scored in another camera. If tools are left out, this needs a mask, because the
    camera's pictures show the tools."""
    seen = data.sequence
    if seen.num_cameras < 2:
        return False
    return tools == "draw" or not seen.has_masks or seen.mask(t, 1) is not None


class Drawn(NamedTuple):
    """A deforming scene rendered from the camera and at the time of a frame.

    Attributes:
        colors: 0 to 1, on the host.
        depths: metres, on the host.
        features: on the device; None if the scene has none.
    """

    colors: Float[np.ndarray, "h w 3"]
    depths: Float[np.ndarray, "h w"]
    features: Float[Array, "h w c"] | None


def draw(
    scene: DeformingScene,
    moving: Moving,
    frame: Frame,
    plan: Plan,
    background: tuple[float, float, float] | None = None,
) -> Drawn:
    """Renders the scene from the camera and at the time of a frame. Views other than the training views may
    need a larger plan, and get it.

    Args:
        scene, moving: the scene, and where its field is evaluated.
        frame: of one camera, on the host.
        plan: the plan that frames were rendered with.
        background: RGB behind the scene, 0 to 1 (default: black).
    """
    behind = None if background is None else jnp.array([background], jnp.float32)
    time = jnp.asarray(0.0 if frame.time is None else frame.time, jnp.float32)
    (colors, depths, features), _ = with_room(
        partial(_drawn, scene, moving, time, on_device(frame.cameras), behind), plan
    )
    return Drawn(np.asarray(colors), np.asarray(depths), features)


@jax.jit
def _drawn(
    scene: DeformingScene,
    moving: Moving,
    time: Float[Array, ""],
    camera: Camera,
    background: Float[Array, "1 3"] | None,
    plan: Plan,
) -> tuple[tuple[Float[Array, "h w 3"], Float[Array, "h w"], Float[Array, "h w c"] | None], Meta]:
    got = render(scene.at(time, moving), camera, plan, backgrounds=background)
    colors, features = jnp.clip(got.colors[0], 0, 1), None if got.features is None else got.features[0]
    return (colors, got.depths[0], features), got.meta._replace(features=None)


def _photograph(frame: Frame) -> Float[np.ndarray, "h w 3"]:
    """The picture of a frame of one camera, 0 to 1."""
    return np.asarray(frame.images[0]) / 255.0


def _counted(frame: Frame) -> Bool[np.ndarray, "h w"] | None:
    """The pixels of a frame of one camera that count; None if all do."""
    return None if frame.masks is None else np.asarray(frame.masks[0])


def _of_frame(drawn: Drawn, frame: Frame) -> dict[str, Any]:
    """Scores of the colours and depth of one frame."""
    true, counts = _photograph(frame), _counted(frame)
    least = min(true.shape[:2])
    row: dict[str, Any] = {"psnr_masked": psnr(drawn.colors, true, counts)}
    filled = _filled(drawn.colors, frame)
    row["ssim"] = ssim(filled, true, counts) if least >= _LEAST_SIDE else None
    row["ms_ssim"] = ms_ssim(filled, true, counts) if least >= MS_SSIM_LEAST_SIDE else None
    row["depth_mm"] = None
    if frame.depths is not None:
        depth = np.asarray(frame.depths[0])
        known = depth > 0 if counts is None else counts & (depth > 0)
        if known.any():
            row["depth_mm"] = 1e3 * float(np.abs(drawn.depths - depth)[known].mean())
    return row


def _filled(colors: np.ndarray, frame: Frame) -> Float[np.ndarray, "h w 3"]:
    """The render where pixels count, and the photograph elsewhere, so that windows that reach there find no
    difference."""
    counts = _counted(frame)
    if counts is None:
        return np.asarray(colors, np.float64)
    return np.where(counts[..., None], colors, _photograph(frame))


def _of_classes(
    drawn: Drawn, frame: Frame, data: DeformData, t: int, overlap: LabelOverlap
) -> dict[str, Any]:
    """The f-PSNR of a frame, on the teacher's grid. Also adds the classes of the pixels that count, by the
    nearest code, and the teacher's to `overlap`."""
    labels = data.labels(t)
    if labels is None or data.meaning is None or drawn.features is None:
        return {"f_psnr": None}
    ids = counted_ids(labels.ids, _counted(frame))
    known, teacher = ids >= 0, jnp.asarray(labels.codes[np.maximum(ids, 0)], jnp.float32)
    features = on_grid(drawn.features, ids.shape)
    codebook = jnp.asarray(data.meaning.codebook, jnp.float32)
    named, true = (np.asarray(classes_of_pixels(one, codebook)) for one in (features, teacher))
    overlap.add(named, np.where(known, true, IGNORED_LABEL))
    return {"f_psnr": feature_psnr(np.asarray(features), np.asarray(teacher), known)}


@jax.jit
def classes_of_pixels(features: Float[Array, "h w c"], codebook: Float[Array, "k c"]) -> Int[Array, "h w"]:
    """The row of each pixel's nearest code; -1 where all are equally near, or nothing is drawn."""
    nearest = most_likely(prompt_probabilities(features, codebook))
    return jnp.where((features != 0).any(axis=-1), nearest, IGNORED_LABEL)


def _classes(overlap: LabelOverlap, names: Iterable[str]) -> list[dict[str, Any]]:
    """The name of each class, and the overlap of its rendered and its true pixels over all frames."""
    return [
        {"class": name, "iou": overlap.iou(row), "dice": overlap.dice(row), "f1": overlap.f1(row)}
        for row, name in enumerate(names)
    ]


def _means_of_classes(overlap: LabelOverlap, count: int) -> dict[str, float | None]:
    """Means over the classes that occurred, and the share of pixels with the right class; None if no class
    occurred."""
    names = ("iou", "dice", "f1")
    found = {name: overlap.mean(getattr(overlap, name), range(count)) for name in names}
    found["accuracy"] = overlap.accuracy
    return {name: None if np.isnan(value) else value for name, value in found.items()}


def over_time(pair: list[tuple[np.ndarray, Frame]]) -> dict[str, Any]:
    """The temporal consistency of two neighbouring frames, as rendered and as recorded; empty if pictures
    are smaller than the windows of the scores, or if only one of the frames has a mask.

    Held-out frames have no held-out neighbours, so each is paired with the next frame (the last frame of a
    recording with the one before it), usually a training frame. Pixels that do not count are taken from the
    photographs.

    Args:
        pair: rendered colours and the frame, of the earlier and of the later one.
    """
    sides = sorted(pair[0][1].images.shape[1:3])
    if sides[0] < _LEAST_SIDE or sides[1] < _LEAST_LONGER_SIDE:
        return {}
    if len({frame.masks is None for _, frame in pair}) > 1:  # what counts in the other is unknown
        return {}
    ours = np.stack([_filled(colors, frame) for colors, frame in pair])
    true = np.stack([_photograph(frame) for _, frame in pair])
    counts = [counts for _, frame in pair if (counts := _counted(frame)) is not None]
    masks = np.stack(counts) if counts else None
    found, wanted = (temporal_scores(video, masks=masks, optical_flow=DisFlow()) for video in (ours, true))
    row = {name: found[name] for name in (*OVER_TIME, "flow_warp_share")}
    for name in OVER_TIME:
        ours, wants = found[name], wanted[name]
        row[f"{name}_true"] = wants
        row[f"{name}_gap"] = None if ours is None or wants is None else abs(ours - wants)
    return row


def _panels(drawn: Drawn, frame: Frame, data: DeformData) -> np.ndarray:
    """The photograph, the render, their difference and, if the scene has features with a meaning, classes."""
    pictures = (to_uint8(frame.images[0]), to_uint8(drawn.colors), _difference(drawn.colors, frame))
    named = dict(zip(PANELS, pictures, strict=True))
    if data.meaning is not None and drawn.features is not None:
        labels = classes_of_pixels(drawn.features, jnp.asarray(data.meaning.codebook, jnp.float32))
        named["what is what"] = overlay_labels(drawn.colors, 1 + np.asarray(labels))
    return in_rows(named, 2 if len(named) == 4 else 3, _PANEL_HEIGHT)


def _difference(colors: np.ndarray, frame: Frame) -> np.ndarray:
    """Five times the absolute difference; grey where pixels do not count."""
    off, counts = 5 * np.abs(colors - _photograph(frame)), _counted(frame)
    return to_uint8(np.clip(off if counts is None else np.where(counts[..., None], off, 0.25), 0, 1))


def _fps(drawn_at: Callable[[Frame], Drawn], frame: Frame) -> float:
    """The median rate, per second, at which the scene is deformed and rendered."""
    took = []
    for i in range(_TIMED):
        begun = perf_counter()
        drawn_at(replace(frame, time=np.asarray(i / _TIMED)))
        took.append(perf_counter() - begun)
    return 1 / float(np.median(took[2:]))


def track_errors(
    scene: DeformingScene, moving: Moving, data: DeformData, tools: Tools
) -> dict[str, float] | None:
    """Distances of the points that the first frame sees from their true positions, over all later frames, and
    the same if nothing moved; None without ground truth.

    Args:
        scene, moving: the scene, and where its field is evaluated.
        data: the recording.
        tools: whether points on tools count.
    """
    truth, count = data.sequence.truth, data.sequence.num_frames
    if truth is None or truth.tracks is None or count < 2:
        return None
    seen = _visible(truth.tracks[0], data.frame(0, 0, tools))
    start = truth.tracks[0][seen]
    if not len(start):
        return None
    at = jax.jit(lambda scene, moving, time: scene.at(time, moving).means)
    times = jnp.asarray(data.times, jnp.float32)
    means = [np.asarray(at(scene, moving, time)) for time in times]
    true = truth.tracks[:, seen]
    errors = 1e3 * np.linalg.norm(carried_points(start, np.stack(means)) - true, axis=-1)[1:]
    still = 1e3 * np.linalg.norm(start - true, axis=-1)[1:]
    return {
        "points": len(start),
        "median_mm": float(np.median(errors)),
        "p95_mm": float(np.quantile(errors, 0.95)),
        "still_median_mm": float(np.median(still)),
        "still_p95_mm": float(np.quantile(still, 0.95)),
    }


def _visible(points: Float[np.ndarray, "n 3"], frame: Frame) -> Bool[np.ndarray, "n"]:
    """Which points a frame sees, by its depth and mask."""
    camera = frame.cameras
    column, row, z, inside = pixels_of(points, camera.viewmat[0], camera.K[0], camera.width, camera.height)
    counted = _counted(frame)
    counts = inside if counted is None else inside & counted[row, column]
    if frame.depths is None:
        return counts
    depth = np.asarray(frame.depths[0])[row, column]
    return counts & (np.abs(depth - z) < _SEEN_WITHIN * depth)
