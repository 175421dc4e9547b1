"""`gsjax distill`: meaning on the Gaussians of a scene that stands, to be asked by `gsjax query`."""

import dataclasses
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
from rich.console import Console

from gsjax.engine.distill.cache import FeatureCache, cache_folder
from gsjax.engine.distill.choice import Second, TeacherChoice, TeacherOptions
from gsjax.engine.distill.file import FOLDER, NAME, StoredField, write_field
from gsjax.engine.distill.results import judge, print_results, write_results
from gsjax.engine.distill.scene import FieldScene, SceneOptions, open_scene
from gsjax.engine.distill.teacher import Teaching
from gsjax.engine.ending import exit_code, finish
from gsjax.engine.folder import RunFolder, plain
from gsjax.engine.learning import Course, Learning, learn, load, say_if_cut_short
from gsjax.engine.machine import describe as describe_machine
from gsjax.engine.messages import Notes, stage
from gsjax.engine.options import RESUME_MAY_CHANGE, Common, Resuming, Seeded, Timed, checked
from gsjax.engine.recording import located
from gsjax.engine.records import digest
from gsjax.methods.distill import DistillConfig, begin_distill, distill

HELP = (
    " As in `gsjax distill RUN`, or, of what others made, `gsjax distill scene.ply --images PHOTOGRAPHS "
    "--features FILES --out FIELD`. What encoders and segmenters say of photographs is kept by what they "
    f"were shown, in {cache_folder()}; delete that folder to have it said anew, or for its space."
)
_LOSSES = ("rec", "cos", "contrast", "tv")


@dataclass(frozen=True, kw_only=True)
class Options(Common, Resuming, Timed, Seeded, TeacherOptions, SceneOptions):
    """What `gsjax distill` is told."""

    out: Path | None = None
    """Folder for the field. Unless given, `field` in the run's."""
    second: Second = "none"
    """Who teaches beside --features clip, which knows of masks alone: maskclip, CLIP's vectors of patches, by
    the same --weights. What they count is --distill.weights.map."""
    snap: int = 0
    """Put outlines of masks on the picture's edges, where there are any within so many pixels: for masks
    whose outlines are off, as many segmenters' are."""
    distill: DistillConfig = dataclasses.field(default_factory=DistillConfig)
    """How it is learned."""


def run(options: Options) -> int:
    """Distil a field and report on it; returns the exit code.

    Raises:
        ValueError, OSError: what was asked cannot be done; everything learned before that is on disk.
    """
    options = checked(options)
    console, begun = Console(stderr=True, highlight=False), perf_counter()
    with Notes(console) as notes:
        asked = TeacherChoice(
            options.features,
            options.masks,
            options.sam,
            options.weights,
            options.level,
            options.second,
            options.snap,
        )
        asked.check()
        scene = open_scene(options)
        sha256 = digest(scene.file)
        folder = RunFolder(_out(options, scene.file), overwrite=options.overwrite, resume=options.resume)
        settings = _settings(options, asked)
        if options.resume:
            folder.check_config(settings, but=RESUME_MAY_CHANGE)
        cache, photographs = FeatureCache(), scene.photographs
        teaching = Teaching(photographs, scene.taught, asked, cache, console)
        if asked.features == "auto":
            console.print(f"[bold]features[/]  {teaching.source.kind}: {teaching.about}", soft_wrap=True)
        with stage(console, "looking which Gaussians each view shows"):
            cameras = [photographs.camera(i) for i in scene.taught]
            problem, state = begin_distill(
                scene.gaussians, cameras, teaching.teacher, options.distill, scene.rasterize_mode
            )
        learning = Learning(
            state,
            {
                str(scene.file.resolve()): sha256,
                "what is said of photographs, and their poses": teaching.digest(),
            },
        )
        if options.resume:
            learning = load(folder.resume, learning)
            notes.add(f"Resumed after {learning.state.step} steps of an earlier run.")
        folder.write_config(settings)  # from here on an earlier field is gone
        course = Course("distilling", options.distill.iterations, _LOSSES, _told)
        learning = learn(distill(problem, learning.state), learning, course, folder, console, options.minutes)
        told = asdict(settings)
        stored = StoredField(
            learning.state.field,
            problem.rows,
            teaching.source,
            {
                "file": str(scene.file.resolve()),
                "sha256": sha256,
                "num_gaussians": scene.gaussians.num,
                "rasterize_mode": scene.rasterize_mode,
                "photographs": plain({f.name: told[f.name] for f in fields(SceneOptions)}),
            },
        )
        write_field(folder.path / NAME, stored)
        with stage(console, "asking it about views"):
            judged = judge(folder, scene, teaching, stored, options.distill, notes)
        say_if_cut_short(learning, course, notes)
        _say_what_was_odd(scene, learning, notes)
        found = {
            "kind": "distill",
            "dataset": photographs.name,
            "features": teaching.source.kind,
            "second": options.second,
            "features_are": teaching.about,
            "masks": teaching.masks,
            "names": sorted(teaching.source.names.values()),
            "dimension": teaching.teacher.dimension,
            "num_gaussians": scene.gaussians.num,
            "trained": sum(leaf.size for leaf in jax.tree.leaves(learning.state.field)),
            "views": {"taught": len(problem.views), "held_out": len(scene.held_out)},
            "size": photographs.sizes.max(0),
            "encoded": {"anew": cache.asked, "from_cache": cache.found},
            **learning.found(begun),
            "machine": describe_machine(),
            **judged,
            "notes": notes.all,
        }
        finish(folder, found, write_results)
    print_results(folder, found)
    return exit_code(learning.stopped)


def _told(row: Mapping[str, Any]) -> str:
    """The means of a row in words."""
    return "1 - cosine to the teacher " + ("–" if row["cos"] is None else f"{row['cos']:.3f}")


def _out(options: Options, scene: Path) -> Path:
    """The folder of the field.

    Raises:
        ValueError: there is none, or its scene lies in it, which goes with all else when it is replaced.
    """
    if options.out is None and options.scene.is_file():
        raise ValueError(
            f"{options.scene}: a PLY file has no folder of its own; --out names one for the field"
        )
    out = options.scene / FOLDER if options.out is None else options.out
    if any(place.is_relative_to(out.resolve()) for place in (scene.resolve(), scene.parent.resolve())):
        raise ValueError(
            f"--out {out}: expected a folder for the field alone, found one with its scene, {scene}, in it; "
            "name another"
        )
    return out


def _settings(options: Options, asked: TeacherChoice) -> Options:
    """The options by which a run finds everything again from elsewhere."""
    found = asked.located() | {"scene": options.scene and Path(located(str(options.scene)))}
    if options.images is not None:
        found["images"] = located(options.images)
    return replace(options, **found)


def _say_what_was_odd(scene: FieldScene, learning: Learning, notes: Notes) -> None:
    if learning.skipped:
        notes.warn(f"{learning.skipped} steps met numbers that are not finite and changed nothing")
    if not len(scene.held_out):
        notes.add("No view is held out: nothing was judged that the field had not seen.")
