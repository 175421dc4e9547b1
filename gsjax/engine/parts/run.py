"""A run of `gsjax parts`: synchronised cameras in, a folder with the parts of a moving scene out."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int
from rich.console import Console

from gsjax.data import Sequence
from gsjax.engine.ending import exit_code, finish
from gsjax.engine.files import read_drawable
from gsjax.engine.fit.run import Options as FitOptions
from gsjax.engine.fit.run import run as run_fit
from gsjax.engine.folder import RunFolder, expect_dataset, expect_run, is_finished, is_run
from gsjax.engine.inputs import Inputs, recording_digest
from gsjax.engine.locks import releasing_locks
from gsjax.engine.messages import Notes, counted, stage
from gsjax.engine.options import RESUME_MAY_CHANGE, OfRecording, SamWeights, Seeded, checked
from gsjax.engine.parts.loop import Loop
from gsjax.engine.parts.outputs import write_outputs
from gsjax.engine.parts.results import summarize
from gsjax.engine.parts.start import FIT, detect_motion, discover
from gsjax.engine.progress import Progress, load_run
from gsjax.engine.recording import Recording, absolute_path, chosen_recording, parse_frames
from gsjax.engine.records import digest
from gsjax.methods.fit import FitConfig
from gsjax.methods.parts import (
    Anchor,
    Parts,
    PartsConfig,
    Start,
    masks_from_labels,
)
from gsjax.methods.protocols import Segmenter
from gsjax.optim.method import Run
from gsjax.perception.sam import load_sam
from gsjax.perception.segmenters import PieceSegmenter
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.origin import rebased

_CANONICAL = "canonical"  # the run of the canonical scene, within that of the parts
_MOST_MOVES = 0.6  # fraction of pixels that change above which everything seems to move


@dataclass(frozen=True, kw_only=True)
class Options(Seeded, SamWeights, OfRecording):
    """Options of `gsjax parts`."""

    anchor: int | None = None
    """Index of the canonical frame among the selected frames, from 0. Default: the frame that differs most
    from the others."""
    masks: Literal["segment", "files"] = "segment"
    """Where the pieces in the anchor's pictures come from: a segmenter, or the recording's own masks, whose
    labels must mean the same in all cameras."""
    scene: Path | None = None
    """The scene at the anchor: a file of Gaussians, or a run of `gsjax fit`; requires --anchor. Default: it
    is fitted, into RUN/canonical."""
    fit: FitConfig = FIT
    """How the canonical scene is fitted."""
    parts: PartsConfig = field(default_factory=PartsConfig)
    """How parts are found and followed."""


@releasing_locks()
def run(options: Options) -> int:
    """Find the parts of a recording and report on them; returns the exit code.

    Raises:
        ValueError, OSError: an option cannot be met; everything found before that is on disk.
    """
    options = checked(options)
    console, begun = Console(stderr=True, highlight=False), perf_counter()
    with Notes(console) as notes:
        expect_dataset(options.dataset)
        recording = chosen_recording(options)
        _check(options, recording)
        segmenter: Segmenter = PieceSegmenter() if options.sam is None else load_sam(options.sam)
        folder = RunFolder.locked(options.out, overwrite=options.overwrite, resume=options.resume)
        settings = replace(
            options, dataset=absolute_path(options.dataset), cameras=recording.tracked.camera_ids
        )
        if options.resume:
            folder.check_config(settings, but=RESUME_MAY_CHANGE)
        scene = None if options.scene is None else _ply_of(options.scene)
        tracked = recording.tracked
        data = recording_digest(tracked, tracked.frame(0))
        if options.resume:  # what cannot be resumed stays as it was
            fitted = folder.path / _CANONICAL / "scene.ply" if scene is None else scene
            load_run(folder.resume, Run(None, None), Progress(_inputs(data, fitted)))
        gaussians = None if scene is None else _read_scene(scene, tracked, notes)
        seconds: dict[str, float] = {}
        with stage(console, "detecting motion"):
            anchor, moved = detect_motion(tracked, options.parts, options.anchor)
        masks = None if moved is None else _masks(tracked, anchor, moved, options)
        folder.write_config(settings)  # from here on an earlier run is gone
        notes.add(
            f"The canonical frame is {anchor.frame}, frame {tracked.frame_ids[anchor.frame]} of the data."
        )
        at = perf_counter()
        if scene is None or gaussians is None:
            scene = _fitted(settings, folder, anchor, recording, console)
            if scene is None:
                return 130
            gaussians = _read_scene(scene, tracked, notes)
        seconds["canonical"], at = perf_counter() - at, perf_counter()
        with stage(console, "discovering parts in all views"):
            start = discover(tracked, gaussians, anchor, moved, options.parts, segmenter, masks)
        if moved is None:
            notes.add("Two states, each by cameras of its own: motions were searched for between them.")
        else:
            _warn_if_doubtful(start, moved.any(1).mean(), options, notes)
        method = Parts(options.parts)
        problem, first = method.start(tracked, start)
        seconds["discovery"] = perf_counter() - at
        progress = Progress(_inputs(data, scene), begun=begun)
        if options.resume:
            first, progress = load_run(folder.resume, first, progress)
            followed = int(method.result(problem, first).done.sum())
            notes.add(f"Resumed after {counted(followed, 'frame')} of an earlier run.")
        loop = Loop(method, problem, first, progress, seconds, folder, notes, console)
        loop.follow()
        if progress.stopped is None:
            loop.finish()
            loop.refine()
        last = method.brought_up_to_date(problem, loop.run)
        outcome = method.result(problem, last)
        found = write_outputs(folder, recording, start, last, outcome, progress, seconds, notes, console)
        found["seconds"]["total"] = progress.total_seconds
        found["notes"] = notes.all
        finish(folder, found, summarize)
    return exit_code(progress.stopped)


def _inputs(data: str, scene: Path) -> Inputs:
    """Digests of what a run is given, by their descriptions."""
    return {"the recording": data, "the canonical scene": digest(scene)}


def _check(options: Options, recording: Recording) -> None:
    sequence = recording.tracked
    if sequence.num_cameras < 2:
        raise ValueError(
            f"--cameras: expected at least 2 that see the scene at once, found {list(sequence.camera_ids)}; "
            "parts are found in space. One camera and depth: gsjax track"
        )
    if sequence.num_frames < 2:
        raise ValueError(
            f"--frames: expected 2 or more, between which something moves, found {options.frames}"
        )
    if options.anchor is not None and not 0 <= options.anchor < sequence.num_frames:
        raise ValueError(
            f"--anchor: expected one of {sequence.num_frames} frames, 0 to {sequence.num_frames - 1}, found "
            f"{options.anchor}"
        )
    inside = options.scene is not None and options.out.resolve() in options.scene.resolve().parents
    if inside and options.overwrite:
        raise ValueError(
            f"--scene {options.scene}: expected one outside --out, which --overwrite replaces, found one "
            "inside it; name another --out"
        )
    if options.scene is not None and options.anchor is None:
        raise ValueError("--scene: expected --anchor too, the frame that it shows, found none")


def _masks(
    sequence: Sequence, anchor: Anchor, moved: Bool[np.ndarray, "C F H W"], options: Options
) -> Int[np.ndarray, "C H W"] | None:
    """The moving pieces according to the recording's own masks; None if a segmenter finds them."""
    if options.masks == "segment":
        return None
    labels = [sequence.mask(anchor.frame, c) for c in range(sequence.num_cameras)]
    missing = [camera for camera, mask in zip(sequence.camera_ids, labels, strict=True) if mask is None]
    if missing:
        raise ValueError(
            f"--masks files: expected a mask of frame {sequence.frame_ids[anchor.frame]} for each camera, "
            f"found none for {', '.join(map(str, missing))}; name other --cameras, or use --masks segment"
        )
    known = [label for label in labels if label is not None]
    masks = masks_from_labels(np.stack(known), moved.any(1), options.parts.discover.most_parts)
    if not masks.any():
        raise ValueError(
            "--masks files: expected a label with at least 30 % of its pixels changed in other frames, "
            "found none; use --masks segment"
        )
    return masks


def _fitted(
    options: Options, folder: RunFolder, anchor: Anchor, recording: Recording, console: Console
) -> Path | None:
    """The file of the scene at the anchor frame; None if the fit was stopped by Ctrl-C."""
    path = folder.path / _CANONICAL
    if not is_finished(path):
        console.print("[bold]canonical scene[/]  fitted to the anchor frame", soft_wrap=True)
        code = run_fit(_fit_options(options, path, anchor, recording))
        if code == 130:
            return None
    return _ply_of(path)


def _ply_of(path: Path) -> Path:
    """The scene file: `path` itself, or the scene of the run of `gsjax fit` in it."""
    if path.is_dir():
        expect_run(path, "`gsjax fit`")
        return path / "scene.ply"
    return path


def _read_scene(path: Path, sequence: Sequence, notes: Notes) -> Gaussians:
    """The Gaussians of a file, relative to the origin of the recording."""
    gaussians, report = read_drawable(path)
    if report.antialiased:
        notes.warn(f"{path} is to be drawn antialiased, and parts are not: small Gaussians look brighter")
    return jax.tree.map(jnp.asarray, rebased(gaussians, report.origin, sequence.origin))


def _fit_options(options: Options, path: Path, anchor: Anchor, recording: Recording) -> FitOptions:
    frame = range(recording.frames_in_data)[parse_frames(options.frames)][anchor.frame]
    return FitOptions(
        options.dataset,
        path,
        frames=f"{frame}:{frame + 1}",
        cameras=options.cameras,
        eval_cameras=options.eval_cameras,
        test_every=0,
        scale=options.scale,
        resume=is_run(path),
        read=options.read,
        fit=options.fit,
    )


def _warn_if_doubtful(start: Start, moved: float, options: Options, notes: Notes) -> None:
    """Warn if the parts are doubtful; `moved` is the fraction of pixels that change."""
    pieces = int(start.masks.max())
    if moved > _MOST_MOVES:
        notes.warn(
            f"{moved:.0%} of the anchor's pixels change in other frames: everything moves, or the cameras "
            "do; the background is then poorly determined"
        )
    if pieces >= options.parts.discover.most_parts:
        notes.warn(
            f"as many pieces changed as --parts.discover.most-parts {pieces} allows; smaller ones, if any, "
            "were left out"
        )
    seen = [(start.masks == piece).any((1, 2)).sum() for piece in range(1, pieces + 1)]
    alone = sum(count == 1 for count in seen)
    if alone:
        notes.add(f"{alone} of {pieces} pieces changed in one camera only.")
