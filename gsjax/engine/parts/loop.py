"""The steps of `gsjax parts`: tracking parts through all frames, then refining the scene."""

from collections.abc import Mapping
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np
from rich.console import Console

from gsjax.engine.drive import Tick, drive
from gsjax.engine.folder import RunFolder
from gsjax.engine.messages import Notes, counted, reason, stage
from gsjax.engine.progress import Progress, Schedule, means_of, warn_of_returns, watch
from gsjax.methods.parts import Discovery, Parts, Problem, RefineParams
from gsjax.optim.method import Run


@dataclass
class Loop:
    """The state of the loops over steps.

    Attributes:
        method, problem: the method and its problem.
        run: the newest run.
        progress: its progress.
        seconds: time by stage; the loops add theirs.
        folder: of the run.
        notes: collects warnings.
        console: shows the progress.
    """

    method: Parts
    problem: Problem
    run: Run
    progress: Progress
    seconds: dict[str, float]
    folder: RunFolder
    notes: Notes
    console: Console

    def follow(self) -> None:
        """Find the poses of all frames, and log a row of progress for each."""
        steps, frames = self.method.config.stream.iterations, self.problem.sequence.num_frames
        total, progress = self.method.steps_of_frames(self.problem), self.progress

        def row(now: Tick, infos: list[Mapping[str, Any]]) -> dict[str, Any]:
            """The row of a frame, after its last step."""
            kept: Discovery = now.run.kept
            return {
                "frame": kept.frame,
                "losses": _losses(infos),
                "found": kept.count + 2,  # with the anchor and this one
                "parts": int(np.asarray(kept.canonical.alive).sum()) - 1,
                "update_s": progress.seconds - sum(update_seconds(progress)),
            }

        def in_words(row: Mapping[str, Any]) -> str:
            loss = "" if row["losses"] is None else f", loss {row['losses'][1]:.4f}"
            return f"{row['found']} of {frames} frames, {counted(row['parts'], 'part')}{loss}"

        if self.run.step < total:
            self._watch(Schedule("following parts", total, row, in_words, every=steps))
        self.seconds |= {"updates": sum(update_seconds(progress)), "compile": progress.compile_seconds}

    def finish(self) -> None:
        """Remove parts that no picture needs."""
        if isinstance(self.run.params, RefineParams):
            return
        begun = perf_counter()
        with stage(self.console, "removing parts that no picture needs"):
            self.run = self.method.brought_up_to_date(self.problem, self.run)
        self.seconds["finish"] = perf_counter() - begun
        if not np.asarray(self.run.kept.weights)[:, 1:].any():
            self.notes.warn("no part is needed to explain the pictures; the result is the canonical scene")

    def refine(self) -> None:
        """Fit the scene and all poses to all frames, unless it is stopped. If an OSError ends this early, the
        run still counts as complete."""
        steps, begun = self.method.steps_of_refinement(self.problem), perf_counter()
        first, total = self.method.steps_of_frames(self.problem), self.method.total(self.problem)
        skipped = self.progress.skipped

        def in_words(row: Mapping[str, Any]) -> str:
            losses = row.get("losses") or [row.get("loss")]  # the newest row may still be a frame's
            return "no finite loss" if losses[-1] is None else f"loss {losses[-1]:.4f}"

        if steps:
            self._watch(Schedule("refining the scene over all frames", total, means_of(), in_words))
        self.seconds["refine"] = perf_counter() - begun
        done, stopped = self.run.step - first, self.progress.stopped
        if stopped is not None:
            self.notes.warn(
                f"the scene was refined for {done} of {steps} steps, then stopped by {reason(stopped)}"
            )
            if isinstance(stopped, OSError):
                self.progress.stopped = None
        if lost := self.progress.skipped - skipped:
            self.notes.warn(f"{lost} of {done} refinement steps produced non-finite numbers and were skipped")
        warn_of_returns(self.progress, self.notes)

    def _watch(self, schedule: Schedule) -> None:
        """Run up to the last step of a schedule."""
        ticks = drive(
            self.method,
            self.problem,
            self.run,
            progress=lambda step: step / schedule.total,
            headroom=self.method.config.headroom,
        )
        try:
            watch(ticks, self.progress, schedule, self.folder, self.console)
        finally:
            self.run = ticks.run


def update_seconds(progress: Progress) -> list[float]:
    """Seconds of each tracked frame, without compiling."""
    return [row["update_s"] for row in progress.rows if "update_s" in row]


def _losses(infos: list[Mapping[str, Any]]) -> list[float] | None:
    """The mean losses of a frame over its first and its last steps; None if none was finite."""
    losses = np.array([float(info["now"]) for info in infos])
    few = max(1, len(losses) // 8)
    return [float(losses[:few].mean()), float(losses[-few:].mean())] if len(losses) else None
