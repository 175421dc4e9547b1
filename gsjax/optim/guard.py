"""A guard over the steps of any method: when a smoothed loss is lost, it goes back to the best parameters and
takes smaller steps from there; and a run ends with the best that it had.

The loss is the mean of a window of steps, and each comparison allows for the standard error that the losses
of the best window have, as a step sees one photograph of many. A stretch is the time during which losses can
be compared: it begins anew when parameters or constants are replaced, such as by densification.

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
"""Fewest steps whose mean loss is compared."""
_WINDOWS = 50  # of a run, at most
_TAIL = 20  # steps at the end of a window that must be no worse than it
_LOST, _LOST_SIGMA = 0.25, 4.0  # by how much a loss is lost: relative, and in standard errors
_WORSE, _WORSE_SIGMA = 0.02, 3.0  # by how much it must be worse at the end to go back
_SMALLER = 0.5


class Guard(eqx.Module):
    """What is known of the present stretch of a run.

    Attributes:
        share: share of each step that is taken; 1 until a return.
        steps: number of steps in the stretch, or since the last return.
        losses: the losses of the latest of them, at most a window.
        best: parameters at the end of the best window, copied to the host; None before the first.
        least: mean and standard deviation of the losses of that window.
        returns: number of returns to the best parameters, in all stretches.
    """

    share: Float[Array, ""]
    steps: int = 0
    losses: tuple[float, ...] = ()
    best: PyTree = None
    least: tuple[float, float] = (float("inf"), 0.0)
    returns: int = 0

    def watched(self, loss: float, params: PyTree, window: int) -> tuple["Guard", PyTree]:
        """The guard after a step, and the parameters to continue from: those given or, where the loss is
        lost, the best.

        Args:
            loss: loss of the step.
            params: parameters after the step.
            window: number of steps that are compared.
        """
        guard = replace(self, steps=self.steps + 1, losses=(*self.losses, loss)[-window:])
        if guard.steps % window:
            return guard, params
        if guard.best is not None and guard._is_worse(guard.losses, _LOST, _LOST_SIGMA):
            return guard._returned()
        now = float(np.mean(guard.losses)), float(np.std(guard.losses))
        is_level = not replace(guard, least=now)._is_worse(guard.losses[-_TAIL:], 0.0, _WORSE_SIGMA)
        if now[0] < guard.least[0] and is_level:
            guard = replace(guard, best=jax.tree.map(np.array, params), least=now)
        return guard, params

    def settled(self, params: PyTree) -> tuple["Guard", PyTree]:
        """The guard at the end of a run, and the parameters to end with: the best, if the latest losses are
        worse.

        Args:
            params: the latest parameters.
        """
        if self.best is None or len(self.losses) < _TAIL:
            return self, params
        latest = self.losses, self.losses[-_TAIL:]
        if any(self._is_worse(some, _WORSE, _WORSE_SIGMA) for some in latest):
            return self._returned()
        return self, params

    def _is_worse(self, losses: tuple[float, ...], relative: float, sigma: float) -> bool:
        """Whether the mean of losses exceeds the least by a relative and a significant amount, or is not
        finite."""
        least, deviation = self.least
        margin = max(relative * abs(least), sigma * deviation * (2 / len(losses)) ** 0.5)
        return not np.mean(losses) <= least + margin

    def _returned(self) -> tuple["Guard", PyTree]:
        """The guard and the parameters after a return to the best."""
        best = jax.tree.map(jnp.array, self.best)
        share = _SMALLER * self.share
        return replace(self, share=share, steps=0, losses=(), returns=self.returns + 1), best


def begun(before: Guard | None = None) -> Guard:
    """The guard at the beginning of a stretch.

    Args:
        before: the guard of the stretch before, whose count of returns goes on.
    """
    return Guard(jnp.ones((), jnp.float32), returns=0 if before is None else before.returns)


def window_of(total: int) -> int:
    """Number of steps that are compared, in a run of a total number."""
    return max(LEAST_WINDOW, total // _WINDOWS)


def shortened(new: PyTree, old: PyTree, share: Float[Array, ""]) -> PyTree:
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
