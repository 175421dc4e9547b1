"""Steps of a method that learns by descent: shown and saved while they go on, until there are enough."""

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any, Protocol

import jax
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gsjax.engine.ending import ended
from gsjax.engine.folder import RunFolder
from gsjax.engine.interrupts import raise_if_interrupted, shielded
from gsjax.engine.messages import Notes
from gsjax.engine.saving import Saver
from gsjax.io.atomic import atomic_write
from gsjax.io.checkpoints import load_checkpoint, load_metadata, save_checkpoint

_STATE = "state.npz"
_LOGGED_EVERY = 10  # steps
_SHOWN_EVERY_S = 0.2
_LINES = 10  # of a log


class Made(Protocol):
    """A step that was made, as every host loop yields it: the state after it, what it says, and its time."""

    state: Any
    info: dict[str, Any]
    seconds: float
    compile_seconds: float


@dataclass(frozen=True)
class Course:
    """What is to be learned.

    Attributes:
        doing: in a word: "distilling".
        total: steps, in all.
        losses: by the names that steps have for them, those that a row has.
        told: a row in words.
    """

    doing: str
    total: int
    losses: tuple[str, ...]
    told: Callable[[Mapping[str, Any]], str]


@dataclass
class Learning:
    """How it goes on.

    Attributes:
        state: to go on from.
        about: what it is of: digests, by what they are of in words.
        rows: step, seconds, and the means of each loss over the steps since the row before.
        recent: losses of the steps since the last row.
        seconds: of all steps so far, without what compiled.
        compile_seconds: that compiling took.
        skipped: steps up to the last row that met numbers that are not finite, and changed nothing.
        stopped: what ended it early, or None.
    """

    state: Any
    about: Mapping[str, str | None]
    rows: list[dict[str, Any]] = field(default_factory=list)
    recent: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = 0.0
    compile_seconds: float = 0.0
    skipped: int = 0
    stopped: BaseException | None = None

    def is_over(self, minutes: float | None) -> bool:
        """Whether so many minutes are used up."""
        return minutes is not None and self.seconds + self.compile_seconds >= 60 * minutes

    def metadata(self) -> dict[str, Any]:
        """What is saved beside the state."""
        recent = [{name: float(a) for name, a in info.items()} for info in jax.device_get(self.recent)]
        kept = ("rows", "seconds", "compile_seconds", "skipped")
        told = {"about": dict(self.about), "recent": recent, "step": self.state.step}
        return {name: getattr(self, name) for name in kept} | told

    def found(self, begun: float) -> dict[str, Any]:
        """What metrics.json says of it; `begun` is by the performance counter."""
        return {
            **ended(self.stopped),
            "steps": self.state.step,
            "skipped": self.skipped,
            "seconds": {
                "steps": self.seconds,
                "compile": self.compile_seconds,
                "total": perf_counter() - begun,
            },
            "curve": self.rows,
        }


def load(folder: Path, first: Learning, form_at: Callable[[Any, int], Any] | None = None) -> Learning:
    """What a run had come to; `first` where it was stopped before it had saved anything.

    Args:
        folder: where it was saved.
        first: before its first step.
        form_at: (first state, step) -> a state of the form that one after so many steps has, where that
            changes.

    Raises:
        CheckpointError: it is damaged.
        ValueError: it is of something else than `first`.
    """
    path = folder / _STATE
    if not path.is_file():
        return first
    stored = load_metadata(path)
    about, step = stored.pop("about", {}), stored.pop("step", 0)
    others = [what for what, digest in first.about.items() if about.get(what) != digest]
    if others:
        raise ValueError(
            f"--resume: {' and '.join(others)}: expected what the run in {folder.parent} was begun with, "
            "found something else; put that back, or replace the run with --overwrite instead"
        )
    like = first.state if form_at is None else form_at(first.state, step)
    state, _ = load_checkpoint(path, like)
    return Learning(state, about, **stored)


def learn(
    steps: Iterator[Made],
    learning: Learning,
    course: Course,
    folder: RunFolder,
    console: Console,
    minutes: float | None = None,
) -> Learning:
    """Go on until all steps are made, the time is up, Ctrl-C or an error.

    Args:
        steps: those that go on from the state of `learning`.
        learning: how far it is.
        course: what is to be learned.
        folder: of the run.
        console: that shows it.
        minutes: of steps, compiling included, after which it is enough.
    """
    saver, total = Saver(course.doing), course.total
    columns = (TextColumn(course.doing), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(compact=True))
    words = TextColumn("{task.description}")
    if not console.is_terminal:
        console.print(f"{course.doing}; compiling, which takes half a minute the first time", soft_wrap=True)

    def save(last: bool) -> None:
        saver(lambda: _save(folder.resume / _STATE, learning), last=last)

    shown = 0.0
    with Progress(*columns, words, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("compiling", total=total, completed=learning.state.step)
        try:
            while not learning.is_over(minutes) and shielded(_made_one_more, steps, learning):
                step = learning.state.step
                if step % _LOGGED_EVERY == 0 or step == total or learning.is_over(minutes):
                    shielded(_add_row, learning, course, folder)
                if perf_counter() - shown > _SHOWN_EVERY_S and learning.rows:
                    bar.update(task, completed=step, description=course.told(learning.rows[-1]))
                    shown = perf_counter()
                if not console.is_terminal and _is_told(step, total):
                    told = f": {course.told(learning.rows[-1])}" if learning.rows else ""
                    console.print(f"{step:,} of {total:,} steps{told}", soft_wrap=True)
                save(last=False)
                raise_if_interrupted()
        except (KeyboardInterrupt, Exception) as stopped:
            if any(
                leaf.is_deleted() for leaf in jax.tree.leaves(learning.state) if isinstance(leaf, jax.Array)
            ):
                raise  # a step that failed took it along: what --resume needs was saved before
            learning.stopped = stopped
        save(last=True)
    return learning


def say_if_cut_short(learning: Learning, course: Course, notes: Notes) -> None:
    """Note where `--minutes` ended it before all steps were made."""
    if learning.state.step < course.total and learning.stopped is None:
        notes.add(f"Stopped by --minutes after {learning.state.step:,} of {course.total:,} steps.")


def _save(path: Path, learning: Learning) -> None:
    save_checkpoint(path, jax.device_get(learning.state), learning.metadata())


def _made_one_more(steps: Iterator[Made], learning: Learning) -> bool:
    """Whether there was a step to make, which gives away the buffers of the state before."""
    if (found := next(steps, None)) is None:
        return False
    learning.state = found.state
    learning.seconds += found.seconds
    learning.compile_seconds += found.compile_seconds
    learning.recent.append(found.info)
    return True


def _add_row(learning: Learning, course: Course, folder: RunFolder) -> None:
    """A row of means, which stands in metrics.jsonl at once."""
    infos = jax.device_get(learning.recent)
    sound = [info for info in infos if not info["skipped"]]
    learning.skipped += len(infos) - len(sound)
    learning.recent = []
    row: dict[str, Any] = {
        "step": learning.state.step,
        "seconds": learning.seconds + learning.compile_seconds,
    }
    for name in ("loss", *course.losses):
        values = [float(info[name]) for info in sound if name in info]
        mean = float(np.mean(values)) if values else np.nan
        row[name] = mean if np.isfinite(mean) else None  # JSON has no infinity
    learning.rows.append(row)
    with atomic_write(folder.metrics_lines) as temporary:
        temporary.write_text("".join(json.dumps(one) + "\n" for one in learning.rows), encoding="utf-8")


def _is_told(step: int, total: int) -> bool:
    """Whether a log has a line of this step: about ten in all, each of which was measured just now."""
    every = max(1, total // (_LINES * _LOGGED_EVERY)) * _LOGGED_EVERY
    return step % every == 0 or step == total
