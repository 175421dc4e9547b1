"""Scores of a deforming scene: held-out frames and their neighbours in time, the other eye, what is what in
them, and tracks where truth has them."""

from collections.abc import Iterable
from time import perf_counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.engine.deform.data import DeformData, Tools
from gsjax.engine.folder import RunFolder
from gsjax.engine.machine import peak_memory_mb
from gsjax.engine.pictures import PANELS
from gsjax.engine.scores import mean_scores
from gsjax.geometry.cameras import Camera, pixels_of
from gsjax.io.pictures import write_png
from gsjax.methods.deform import (
    DeformingScene,
    DeformProblem,
    DeformState,
    Look,
    Moving,
    counted_ids,
    on_grid,
)
from gsjax.methods.deform.query import prompt_probabilities
from gsjax.metrics.features import feature_psnr
from gsjax.metrics.image import MS_SSIM_LEAST_SIDE, ms_ssim, psnr, ssim
from gsjax.metrics.segmentation import IGNORED_LABEL, LabelOverlap
from gsjax.metrics.temporal import temporal_scores
from gsjax.metrics.tracking import carried_points
from gsjax.perception.optical_flow import DisFlow
from gsjax.rasterize.plan import Plan
from gsjax.scene.render import render
from gsjax.viz.colors import in_rows, overlay_labels, to_uint8

OVER_TIME = ("t_ssim", "flow_warp_error", "warped_ssim")
"""Scores of a frame and its neighbour, as `temporal_scores` names them; beside each stand NAME_true, that of
the recording, and NAME_gap, how far apart the two are."""
_OF_FRAMES = ("psnr_masked", "ssim", "depth_mm", "psnr_other", "ms_ssim", "f_psnr", "flow_warp_share")
_OF_FRAMES += tuple(f"{name}{end}" for name in OVER_TIME for end in ("", "_true", "_gap"))
_SHOWN = 8  # frames in the report
_PANEL_HEIGHT = 200  # pixels, at least
_TIMED = 12  # frames drawn to say how many a second
_SEEN_WITHIN = 0.01  # of the depth: how far from what a pixel sees a tracked point may lie
_HEADROOM = 1.3
_LEAST_SIDE = 11  # of SSIM's window
_LEAST_LONGER_SIDE = 12  # of DIS's patches


def judge(
    folder: RunFolder, problem: DeformProblem, state: DeformState, data: DeformData, tools: Tools
) -> dict[str, Any]:
    """Scores of held-out frames, or of some that were learned from where none is, and pictures of them."""
    memory = peak_memory_mb()  # of learning, before anything is scored
    plan, scene, moving = problem.plan_for(state), state.scene, state.moving
    which = data.test or data.train[:: max(1, len(data.train) // _SHOWN)][:_SHOWN]
    rows: list[dict[str, Any]] = []
    overlap = LabelOverlap()
    for t in which:
        look = data.look(t, 0, tools)
        drawn = draw(scene, moving, look, plan)
        number = data.sequence.frame_ids[t]
        path = folder.path / "test" / f"{number:06d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, to_uint8(drawn.colors))
        row = {"frame": number, **_of_frame(drawn, look), **_of_classes(drawn, look, data, t, overlap)}
        neighbor = t + 1 if t + 1 < data.sequence.num_frames else t - 1
        if neighbor >= 0:
            beside = data.look(neighbor, 0, tools)
            pair = [(drawn.colors, look), (draw(scene, moving, beside, plan).colors, beside)]
            row |= over_time(pair if neighbor > t else pair[::-1])
        if _other_counts(data, t, tools):
            other = data.look(t, 1, tools)
            there = draw(scene, moving, other, plan).colors
            row["psnr_other"] = psnr(there, other.image / 255.0, other.counts)
        if len(rows) < _SHOWN:
            panels = folder.render("held_out" if data.test else "learned", number)
            write_png(panels, _panels(drawn, look, data))
            row["picture"] = str(panels.relative_to(folder.path))
        rows.append(row)
    test = mean_scores(rows, _OF_FRAMES)
    test |= _means_of_classes(overlap, len(data.names))
    return {
        "judged_by": "held out" if data.test else "learned",
        "test": test | {"fps": _fps(scene, moving, data.look(0, 0, tools), plan)},
        "tracks": _tracks(scene, moving, data, tools),
        "classes": _classes(overlap, data.names),
        "memory_mb": memory,
        "scores": rows,
    }


def _other_counts(data: DeformData, t: int, tools: Tools) -> bool:
    """Whether another camera can judge: one without masks shows tools that were left out."""
    seen = data.sequence
    if seen.num_cameras < 2:
        return False
    return tools == "draw" or not seen.has_masks or seen.mask(t, 1) is not None


class Drawn(NamedTuple):
    """A deforming scene where and when a look was.

    Attributes:
        colors: 0 to 1, on the host.
        depths: metres, on the host.
        features: on the device; None of a scene without.
    """

    colors: Float[np.ndarray, "h w 3"]
    depths: Float[np.ndarray, "h w"]
    features: Float[Array, "h w c"] | None


def draw(scene: DeformingScene, moving: Moving, look: Look, plan: Plan) -> Drawn:
    """The scene where and when a look was."""
    height, width = look.image.shape[:2]
    viewmat, K = (jnp.asarray(a, jnp.float32)[None] for a in (look.viewmat, look.K))
    camera = Camera(viewmat, K, width, height, look.near)
    while True:
        time = jnp.asarray(look.time, jnp.float32)
        colors, depths, features, overflow, needed = _drawn(scene, moving, time, camera, plan)
        if not bool(overflow):  # views that nothing learned from may need a larger plan
            return Drawn(np.asarray(colors), np.asarray(depths), features)
        plan = plan.grown(int(needed), _HEADROOM)


@jax.jit
def _drawn(scene: DeformingScene, moving: Moving, time, camera: Camera, plan: Plan):
    got = render(scene.at(time, moving), camera, plan)
    colors, features = jnp.clip(got.colors[0], 0, 1), None if got.features is None else got.features[0]
    return colors, got.depths[0], features, got.meta.overflow.any(), got.meta.needed.max()


def _of_frame(drawn: Drawn, look: Look) -> dict[str, Any]:
    """Scores of the colours and depth of one frame."""
    true, least = look.image / 255.0, min(look.image.shape[:2])
    row: dict[str, Any] = {"psnr_masked": psnr(drawn.colors, true, look.counts)}
    row["ssim"] = ssim(drawn.colors, true, look.counts) if least >= _LEAST_SIDE else None
    row["ms_ssim"] = None
    if least >= MS_SSIM_LEAST_SIDE:
        row["ms_ssim"] = ms_ssim(_filled(drawn.colors, look), true, look.counts)
    row["depth_mm"] = None
    if look.depth is not None:
        known = look.depth > 0 if look.counts is None else look.counts & (look.depth > 0)
        if known.any():
            row["depth_mm"] = 1e3 * float(np.abs(drawn.depths - look.depth)[known].mean())
    return row


def _filled(colors: np.ndarray, look: Look) -> Float[np.ndarray, "h w 3"]:
    """What is drawn where it counts, and the photograph elsewhere: windows that reach there find nothing."""
    if look.counts is None:
        return np.asarray(colors, np.float64)
    return np.where(look.counts[..., None], colors, look.image / 255.0)


def _of_classes(drawn: Drawn, look: Look, data: DeformData, t: int, overlap: LabelOverlap) -> dict[str, Any]:
    """f-PSNR of a frame, on the teacher's grid; what its pixels that count are, by the nearest code, is added
    to `overlap`, against what the teacher's are."""
    said = data.said(t)
    if said is None or data.meaning is None or drawn.features is None:
        return {"f_psnr": None}
    ids = counted_ids(look._replace(ids=said.ids))
    known, teacher = ids >= 0, jnp.asarray(said.codes[np.maximum(ids, 0)], jnp.float32)
    features = on_grid(drawn.features, ids.shape)
    codebook = jnp.asarray(data.meaning.codebook, jnp.float32)
    named, true = (np.asarray(classes_of_pixels(one, codebook)) for one in (features, teacher))
    overlap.add(named, np.where(known, true, IGNORED_LABEL))
    return {"f_psnr": feature_psnr(np.asarray(features), np.asarray(teacher), known)}


@jax.jit
def classes_of_pixels(features: Float[Array, "h w c"], codebook: Float[Array, "k c"]) -> Int[Array, "h w"]:
    """The row whose code is the nearest; -1 where all are as near, as where nothing is drawn."""
    said = prompt_probabilities(features, codebook)
    return jnp.where(said.max(axis=-1) > said.min(axis=-1), said.argmax(axis=-1), IGNORED_LABEL)


def _classes(overlap: LabelOverlap, names: Iterable[str]) -> list[dict[str, Any]]:
    """Of each class: its name, and how far what is drawn and what was seen of it overlap, over all frames."""
    return [
        {"class": name, "iou": overlap.iou(row), "dice": overlap.dice(row), "f1": overlap.f1(row)}
        for row, name in enumerate(names)
    ]


def _means_of_classes(overlap: LabelOverlap, count: int) -> dict[str, float | None]:
    """Means over classes that occurred, and the share of pixels that are named right; None without any."""
    names = ("iou", "dice", "f1")
    found = {name: overlap.mean(getattr(overlap, name), range(count)) for name in names}
    found["accuracy"] = overlap.accuracy
    return {name: None if np.isnan(value) else value for name, value in found.items()}


def over_time(pair: list[tuple[np.ndarray, Look]]) -> dict[str, Any]:
    """How steady two neighbouring frames are, as they are drawn and as they were recorded; empty for pictures
    that are smaller than windows.

    Held-out frames stand alone, so each makes a pair with the frame after it (the last one of a recording
    with that before it), which as a rule was learned from. What does not count is as it was photographed.

    Args:
        pair: colours and look of the earlier frame and of the later one.
    """
    sides = sorted(pair[0][1].image.shape[:2])
    if sides[0] < _LEAST_SIDE or sides[1] < _LEAST_LONGER_SIDE:
        return {}
    ours = np.stack([_filled(colors, look) for colors, look in pair])
    true = np.stack([look.image / 255.0 for _, look in pair])
    counts = [look.counts for _, look in pair if look.counts is not None]
    masks = np.stack(counts) if counts else None
    found, wanted = (temporal_scores(video, masks=masks, optical_flow=DisFlow()) for video in (ours, true))
    row = {name: found[name] for name in (*OVER_TIME, "flow_warp_share")}
    for name in OVER_TIME:
        ours, wants = found[name], wanted[name]
        row[f"{name}_true"] = wants
        row[f"{name}_gap"] = None if ours is None or wants is None else abs(ours - wants)
    return row


def _panels(drawn: Drawn, look: Look, data: DeformData) -> np.ndarray:
    """What was seen, what is drawn, their difference, and, of a scene that knows it, what is what."""
    pictures = (to_uint8(look.image), to_uint8(drawn.colors), _difference(drawn.colors, look))
    named = dict(zip(PANELS, pictures, strict=True))
    if data.meaning is not None and drawn.features is not None:
        labels = classes_of_pixels(drawn.features, jnp.asarray(data.meaning.codebook, jnp.float32))
        named["what is what"] = overlay_labels(drawn.colors, 1 + np.asarray(labels))
    return in_rows(named, 2 if len(named) == 4 else 3, _PANEL_HEIGHT)


def _difference(colors: np.ndarray, look: Look) -> np.ndarray:
    """Five times the difference; grey where nothing counts."""
    off = 5 * np.abs(colors - look.image / 255.0)
    return to_uint8(
        np.clip(off if look.counts is None else np.where(look.counts[..., None], off, 0.25), 0, 1)
    )


def _fps(scene: DeformingScene, moving: Moving, look: Look, plan: Plan) -> float:
    """How often a second the scene is deformed and drawn; the median."""
    took = []
    for i in range(_TIMED):
        begun = perf_counter()
        draw(scene, moving, look._replace(time=i / _TIMED), plan)
        took.append(perf_counter() - begun)
    return 1 / float(np.median(took[2:]))


def _tracks(scene: DeformingScene, moving: Moving, data: DeformData, tools: Tools) -> dict[str, float] | None:
    """How far points that the first frame sees are from where they truly are; None without truth."""
    truth, count = data.sequence.truth, data.sequence.num_frames
    if truth is None or truth.tracks is None or count < 2:
        return None
    seen = _seen(truth.tracks[0], data.look(0, 0, tools))
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


def _seen(points: Float[np.ndarray, "n 3"], look: Look) -> Bool[np.ndarray, "n"]:
    """Which points a look sees, by its depth and masks."""
    height, width = look.image.shape[:2]
    column, row, z, inside = pixels_of(points, look.viewmat, look.K, width, height)
    counts = inside if look.counts is None else inside & look.counts[row, column]
    if look.depth is None:
        return counts
    depth = look.depth[row, column]
    return counts & (np.abs(depth - z) < _SEEN_WITHIN * depth)
