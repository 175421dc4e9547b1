"""`gsjax fit`: a static scene from posed photographs."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Literal

import jax
import numpy as np
from jaxtyping import Float
from rich.console import Console

from gsjax.engine.ending import ended, exit_code, finish
from gsjax.engine.fit.loop import follow, some_of
from gsjax.engine.fit.orbit import write_orbit
from gsjax.engine.fit.results import Curve, Plans, Scores, judge, living, print_results, write_results
from gsjax.engine.fit.resume import load
from gsjax.engine.fit.start import start_from
from gsjax.engine.fit.tensorboard import TensorBoard
from gsjax.engine.fit.worth import parts
from gsjax.engine.folder import RunFolder
from gsjax.engine.machine import describe as describe_machine
from gsjax.engine.messages import Notes, reason, stage
from gsjax.engine.options import OF_NO_BEARING, OfDataset, checked, expect_positive, preset_options
from gsjax.engine.photographs import choose_photographs, read_views, say_if_large, split
from gsjax.engine.recording import located
from gsjax.io.atomic import write_npz
from gsjax.io.ply import write_ply
from gsjax.methods.fit import (
    PRESETS,
    FitConfig,
    Model,
    View,
    as_found,
    begin,
    light_of,
    needed,
)
from gsjax.scene.gaussians import Gaussians, take

HELP = " All frames of a recording are taken as photographs of one scene."
_OF_NO_BEARING = (*OF_NO_BEARING, "tensorboard", "save_every")  # on what is fitted


@dataclass(frozen=True, kw_only=True)
class Options(OfDataset):
    """What `gsjax fit` is told."""

    preset: Literal["default", "quick", "classic", "depth", "published"] = "default"
    """How the scene is fitted unless given: quick (a first look), classic (cloning and splitting, as in
    3DGS), depth (for RGB-D), published (those of 3DGS-MCMC, for a GPU or a night)."""
    until_psnr: float | None = None
    """Stop when held-out photographs are seen with so many dB."""
    judge_every: int = 500
    """Steps between looks at held-out photographs; under --minutes there are ten besides."""
    save_every: float = 30.0
    """Seconds of fitting that a run may lose when it is killed."""
    tensorboard: bool = False
    """Write the curve for TensorBoard too, into RUN/tensorboard."""
    fit: FitConfig = field(default_factory=FitConfig)
    """How the scene is fitted."""


def options_for(arguments: list[str]) -> tuple[type[Options], list[str]]:
    """The options whose defaults are those of the preset that is named."""
    return preset_options(Options, arguments, "fit", PRESETS)


def run(options: Options) -> int:
    """Fit a scene and report on it; returns the exit code.

    Raises:
        ValueError, OSError: what was asked cannot be done; everything fitted before that is on disk.
    """
    options = checked(options)
    expect_positive(options, "until_psnr", "judge_every", "save_every")
    console, begun = Console(stderr=True, highlight=False), perf_counter()
    with Notes(console) as notes:
        photographs = choose_photographs(
            options.dataset,
            options.read,
            scale=options.scale,
            frames=options.frames,
            cameras=options.cameras,
            eval_cameras=options.eval_cameras,
        )
        chosen, held_out = split(photographs, options.test_every)
        if options.until_psnr is not None and not len(held_out):
            raise ValueError("--until-psnr: nothing is held out to judge by; see --test-every")
        folder = RunFolder(options.out, overwrite=options.overwrite, resume=options.resume)
        settings = replace(options, dataset=located(options.dataset))
        if options.resume:
            folder.check_config(settings, but=_OF_NO_BEARING)
        say_if_large(photographs)
        views = read_views(photographs, console)
        fitted = [views[i] for i in chosen]
        config, cloud = start_from(photographs, fitted, options.fit, console)
        problem, state = begin(fitted, config, cloud, photographs.background)
        folder.write_config(settings)  # from here on an earlier run is gone
        curve = Curve()
        if options.resume:
            state, curve = load(folder.resume, problem, state)
            notes.add(f"Resumed after {state.step} steps of an earlier run.")
        board = TensorBoard(folder.path, curve.rows) if options.tensorboard else None
        judged = [(photographs.names[i], views[i]) for i in held_out]
        state, stopped = follow(
            problem,
            state,
            curve,
            judged,
            folder,
            console,
            minutes=options.minutes,
            until_psnr=options.until_psnr,
            judge_every=options.judge_every,
            save_every=options.save_every,
            board=board,
        )
        if isinstance(stopped, KeyboardInterrupt):
            console.print("stopping: what there is is written; Ctrl-C again leaves out the scores")
        seconds = {"fit": curve.seconds, "compile": curve.compile_seconds}
        gaussians, finished, worth = living(state.gaussians)[0], stopped is None, []
        _say_what_was_odd(options, curve, gaussians, finished, notes)
        found_views = as_found(problem, state.model)
        write_cameras(folder, [photographs.names[i] for i in chosen], found_views, state.model)
        aside = Aside(seconds, console, notes)
        light, plans, scores = None, Plans(), Scores([])
        if finished:  # who pressed Ctrl-C does not wait for this
            with aside("pruning", "leaving out what no photograph needs"):
                gaussians, light = without_needless(found_views, problem.config, gaussians, notes)
        write_ply(folder.scene, gaussians)
        with aside("scores", "scoring held-out photographs"):
            shown = judged or [(photographs.names[i], views[i]) for i in chosen[:1]]
            scores = judge(problem, gaussians, shown, folder, plans)
        if finished and judged and light is not None and gaussians.num:
            with aside("parts", "looking at what each part of the scene is worth"):
                worth = parts(problem, gaussians, light, some_of(judged), curve, plans)
        if finished:
            with aside("video", "drawing a video of the scene"):
                write_orbit(folder, problem._replace(views=found_views), gaussians)
        found = {
            "kind": "fit",
            "dataset": photographs.name,
            **ended(stopped),
            "steps": state.step,
            "skipped": curve.skipped,
            "num_gaussians": gaussians.num,
            "sh_degree": gaussians.sh_degree,
            "photographs": {
                "fitted": len(chosen),
                "held_out": len(held_out),
                "looked_at": len(some_of(judged)),
            },
            "size": photographs.sizes.max(0),
            "start": problem.start,
            "seconds": seconds | {"total": perf_counter() - begun},
            "machine": describe_machine(),
            "test": scores.mean() if judged and scores.rows else None,
            "views": scores.rows,
            "parts": worth,
            "curve": curve.rows,
            "notes": notes.all,
        }
        if board is not None:
            board.close({f"held_out/{row['view']}": folder.path / row["picture"] for row in scores.rows})
        finish(folder, found, write_results)
    print_results(folder, found)
    return exit_code(stopped)


class Aside:
    """What is done with a fit after its last step, and what it can do without: Ctrl-C and errors end it, and
    the run still has its report."""

    def __init__(self, seconds: dict[str, float], console: Console, notes: Notes):
        self._seconds, self._console, self._notes = seconds, console, notes

    @contextmanager
    def __call__(self, name: str, words: str) -> Iterator[None]:
        """Say what goes on, and how long it took."""
        begun = perf_counter()
        try:
            with stage(self._console, words):
                yield
        except (KeyboardInterrupt, OSError, ValueError) as error:
            self._notes.warn(f"{words} was left out: {reason(error)}")
        self._seconds[name] = perf_counter() - begun


def _say_what_was_odd(
    options: Options, curve: Curve, gaussians: Gaussians, finished: bool, notes: Notes
) -> None:
    if curve.skipped:
        notes.add(f"{curve.skipped} steps met numbers that are not finite and changed nothing.")
    compiling, given = curve.compile_seconds, 60 * (options.minutes or np.inf)
    if compiling > given / 3:
        kept = jax.config.jax_enable_compilation_cache and jax.config.jax_compilation_cache_dir
        later = "; programs are kept, and the next fit at this size finds most of them" if kept else ""
        notes.warn(f"compiling took {compiling:.0f} s, of {given:.0f} given{later}")
    if finished and gaussians.sh_degree < options.fit.sh_degree:
        notes.add(
            f"Colours are of degree {gaussians.sh_degree}: a degree is added every "
            f"{options.fit.sh_every:,} steps (--fit.sh-every)."
        )


def write_cameras(folder: RunFolder, names: list[str], views: list[View], model: Model) -> None:
    """Writes cameras.npz, where cameras or exposures were learned: names [V], viewmats [V,4,4] (world to
    camera, OpenCV axes), exposures [V,3,4] (the affine maps of colours)."""
    if model.twists is None and model.exposures is None:
        return
    found = {"names": np.array(names), "viewmats": np.stack([view.viewmat for view in views])}
    if model.exposures is not None:
        exposures = np.asarray(model.exposures)
        found["exposures"] = np.eye(3, 4) + exposures - exposures.mean(0)
    write_npz(folder.path / "cameras.npz", found)


def without_needless(
    views: list[View], config: FitConfig, gaussians: Gaussians, notes: Notes
) -> tuple[Gaussians, Float[np.ndarray, "n"]]:
    """Those that some photograph needs, and the light that each sends.

    Args:
        views: the photographs that were fitted.
        config: how; its `prune` is the share of light below which one is not needed.
        gaussians: the scene.
        notes: told how many were left out.
    """
    if not gaussians.num:
        return gaussians, np.zeros(0)
    light = light_of(gaussians, views, "antialiased" if config.antialiased else "classic")
    kept = needed(light, config.prune) if config.prune else np.ones(len(light), bool)
    if not kept.all():
        some = f"{(~kept).sum():,} of {gaussians.num:,} Gaussians were left out in the end"
        notes.add(f"{some}: together they sent at most {config.prune:.2%} of the light into any photograph.")
    return take(gaussians, kept), light[kept]
