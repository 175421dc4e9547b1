"""The progress of a run: logged rows, timing, a progress bar or log lines, and checkpoints.

`watch` drives a method to its end for a command; saving, rows and the bar listen to its ticks.
"""

import json
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from gsjax.data.errors import DataWarning
from gsjax.engine.budget import Budget
from gsjax.engine.drive import COMPILING, Drive, Tick
from gsjax.engine.ending import completion
from gsjax.engine.folder import RunFolder
from gsjax.engine.inputs import Inputs, expect_same
from gsjax.engine.interrupts import raise_if_interrupted, shielded
from gsjax.engine.messages import Notes, counted, describe, reason
from gsjax.engine.saving import Saver
from gsjax.engine.streams import say_error
from gsjax.io.atomic import atomic_write
from gsjax.io.checkpoints import CheckpointError, load_checkpoint, save_checkpoint
from gsjax.optim.method import Run

KEPT = 2
"""Number of checkpoints kept: if the newest is damaged, the one before it remains."""
_SHOWN_EVERY_S = 0.2
_LINES = 10  # in a log
_COMPILING = "compiling"


@dataclass
class Progress:
    """The progress of a run.

    Attributes:
        about: digests of the run's inputs, by their descriptions.
        rows: one every few steps: step, seconds, and the schedule's summary of the steps since the last.
        recent: info of the steps since the last row.
        seconds: time of all steps, without compiling.
        compile_seconds: time of tracing and compiling.
        skipped: number of steps up to the last row that changed nothing, because a number was not finite.
        returns: number of returns to the best parameters, because the loss grew.
        is_settled: whether the result is the best parameters rather than the latest.
        shrink: factor by which `gsjax fit --minutes` downscales photographs; 0 before its first step.
        stopped: what ended the run early, or None.
        begun: start time of the command, by `time.perf_counter`, less the time of earlier commands, up to the
            checkpoint that is resumed.
        pace: recent steps per second; 0 before any is known.
    """

    about: Inputs = field(default_factory=dict)
    rows: list[dict[str, Any]] = field(default_factory=list)
    recent: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = 0.0
    compile_seconds: float = 0.0
    skipped: int = 0
    returns: int = 0
    is_settled: bool = False
    shrink: int = 0
    stopped: BaseException | None = None
    begun: float = field(default_factory=perf_counter)
    pace: float = field(default=0.0, init=False)

    @property
    def used_seconds(self) -> float:
        """Time of steps and of compiling."""
        return self.seconds + self.compile_seconds

    @property
    def total_seconds(self) -> float:
        """Time of the command, and of the earlier commands that it resumes."""
        return perf_counter() - self.begun

    def add(self, tick: Tick) -> None:
        """Record a step."""
        self.seconds += tick.seconds
        self.compile_seconds += tick.compile_seconds
        if tick.seconds and not tick.compile_seconds:
            now = 1 / tick.seconds
            self.pace = 1 / (0.95 / self.pace + 0.05 / now) if self.pace else now
        scalars = {name: value for name, value in tick.info.items() if getattr(value, "shape", None) == ()}
        self.recent.append(scalars)

    @property
    def mishaps(self) -> dict[str, int | bool]:
        """What went wrong and was recovered from, for metrics.json: the numbers of skipped steps and of
        returns, and whether the last steps were undone."""
        return {"skipped": self.skipped, "returns": self.returns, "settled": self.is_settled}

    def metadata(self) -> dict[str, Any]:
        """The metadata of a checkpoint."""
        recent = [{name: float(a) for name, a in info.items()} for info in jax.device_get(self.recent)]
        kept = ("rows", "seconds", "compile_seconds", "skipped", "shrink", "total_seconds")
        return {name: getattr(self, name) for name in kept} | {"about": dict(self.about), "recent": recent}

    def found(self, steps: int) -> dict[str, Any]:
        """The part of metrics.json about the progress, after a number of `steps`."""
        return {
            **completion(self.stopped),
            "steps": steps,
            **self.mishaps,
            "seconds": {
                "steps": self.seconds,
                "compile": self.compile_seconds,
                "total": self.total_seconds,
            },
            "curve": self.rows,
        }


@dataclass(frozen=True)
class Schedule:
    """What is displayed and logged during a run.

    Attributes:
        doing: the work, such as "distilling".
        total: total number of steps.
        row: (tick, infos of the steps since the last row, on the host, without skipped ones) -> the row
            apart from step and seconds. See `means_of`.
        words: row -> text.
        every: steps between rows.
    """

    doing: str
    total: int
    row: Callable[[Tick, list[Mapping[str, Any]]], dict[str, Any]]
    words: Callable[[Mapping[str, Any]], str]
    every: int = 10


def means_of(*names: str) -> Callable[[Tick, list[Mapping[str, Any]]], dict[str, Any]]:
    """A `Schedule.row` with the mean of each named loss over the steps that have a finite one; None if none
    has."""

    def row(now: Tick, infos: list[Mapping[str, Any]]) -> dict[str, Any]:
        found = {}
        for name in ("loss", *names):
            values = [float(info[name]) for info in infos if name in info and np.isfinite(info[name])]
            found[name] = float(np.mean(values)) if values else None
        return found

    return row


def watch(
    ticks: Drive,
    progress: Progress,
    schedule: Schedule,
    folder: RunFolder,
    console: Console,
    *,
    budget: Budget | None = None,
    save_every: float | None = None,
    evaluate: Callable[[Tick], dict[str, Any] | None] | None = None,
    enough: Callable[[Tick, Mapping[str, Any]], bool] | None = None,
    listeners: tuple[Callable[[Mapping[str, Any]], None], ...] = (),
) -> Progress:
    """Run until all steps are done, `enough` is met, the time is up, or Ctrl-C or an error ends the run.
    `ticks.run` is then the newest run, or the best if the newest is worse; if `enough` was met, the newest.

    Args:
        ticks: the method, from `drive`.
        progress: the progress so far; it is extended.
        schedule: what is shown and logged.
        folder: of the run.
        console: shows the progress.
        budget: the time limit; the time for steps starts now.
        save_every: seconds of work that may be lost when the run is killed.
        evaluate: tick -> additions to its row, or None; a tick with additions gets a row.
        enough: (tick, its row) -> whether to stop there; called after each new row.
        listeners: called with each new row.
    """
    saver, budget = Saver(schedule.doing, save_every), budget or Budget(None, perf_counter())
    is_enough = False
    budget.begin_steps(progress.used_seconds, console)

    def save(last: bool) -> None:
        saver(lambda: save_run(folder.resume, ticks.run, progress), last=last)

    def step() -> tuple[Tick, dict[str, Any] | None] | None:
        """The next step, if any, and its row, if it gets one. Ctrl-C waits for both: a resumed run begins
        after the step, and would lack its row."""
        if (now := next(ticks, None)) is None:
            return None
        progress.add(now)
        last = now.step == schedule.total or budget.is_over  # before evaluating, which takes time
        more = None if evaluate is None else evaluate(now)
        due = now.step % schedule.every == 0 or last or more is not None
        return now, _add_row(now, progress, schedule, folder, more or {}) if due else None

    with _Display(console, schedule, progress, ticks, budget) as display:
        try:
            while not budget.is_over and (taken := shielded(step)) is not None:
                now, row = taken
                for listen in listeners if row is not None else ():
                    listen(row)
                display.show()
                if row is not None and enough is not None and (is_enough := enough(now, row)):
                    break
                save(last=False)
                raise_if_interrupted()
        except (KeyboardInterrupt, Exception) as stopped:
            if any(leaf.is_deleted() for leaf in jax.tree.leaves(ticks.run) if isinstance(leaf, jax.Array)):
                raise  # a failed step has consumed the run; --resume has an earlier one
            if isinstance(stopped, KeyboardInterrupt):
                say_error(
                    f"by {reason(stopped)} after {ticks.run.step:,} of {schedule.total:,} steps",
                    word="stopped",
                )
            progress.stopped = stopped
        save(last=True)
    if not is_enough:
        shielded(ticks.settle)
    if (guard := ticks.run.guard) is not None:
        progress.returns, progress.is_settled = guard.returns, guard.is_settled
    return progress


def note_if_cut_short(progress: Progress, schedule: Schedule, steps: int, notes: Notes) -> None:
    """Note if `--minutes` ended the run before all steps were done."""
    if steps < schedule.total and progress.stopped is None:
        notes.add(f"Stopped by --minutes after {steps:,} of {schedule.total:,} steps.")


def warn_of_mishaps(progress: Progress, notes: Notes) -> None:
    """Warn about steps that changed nothing, because a number was not finite, and about returns."""
    if progress.skipped:
        notes.warn(
            f"{counted(progress.skipped, 'step')} produced non-finite numbers and changed nothing; if they "
            "are many, try lower learning rates"
        )
    warn_of_returns(progress, notes)


def warn_of_returns(progress: Progress, notes: Notes) -> None:
    """Warn about returns to the best parameters after the optimisation diverged."""
    if progress.returns:
        notes.warn(
            f"the optimisation diverged {counted(progress.returns, 'time')}, and continued from its best "
            "parameters with smaller steps; if the result is poor, try lower learning rates"
        )
    if progress.is_settled:
        notes.add("The last steps had made the loss worse, so the result is from the best steps before them.")


def save_run(folder: Path, run: Run, progress: Progress) -> None:
    """Write a checkpoint; the newest few are kept.

    Args:
        folder: RUN/resume.
        run: the newest run.
        progress: its progress.
    """
    save_checkpoint(folder / f"step-{run.step:08d}.npz", run, progress.metadata())
    for old in _saved(folder)[:-KEPT]:
        old.unlink()


def load_run(folder: Path, run: Run, progress: Progress) -> tuple[Run, Progress]:
    """Load the run and its progress from the newest intact checkpoint; the given ones if none was saved.

    Args:
        folder: RUN/resume.
        run: the run before the first step.
        progress: its progress before the first step, with digests of its inputs.

    Raises:
        CheckpointError: all checkpoints are damaged, or of another version.
        ValueError: the checkpoint is of a run with other inputs.
    """
    wrong, damaged, saved = None, [], _saved(folder)
    if not saved and (other := sorted(folder.glob("*.npz"))):
        raise CheckpointError(
            f"{other[0]}: expected a checkpoint step-*.npz, found one of another version of gsjax; start "
            "again with --overwrite in place of --resume"
        )
    for path in reversed(saved):
        try:
            found, stored = load_checkpoint(path)
        except CheckpointError as error:
            wrong = error
            damaged.append(path)
            continue
        expect_same(stored.pop("about"), progress.about, folder.parent)
        for later in damaged:  # otherwise they would count among the newest
            later.unlink()
        begun = progress.begun - stored.pop("total_seconds", 0.0)  # which older checkpoints do not have
        return found, Progress(progress.about, begun=begun, **stored)
    if wrong is not None:
        raise wrong
    return run, progress


def _saved(folder: Path) -> list[Path]:
    """Checkpoints in the order of their steps."""
    return sorted(folder.glob("step-*.npz"))


def _add_row(
    now: Tick, progress: Progress, schedule: Schedule, folder: RunFolder, more: Mapping[str, Any]
) -> dict[str, Any]:
    """Add a row, and write it to metrics.jsonl at once; warn if it cannot be written, as by a full disk."""
    infos = jax.device_get(progress.recent)
    sound = [info for info in infos if not info["skipped"]]
    progress.skipped += len(infos) - len(sound)
    progress.recent = []
    row = {"step": now.step, "seconds": progress.used_seconds, **schedule.row(now, sound), **more}
    progress.rows.append(row)
    try:
        with atomic_write(folder.metrics_lines) as temporary:
            temporary.write_text("".join(json.dumps(one) + "\n" for one in progress.rows), encoding="utf-8")
    except OSError as error:  # it is written with the next row
        message = f"could not log a row ({describe(error)}); {schedule.doing} goes on"
        warnings.warn(message, DataWarning, stacklevel=2)
    return row


class _Display:
    """A progress bar in a terminal; about ten lines in a log."""

    def __init__(
        self, console: Console, schedule: Schedule, progress: Progress, ticks: Drive, budget: Budget
    ):
        self._console, self._schedule, self._progress = console, schedule, progress
        self._ticks, self._budget, self._at = ticks, budget, 0.0
        self._line = int(_LINES * self._share())
        columns = (
            TextColumn(schedule.doing),
            BarColumn(),
            TextColumn("{task.fields[reached]}"),
            TimeRemainingColumn(compact=True),
            TextColumn("{task.description}"),
        )
        self._bar = Bar(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._task = self._bar.add_task(
            _COMPILING, total=1.0, completed=self._share(), reached=self._reached()
        )

    def __enter__(self) -> "_Display":
        if not self._console.is_terminal:
            words = f"{self._schedule.doing}; compiling, which takes half a minute the first time"
            self._console.print(words, soft_wrap=True)
        self._bar.start()
        jax.monitoring.register_event_listener(self._announce)
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()
        jax.monitoring.unregister_event_listener(self._announce)

    def show(self) -> None:
        """Update the bar; a log gets a line for each tenth of the run, once there is something to log."""
        rows, words = self._progress.rows, self._schedule.words
        if rows and perf_counter() - self._at > _SHOWN_EVERY_S:
            share, reached = self._share(), self._reached()
            self._bar.update(self._task, completed=share, description=words(rows[-1]), reached=reached)
            self._at = perf_counter()
        tenth = int(_LINES * self._share())
        if not self._console.is_terminal and rows and tenth > self._line:
            self._line = tenth
            self._console.print(f"{self._reached()}: {words(rows[-1])}", soft_wrap=True)

    def _announce(self, event: str, **_: Any) -> None:
        """Announce that a later step is about to compile."""
        if event != COMPILING or self._ticks.tick is None:
            return
        self._bar.update(self._task, description=_COMPILING)
        if not self._console.is_terminal:
            words = f"{self._reached()}: compiling again, for arrays of other sizes"
            self._console.print(words, soft_wrap=True)

    def _share(self) -> float:
        """The fraction done, of steps or of their time, whichever is larger."""
        return min(1.0, max(self._ticks.run.step / max(1, self._schedule.total), self._budget.share))

    def _reached(self) -> str:
        step = self._ticks.run.step
        if self._budget.minutes is None:
            return f"{step:,} of {self._schedule.total:,} steps"
        return f"{self._budget.used / 60:.1f} of {self._budget.minutes:g} min, {step:,} steps"
