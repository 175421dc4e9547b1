"""A run of `gsjax fit`: photographs in, a folder with a scene, its scores and a report out."""

from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Literal

import jax
import numpy as np
from jaxtyping import Float
from rich.console import Console

from gsjax.data.photographs import Photographs
from gsjax.engine.budget import Budget
from gsjax.engine.drive import Drive, drive
from gsjax.engine.ending import completion, exit_code, finish
from gsjax.engine.files import write_scene
from gsjax.engine.fit.costs import settings_within
from gsjax.engine.fit.ending import Ending, judged_subset
from gsjax.engine.fit.judge import Judge
from gsjax.engine.fit.results import summarize
from gsjax.engine.fit.schedule import Evaluation, evaluated, schedule_of
from gsjax.engine.fit.sizes import Sizes
from gsjax.engine.fit.start import start_from
from gsjax.engine.fit.tensorboard import TensorBoard
from gsjax.engine.folder import RunFolder
from gsjax.engine.inputs import photographs_digest
from gsjax.engine.locks import releasing_locks
from gsjax.engine.machine import describe as describe_machine
from gsjax.engine.messages import Notes, counted
from gsjax.engine.options import RESUME_MAY_CHANGE, OfDataset, checked, expect_positive
from gsjax.engine.photographs import choose_photographs, read_frames, smaller, split
from gsjax.engine.progress import Progress, load_run, warn_of_mishaps, watch
from gsjax.engine.recording import absolute_path
from gsjax.io.atomic import write_npz
from gsjax.methods.fit import Fit, FitConfig, Model, Problem, refined_frames
from gsjax.methods.fit.model import in_slots
from gsjax.methods.fit.padding import sizes_of
from gsjax.optim.method import Run
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.origin import cameras_in_world

_UNLIMITED = 1_000_000  # steps
_MAY_CHANGE = (*RESUME_MAY_CHANGE, "tensorboard", "save_every")


@dataclass(frozen=True, kw_only=True)
class Options(OfDataset):
    """Options of `gsjax fit`."""

    preset: Literal["default", "quick", "classic", "depth", "published"] = "default"
    """Default settings of the fit: quick (for a first impression), classic (cloning and splitting, as in
    3DGS), depth (for RGB-D), published (those of 3DGS-MCMC, for a GPU or an overnight run)."""
    until_psnr: float | None = None
    """Stop when held-out photographs reach this PSNR, dB."""
    judge_every: int = 500
    """Steps between evaluations of held-out photographs. With --minutes there are ten more, but those that
    would take more than a twentieth of the time are left out, except with --until-psnr."""
    save_every: float = 30.0
    """Seconds of fitting that a run may lose when it is killed."""
    tensorboard: bool = False
    """Also log loss, PSNR and number of Gaussians for TensorBoard, in RUN/tensorboard."""
    scale: float | None = None
    """Size of the pictures (width and height) relative to the original, for example 0.5. Default: the
    original, but at most 1,600 pixels a side. With --minutes, they are downscaled further if that pays."""
    fit: FitConfig = field(default_factory=FitConfig)
    """Settings of the fit. With --minutes and no other setting, the number of steps, the largest number of
    Gaussians and the degree of their colours follow from what there is time for."""


@releasing_locks()
def run(options: Options) -> int:
    """Fit a scene and report on it; returns the exit code.

    Raises:
        ValueError, OSError: an option cannot be met; everything fitted before that is on disk.
    """
    options = checked(options)
    expect_positive(options, "until_psnr", "judge_every", "save_every")
    console, begun = Console(stderr=True, highlight=False), perf_counter()
    budget = Budget(options.minutes, begun)
    with Notes(console) as notes:
        photographs = choose_photographs(
            options.dataset,
            options.read,
            frames=options.frames,
            cameras=options.cameras,
            eval_cameras=options.eval_cameras,
        )
        photographs = _at_scale(photographs, options.scale, notes, console)
        chosen, held_out = split(photographs, options.test_every)
        if options.until_psnr is not None and not len(held_out):
            raise ValueError("--until-psnr: nothing is held out to judge by; see --test-every")
        folder = RunFolder.locked(options.out, overwrite=options.overwrite, resume=options.resume)
        settings = replace(options, dataset=absolute_path(options.dataset))
        is_default = options.fit == FitConfig(seed=options.fit.seed)  # so that --minutes decide
        if options.resume:
            differ = is_default and (folder.setting("minutes") is None) != (options.minutes is None)
            may_change = [name for name in _MAY_CHANGE if not (differ and name == "minutes")]
            folder.check_config(settings, but=tuple(may_change))
        frames = read_frames(photographs, console)
        progress = Progress({"the photographs": photographs_digest(photographs, chosen, frames)}, begun=begun)
        fitted = [frames[i] for i in chosen]
        width, height = photographs.sizes[photographs.sizes.prod(1).argmax()].tolist()
        config, in_time = options.fit, None
        if options.minutes is not None and is_default:
            config, in_time = settings_within(config, (width, height), options.minutes)
            config = replace(config, steps=_UNLIMITED)
        config, cloud = start_from(photographs, fitted, config, console)
        method = Fit(config)
        problem, run = method.start(fitted, cloud, photographs.background)
        if options.resume:
            run, progress = load_run(folder.resume, run, progress)
            budget.check_exceeds(progress.used_seconds)
            notes.add(f"Resumed after {counted(run.step, 'step')} of an earlier run.")
            if is_default:  # the slots that an earlier run chose for its minutes are kept
                config = replace(config, cap=run.params.gaussians.num)
                method = Fit(config)
        if in_time is not None:
            _tell_settings(config, None if options.resume else in_time, notes, console)
        folder.write_config(settings)  # from here on an earlier run is gone
        if options.minutes is not None:
            sizes = Sizes(config, (width, height), budget, progress, notes, console)
            problem = problem._replace(shrink=sizes)
        board = TensorBoard(folder.path, progress.rows) if options.tensorboard else None
        judged = [(photographs.names[i], frames[i]) for i in held_out]
        judge = Judge(config, problem.background, sizes_of(fitted))
        ending = Ending(judge, fitted, judged, progress, budget, console, notes)
        budget.rest_s = ending.rest_s
        ticks = _fitted(options, method, problem, run, folder, ending, board)
        stopped, run, gaussians = progress.stopped, ticks.run, ticks.result
        if isinstance(stopped, KeyboardInterrupt):
            console.print("stopping: the scene is scored and written; Ctrl-C again leaves out the scores")
        budget.hurried = stopped is not None
        _note_oddities(options, config, progress, gaussians, stopped is None, notes)
        found_frames = refined_frames(problem, run.params)
        names = [photographs.names[i] for i in chosen]
        write_cameras(folder, names, found_frames, run.params, photographs.origin)
        gaussians, light = ending.pruned(gaussians, found_frames, config)
        write_scene(folder.scene, gaussians, origin=photographs.origin, antialiased=config.antialiased)
        # In the slots of the fit, so that its compiled programs can render it.
        shown = in_slots(gaussians, run.params.gaussians.num) if gaussians.num else gaussians
        scores = ending.scored(shown, (photographs.names[chosen[0]], fitted[0]), folder)
        ablation = ending.ablated(shown, light)
        ending.filmed(shown, found_frames, problem.extent.focus, folder)
        seconds = {"fit": progress.seconds, "compile": progress.compile_seconds, **ending.seconds}
        found = {
            "kind": "fit",
            "dataset": photographs.name,
            **completion(stopped),
            "steps": run.step,
            **progress.mishaps,
            "num_gaussians": gaussians.num,
            "sh_degree": gaussians.sh_degree,
            "photographs": {
                "fitted": len(chosen),
                "held_out": len(held_out),
                "looked_at": len(judged_subset(judged)),
            },
            "size": photographs.sizes.max(0),
            "start": problem.start,
            "seconds": seconds | {"total": progress.total_seconds},
            "machine": describe_machine(),
            "test": scores.mean() if judged and scores.rows else None,
            "views": scores.rows,
            "parts": ablation,
            "curve": progress.rows,
            "notes": notes.all,
        }
        if board is not None:
            board.close({f"held_out/{row['view']}": folder.path / row["picture"] for row in scores.rows})
        finish(folder, found, summarize)
    return exit_code(stopped)


def _at_scale(photographs: Photographs, scale: float | None, notes: Notes, console: Console) -> Photographs:
    """The photographs at the size of the fit; says so if that is smaller without having been asked for."""
    scaled = smaller(photographs, scale)
    if scale is None and (shrunk := (scaled.sizes < photographs.sizes).any(1)).any():
        largest = int(photographs.sizes.prod(1).argmax())
        before, after = ("{}x{}".format(*of.sizes[largest]) for of in (photographs, scaled))
        some = "" if shrunk.all() else f" ({shrunk.sum()} of {len(shrunk)} are so large)"
        words = f"photographs of {before} are fitted at {after}{some}; for more, give --scale"
        console.print(words, soft_wrap=True)
        notes.add(f"P{words[1:]}.")
    return scaled


def _tell_settings(config: FitConfig, steps: int | None, notes: Notes, console: Console) -> None:
    """Print and note the settings that --minutes chose for a number of steps; None in a resumed run, which
    has the Gaussians that were chosen at its start."""
    most, colours = f"up to {config.cap:,} Gaussians", f"with colours of degree {config.sh_degree}"
    words = f"{most}, as when the run was started, {colours}"
    if steps is not None:
        words = f"{most} {colours}, as there should be time for {steps:,} steps"
    console.print(words, soft_wrap=True)
    notes.add(f"U{words[1:]} (--minutes).")


def _fitted(
    options: Options,
    method: Fit,
    problem: Problem,
    run: Run,
    folder: RunFolder,
    ending: Ending,
    board: TensorBoard | None,
) -> Drive:
    """Fit until the steps or minutes are used up, the wanted PSNR is reached, or the run is stopped."""
    budget, progress, judge, judged = ending.budget, ending.progress, ending.judge, ending.judged
    goal, steps = options.until_psnr, method.config.steps

    def is_met(run: Run) -> bool:
        """Whether the wanted PSNR is reached: by the views evaluated after the newest step, if they were, and
        then by all held-out views."""
        rows = [row for row in evaluated(progress.rows)[-1:] if row["step"] == run.step]
        if goal is None or not any(row["test_psnr"] >= goal for row in rows):
            return False
        found = judge(run.params.gaussians, judged).mean()["psnr"]
        return found is not None and found >= goal

    def share(step: int) -> float:
        """The share of the fit that is done: of its steps or of its time for them, whichever is larger."""
        return max(step / steps, budget.share)

    shrink = problem.shrink  # logging a row must not make `Sizes` advance to the next size
    shown = (lambda _: shrink.now) if isinstance(shrink, Sizes) else shrink
    ticks = drive(method, problem, run, progress=(lambda step: 1.0) if is_met(run) else share)
    watch(
        ticks,
        progress,
        schedule_of(steps, shown, progress),
        folder,
        ending.console,
        budget=budget,
        save_every=options.save_every,
        evaluate=Evaluation(
            judge, judged_subset(judged), options.judge_every, steps, goal is not None, budget
        ),
        enough=lambda now, row: row["test_psnr"] is not None and is_met(now.run),
        listeners=() if board is None else (board.add,),
    )
    return ticks


def _note_oddities(
    options: Options,
    config: FitConfig,
    progress: Progress,
    gaussians: Gaussians,
    finished: bool,
    notes: Notes,
) -> None:
    warn_of_mishaps(progress, notes)
    compiling, given = progress.compile_seconds, 60 * (options.minutes or np.inf)
    if compiling > given / 3:
        kept = jax.config.jax_enable_compilation_cache and jax.config.jax_compilation_cache_dir
        later = "; programs are kept, and the next fit of this size finds most of them" if kept else ""
        notes.warn(f"compiling took {compiling:.0f} s, of {given:.0f} given{later}")
    if finished and gaussians.sh_degree < config.sh_degree:
        notes.add(
            f"Colours are of degree {gaussians.sh_degree}: a degree is added every "
            f"{config.sh_every:,} steps (--fit.sh-every)."
        )


def write_cameras(
    folder: RunFolder,
    names: list[str],
    frames: list[Frame],
    model: Model,
    origin: Float[np.ndarray, "3"] | None = None,
) -> None:
    """Write cameras.npz, if cameras or exposures were learned: names [V], viewmats [V,4,4] (world to camera,
    OpenCV axes; those of the frames), exposures [V,3,4] (the affine maps of colours).

    Args:
        folder: of the run.
        names: of the photographs.
        frames: their frames, with the cameras as learned.
        model: what was learned.
        origin: what the cameras are relative to; it is added back.
    """
    if model.twists is None and model.exposures is None:
        return
    viewmats = np.concatenate([frame.cameras.viewmat for frame in frames])
    found = {"names": np.array(names), "viewmats": cameras_in_world(viewmats, origin)}
    if model.exposures is not None:
        exposures = np.asarray(model.exposures)
        found["exposures"] = np.eye(3, 4) + exposures - exposures.mean(0)
    write_npz(folder.path / "cameras.npz", found)
