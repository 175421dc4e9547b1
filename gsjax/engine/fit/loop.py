"""The steps of `gsjax fit`: shown, judged and saved while they go on, until there are enough."""

from time import perf_counter
from typing import Any

import jax
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from gsjax.engine.fit.results import Curve, Plans, judge
from gsjax.engine.fit.resume import Saver
from gsjax.engine.fit.tensorboard import TensorBoard
from gsjax.engine.folder import RunFolder
from gsjax.engine.interrupts import raise_if_interrupted, shielded
from gsjax.methods.fit import Fitted, Problem, View, fit

_SHOWN_EVERY_S = 0.2
_LOGGED_EVERY = 100  # steps
_LOOKS = 10  # under --minutes, beside those that were asked for
JUDGED_AT_MOST = 4
"""Held-out views that are looked at while the fit goes on; all of them at its end."""


def some_of(judged: list[tuple[str, View]]) -> list[tuple[str, View]]:
    """The held-out views that are looked at on the way."""
    return judged[:: max(1, len(judged) // JUDGED_AT_MOST)][:JUDGED_AT_MOST]


class Budget:
    """What share of a fit is done: of its steps, or of its minutes, whichever is more."""

    def __init__(self, steps: int, minutes: float | None, curve: Curve):
        self._steps, self._minutes, self._curve = steps, minutes, curve

    def __call__(self, step: int) -> float:
        used = 0.0 if self._minutes is None else self._used_minutes() / self._minutes
        return max(step / self._steps, used)

    def in_words(self, step: int) -> str:
        """How far it is, in what it was given."""
        if self._minutes is None:
            return f"{step:,} of {self._steps:,} steps"
        return f"{self._used_minutes():.1f} of {self._minutes:g} min, {step:,} steps"

    def _used_minutes(self) -> float:
        return (self._curve.seconds + self._curve.compile_seconds) / 60


class _Display:
    """A bar for people; for a log a line at each look at held-out views."""

    def __init__(self, console: Console, curve: Curve, budget: Budget, step: int, judged: bool):
        self._console, self._curve, self._budget, self._judged = console, curve, budget, judged
        columns = (
            TextColumn("[bold]{task.description}"),
            BarColumn(bar_width=None),
            TextColumn("{task.fields[told]}"),
            TimeRemainingColumn(compact=True),
        )
        self._bar = Progress(*columns, console=console, expand=True, auto_refresh=False)
        self._task = self._bar.add_task("compiling", total=1.0, completed=budget(step), told="")
        self._at = 0.0

    def __enter__(self) -> "_Display":
        if self._console.is_terminal:
            self._bar.start()
            self._bar.refresh()
        else:
            self._console.print("compiling, which takes about a minute the first time", soft_wrap=True)
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()

    def show(self, fitted: Fitted, looked: bool) -> None:
        """That a step is done; `looked`: held-out views were just judged."""
        if not looked and perf_counter() - self._at < _SHOWN_EVERY_S:
            return
        step, told = fitted.state.step, self._curve.in_words(fitted, self._judged)
        if self._console.is_terminal:
            done, so_far = self._budget(step), self._budget.in_words(step)
            self._bar.update(self._task, completed=min(1.0, done), description=so_far, told=told)
            self._bar.refresh()
        elif looked:
            self._console.print(f"{self._budget.in_words(step)}: {told}", soft_wrap=True)
        self._at = perf_counter()


def follow(
    problem: Problem,
    state: Any,
    curve: Curve,
    judged: list[tuple[str, View]],
    folder: RunFolder,
    console: Console,
    *,
    minutes: float | None,
    until_psnr: float | None,
    judge_every: int,
    save_every: float,
    board: TensorBoard | None = None,
) -> tuple[Any, BaseException | None]:
    """Fit until the steps, the minutes or the wanted PSNR are reached, Ctrl-C or an error; returns the last
    state, and what stopped it early.

    Args:
        problem: what is fitted to what.
        state: where to begin.
        curve: how it went so far; it is added to.
        judged: held-out photographs with their names.
        folder: of the run.
        console: shows how far it is.
        minutes: of steps, compiling included, after which it is enough.
        until_psnr: of held-out photographs, dB, with which it is enough.
        judge_every: steps between looks at them.
        save_every: seconds of fitting that may be lost.
        board: is told of every row, or None.
    """
    budget, saver = Budget(problem.config.steps, minutes, curve), Saver(folder, save_every)
    some, tenths = some_of(judged), int(_LOOKS * budget(state.step))
    plans: Plans = {}

    def met(gaussians: Any) -> bool:
        """Whether what is wanted is reached: by some views, and then by all of them."""
        if until_psnr is None or not curve.has_met(until_psnr):
            return False
        found = judge(problem, gaussians, judged, plans=plans).mean()["psnr"]
        return found is not None and found >= until_psnr

    with _Display(console, curve, budget, state.step, len(judged) > 0) as display:
        try:
            steps = iter(()) if met(state.gaussians) else fit(problem, state, share=budget)
            while (fitted := shielded(next, steps, None)) is not None:
                state, step = fitted.state, fitted.state.step
                curve.took(fitted.seconds, fitted.compile_seconds)
                curve.skipped += bool(fitted.info["skipped"])
                share = budget(step)
                look = step % judge_every == 0 or share >= 1
                if minutes is not None and int(_LOOKS * share) > tenths:
                    look, tenths = True, int(_LOOKS * share)
                if step % _LOGGED_EVERY == 0 or look:
                    psnr = judge(problem, state.gaussians, some, plans=plans).mean()["psnr"] if look else None
                    curve.add(fitted, psnr, folder)
                    if board is not None:
                        board.add(curve.rows[-1])
                display.show(fitted, look)
                if look and met(state.gaussians):
                    break
                saver(state, curve, last=False)
                raise_if_interrupted()
            saver(state, curve, last=True)
        except (KeyboardInterrupt, Exception) as stopped:
            if any(leaf.is_deleted() for leaf in jax.tree.leaves(state) if isinstance(leaf, jax.Array)):
                raise  # a step that failed took it along: what --resume needs was saved before
            saver(state, curve, last=True)
            return state, stopped
    return state, None
