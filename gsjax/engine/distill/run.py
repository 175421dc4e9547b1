"""A run of `gsjax distill`: a scene and its photographs in, a folder with a field and a report out."""

import dataclasses
import shlex
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import jax
from rich.console import Console
from rich.text import Text

from gsjax.engine.budget import Budget, note_if_few
from gsjax.engine.checkpoint import write_field
from gsjax.engine.distill.file import FOLDER, NAME
from gsjax.engine.distill.judge import judge
from gsjax.engine.distill.results import asked_by, summarize
from gsjax.engine.distill.scene import FieldScene, SceneOptions, open_field_scene
from gsjax.engine.drive import Tick, drive
from gsjax.engine.ending import exit_code, finish
from gsjax.engine.folder import RunFolder, plain
from gsjax.engine.locks import releasing_locks, share
from gsjax.engine.machine import describe as describe_machine
from gsjax.engine.messages import Notes, counted, stage
from gsjax.engine.options import RESUME_MAY_CHANGE, Common, Resuming, Seeded, Timed, checked
from gsjax.engine.progress import (
    Progress,
    Schedule,
    load_run,
    means_of,
    note_if_cut_short,
    warn_of_mishaps,
    watch,
)
from gsjax.engine.recording import absolute_path
from gsjax.engine.records import digest
from gsjax.engine.teaching.cache import FeatureCache
from gsjax.engine.teaching.choice import TeacherChoice
from gsjax.engine.teaching.teaching import Teaching
from gsjax.methods.distill import PRESETS, Distill, DistillConfig

_OF_TRAINING = (
    "encoding",
    "grid",
    "rates",
    "contrast_after",
    "contrast_gamma",
    "contrast_pool",
    "contrast_patch",
)


@dataclass(frozen=True, kw_only=True)
class Options(Common, Resuming, Timed, Seeded, TeacherChoice, SceneOptions):
    """Options of `gsjax distill`."""

    out: Path | None = None
    """Folder for the field. Default: `field` in the run's folder."""
    preset: Literal["vote", "solve", "field", "paper"] = "field"
    """Default settings, the fastest first: vote (each Gaussian has the mean feature of the pixels that show
    it), solve (the features that the views show best, by least squares), field (a hash grid that begins as
    that solution), paper (the training of FD-3DGS, which takes tens of minutes)."""
    distill: DistillConfig = dataclasses.field(default_factory=lambda: PRESETS["field"])
    """Settings of the field and its training."""


@releasing_locks()
def run(options: Options) -> int:
    """Distil a field and report on it; returns the exit code.

    Raises:
        ValueError, OSError: the options cannot be followed; everything learned before that is on disk.
    """
    options = checked(options)
    console, begun = Console(stderr=True, highlight=False), perf_counter()
    budget = Budget(options.minutes, begun)
    with Notes(console) as notes:
        options.check()
        _note_unused(options.distill, notes)
        scene = open_field_scene(options)
        sha256 = digest(scene.file)
        out = _out(options, scene.file)
        folder = RunFolder.locked(out, overwrite=options.overwrite, resume=options.resume)
        settings = with_paths(options)
        if options.resume:
            folder.check_config(settings, but=RESUME_MAY_CHANGE)
        cache, photographs = FeatureCache(), scene.photographs
        teaching = Teaching(photographs, scene.taught, options, cache, console)
        if options.features == "auto":
            console.print(f"[bold]features[/]  {teaching.source.kind}: {teaching.about}", soft_wrap=True)
        method, values = Distill(options.distill), asdict(settings)
        with stage(console, "listing the Gaussians that each view shows"):
            problem, run = method.start(
                scene.gaussians,
                [photographs.camera(i) for i in scene.taught],
                teaching.teacher,
                scene.rasterize_mode,
                source=teaching.source,
                scene={
                    "file": str(scene.file.resolve()),
                    "sha256": sha256,
                    "photographs": plain({f.name: values[f.name] for f in fields(SceneOptions)}),
                },
            )
        progress = Progress(
            {
                str(scene.file.resolve()): sha256,
                "the teacher's features of photographs, and their poses": teaching.digest(),
            },
            begun=begun,
        )
        if options.resume:
            run, progress = load_run(folder.resume, run, progress)
            budget.check_exceeds(progress.used_seconds)
            notes.add(f"Resumed after {counted(run.step, 'step')} of an earlier run.")
        folder.write_config(settings)  # from here on an earlier field is gone
        share(out)  # with queries of the first answer
        ticks = drive(method, problem, run)
        total, losses = method.total(problem), means_of("rec", "cos", "contrast", "tv")
        schedule = Schedule("distilling", total, losses, _words)
        if not options.distill.iterations:  # each pass over the views has its own objective, known at its end
            of_pass = method.period(problem)
            schedule = Schedule(
                "distilling", total, lambda now, infos: losses(now, infos[-1:]), _words, of_pass
            )
        solved = method.steps_of_solution(problem)

        def first_answer(now: Tick) -> None:
            """Writes the field of the solution, which can be queried while it is trained further."""
            if now.step == solved < total:
                write_field(folder.path / NAME, now.result)
                field = shlex.quote(str(out))
                ask = f"gsjax query {field} {asked_by(teaching.source.kind)}"
                words = f"a first answer is there: {ask}, or gsjax view {field}"
                console.print(Text(words), soft_wrap=True)

        watch(ticks, progress, schedule, folder, console, budget=budget, evaluate=first_answer)
        steps, result = ticks.run.step, ticks.result
        write_field(folder.path / NAME, result)
        with stage(console, "scoring views"):
            judged = judge(folder, scene, teaching, result, options.distill, notes, budget)
        note_if_cut_short(progress, schedule, steps, notes)
        note_if_few(judged["scores"], scene.held_out, "held-out views", notes)
        _note_oddities(scene, progress, notes)
        found = {
            "kind": "distill",
            "dataset": photographs.name,
            "preset": options.preset,
            "features": teaching.source.kind,
            "second": options.second,
            "features_are": teaching.about,
            "masks": teaching.masks,
            "names": sorted(teaching.source.names.values()),
            "dimension": teaching.teacher.dimension,
            "num_gaussians": scene.gaussians.num,
            "trained": sum(leaf.size for leaf in jax.tree.leaves(ticks.run.params)),
            "views": {"taught": len(problem.views), "held_out": len(scene.held_out)},
            "size": photographs.sizes.max(0),
            "encoded": {"anew": cache.asked, "from_cache": cache.found},
            **progress.found(steps),
            "machine": describe_machine(),
            **judged,
            "notes": notes.all,
        }
        finish(folder, found, summarize)
    return exit_code(progress.stopped)


def with_paths(options: Options) -> Options:
    """The options with paths that are valid from any folder."""
    images = None if options.images is None else absolute_path(options.images)
    return replace(options, **options.located(), scene=Path(absolute_path(str(options.scene))), images=images)


def _note_unused(config: DistillConfig, notes: Notes) -> None:
    """Warn of settings that were changed without effect, because no training follows."""
    plain, given = asdict(DistillConfig()), asdict(config)
    if config.iterations == 0:
        changed = [name for name in _OF_TRAINING if given[name] != plain[name]]
        if changed:
            flags = ", ".join(f"--distill.{name.replace('_', '-')}" for name in changed)
            notes.warn(f"settings without an effect: {flags}; no training follows (--distill.iterations)")


def _words(row: Mapping[str, Any]) -> str:
    """A row of means in words."""
    if row["cos"] is not None:
        return f"1 - cosine to the teacher {row['cos']:.3f}"
    return "a vote of the views" if row["rec"] is None else f"squared error {row['rec']:.3g}"


def _out(options: Options, scene: Path) -> Path:
    """The folder for the field.

    Raises:
        ValueError: there is none, or it contains the scene, which replacing the field would remove.
    """
    if options.out is None and options.scene.is_file():
        raise ValueError(f"{options.scene}: a file has no folder of its own; --out names one for the field")
    out = options.scene / FOLDER if options.out is None else options.out
    if any(place.is_relative_to(out.resolve()) for place in (scene.resolve(), scene.parent.resolve())):
        raise ValueError(
            f"--out {out}: expected a folder for the field alone, found the one that contains its scene, "
            f"{scene}; name another"
        )
    return out


def _note_oddities(scene: FieldScene, progress: Progress, notes: Notes) -> None:
    warn_of_mishaps(progress, notes)
    if not len(scene.held_out):
        notes.add("No view is held out: all scores are of training views.")
