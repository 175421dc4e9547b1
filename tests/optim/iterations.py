"""Shared by tests of least squares: the solvers, and many updates on one batch."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from gsjax.optim.least_squares import LevenbergMarquardt

SOLVERS = {
    "default": LevenbergMarquardt(1e-6, 1e-6),
    "LM": optx.LevenbergMarquardt(1e-6, 1e-6),
    "GN": optx.GaussNewton(1e-6, 1e-6),
    "dogleg": optx.Dogleg(1e-6, 1e-6),
}


def scanned(step, params, batch, num):
    """The final parameters and the stacked infos of `num` updates on one batch."""

    def body(carry, i):
        *carry, info = step.update(*carry, batch, step=i, key=None)
        return tuple(carry), info

    (params, _), infos = jax.lax.scan(body, (params, step.init(params)), jnp.arange(num))
    return params, infos


def falls(losses) -> bool:
    """Whether losses never rise beyond the rounding error between two ways of computing one image."""
    return bool((np.diff(losses) <= 1e-6 * losses[:-1]).all())
