"""`gsjax track`: from a recording to a run folder."""

import dataclasses
from dataclasses import dataclass, field
from functools import partial
from time import perf_counter
from typing import Any, Literal

import numpy as np
from rich.console import Console

from gsjax.engine.ending import ended, exit_code, finish
from gsjax.engine.folder import RunFolder, expect_dataset
from gsjax.engine.machine import describe as describe_machine
from gsjax.engine.messages import FITTING, Notes, reason, say_error, stage
from gsjax.engine.options import (
    RESUME_MAY_CHANGE,
    FirstMasks,
    OfRecording,
    checked,
    expect_positive,
    preset_options,
)
from gsjax.engine.pictures import Film
from gsjax.engine.recording import (
    FirstMask,
    Recording,
    chosen_recording,
    draw_ahead,
    first_mask,
    located,
    warn_of_missing,
)
from gsjax.engine.scores import Scores
from gsjax.engine.summary import Media, format_number
from gsjax.engine.track.loop import Tracking, begin, follow
from gsjax.engine.track.outputs import write_first_mask, write_plots, write_tracking
from gsjax.engine.track.results import summarize
from gsjax.engine.track.resume import Saver, load
from gsjax.engine.track.scoring import (
    budget_metrics,
    group_values,
    lost_over_frames,
    metrics,
    object_names,
    score_motion,
    turn_unknown_from,
)
from gsjax.engine.track.views import views
from gsjax.methods.track import PRESETS, TrackConfig, TrackedScene, scene_from_shapes, start_scene
from gsjax.scene.frame import Frame


@dataclass(frozen=True, kw_only=True)
class Options(FirstMasks, OfRecording):
    """Options of `gsjax track`."""

    budget_ms: float | None = None
    """Time that an update may take, milliseconds. Settings are then chosen by measured cost; of those given,
    only how the scene starts, how much may join it and the seed count."""
    preset: Literal["accurate", "balanced", "fast", "paper"] = "accurate"
    """Default settings of the tracker: for small errors, between, for 30 Hz, or as in the paper."""
    track: TrackConfig = field(default_factory=TrackConfig)
    """The tracker's own settings."""


def options_for(arguments: list[str]) -> tuple[type[Options], list[str]]:
    """The options where a preset is named: the tracker's default to those of the preset. A budget names
    `fast`, for a scene of fewer Gaussians to start from."""
    flags = [argument.split("=")[0].replace("_", "-") for argument in arguments]
    if "--budget-ms" in flags and "--preset" not in flags:
        return preset_options(Options, [*arguments, "--preset", "fast"], "track", PRESETS)
    return preset_options(Options, arguments, "track", PRESETS)


def run(options: Options) -> int:
    """Track a recording and report on it; returns the exit code.

    Raises:
        ValueError, OSError: what was asked cannot be done; everything tracked before that is on disk.
    """
    options = checked(options)
    expect_positive(options, "budget_ms")
    console, begun = Console(stderr=True, highlight=False), perf_counter()
    with Notes(console) as notes:
        expect_dataset(options.dataset)
        recording = chosen_recording(options)
        folder = RunFolder(options.out, overwrite=options.overwrite, resume=options.resume)
        settings = dataclasses.replace(
            options, dataset=located(options.dataset), cameras=recording.tracked.camera_ids
        )
        if options.resume:
            folder.check_config(settings, but=RESUME_MAY_CHANGE)
        mask = first_mask(recording.tracked, options.mask_camera, options.masks)
        folder.write_config(settings)  # from here on an earlier run is gone
        draw_ahead(recording, console)
        seconds = {"preparing": perf_counter() - begun}
        first = recording.tracked.frame(0)
        if options.resume:
            tracking = load(folder.resume, options.track)
            notes.add(f"Resumed after {tracking.resumed} frames of an earlier run.")
        else:
            scene, seconds["start"] = _start(recording, first, mask, options.track, console, notes)
            tracking = begin(scene)
        saver = Saver(folder.resume, tracking.resumed)
        how = {"budget_ms": options.budget_ms, "saved": saver}
        tracking = follow(tracking, first, recording.tracked, options.track, console, **how)
        seconds |= _seconds(tracking)
        write_tracking(folder, tracking, recording.tracked.times)
        _say_if_stopped(tracking, recording, notes)
        found, media, failed = _judge(
            folder, tracking, recording, mask, seconds, notes, console, options.budget_ms
        )
        seconds["total"] = perf_counter() - begun
        found |= {"seconds": seconds, "notes": notes.all}
        finish(folder, found, partial(summarize, **media))
    return exit_code(tracking.stopped or failed)


def _start(
    recording: Recording,
    frame: Frame,
    mask: FirstMask,
    config: TrackConfig,
    console: Console,
    notes: Notes,
) -> tuple[TrackedScene, float]:
    """The scene at the first frame, and the seconds that it took."""
    begun = perf_counter()
    with stage(console, FITTING):
        if mask.labels is not None:
            scene = start_scene(frame, mask.labels, recording.tracked.camera_ids.index(mask.camera), config)
        else:
            scene = scene_from_shapes(recording.tracked.models, frame, config)
    warn_of_missing(recording, mask, scene.label_ids, notes)
    seconds = perf_counter() - begun
    console.print(
        f"[bold]scene[/]     {format_number(scene.gaussians.num)} Gaussians, "
        f"{format_number(scene.num_moving)} of them in "
        f"{_count(scene)}, in {seconds:.1f} s; {_origin(mask)}",
        soft_wrap=not console.is_terminal,
    )
    return scene, seconds


def _count(scene: TrackedScene) -> str:
    """How many objects there are; what is too large to be rigid is followed in parts."""
    objects = len(set(scene.label_ids) - {0})
    parts = f" ({scene.num_objects} rigid parts)" if scene.num_objects > objects else ""
    return f"{objects} objects{parts}"


def _origin(mask: FirstMask) -> str:
    """Where objects come from, in words."""
    if mask.source == "shapes":
        return "objects are the shapes that the recording brings"
    made = "the file" if mask.source == "files" else "the weight-free segmenter"
    return f"labels from {made} in camera {mask.camera}"


def _judge(
    folder: RunFolder,
    tracking: Tracking,
    recording: Recording,
    mask: FirstMask,
    seconds: dict[str, float],
    notes: Notes,
    console: Console,
    budget_ms: float | None,
) -> tuple[dict[str, Any], dict[str, list[Media]], Exception | None]:
    """Render and score what was tracked. Ctrl-C or an error ends it; what was scored until then counts.

    Returns:
        metrics.json but for seconds and notes; the plots and images of the report; and what ended the scoring
        early, or None.
    """
    begun = perf_counter()
    values = group_values(tracking, mask, recording)
    colors = np.asarray(tracking.scene.label_ids) if values is None else values
    truth = recording.tracked.truth
    scores, failed = Scores(values, None if truth is None else truth.robot), None
    try:
        with Film(folder, recording, tracking.num_frames, colors) as film, console.status("") as status:
            for frame in views(tracking, recording):
                status.update(f"rendering and scoring frame {frame[0].t + 1} of {tracking.num_frames}")
                for view in frame:
                    scores.add(view)
                    film.add(view)
    except (KeyboardInterrupt, Exception) as error:
        scored = f"{scores.num_frames} of {tracking.num_frames} frames"
        notes.warn(f"scoring was stopped after {scored} by {reason(error)}")
        failed = error if isinstance(error, Exception) else None
    motion = score_motion(tracking, recording)
    names = object_names(tracking, recording, mask, values)
    seconds["evaluation"] = perf_counter() - begun
    found = _what_ran(tracking, recording, mask, scores, budget_ms)
    found |= metrics(tracking, recording, mask, scores, motion, values)
    _note_what_is_missing(found, tracking, recording, mask, values, notes)
    media = {
        "plots": write_plots(folder, tracking, recording, scores, motion, names, colors),
        "images": write_first_mask(folder, recording, mask),
    }
    return found, media, failed


def _budget(tracking: Tracking, budget_ms: float | None) -> dict[str, Any] | None:
    """The settings that a budget led to."""
    if budget_ms is None or tracking.chosen is None:
        return None
    updates = 1e3 * np.asarray(tracking.update_s[1:])
    return {
        "ms": budget_ms,
        **budget_metrics(tracking.chosen),
        "late": int((updates > budget_ms).sum()),
        "everywhere": tracking.everywhere,
    }


def _what_ran(
    tracking: Tracking, recording: Recording, mask: FirstMask, scores: Scores, budget_ms: float | None
) -> dict[str, Any]:
    """The part of metrics.json about what ran, and how fast."""
    ids, updates = recording.tracked.frame_ids, np.asarray(tracking.update_s[1:]) * 1e3
    return {
        "kind": "track",
        "dataset": recording.tracked.name,
        **ended(tracking.stopped),
        "complete": tracking.stopped is None and scores.num_frames == tracking.num_frames,
        "frames": {
            "tracked": tracking.num_frames,
            "asked": recording.tracked.num_frames,
            "in_data": recording.frames_in_data,
            "scored": scores.num_frames,
            "first_id": ids[0],
            "last_id": ids[tracking.num_frames - 1],
        },
        "image": {"width": recording.tracked.width, "height": recording.tracked.height},
        "tracked_cameras": list(recording.tracked.camera_ids),
        "held_out_cameras": list(recording.held_out),
        "mask": {"source": mask.source, "camera": mask.camera},
        "gaussians": {"all": tracking.scene.gaussians.num, "moving": tracking.scene.num_moving},
        "update_hz": tracking.hz,
        "update_ms": {
            "mean": float(updates.mean()) if len(updates) else None,
            "median": float(np.median(updates)) if len(updates) else None,
            "p95": float(np.percentile(updates, 95)) if len(updates) else None,
        },
        "budget": _budget(tracking, budget_ms),
        "plans": tracking.plans,
        "updates_skipped": tracking.skipped,
        "machine": describe_machine(),
    }


def _seconds(tracking: Tracking) -> dict[str, float]:
    """Where the time of the loop went."""
    parts = {
        "planning": tracking.planning_s,
        "compile": tracking.compile_s,
        "updates": sum(tracking.update_s[max(tracking.resumed, 1) :]),
        "loading": tracking.loading_s,
    }
    return parts | {"loop_rest": tracking.loop_s - sum(parts.values()), "loop_wall": tracking.loop_s}


def _say_if_stopped(tracking: Tracking, recording: Recording, notes: Notes) -> None:
    if tracking.stopped is None:
        return
    after = f"after {tracking.num_frames} of {recording.tracked.num_frames} frames"
    why = reason(tracking.stopped).rstrip(".")
    notes.add(f"This run is not complete: it was stopped {after} by {why}.")
    if isinstance(tracking.stopped, KeyboardInterrupt):
        say_error(f"by Ctrl-C {after}; scoring those (Ctrl-C again to skip that)", word="stopped")


def _note_what_is_missing(
    found: dict[str, Any],
    tracking: Tracking,
    recording: Recording,
    mask: FirstMask,
    values: np.ndarray | None,
    notes: Notes,
) -> None:
    """Note what was not scored, and why."""
    sequence = recording.judged
    if mask.source == "segment":
        notes.add("Objects were found by the weight-free segmenter; they are named by size.")
    if sequence.truth is None:
        notes.add("Motion was not scored: the recording has no true poses.")
    elif not (recording.tracked.has_masks and recording.tracked.has_depth):
        notes.add("Motion was not scored: which Gaussian belongs to which true object takes masks and depth.")
    if values is None or not sequence.has_masks:
        notes.add("Labels were not scored: the recording has no masks.")
    if not sequence.has_depth:
        notes.add("Depth was not scored: the recording has none.")
    for name, scored in found["objects"].items():
        if scored["gaussians"] == 0:
            notes.add(f"{name}: not tracked, it is not in the first mask.")
        elif sequence.truth is not None and scored["gaussians_scored"] == 0:
            why = (
                "the truth holds no pose of it"
                if name not in sequence.truth.names
                else "no Gaussian is surely its"
            )
            notes.add(f"{name}: motion not scored, {why}.")
    if tracking.chosen is not None and not tracking.chosen.fits:
        base = f"{1e3 * tracking.chosen.costs.base:.0f} ms"
        notes.warn(
            f"no settings keep the budget on this machine; {tracking.chosen.name} take {base} an update"
        )
    if tracking.skipped:
        notes.add(f"{tracking.skipped} updates gave numbers that are not finite and were left out.")
    unseen = [np.flatnonzero(~seen) for seen in tracking.visible]
    counts = np.bincount(np.concatenate([*unseen, []]).astype(int), minlength=tracking.scene.num_objects)
    names = object_names(tracking, recording, mask, values)
    ids = tracking.scene.label_ids if values is None else values.tolist()
    for label in sorted({*ids} - {0}):
        name = names.get(label, f"object {label}")
        lost = 1 + np.flatnonzero(lost_over_frames(tracking, values, label))
        to_the_end = len(lost) > 0 and lost[-1] == tracking.num_frames - 1
        if len(lost):
            ended = "to the end" if to_the_end else f"to {lost[-1]}"
            notes.add(f"{name}: lost in {len(lost)} frames, from {lost[0]} {ended}.")
        unknown = turn_unknown_from(tracking, values, label)
        if unknown is not None and not to_the_end:
            why = "it was lost then" if unknown in lost else "other turns agree as well"
            notes.add(f"{name}: from frame {unknown} on it is not known how it is turned: {why}.")
    for label in sorted({ids[group + 1] for group in np.flatnonzero(counts)}):
        name = names.get(label, f"object {label}")
        frames = max(counts[group] for group in range(len(counts)) if ids[group + 1] == label)
        notes.add(f"{name}: no camera saw it, or a part of it, in {frames} frames; it stood still meanwhile.")
