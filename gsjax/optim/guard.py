"""A guard over the steps of any method: when the loss is lost, it goes back to the best parameters and takes
smaller steps from there; and a run ends with the best that it had.

Losses are compared by their mean over a window of steps, and beyond the standard error that they have in the
best window. It has whole passes over the views, so that each view counts in each; where those would be a
large part of the run, it has some of the views, in their random order. A stretch is the time during which
losses can be compared: it begins anew when parameters or constants are replaced, such as by densification, or
when a method says that its loss has become another. One shorter than a window, such as a frame of parts, is
not guarded.

That a step is finite is the step's own promise (`gsjax.optim.step`), as is that none is far longer than usual
(`steady_adam`).
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

LEAST_WINDOW = 100
"""Fewest steps whose losses are compared."""
_WINDOWS, _MOST_STEPS = 50, 200  # windows of a run, at most, unless they have so many steps
_LEAST_WINDOWS = 8  # of a run, if whole passes are compared
_TAIL = 20  # steps by which a candidate is confirmed, and of which most must not be worse at the end
_LOST, _LOST_SIGMA = 0.25, 4.0  # by how much a loss is lost: relative, and in standard errors
_WORSE, _WORSE_SIGMA = 0.02, 3.0  # by how much it must be worse at the end to go back
_SMALLER = 0.5


class Level(eqx.Module):
    """The losses of a window, and the parameters at its end.

    Attributes:
        mean, deviation: mean and standard deviation of the losses.
        params: the parameters, copied to the host.
    """

    mean: float
    deviation: float
    params: PyTree

    def is_exceeded(self, loss: float, count: int, relative: float, sigma: float) -> bool:
        """Whether a mean or median of losses is larger by a relative and a significant amount.

        Args:
            loss: the mean or median.
            count: number of losses.
            relative: least difference, relative to the level.
            sigma: least difference in standard errors.
        """
        margin = max(relative * abs(self.mean), sigma * self.deviation * (2 / count) ** 0.5)
        return loss > self.mean + margin


class Guard(eqx.Module):
    """What is known of the present stretch of a run.

    Attributes:
        share: share of each step that is taken; 1 until a return.
        losses: those of the latest steps, at most a window; NaN for the ones that were skipped.
        steps: number of steps in the stretch, or since the last return.
        best: the best window; None before the first.
        candidate: a better one, until the steps after it confirm its parameters, which no loss has seen.
        returns: number of returns to the best parameters, in all stretches.
        is_settled: whether the parameters at the end of the run are the best rather than the latest.
    """

    share: Float[Array, ""]
    losses: Float[np.ndarray, "n"] = eqx.field(default_factory=lambda: np.zeros(0))
    steps: int = 0
    best: Level | None = None
    candidate: Level | None = None
    returns: int = 0
    is_settled: bool = False

    def watched(self, loss: float, params: PyTree, window: int) -> tuple["Guard", PyTree]:
        """The guard after a step, and the parameters to continue from: those given or, where the loss is
        lost, the best.

        Args:
            loss: loss of the step; NaN if it was skipped.
            params: parameters after the step.
            window: number of steps that are compared.
        """
        losses = np.append(self.losses, loss)[-window:]
        guard = replace(self, losses=losses, steps=self.steps + 1, is_settled=False)
        best, candidate = guard.best, guard.candidate
        if candidate is not None and guard.steps % window == _TAIL:
            is_confirmed = not candidate.is_exceeded(_median(losses[-_TAIL:]), _TAIL, _LOST, _LOST_SIGMA)
            guard = replace(guard, best=candidate if is_confirmed else best, candidate=None)
        if guard.steps % window:
            return guard, params
        mean = _mean(losses)
        if best is not None and best.is_exceeded(mean, window, _LOST, _LOST_SIGMA):
            state = {"share": _SMALLER * self.share, "candidate": None, "returns": self.returns + 1}
            return replace(guard, losses=np.zeros(0), steps=0, **state), _restored(best)
        if mean < (np.inf if best is None else best.mean):
            level = Level(mean, float(np.nanstd(losses)), jax.tree.map(np.array, params))
            guard = replace(guard, candidate=level)
        return guard, params

    def settled(self, params: PyTree) -> tuple["Guard", PyTree]:
        """The guard at the end of a run, and the parameters to end with: the best, if the latest losses are
        worse.

        Args:
            params: the latest parameters.
        """
        best, count = self.best, len(self.losses)
        if best is None or count < _TAIL:
            return self, params
        latest = ((_mean(self.losses), count), (_median(self.losses[-_TAIL:]), _TAIL))
        if any(best.is_exceeded(*some, _WORSE, _WORSE_SIGMA) for some in latest):
            settled = replace(self, losses=np.zeros(0), steps=0, candidate=None, is_settled=True)
            return settled, _restored(best)
        return self, params


def begun(before: Guard | None = None) -> Guard:
    """The guard at the beginning of a stretch.

    Args:
        before: the guard of the stretch before, whose count of returns goes on.
    """
    return Guard(jnp.ones((), jnp.float32), returns=0 if before is None else before.returns)


def window_of(total: int, period: int) -> int:
    """Number of steps that are compared: whole passes over the views, unless windows would be too few.

    Args:
        total: number of steps of the run.
        period: number of steps of a pass over the views.
    """
    steps = max(LEAST_WINDOW, min(total // _WINDOWS, _MOST_STEPS))
    passes = period * -(-steps // period)
    return passes if _LEAST_WINDOWS * passes <= total else steps


def part_of_step(new: PyTree, old: PyTree, share: Float[Array, ""]) -> PyTree:
    """The parameters after a share of a step; after a whole one, the new ones to the bit.

    Args:
        new, old: parameters after and before the step.
        share: 0 to 1.
    """

    def of(end, start):
        if not eqx.is_inexact_array(start):
            return end
        return jnp.where(share < 1, start + share.astype(start.dtype) * (end - start), end)

    return jax.tree.map(of, new, old)


def _restored(best: Level) -> PyTree:
    return jax.tree.map(jnp.array, best.params)


def _mean(losses: Float[np.ndarray, "n"]) -> float:
    """Mean of losses without those of skipped steps; infinite if these are half of all, or another is not
    finite."""
    return _of_those_taken(np.mean, losses)


def _median(losses: Float[np.ndarray, "n"]) -> float:
    """Median of losses, as `_mean`: one view that stands out does not count."""
    return _of_those_taken(np.median, losses)


def _of_those_taken(statistic, losses: Float[np.ndarray, "n"]) -> float:
    taken = losses[~np.isnan(losses)]
    return float(statistic(taken)) if 2 * len(taken) > len(losses) else float("inf")
