"""A run of `gsjax track`: a recording in, a folder with the tracked scene, its scores and a report out."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import numpy as np
from rich.console import Console

from gsjax.engine.ending import completion, exit_code, finish
from gsjax.engine.first_mask import (
    KEPT_MASK,
    PICTURE,
    FirstMask,
    first_mask,
    placed,
    warn_of_missing,
    without_own_objects,
)
from gsjax.engine.folder import RunFolder, expect_dataset
from gsjax.engine.inputs import recording_digest
from gsjax.engine.locks import releasing_locks
from gsjax.engine.machine import describe as describe_machine
from gsjax.engine.messages import FITTING, Notes, counted, reason, stage
from gsjax.engine.options import (
    RESUME_MAY_CHANGE,
    FirstMasks,
    OfRecording,
    checked,
    expect_positive,
    preset_options,
)
from gsjax.engine.pictures import Film
from gsjax.engine.recording import Recording, absolute_path, chosen_recording, draw_ahead, drawing_ahead
from gsjax.engine.scores import Scores
from gsjax.engine.streams import say_error
from gsjax.engine.summary import Media, format_number
from gsjax.engine.track.loop import Tracking, begin, follow
from gsjax.engine.track.outputs import write_first_mask, write_plots, write_tracking
from gsjax.engine.track.rehearsal import Rehearsal
from gsjax.engine.track.results import summarize
from gsjax.engine.track.resume import Saver, load
from gsjax.engine.track.scoring import (
    budget_metrics,
    first_labels,
    group_values,
    labels_of_groups,
    lost_over_frames,
    metrics,
    object_names,
    score_motion,
    turn_unknown_from,
)
from gsjax.engine.track.views import views
from gsjax.io.pictures import write_png
from gsjax.methods.track import PRESETS, TrackConfig, TrackedScene, scene_from_shapes, start_scene
from gsjax.methods.track.lost import DOUBTFUL


@dataclass(frozen=True, kw_only=True)
class Options(FirstMasks, OfRecording):
    """Options of `gsjax track`."""

    budget_ms: float | None = None
    """Time that an update may take, milliseconds. Settings are then chosen by measured cost; of those under
    --track, only start, grow.slots, headroom and seed are used."""
    preset: Literal["fast", "balanced", "accurate", "paper"] = "fast"
    """Default settings of the tracker: for 30 Hz (fast), for small errors (accurate), between the two
    (balanced), or as in the paper."""
    track: TrackConfig = field(default_factory=TrackConfig)
    """The tracker's own settings."""


def options_for(arguments: list[str]) -> tuple[type[Options], list[str]]:
    """The class of options, with the defaults of the preset that is named, and the arguments to parse."""
    return preset_options(Options, arguments, "track", PRESETS)


@releasing_locks()
def run(options: Options) -> int:
    """Track a recording and report on it; returns the exit code.

    Raises:
        ValueError, OSError: an option cannot be met; everything tracked before that is on disk.
    """
    options = checked(options)
    expect_positive(options, "budget_ms")
    console, begun = Console(stderr=True, highlight=False), perf_counter()
    with Notes(console) as notes:
        expect_dataset(options.dataset)
        recording = chosen_recording(options)
        folder = RunFolder.locked(options.out, overwrite=options.overwrite, resume=options.resume)
        settings = replace(
            options,
            dataset=absolute_path(options.dataset),
            cameras=recording.tracked.camera_ids,
            masks=placed(options.masks),
        )
        if options.resume:
            folder.check_config(settings, but=RESUME_MAY_CHANGE)
        kept = folder.path / KEPT_MASK
        masks = kept if options.resume and isinstance(options.masks, Path) else settings.masks
        mask = first_mask(recording.tracked, options.mask_camera, masks, options.scale)
        first = recording.tracked.frame(0)
        about = {"the recording": recording_digest(recording.tracked, first)}
        tracking = load(folder.resume, options.track, about) if options.resume else None
        folder.write_config(settings)  # from here on an earlier run is gone
        if mask.source == PICTURE and mask.labels is not None:
            recording = without_own_objects(recording)
            write_png(kept, mask.labels.astype(np.uint16))
        seconds = {"preparing": perf_counter() - begun}
        rehearsal = Rehearsal(
            first, options.track, options.budget_ms is not None, needed=recording.tracked.num_frames > 1
        )
        if tracking is not None:
            notes.add(f"Resumed after {counted(tracking.resumed, 'frame')} of an earlier run.")
        else:
            with drawing_ahead(recording):
                scene, seconds["start"] = _start(recording, mask, rehearsal, console, notes)
            tracking = begin(scene)
        saver = Saver(folder.resume, about, tracking.resumed)
        drawing = perf_counter()
        draw_ahead(recording, console)
        seconds["preparing"] += perf_counter() - drawing
        loop = {"budget_ms": options.budget_ms, "like": rehearsal.tick, "saved": saver}
        follow(tracking, first, recording.tracked, options.track, console, **loop)
        seconds |= tracking.seconds()
        write_tracking(folder, tracking, recording.tracked.times, recording.tracked.origin)
        _note_if_stopped(tracking, recording, notes)
        found, media, failed = _evaluate(
            folder, tracking, recording, mask, seconds, notes, console, options.budget_ms
        )
        seconds["total"] = perf_counter() - begun
        found |= {"seconds": seconds, "notes": notes.all}
        finish(folder, found, partial(summarize, **media))
    return exit_code(tracking.stopped or failed)


def _start(
    recording: Recording, mask: FirstMask, rehearsal: Rehearsal, console: Console, notes: Notes
) -> tuple[TrackedScene, float]:
    """The scene at the first frame, and the seconds that it took; its updates are rehearsed meanwhile."""
    begun, frame, config = perf_counter(), rehearsal.first, rehearsal.config
    with stage(console, FITTING):
        if mask.labels is not None:
            camera = recording.tracked.camera_ids.index(mask.camera)
            scene = start_scene(frame, mask.labels, camera, config, before_fit=rehearsal.begin)
        else:
            scene = scene_from_shapes(recording.tracked.models, frame, config)
    warn_of_missing(recording, mask, scene.label_ids, notes)
    seconds = perf_counter() - begun
    objects = len(set(scene.label_ids) - {0})
    parts = f" ({scene.num_objects} rigid parts)" if scene.num_objects > objects else ""
    made_by = {"files": "the file", PICTURE: "your picture", "segment": "the weight-free segmenter"}
    origin = "objects are the shapes that come with the recording"
    if mask.labels is not None:
        origin = f"labels from {made_by[mask.source]} in camera {mask.camera}"
    console.print(
        f"[bold]scene[/]     {format_number(scene.gaussians.num)} Gaussians, "
        f"{format_number(scene.num_moving)} of them in {objects} objects{parts}, in {seconds:.1f} s; "
        f"{origin}",
        soft_wrap=not console.is_terminal,
    )
    return scene, seconds


def _evaluate(
    folder: RunFolder,
    tracking: Tracking,
    recording: Recording,
    mask: FirstMask,
    seconds: dict[str, float],
    notes: Notes,
    console: Console,
    budget_ms: float | None,
) -> tuple[dict[str, Any], dict[str, list[Media]], BaseException | None]:
    """Render and score what was tracked. Ctrl-C or an error ends it; what was scored by then counts.

    Returns:
        metrics.json without seconds and notes; the plots and images of the report; and what ended the scoring
        early, or None.
    """
    begun = perf_counter()
    values, truth = group_values(tracking, mask, recording), recording.tracked.truth
    labels = labels_of_groups(tracking, values)
    scores, failed = Scores(values, None if truth is None else truth.robot), None
    try:
        film = Film(folder, recording, tracking.num_frames, labels)
        film.score(views(tracking, recording), scores, tracking.num_frames, console)
    except (KeyboardInterrupt, Exception) as error:
        scored = f"{scores.num_frames} of {tracking.num_frames} frames"
        notes.warn(f"scoring was stopped after {scored} by {reason(error)}")
        failed = error
    true_labels = first_labels(tracking, recording)
    motion = score_motion(tracking, recording, true_labels)
    names = object_names(tracking, recording, values)
    seconds["evaluation"] = perf_counter() - begun
    found = _run_metrics(tracking, recording, mask, scores, budget_ms, tracking.stopped or failed)
    found |= metrics(tracking, recording, mask, scores, motion, values, true_labels)
    _note_unscored(found, tracking, recording, mask, values, notes)
    _note_lost(found, tracking, values, names, recording.tracked.frame_ids, notes)
    media = {
        "plots": write_plots(folder, tracking, recording, scores, motion, names, labels),
        "images": write_first_mask(folder, recording, mask),
    }
    return found, media, failed


def _run_metrics(
    tracking: Tracking,
    recording: Recording,
    mask: FirstMask,
    scores: Scores,
    budget_ms: float | None,
    stopped: BaseException | None,
) -> dict[str, Any]:
    """The part of metrics.json about what ran, and how fast."""
    sequence, updates = recording.tracked, np.asarray(tracking.update_s[1:]) * 1e3
    budget = None
    if budget_ms is not None and tracking.chosen is not None:
        budget = {
            "ms": budget_ms,
            **budget_metrics(tracking.chosen),
            "late": int((updates > budget_ms).sum()),
            "everywhere": tracking.everywhere,
        }
    return {
        "kind": "track",
        "dataset": sequence.name,
        **completion(stopped),
        "frames": {
            "tracked": tracking.num_frames,
            "asked": sequence.num_frames,
            "in_data": recording.frames_in_data,
            "scored": scores.num_frames,
            "first_id": sequence.frame_ids[0],
            "last_id": sequence.frame_ids[tracking.num_frames - 1],
        },
        "image": {"width": sequence.width, "height": sequence.height},
        "tracked_cameras": list(sequence.camera_ids),
        "held_out_cameras": list(recording.held_out),
        "mask": {"source": mask.source, "camera": mask.camera},
        "gaussians": {"all": tracking.scene.gaussians.num, "moving": tracking.scene.num_moving},
        "update_hz": tracking.hz,
        "update_ms": {
            "mean": float(updates.mean()) if len(updates) else None,
            "median": float(np.median(updates)) if len(updates) else None,
            "p95": float(np.percentile(updates, 95)) if len(updates) else None,
        },
        "budget": budget,
        "plans": tracking.plans,
        "updates_skipped": tracking.skipped,
        "machine": describe_machine(),
    }


def _note_if_stopped(tracking: Tracking, recording: Recording, notes: Notes) -> None:
    if tracking.stopped is None:
        return
    after = f"after {tracking.num_frames} of {recording.tracked.num_frames} frames"
    why = reason(tracking.stopped).rstrip(".")
    notes.add(f"This run is not complete: it was stopped {after} by {why}.")
    if isinstance(tracking.stopped, KeyboardInterrupt):
        say_error(f"by {why} {after}; scoring those (Ctrl-C again to skip that)", word="stopped")


def _note_unscored(
    found: dict[str, Any],
    tracking: Tracking,
    recording: Recording,
    mask: FirstMask,
    values: np.ndarray | None,
    notes: Notes,
) -> None:
    """Note what was not scored, and why."""
    sequence = recording.judged
    overlaps = found["iou"] | found["iou_held_out"]
    if mask.source == "segment":
        notes.add("Objects were found by the weight-free segmenter; they are named by size.")
    if mask.source == PICTURE:
        notes.add("Motion and labels were not scored: the objects are those of your picture.")
    elif sequence.truth is None:
        notes.add("Motion was not scored: the recording has no true poses.")
    elif not (recording.tracked.has_masks and recording.tracked.has_depth):
        notes.add("Motion was not scored: assigning Gaussians to true objects requires masks and depth.")
    if mask.source != PICTURE and not sequence.has_masks:
        notes.add("Labels were not scored: the recording has no masks.")
    elif mask.source != PICTURE and values is None:
        notes.add(f"Labels were not scored: the recording has no first mask of camera {mask.camera}.")
    elif mask.source != PICTURE and found["frames"]["scored"] > 1 and not overlaps:
        notes.add("Labels were not scored: the recording has masks of the first frame alone.")
    if not sequence.has_depth:
        notes.add("Depth was not scored: the recording has none.")
    for name, scored in found["objects"].items():
        if scored["gaussians"] == 0:
            notes.add(f"{name}: not tracked, because it is not in the first mask.")
        elif sequence.truth is not None and scored["gaussians_scored"] == 0:
            posed = values is not None and scored["label"] in sequence.truth.label_ids
            why = "no Gaussian certainly belongs to it" if posed else "the ground truth has no pose of it"
            notes.add(f"{name}: motion not scored, {why}.")
    if tracking.chosen is not None and not tracking.chosen.fits:
        base = f"{1e3 * tracking.chosen.costs.base:.0f} ms"
        notes.warn(
            f"no settings keep the budget on this machine; {tracking.chosen.name} take {base} an update"
        )
    if tracking.skipped:
        notes.add(f"Skipped, because numbers were not finite: {counted(tracking.skipped, 'update')}.")


def _note_lost(
    found: dict[str, Any],
    tracking: Tracking,
    values: np.ndarray | None,
    names: dict[int, str],
    frame_ids: Sequence[int],
    notes: Notes,
) -> None:
    """Note when each object was lost, its rotation unknown, in doubt at the end, or seen by no camera, in
    frames by their numbers in the data."""
    groups = labels_of_groups(tracking, values)[1:]
    unseen = (~np.asarray(tracking.visible, bool).reshape(len(tracking.visible), len(groups))).sum(axis=0)
    labels = sorted({*groups.tolist()})
    names = {0: "a segment that the recording's masks count as background"} | names
    for label in labels:
        lost = 1 + np.flatnonzero(lost_over_frames(tracking, values, label))
        to_the_end = len(lost) > 0 and lost[-1] == tracking.num_frames - 1
        if len(lost):
            first, last = frame_ids[lost[0]], "the end" if to_the_end else frame_ids[lost[-1]]
            between = f"between {first} and {last}" if len(lost) > 1 or to_the_end else f"number {first}"
            notes.say(f"{names[label]}: lost in {counted(len(lost), 'frame')}, {between}.")
        unknown = turn_unknown_from(tracking, values, label)
        begins = lost[np.diff(lost, prepend=-1) > 1]  # where each loss begins; frame 0 is never lost
        if unknown is not None and (not to_the_end or unknown < begins[-1]):
            why = "it was lost then" if unknown in lost else "other rotations agree as well"
            notes.say(f"{names[label]}: its rotation is unknown from frame {frame_ids[unknown]} on: {why}.")
        agrees = found["objects"][names[label]]["agrees_last"] if label else None
        if agrees is not None and agrees < DOUBTFUL and not to_the_end:
            notes.say(
                f"{names[label]}: at the end, only {agrees:.0%} of its visible part, or of one of its rigid "
                "parts, agrees with the images; it shows other sides, or is not where it is drawn."
            )
    for label in labels:
        frames = unseen[groups == label].max()
        if frames:
            unseen_in = counted(int(frames), "frame")
            notes.add(
                f"{names[label]}: no camera saw it, or one of its rigid parts, in {unseen_in}; it was not "
                "moved then."
            )
