"""A guard over the steps of any method. It limits steps that are many times as long as usual, refuses those
that leave the finite, and when a smoothed loss is lost, goes back to the best parameters with smaller steps.

The loss is the mean of a window of steps, and each comparison allows for its standard error, as a step sees
one photograph of many. A stretch is the time during which losses can be compared: it begins anew when
parameters or constants are replaced, such as by densification.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

LEAST_WINDOW = 100
"""Fewest steps whose mean loss is compared."""
_WINDOWS = 50  # of a run, at most
_LONG = 10.0  # usual lengths: no step is longer
_AVERAGED = 100  # steps over which the usual length is averaged
_KNOWN = 20  # steps after which it is known, and losses at the end of a window that must be no worse
_LOST, _LOST_SIGMA = 0.25, 4.0  # by how much a loss is lost: relative, and in standard errors
_WORSE, _WORSE_SIGMA = 0.02, 3.0  # by how much it must be worse at the end to go back
_SMALLER = 0.5


class Pace(eqx.Module):
    """Lengths of steps, on the device.

    Attributes:
        usual: root mean square of the change of each array of the parameters in a step, averaged.
        counted: number of steps averaged.
        share: share of each step that is taken; 1 but after a return.
        limited: number of steps that were shortened.
    """

    usual: Float[Array, "arrays"]
    counted: Int[Array, "arrays"]
    share: Float[Array, ""]
    limited: Int[Array, ""]


class Guard(eqx.Module):
    """What is known of the present stretch of a run.

    Attributes:
        pace: lengths of its steps.
        steps: number of its steps.
        losses: losses of its latest steps, at most a window.
        best: parameters at the end of its best window, copied to the host; None before the first.
        least: mean and standard error of the losses of that window.
        returns: number of returns to the best parameters, in all stretches.
    """

    pace: Pace
    steps: int = 0
    losses: tuple[float, ...] = ()
    best: PyTree = None
    least: tuple[float, float] = (float("inf"), 0.0)
    returns: int = 0

    def watched(self, loss: float, params: PyTree, window: int) -> tuple["Guard", PyTree]:
        """The guard after a step, and the parameters to continue from: those given or, where the loss is
        lost, the best.

        Args:
            loss: loss of the step; it is finite.
            params: parameters after the step.
            window: number of steps that are compared.
        """
        guard = replace(self, steps=self.steps + 1, losses=(*self.losses, loss)[-window:])
        if guard.steps % window:
            return guard, params
        mean, error = _mean(guard.losses)
        if _exceeds((mean, error), self.least, _LOST, _LOST_SIGMA):
            return guard._returned()
        is_level = not _exceeds(_mean(guard.losses[-_KNOWN:]), (mean, error), 0.0, _WORSE_SIGMA)
        if mean < self.least[0] and is_level:
            guard = replace(guard, best=jax.tree.map(np.array, params), least=(mean, error))
        return guard, params

    def settled(self, params: PyTree) -> tuple["Guard", PyTree]:
        """The guard at the end of a run, and the parameters to end with: the best, if the latest losses are
        worse.

        Args:
            params: the latest parameters.
        """
        if self.best is None or len(self.losses) < _KNOWN:
            return self, params
        latest = self.losses, self.losses[-_KNOWN:]
        if any(_exceeds(_mean(some), self.least, _WORSE, _WORSE_SIGMA) for some in latest):
            return self._returned()
        return self, params

    def _returned(self) -> tuple["Guard", PyTree]:
        """The guard and the parameters after a return to the best."""
        pace = replace(self.pace, share=_SMALLER * self.pace.share)
        best = jax.tree.map(jnp.array, self.best)
        return replace(self, pace=pace, steps=0, losses=(), returns=self.returns + 1), best


def begun(params: PyTree, before: Guard | None = None) -> Guard:
    """The guard at the beginning of a stretch.

    Args:
        params: parameters before its first step.
        before: the guard of the stretch before, whose counts go on.
    """
    arrays = len(jax.tree.leaves(eqx.filter(params, eqx.is_inexact_array)))
    limited, returns = (jnp.int32(0), 0) if before is None else (before.pace.limited, before.returns)
    pace = Pace(jnp.zeros(arrays), jnp.zeros(arrays, jnp.int32), jnp.ones(()), limited)
    return Guard(pace, returns=returns)


def window_of(total: int) -> int:
    """Number of steps that are compared, in a run of a total number."""
    return max(LEAST_WINDOW, total // _WINDOWS)


def paced(new: PyTree, old: PyTree, pace: Pace) -> tuple[PyTree, Pace, Bool[Array, ""]]:
    """The parameters after a step of at most ten times the usual length in each array; lengths with this
    step; and whether the step is finite: otherwise the old parameters remain. A step within the limits is
    taken to the bit.

    Args:
        new, old: parameters after and before the step.
        pace: usual lengths before the step.
    """
    is_float = jax.tree.map(eqx.is_inexact_array, old)
    ends, starts = (jax.tree.leaves(eqx.filter(tree, is_float)) for tree in (new, old))
    if not starts:
        return new, pace, jnp.asarray(True)
    pairs = list(zip(ends, starts, strict=True))
    lengths = jnp.stack([jnp.sqrt(jnp.square(end - start).mean()) for end, start in pairs])
    lengths = lengths.astype(pace.usual.dtype)
    is_finite = jnp.isfinite(lengths).all()
    most = jnp.where((pace.counted >= _KNOWN) & (pace.usual > 0), _LONG * pace.usual, jnp.inf)
    shares = jnp.minimum(1.0, most / jnp.where(lengths > 0, lengths, 1.0))
    taken = iter(shares * pace.share)

    def step(end, start, moves):
        if not moves:
            return jnp.where(is_finite, end, start)
        share = next(taken).astype(start.dtype)
        shorter = jnp.where(share < 1, start + share * (end - start), end)
        return jnp.where(is_finite, shorter, start)

    counts = is_finite & (lengths > 0)
    weight = jnp.maximum(1 / _AVERAGED, 1 / (pace.counted + 1))
    usual = jnp.where(counts, pace.usual + weight * (shares * lengths - pace.usual), pace.usual)
    limited = pace.limited + (is_finite & (shares < 1).any())
    pace = Pace(usual, pace.counted + counts, pace.share, limited)
    return jax.tree.map(step, new, old, is_float), pace, is_finite


def _mean(losses: tuple[float, ...]) -> tuple[float, float]:
    """Mean of losses, and its standard error."""
    return float(np.mean(losses)), float(np.std(losses) / np.sqrt(len(losses)))


def _exceeds(one: tuple[float, float], other: tuple[float, float], relative: float, sigma: float) -> bool:
    """Whether a mean is larger than another, each with its standard error, by a relative and a significant
    amount."""
    margin = max(relative * abs(other[0]), sigma * float(np.hypot(one[1], other[1])))
    return one[0] > other[0] + margin
