"""A run of `gsjax deform`: the frames of one camera in, a folder with a deforming scene, its scores and a
report out."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from time import perf_counter
from typing import Annotated, Any, Literal

import jax
import numpy as np
import tyro
from jaxtyping import Float
from rich.console import Console

from gsjax.data import Photographs, Sequence
from gsjax.data.consistency import check_recording
from gsjax.data.open import is_only_photographs, open_photographs
from gsjax.data.ordered import open_as_sequence
from gsjax.engine.budget import Budget, note_if_few
from gsjax.engine.deform.data import Tools, deform_data
from gsjax.engine.deform.depth import METRIC, Depth, DepthSource, shows_one_object, with_depth
from gsjax.engine.deform.file import write_deformation
from gsjax.engine.deform.poses import with_refined_poses
from gsjax.engine.deform.results import summarize
from gsjax.engine.deform.scores import judge
from gsjax.engine.drive import drive
from gsjax.engine.ending import exit_code, finish
from gsjax.engine.files import write_scene
from gsjax.engine.folder import DEFORMATION, RunFolder, expect_dataset
from gsjax.engine.locks import releasing_locks
from gsjax.engine.machine import describe as describe_machine
from gsjax.engine.messages import Notes, counted, stage
from gsjax.engine.options import RESUME_MAY_CHANGE, OfDataset, checked
from gsjax.engine.progress import (
    Progress,
    Schedule,
    load_run,
    means_of,
    note_if_cut_short,
    warn_of_mishaps,
    watch,
)
from gsjax.engine.recording import absolute_path, open_recording
from gsjax.engine.teaching.choice import NO_TEACHER, TeacherChoice, TeacherOptions
from gsjax.methods.deform import PRESETS, Deform, DeformConfig
from gsjax.methods.deform.method import PLAN
from gsjax.methods.deform.update import LOSSES

_STATIC_SHARE = 0.95  # of the error of a static scene: above it, motion was hardly learned
_LEAST_IOU = 0.6  # IoU below which a warning is given


@dataclass(frozen=True, kw_only=True)
class Options(TeacherOptions, OfDataset):
    """Options of `gsjax deform`."""

    preset: Literal["surst", "clin", "around"] | None = None
    """Recipe whose settings are the defaults of --deform: SurstSplat's, GaussianClin's, or the one for a
    camera that goes around a moving object, as in D-NeRF's scenes. Default: around if the scene starts within
    its visual hull (--depth) and pictures are transparent around it, else surst."""
    tools: Tools = "leave-out"
    """Leave tools out, or draw them too. Tools are recognised by the names of mask values; without
    names, all values but 0 are tools."""
    tool_values: Annotated[tuple[int, ...], tyro.conf.arg(metavar="VALUE")] = ()
    """Mask values that are tools, whatever their names."""
    depth: Depth = "auto"
    """Source of the depth: data (files), stereo (matching the training camera with the next one), or none:
    hull (the scene starts as random points within what most frames show, as suits a camera that goes around
    it) or plane (it starts as a plane, and lengths have no unit). auto: the first that is available."""
    deform: DeformConfig = field(default_factory=lambda: PRESETS["surst"])
    """Settings of the scene and its training."""


@releasing_locks()
def run(options: Options, by_preset: Callable[[str], Options]) -> int:
    """Reconstruct a deforming scene and report on it; returns the exit code.

    Args:
        options: those of the command.
        by_preset: returns the same options with the defaults of a given preset; used if none is named.

    Raises:
        ValueError, OSError: the options cannot be followed; everything learned before that is on disk.
    """
    options = checked(options)
    choice = _teacher(options)
    console, begun = Console(stderr=True, highlight=False), perf_counter()
    budget = Budget(options.minutes, begun)
    with Notes(console) as notes:
        expect_dataset(options.dataset)
        folder = RunFolder.locked(options.out, overwrite=options.overwrite, resume=options.resume)
        sequence, source = _recording(options, notes)
        if options.preset is None:
            stored = folder.setting("preset") if options.resume else None
            preset = stored or ("around" if shows_one_object(sequence, source) else "surst")
            if preset != "surst":  # the options already have its settings
                options = checked(by_preset(preset))
            options = replace(options, preset=preset)
            if preset == "around":
                console.print("settings of --preset around, as a camera goes around an object")
            elif source == "hull" and stored is None:
                notes.add(
                    "The camera goes around the scene, but its pictures are not transparent, so the settings "
                    "are those of --preset surst. If they show one object, make them transparent around it."
                )
        settings = replace(options, dataset=absolute_path(options.dataset), **choice.located())
        if options.resume:
            folder.check_config(settings, but=RESUME_MAY_CHANGE)
        how = (options.test_every, options.tools, choice, options.deform.channels)
        data = deform_data(sequence, *how, options.tool_values, notes, console)
        if data.meaning is None and choice.features != NO_TEACHER:
            only = "One class among the pixels that count" if data.sequence.has_masks else "No masks"
            only += ": colours alone are learned, without meaning or graph"
            notes.add(f"{only}.")
            console.print(f"{only}; for gsjax query and ask: --tools draw, or --features", soft_wrap=True)
        method, metric = Deform(options.deform), source in METRIC
        with stage(console, "placing the first Gaussians"):
            problem, run = method.start(
                data.frames,
                data.lesson,
                first=None if source == "hull" else data.first,
                timeline=data.timeline(metric),
                background=sequence.background,
                hull=source == "hull",
            )
        progress = Progress({"frames, depth, masks, poses and features": data.digest()}, begun=begun)
        if options.resume:
            run, progress = load_run(folder.resume, run, progress)
            budget.check_exceeds(progress.used_seconds)
            notes.add(f"Resumed after {counted(run.step, 'step')} of an earlier run.")
            if (folder.path / "query").exists():
                notes.warn(f"{folder.path / 'query'} answers a query of the earlier scene; query again")
        folder.write_config(settings)  # from here on an earlier run is gone
        row, ticks = means_of("psnr", *LOSSES), drive(method, problem, run)
        schedule = Schedule("reconstructing", method.total(problem), row, _in_words)
        watch(ticks, progress, schedule, folder, console, budget=budget)
        run, result = ticks.run, ticks.result
        data, refined = with_refined_poses(folder, problem, run.params, data, notes)
        write_deformation(folder.path / DEFORMATION, result, sequence.origin, sequence.background)
        write_scene(folder.scene, jax.device_get(result.at(0.0)), origin=sequence.origin)
        with stage(console, "scoring held-out frames"):
            judged = judge(folder, result, run.plans[PLAN], data, options.tools, budget)
        note_if_cut_short(progress, schedule, run.step, notes)
        _warn_of_oddities(progress, judged, notes)
        if not data.test:
            notes.add("No frame is held out: all scores are of training frames.")
        note_if_few(judged["scores"], data.test, "held-out frames", notes)
        found = {
            "kind": "deform",
            "dataset": data.sequence.name,
            "preset": options.preset,
            "num_gaussians": run.params.gaussians.num,
            "frames": {"learned": len(data.train), "held_out": len(data.test)},
            "size": (data.sequence.width, data.sequence.height),
            "features": "none" if data.meaning is None else data.meaning.source.kind,
            "masks": "none" if data.taught is None else data.taught.masks,
            "tools": options.tools if data.sequence.has_masks else "draw",
            "names": data.names,
            "depth": {"source": source, "metric": metric},
            "poses": refined,
            **progress.found(run.step),
            "machine": describe_machine(),
            **judged,
            "notes": notes.all,
        }
        finish(folder, found, summarize)
    return exit_code(progress.stopped)


def _warn_of_oddities(progress: Progress, judged: Mapping[str, Any], notes: Notes) -> None:
    """Warns of skipped steps, and if motion or classes were hardly learned."""
    warn_of_mishaps(progress, notes)
    if progress.stopped is not None:
        return
    tracks = judged["tracks"]
    if tracks is not None and tracks["median_mm"] > _STATIC_SHARE * tracks["still_median_mm"]:
        off, still = tracks["median_mm"], tracks["still_median_mm"]
        how = "worse" if off > still else "hardly better"
        went_wrong = progress.skipped or progress.returns
        do = "lower learning rates (--deform.rates)" if went_wrong else "more --deform.iterations"
        notes.warn(
            f"tracks are {how} than those of a static scene (median {off:.3g} and {still:.3g} mm); try {do}"
        )
    unlike = [f"{one['class']} {one['iou']:.2f}" for one in judged["classes"] if one["iou"] < _LEAST_IOU]
    if unlike:
        notes.warn(
            f"rendered classes hardly overlap the recorded ones (IoU): {', '.join(unlike)}; more steps?"
        )


def _recording(options: Options, notes: Notes) -> tuple[Sequence, DepthSource]:
    """The recording with its depth, the training camera first, and the source of the depth."""
    chosen = (options.frames, options.read, options.scale)
    whole = open_recording(options.dataset, (), (), *chosen, opened=open_as_sequence).judged
    check_recording(whole)
    if is_only_photographs(options.dataset, options.read.images):
        photographs = open_photographs(options.dataset, options.read)
        notes.add(_of_photographs(photographs, whole.viewmats[0, 0]))
        if photographs.times is None and photographs.splits is not None:
            notes.warn(
                f"{whole.name}: its photographs have splits but no times, or one time: the order of their "
                'files, split after split, is taken for time; give each frame of its transforms a "time"'
            )
    for flag, camera in (("--cameras", options.cameras), ("--eval-cameras", options.eval_cameras)):
        if camera and camera[0] not in whole.camera_ids:
            known = list(whole.camera_ids)
            raise ValueError(f"{flag}: {whole.name} has no camera {camera[0]}; it has {known}")
    judge = options.eval_cameras
    first = options.cameras or tuple(c for c in whole.camera_ids if c not in judge)[:1]
    if not first or first == judge:
        raise ValueError(
            f"--eval-cameras: expected a camera other than the training camera, found {list(judge)} for both"
        )
    others = [camera for camera in whole.camera_ids if camera not in (*first, *judge)]
    sequence = whole.select(cameras=[*first, *judge, *others])
    return with_depth(sequence, options.depth, options.deform.plane_depth, notes)


def _of_photographs(photographs: Photographs, facing: Float[np.ndarray, "4 4"]) -> str:
    """A note on the order of the photographs and, from their points, on the unit of lengths; `facing` is the
    first view matrix."""
    order = (
        "that of their files, as they have no times" if photographs.times is None else "that of their times"
    )
    words = f"{photographs.num} photographs are used as frames; their order is {order}."
    if photographs.cloud is None or not len(photographs.cloud.points):
        return words
    away = float(np.median(photographs.cloud.points @ facing[2, :3] + facing[2, 3]))
    return (
        f"{words} Their sparse points lie {away:.3g} in front of the first camera, in the unit of the poses."
    )


def _teacher(options: Options) -> TeacherChoice:
    """The choice of a teacher, after checking the options."""
    if len(options.cameras) > 1:
        raise ValueError(f"--cameras: expected one training camera, found {list(options.cameras)}")
    if len(options.eval_cameras) > 1:
        raise ValueError(f"--eval-cameras: expected one held-out camera, found {list(options.eval_cameras)}")
    option = "masks" if options.masks != "auto" else "sam" if options.sam is not None else None
    if option is not None and options.features not in ("closed", "clip"):
        raise ValueError(
            f"--{option}: expected --features closed or clip, which need masks, found {options.features}"
        )
    choice = TeacherChoice(**{f.name: getattr(options, f.name) for f in fields(TeacherOptions)})
    choice.check(optional=True)
    return choice


def _in_words(row: Mapping[str, Any]) -> str:
    """The PSNR of a row in words."""
    return "–" if row["psnr"] is None else f"{row['psnr']:.1f} dB"
