"""What a fit logs, and when it evaluates held-out photographs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np

from gsjax.engine.budget import Budget
from gsjax.engine.drive import Tick
from gsjax.engine.fit.judge import Judge
from gsjax.engine.progress import Progress, Schedule

_LOGGED_EVERY = 100  # steps
_EXTRA = 10  # evaluations under --minutes, besides those of --judge-every
_EVAL_SHARE = 0.05  # largest share of the time for evaluations under --minutes


def schedule_of(steps: int, shrink: Callable[[float], int], progress: Progress) -> Schedule:
    """A schedule whose rows have the loss and psnr (of the photograph of that step), the number of Gaussians
    (alive), the factor by which the photograph was downscaled (shrink), and the test_psnr of held-out
    photographs, or None."""

    def row(now: Tick, infos: list[Mapping[str, Any]]) -> dict[str, Any]:
        last = infos[-1] if infos else {}
        shown = {name: _finite(last.get(name)) for name in ("loss", "psnr")}
        alive = int(now.info["alive"])
        return shown | {"alive": alive, "shrink": shrink(now.progress), "test_psnr": None}

    def words(row: Mapping[str, Any]) -> str:
        tested = evaluated(progress.rows)
        test = f", {tested[-1]['test_psnr']:.1f} dB" if tested else ""
        pace = f", {progress.pace:.0f}/s" if progress.pace else ""
        loss = "–" if row["loss"] is None else f"{row['loss']:.2f}"
        return f"loss {loss}{test}, {row['alive']:,} Gaussians{pace}"

    return Schedule("fitting", steps, row, words, _LOGGED_EVERY)


def _finite(value: Any) -> float | None:
    """The number if it is finite, else None: JSON has no infinity, which is the PSNR of a perfect picture."""
    return None if value is None or not np.isfinite(value) else float(value)


def evaluated(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The rows of steps after which held-out photographs were evaluated."""
    return [row for row in rows if row["test_psnr"] is not None]


@dataclass
class Evaluation:
    """Evaluates held-out photographs during a fit.

    Attributes:
        judge: scores photographs.
        some: the held-out photographs to evaluate during the fit.
        every: steps between evaluations.
        steps: steps of the fit.
        awaited: whether the fit ends when a score is reached, so that no evaluation may be skipped.
        budget: of the fit; with minutes there are ten more evaluations, but while evaluations take more than
            a twentieth of the time they are skipped, except for regular ones if a score is awaited.
    """

    judge: Judge
    some: Sequence[Any]
    every: int
    steps: int
    awaited: bool
    budget: Budget
    _tenths: int = field(default=0, init=False)
    _seconds: float = field(default=0.0, init=False)
    _is_known: bool = field(default=False, init=False)  # the first evaluation compiles

    def __call__(self, now: Tick) -> dict[str, Any] | None:
        """The scores for the row of a step; None if nothing is evaluated after it."""
        begun, tenths = perf_counter(), int(_EXTRA * self.budget.share)
        regular, extra = now.step % self.every == 0, tenths > self._tenths
        costly = self.budget.minutes is not None and self._seconds > _EVAL_SHARE * self.budget.used
        due = (regular and self.awaited) or ((regular or extra) and not costly)
        self._tenths = tenths
        if not due and not self.budget.is_over and now.step < self.steps:
            return None
        found = self.judge(now.run.params.gaussians, self.some).mean()["psnr"]
        if self._is_known:
            self._seconds += perf_counter() - begun
        self._is_known = True
        return {"test_psnr": found}
