"""A guard over the steps of any method: if the loss diverges, the run goes back to its best parameters and
continues from there in smaller steps; and a run ends with the best parameters that it had.

Losses are compared by their means over windows of steps, and differences must exceed the standard error of
the best window. A window consists of whole passes over the views, so that each view counts equally; if those
would be a large part of the run, it has some of the views, in their random order. Before the first window,
the best parameters are those with which the stretch began. A stretch is a period in which losses can be
compared: a new one begins when parameters or constants are replaced, such as by densification, or when a
method says that the meaning of its loss has changed. A stretch shorter than a window can only go back to
its beginning.

Steps themselves ensure that their results are finite (`gsjax.optim.step`) and that none is far longer than
usual (`steady_adam`).
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from gsjax.optim.step import all_finite

LEAST_WINDOW = 100
"""Fewest steps in a window."""
_WINDOWS, _MOST_STEPS = 50, 200  # most windows in a run; with this many steps in each, there may be more
_LEAST_WINDOWS = 8  # fewest windows in a run for each to consist of whole passes
_TAIL = 20  # steps that confirm a candidate, and most of which must not be worse at the end
_DIVERGED, _DIVERGED_SIGMA = 0.25, 4.0  # increase of a diverged loss: relative, and in standard errors
_WORSE, _WORSE_SIGMA = 0.02, 3.0  # the same at the end of a run, to go back to the best
_SMALLER = 0.5  # factor on steps after a return
_FIRST = 5  # first losses, the largest of which stands for the initial parameters
# Skipped steps in a tail that make a run go back at once, the factor on steps then, and the smallest share.
_MOST_SKIPPED, _FAR_SMALLER, _LEAST_SHARE = 18, 0.1, 1e-3


class Level(eqx.Module):
    """The losses of a window, and the parameters at its end; or the first losses of a stretch, and the
    parameters with which it began.

    Attributes:
        mean: mean of the losses; at the beginning, the largest.
        deviation: their standard deviation; None at the beginning.
        params: the parameters, copied to the host.
    """

    mean: float
    deviation: float | None
    params: PyTree

    def is_exceeded(
        self, losses: Float[np.ndarray, "n"], relative: float, sigma: float, statistic=np.mean
    ) -> bool:
        """Whether losses exceed this level, by an amount that is both relatively large and significant.

        The beginning has no known deviation; only losses that have diverged exceed it.

        Args:
            losses: losses of as many steps; NaN for skipped ones.
            relative: least difference, relative to the level.
            sigma: least difference in standard errors.
            statistic: the statistic of the losses that is compared.
        """
        loss = _of_unskipped(statistic, losses)
        if self.deviation is None:
            margin = (
                max(_DIVERGED * abs(self.mean), _DIVERGED_SIGMA * float(np.nanstd(losses)))
                if loss < np.inf
                else 0
            )
        else:
            margin = max(relative * abs(self.mean), sigma * self.deviation * (2 / len(losses)) ** 0.5)
        return loss > self.mean + margin


class Guard(eqx.Module):
    """The state of the guard in the current stretch of a run.

    Attributes:
        share: fraction of each step that is taken; 1 until a return.
        beginning: the beginning of the stretch; its parameters are dropped once there is a best window.
        losses: losses of the latest steps, at most a window; NaN for skipped ones.
        steps: number of steps in the stretch, or since the last return.
        best: the best window; None before the first.
        candidate: a better window, until the next steps confirm its parameters, which no loss has tested yet.
        returns: number of returns to the best parameters, in all stretches.
        is_settled: whether the parameters at the end of the run are the best rather than the latest.
        is_resting: whether nothing is watched; see `inactive`.
    """

    share: Float[Array, ""]
    beginning: Level
    losses: Float[np.ndarray, "n"] = eqx.field(default_factory=lambda: np.zeros(0))
    steps: int = 0
    best: Level | None = None
    candidate: Level | None = None
    returns: int = 0
    is_settled: bool = False
    is_resting: bool = False

    @property
    def level(self) -> Level:
        """The level that the run goes back to: the best window or, before the first, the beginning."""
        return self.beginning if self.best is None else self.best

    def after_step(self, loss: float, params: PyTree, window: int) -> tuple["Guard", PyTree]:
        """The guard after a step, and the parameters to continue from: those given or, if the loss has
        diverged, the best.

        Args:
            loss: loss of the step; NaN if it was skipped.
            params: parameters after the step.
            window: number of steps in a window.
        """
        if self.is_resting:
            return self, params
        losses = np.append(self.losses, loss)[-window:]
        guard = replace(self, losses=losses, steps=self.steps + 1, is_settled=False)
        candidate, beginning = guard.candidate, guard.beginning
        if guard.best is None and guard.steps <= _FIRST and float(guard.share) == 1:
            beginning = replace(beginning, mean=float(np.fmax(beginning.mean, loss)))
            guard = replace(guard, beginning=beginning)
        if guard.steps % _TAIL == 0 and np.isnan(losses[-_TAIL:]).sum() >= _MOST_SKIPPED:
            is_small = float(guard.share) <= _LEAST_SHARE  # smaller steps will not help
            return (guard, params) if is_small else guard._returned(params, _FAR_SMALLER)
        if candidate is not None and guard.steps % window == _TAIL:
            is_confirmed = not candidate.is_exceeded(losses[-_TAIL:], _DIVERGED, _DIVERGED_SIGMA, np.median)
            guard = replace(guard, candidate=None)
            if is_confirmed:
                guard = replace(guard, best=candidate, beginning=replace(beginning, params=None))
        if guard.steps % window:
            return guard, params
        if guard.level.is_exceeded(losses, _DIVERGED, _DIVERGED_SIGMA):
            return guard._returned(params, _SMALLER)
        mean = _of_unskipped(np.mean, losses)
        if mean < (np.inf if guard.best is None else guard.best.mean):
            level = Level(mean, float(np.nanstd(losses)), jax.tree.map(np.array, params))
            guard = replace(guard, candidate=level)
        return guard, params

    def at_end(self, params: PyTree) -> tuple["Guard", PyTree]:
        """The guard at the end of a run, and the parameters to end with: the best, if the latest losses are
        worse.

        Args:
            params: the latest parameters.
        """
        if self.is_resting:
            return self, params
        level, tail = self.level, self.losses[-_TAIL:]
        is_known = len(tail) >= _TAIL or np.isnan(tail).any()
        if not is_known or not np.isfinite(level.mean):
            return self, params
        if self.best is None and bool(all_finite(params)):  # a skipped step has changed nothing
            tail = tail[~np.isnan(tail)]
        latest = ((tail if self.best is None else self.losses, np.mean), (tail, np.median))
        if any(level.is_exceeded(losses, _WORSE, _WORSE_SIGMA, statistic) for losses, statistic in latest):
            settled = replace(self, losses=np.zeros(0), steps=0, candidate=None, is_settled=True)
            return settled, _restored(level)
        return self, params

    def _returned(self, params: PyTree, smaller: float) -> tuple["Guard", PyTree]:
        """The guard and the parameters after a return, if there is something to return to."""
        if not np.isfinite(self.level.mean):
            return self, params
        share = jnp.maximum(smaller * self.share, _LEAST_SHARE)
        state = {"share": share, "candidate": None, "returns": self.returns + 1}
        return replace(self, losses=np.zeros(0), steps=0, **state), _restored(self.level)


def new_guard(params: PyTree, before: Guard | None = None) -> Guard:
    """The guard at the beginning of a stretch.

    Args:
        params: the parameters.
        before: the guard of the previous stretch, whose count of returns continues.
    """
    beginning = Level(-np.inf, None, jax.tree.map(np.array, params))
    return Guard(jnp.ones((), jnp.float32), beginning, returns=0 if before is None else before.returns)


def inactive(before: Guard | None) -> Guard:
    """A guard that watches nothing and keeps no parameters, for steps that are parts of an iteration that
    cannot diverge, and whose losses do not show how good the parameters are.

    Args:
        before: the previous guard, whose count of returns continues.
    """
    if before is not None and before.is_resting:
        return before
    nothing, returns = Level(-np.inf, None, None), 0 if before is None else before.returns
    return Guard(jnp.ones((), jnp.float32), nothing, returns=returns, is_resting=True)


def window_of(total: int, period: int) -> int:
    """Number of steps in a window: whole passes over the views, unless there would be too few windows.

    Args:
        total: number of steps of the run.
        period: number of steps in a pass over the views.
    """
    steps = max(LEAST_WINDOW, min(total // _WINDOWS, _MOST_STEPS))
    passes = period * -(-steps // period)
    return passes if _LEAST_WINDOWS * passes <= total else steps


def partial_step(new: PyTree, old: PyTree, share: Float[Array, ""]) -> PyTree:
    """The parameters after a fraction of a step; after a whole one, bitwise equal to the new ones.

    Args:
        new, old: parameters after and before the step.
        share: the fraction, 0 to 1.
    """

    def of(end, start):
        if not eqx.is_inexact_array(start):
            return end
        return jnp.where(share < 1, start + share.astype(start.dtype) * (end - start), end)

    return jax.tree.map(of, new, old)


def _restored(level: Level) -> PyTree:
    return jax.tree.map(jnp.array, level.params)


def _of_unskipped(statistic, losses: Float[np.ndarray, "n"]) -> float:
    """A statistic of the losses of steps that were not skipped; infinite if at least half were skipped."""
    taken = losses[~np.isnan(losses)]
    return float(statistic(taken)) if 2 * len(taken) > len(losses) else float("inf")
