"""`gsjax deform`: a scene that deforms, seen by one moving camera, and what is what in it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Annotated, Any, Literal

import jax
import numpy as np
import tyro
from jaxtyping import Float
from rich.console import Console

from gsjax.data import Photographs
from gsjax.data.open import is_photographs, is_recording, open_photographs
from gsjax.data.ordered import open_as_sequence
from gsjax.engine.deform.data import DeformData, Tools, deform_data
from gsjax.engine.deform.depth import Deep, Depth, with_depth
from gsjax.engine.deform.file import NAME, StoredDeformation, write_deformation
from gsjax.engine.deform.poses import as_refined
from gsjax.engine.deform.results import print_results, write_results
from gsjax.engine.deform.scores import judge
from gsjax.engine.distill.choice import TeacherChoice, TeacherOptions
from gsjax.engine.ending import exit_code, finish
from gsjax.engine.folder import RunFolder, expect_dataset
from gsjax.engine.learning import Course, Learning, learn, load, say_if_cut_short
from gsjax.engine.machine import describe as describe_machine
from gsjax.engine.messages import Notes, stage
from gsjax.engine.options import RESUME_MAY_CHANGE, OfDataset, checked, preset_options
from gsjax.engine.recording import located, open_recording
from gsjax.io.ply import write_ply
from gsjax.methods.deform import (
    PRESETS,
    DeformConfig,
    DeformState,
    begin_deform,
    of_step,
    reconstruct,
)

HELP = (
    " As in `gsjax deform DATASET --out RUN`. Masks say where tools are, which are left out unless --tools "
    "draw. Depth is the data's, else matched between two eyes; without either the scene begins on a plane. "
    "One camera is learned from (--cameras; the first unless given), one judges (--eval-cameras; the next)."
)
_LOSSES = ("rgb", "depth", "feature", "node", "structure", "spatial", "temporal", "planes")
_HARDLY = 0.95  # of the error of a scene that stands still
NOBODY = "none"  # of features: there is no teacher
_UNLIKE = 0.6  # an IoU


@dataclass(frozen=True, kw_only=True)
class Options(TeacherOptions, OfDataset):
    """What `gsjax deform` is told."""

    preset: Literal["surst", "clin"] = "surst"
    """Whose recipe, unless given by --deform: SurstSplat's or GaussianClin's."""
    tools: Tools = "leave-out"
    """What masks call a tool, by the names of their values, or without names all but 0: leave out, or draw it
    too."""
    tool_values: Annotated[tuple[int, ...], tyro.conf.arg(metavar="VALUE")] = ()
    """Mask values that are tools, in place of what their names say."""
    depth: Depth = "auto"
    """Where depth is from: data (files), stereo (camera to learn from and the next one are matched) or plane
    (none: the scene begins on one, and its depth is of no unit). auto: the first of these that there is."""
    deform: DeformConfig = field(default_factory=lambda: PRESETS["surst"])
    """How it is learned."""


def options_for(arguments: list[str]) -> tuple[type[Options], list[str]]:
    """The options whose defaults are those of the recipe that is named."""
    return preset_options(Options, arguments, "deform", PRESETS)


def run(options: Options) -> int:
    """Reconstruct a deforming scene and report on it; returns the exit code.

    Raises:
        ValueError, OSError: what was asked cannot be done; everything learned before that is on disk.
    """
    options = checked(options)
    asked = _teacher(options)
    console, begun = Console(stderr=True, highlight=False), perf_counter()
    with Notes(console) as notes:
        expect_dataset(options.dataset)
        folder = RunFolder(options.out, overwrite=options.overwrite, resume=options.resume)
        elsewhere = {} if asked is None else asked.located()
        settings = replace(options, dataset=located(options.dataset), **elsewhere)
        if options.resume:
            folder.check_config(settings, but=RESUME_MAY_CHANGE)
        deep = _recording(options, notes)
        told = (options.test_every, options.tools, asked, options.deform.channels)
        data = deform_data(deep.sequence, *told, options.tool_values, notes, console)
        if data.meaning is None and asked is not None:
            only = "One class among the pixels that count" if data.sequence.has_masks else "No masks"
            only += ": colours are learned, and no meaning or graph"
            notes.add(f"{only}.")
            console.print(f"{only}; for gsjax query and ask: --tools draw, or --features", soft_wrap=True)
        config = options.deform
        with stage(console, "placing the first Gaussians"):
            problem, state = begin_deform(data.looks, config, data.codes, data.first)
        learning = Learning(state, {"frames, depth, masks, poses and features": data.digest()})
        if options.resume:
            learning = load(folder.resume, learning, lambda first, step: of_step(problem, first, step))
            notes.add(f"Resumed after {learning.state.step} steps of an earlier run.")
            if (folder.path / "query").exists():
                notes.warn(f"{folder.path / 'query'} is an answer of the scene as it was; ask again")
        folder.write_config(settings)  # from here on an earlier run is gone
        course = Course("reconstructing", config.warmup + config.iterations, ("psnr", *_LOSSES), _told)
        learning = learn(
            reconstruct(problem, learning.state), learning, course, folder, console, options.minutes
        )
        data, refined = as_refined(folder, problem, learning.state.scene, data, notes)
        write_scene(folder, learning.state, data, deep.metric)
        with stage(console, "looking at held-out frames"):
            judged = judge(folder, problem, learning.state, data, options.tools)
        say_if_cut_short(learning, course, notes)
        if learning.skipped:
            notes.warn(f"{learning.skipped} steps met numbers that are not finite and changed nothing")
        tracks = judged["tracks"]
        if tracks is not None and tracks["median_mm"] > _HARDLY * tracks["still_median_mm"]:
            notes.warn("tracks are hardly better than if nothing moved; more steps (--deform.iterations)?")
        unlike = [f"{one['class']} {one['iou']:.2f}" for one in judged["classes"] if one["iou"] < _UNLIKE]
        if unlike:
            notes.warn(f"what is drawn hardly overlaps what was seen (IoU): {', '.join(unlike)}; more steps?")
        if not data.test:
            notes.add("No frame is held out: nothing was judged that the scene had not learned from.")
        found = {
            "kind": "deform",
            "dataset": data.sequence.name,
            "preset": options.preset,
            "num_gaussians": learning.state.scene.gaussians.num,
            "frames": {"learned": len(data.train), "held_out": len(data.test)},
            "size": (data.sequence.width, data.sequence.height),
            "features": "none" if data.meaning is None else data.meaning.source.kind,
            "names": data.names,
            "depth": deep.found,
            "poses": refined,
            **learning.found(begun),
            "machine": describe_machine(),
            **judged,
            "notes": notes.all,
        }
        finish(folder, found, write_results)
    print_results(folder, found)
    return exit_code(learning.stopped)


def _recording(options: Options, notes: Notes) -> Deep:
    """The recording, the camera that is learned from first, with its depth."""
    told = (options.frames, options.read, options.scale)
    whole = open_recording(options.dataset, (), (), *told, opened=open_as_sequence).judged
    if is_photographs(options.dataset) and not is_recording(options.dataset):
        photographs = open_photographs(options.dataset, options.read)
        notes.add(_of_photographs(photographs, whole.viewmats[0, 0]))
    for flag, camera in (("--cameras", options.cameras), ("--eval-cameras", options.eval_cameras)):
        if camera and camera[0] not in whole.camera_ids:
            known = list(whole.camera_ids)
            raise ValueError(f"{flag}: {whole.name} has no camera {camera[0]}; it has {known}")
    judge = options.eval_cameras
    first = options.cameras or tuple(c for c in whole.camera_ids if c not in judge)[:1]
    if not first or first == judge:
        raise ValueError(
            f"--eval-cameras: expected another camera than that to learn from, found {list(judge)} for both"
        )
    others = [camera for camera in whole.camera_ids if camera not in (*first, *judge)]
    sequence = whole.select(cameras=[*first, *judge, *others])
    return with_depth(sequence, options.depth, options.deform.plane_depth, notes)


def _of_photographs(photographs: Photographs, facing: Float[np.ndarray, "4 4"]) -> str:
    """What their poses and points say of the unit of lengths; `facing` is the first view matrix."""
    told = f"{photographs.num} photographs are taken as frames, in their order."
    if photographs.cloud is None or not len(photographs.cloud.points):
        return told
    away = float(np.median(photographs.cloud.points @ facing[2, :3] + facing[2, 3]))
    return (
        f"{told} The points that came with their poses lie {away:.3g} before the first, in the poses' unit."
    )


def write_scene(folder: RunFolder, state: DeformState, data: DeformData, metric: bool = True) -> None:
    """Writes deformation.npz, and scene.ply, the scene as it was at the first frame.

    Args:
        folder: of the run.
        state: what was learned.
        data: what it was learned from.
        metric: whether depth, and so the scene, is in metres.
    """
    seen = data.sequence
    stored = StoredDeformation(
        state.scene,
        state.moving,
        data.meaning,
        data.times,
        np.asarray(seen.frame_ids),
        float(seen.times[-1] - seen.times[0]),
        seen.viewmats[:, 0],
        seen.Ks[:, 0],
        (seen.width, seen.height),
        seen.near,
        np.array(data.test, int),
        metric,
    )
    write_deformation(folder.path / NAME, stored)
    write_ply(folder.scene, jax.device_get(stored.at(0.0)))


def _teacher(options: Options) -> TeacherChoice | None:
    """Whose features are asked for, once all options fit; None: nobody's."""
    if len(options.cameras) > 1:
        raise ValueError(f"--cameras: expected one to learn from, found {list(options.cameras)}")
    if len(options.eval_cameras) > 1:
        raise ValueError(f"--eval-cameras: expected one to judge by, found {list(options.eval_cameras)}")
    asked = TeacherChoice(options.features, options.masks, options.sam, options.weights, options.level)
    option = "masks" if asked.masks != "auto" else "sam" if asked.sam is not None else None
    if option is not None and asked.features not in ("closed", "clip"):
        raise ValueError(
            f"--{option}: expected --features closed or clip, which ask of masks, found {options.features}"
        )
    if options.features != NOBODY:
        asked.check(also=(NOBODY,))
        return asked
    if asked != TeacherChoice(NOBODY):
        raise ValueError("--weights, --level: expected --features that have a use for them, found none")
    return None


def _told(row: Mapping[str, Any]) -> str:
    """The means of a row in words."""
    return "–" if row["psnr"] is None else f"{row['psnr']:.1f} dB"
