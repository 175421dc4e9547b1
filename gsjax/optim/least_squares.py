"""Gauss-Newton and Levenberg-Marquardt through optimistix: few parameters, many residuals.

Where a loss is one number, a residual has all that are squared in it:

    residual(params, batch, *, step, key) -> (pytree of arrays, aux)        loss = 1/2 sum of squares

`solve` runs optimistix until it converges; `least_squares_step` is one iteration, as a Step that composes
with others. The default is `LevenbergMarquardt`; optimistix's GaussNewton and Dogleg serve, and what else
is put together from its descents and searches.

Both stay on the manifold: a leaf of `params` that is a jaxlie group T moves by T exp(xi), six numbers for an
SE3. Hold a camera's pose as camera to world and an object's as object to world: then xi is in its own frame.

The Jacobian is dense, [residuals, parameters] in memory. jac="fwd" makes it by columns (poses, intrinsics; a
plan with derivative="forward"), jac="bwd" by rows (Gaussians; a plan with the reverse derivative).

Damping is Levenberg's, (J^T J + lambda I) move = -J^T r: a unit of each parameter should matter as much.

Source: Nocedal, Wright, Numerical Optimization (2nd ed.), chapter 10; optimistix (Rader, Lyons, Kidger 2024).
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import lineax as lx
import numpy as np
import optimistix as optx
from equinox.internal import nondifferentiable
from jaxtyping import Array, Bool, Float, Int, PyTree

from gsjax.optim.step import Step, all_finite, keep_if

Residual = Callable[..., tuple[PyTree, dict[str, Any]]]


class LevenbergMarquardt(optx.LevenbergMarquardt):
    """optimistix's, which here also ends where a move was rejected and the next is below its tolerances.

    At an optimum rounding decides whether a move is accepted, and optimistix looks at accepted ones alone: it
    goes on for some thirty images until its damping has shrunk the moves to nothing.
    """

    def terminate(self, fn, y, args, options, state, tags):
        """As optimistix's, and also where the move that was rejected last is below the tolerances.

        Arguments as for `optimistix.AbstractLeastSquaresSolver.terminate`.
        """
        done, result = super().terminate(fn, y, args, options, state, tags)

        def still(at, to):
            return (jnp.abs(to - at) <= self.atol + self.rtol * jnp.abs(at)).all()

        small = jnp.stack(jax.tree.leaves(jax.tree.map(still, y, state.y_eval))).all()
        return done | (small & (state.num_steps_since_acceptance > 0)), result


LEVENBERG_MARQUARDT = LevenbergMarquardt(rtol=1e-4, atol=1e-5)
"""The default solver. Tighter tolerances than these lie in the rounding of float32 images."""


def solve(
    residual: Residual,
    params: PyTree,
    batch: PyTree,
    *,
    solver: optx.AbstractLeastSquaresSolver = LEVENBERG_MARQUARDT,
    jac: str = "fwd",
    damping: float = 1.0,
    max_steps: int = 50,
    step: Any = 0,
    key: Any = None,
) -> tuple[PyTree, dict[str, Any]]:
    """The parameters that minimise half the sum of squared residuals.

    Compiled once for a residual function (the same object), shapes, `jac` and `max_steps`; goes through jit,
    vmap and scan. It has no derivative.

    Args:
        residual: as above; aux is a dict, which may be empty. Where `aux["overflow"]` is True its values
            count as infinite (`reject_overflow`).
        params: where to start: floating arrays and jaxlie groups.
        batch: what is given: observations, frozen scene, plan.
        solver: of optimistix, with its rtol and atol.
        jac: "fwd" or "bwd", how the Jacobian is made.
        damping: lambda at the start, for LevenbergMarquardt. It weighs against J^T J, which grows with the
            number of pixels: as large as that is cautious, far below is Gauss-Newton.
        max_steps: iterations at most, rejected ones included.
        step, key: handed on to the residual.

    Returns:
        (params, info). `info` is aux at the solution with `loss`, `steps`, `result` (optimistix.RESULTS),
        `converged`, and `skipped`: the outcome was not finite or had overflowed, and params are the start's.
        `overflow` and `needed`, where aux has them, tell of the next move too: where that overflows, the plan
        is what ended the search, and `converged` is False. What nothing depends on (an object that no camera
        sees) converges where it starts.

    Raises:
        ValueError: `jac` or `damping` is none of these, or `params` has leaves that are not floating.
    """
    _check(jac, damping)
    params, batch, step, damping = jax.tree.map(_traced, (params, batch, step, damping))
    return _solve(residual, params, batch, solver, jac, damping, max_steps, step, key)


@eqx.filter_jit
def _solve(residual, params, batch, solver, jac, damping, max_steps, step, key):
    message = "has no derivative; differentiate through least_squares_step, or the residual at the solution"
    params, batch = nondifferentiable(
        (params, batch), name="solve", msg=f"gsjax.optim.least_squares.solve {message}"
    )
    inner, start = _scaled(residual, params, batch, damping, step, key), to_coordinates(params)

    def narrow(y):
        return jax.tree.map(lambda a, like: a.astype(like.dtype), y, start)

    def widen(tree):  # what optimistix makes by itself is of the default type, and has to meet the same
        return jax.tree.map(lambda a: a.astype(float), tree)

    def fn(y):
        values, aux = inner(narrow(y))
        return widen(values), aux

    # Wherever optimistix multiplies by the Jacobian it would push a tangent through the renderer anew, and it
    # could not transpose that. With a rule of its own the Jacobian is made once a step, as a matrix.
    @jax.custom_jvp
    def dense(y):
        return fn(y)

    @dense.defjvp
    def _(primals, tangents):
        values, operator, aux = _linearise(fn, *primals, jac)
        return (values, aux), (operator.mv(*tangents), jax.tree.map(_no_tangent, aux))

    solution = optx.least_squares(
        lambda y, _: dense(y), solver, widen(start), has_aux=True, max_steps=max_steps, throw=False
    )
    values, aux = fn(solution.value)
    loss = damping * _half_sum_of_squares(values)
    found = from_coordinates(params, narrow(solution.value))
    sound = all_finite((found, loss))
    # Where trials overflowed the solver stops short of them, and calls that an end. The next move would tell.
    ahead = _move(solution.state.f_info, solution.value)
    told = _joined(aux, fn(jax.tree.map(jnp.add, solution.value, ahead))[1])
    stuck = jnp.asarray(told.get("overflow", False)).any()
    info = {
        "loss": loss,
        "steps": solution.stats["num_steps"],
        "result": solution.result,
        "converged": (solution.result == optx.RESULTS.successful) & sound & ~stuck,
        "skipped": ~sound,
    }
    return keep_if(sound, found, params), {**aux, **told, **info}


def _move(there, y: PyTree) -> PyTree:
    """What Levenberg-Marquardt would try first from y."""
    descent = optx.DampedNewtonDescent()
    move, _ = descent.step(jnp.array(1.0), descent.query(y, there, descent.init(y, there)))
    return jax.tree.map(lambda a: jnp.where(jnp.isfinite(a), a, 0.0), move)


def _joined(aux: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """What two evaluations say of the plan, where they say it: did any overflow, and what did they need."""
    joins = (("overflow", jnp.logical_or), ("needed", jnp.maximum))
    return {name: join(aux[name], other[name]) for name, join in joins if name in aux}


def least_squares_step(
    residual: Residual,
    solver: optx.AbstractLeastSquaresSolver = LEVENBERG_MARQUARDT,
    *,
    jac: str = "fwd",
    damping: float = 1.0,
) -> Step:
    """One iteration of `solver` on `residual`: a Jacobian, a move, and one more evaluation to judge it.

    Arguments as for `solve`; the solver's tolerances are not used. The state is what its search carries (for
    LevenbergMarquardt 1/lambda), so the batch may change from update to update. Begin a new frame with a new
    `init`: rejections at the optimum of the last one leave the damping high.

    `info` is aux at the params returned with `loss`, `accepted`, and `skipped`: already before the move the
    residual was not finite or had overflowed, and params and state are unchanged. `overflow` and `needed`
    tell of a rejected move too, so that the host re-plans.

    Raises:
        ValueError: as `solve`; what `params` are is looked at by `init`.
    """
    _check(jac, damping)

    def init(params):
        state = solver.search.init(to_coordinates(params), None)
        dtype = jnp.result_type(*jax.tree.leaves(params))
        return jax.tree.map(lambda a: jnp.asarray(a, dtype), state)

    def update(params, state, batch, *, step, key):
        fn = _scaled(residual, params, batch, damping, step, key)
        y = to_coordinates(params)
        values, operator, aux = _linearise(fn, y, jac)
        here = optx.FunctionInfo.ResidualJac(values, operator)
        # As in optimistix's own loop: the first step of a search says only how long a move to try.
        length, _, _, search = solver.search.step(jnp.array(True), y, y, here, here, state)
        descent = solver.descent.query(y, here, solver.descent.init(y, here))
        move, _ = solver.descent.step(length, descent)
        moved = jax.tree.map(jnp.add, y, move)
        values, moved_aux = fn(moved)
        there = optx.FunctionInfo.Residual(values)
        _, accepted, _, search = solver.search.step(jnp.array(False), y, moved, here, there, search)

        sound = all_finite((params, here.as_min()))
        accepted &= sound & all_finite((moved, there.as_min()))
        # Factors of 3.5 and 1/4 over many frames must not end where no factor leads back from (0, infinity).
        search = jax.tree.map(lambda new, old: jnp.clip(new, 1e-6, 1e6).astype(old.dtype), search, state)
        told = _joined(aux, moved_aux)
        info = {
            "loss": damping * jnp.where(accepted, there.as_min(), here.as_min()),
            "accepted": accepted,
            "skipped": ~sound,
        }
        aux = {**keep_if(accepted, moved_aux, aux), **told, **info}
        params = keep_if(accepted, from_coordinates(params, moved), params)
        return params, keep_if(sound, search, state), aux

    return Step(init, update)


def reject_overflow(residual: PyTree, overflow: Bool[Array, "..."]) -> PyTree:
    """Infinity in every value where any camera overflowed its plan, so that a solver rejects the step.

    Args:
        residual: arrays of any shape.
        overflow: of the cameras, [..., C].
    """
    overflow = jnp.asarray(overflow).any()
    return jax.tree.map(lambda a: jnp.where(overflow, jnp.inf, a), residual)


def difference(
    rendered: Float[Array, "*shape"], observed: Float[Array, "*shape"]
) -> tuple[Float[Array, "*shape"], Int[Array, ""]]:
    """`rendered - observed` where the observation is finite, else 0; and how many were left out.

    Mark what was not measured (depth 0, a mask) by NaN in `observed`.

    Raises:
        ValueError: they differ in shape, or are not floating.
    """
    if jnp.shape(rendered) != jnp.shape(observed):
        raise ValueError(
            f"observed must have the shape of rendered, {jnp.shape(rendered)}; got {jnp.shape(observed)}"
        )
    for name, array in (("rendered", rendered), ("observed", observed)):
        if not jnp.issubdtype(jnp.result_type(array), jnp.floating):
            raise ValueError(
                f"{name} must hold floats, colours from 0 to 1; got {jnp.result_type(array)}: of 8 bits, "
                "divide by 255"
            )
    known = jnp.isfinite(observed)
    return jnp.where(known, rendered - jnp.where(known, observed, 0.0), 0.0), jnp.sum(~known)


def huber(residual: PyTree, delta: float) -> PyTree:
    """Residuals with half squares of Huber's loss: r to `delta`, sign(r) sqrt(2 delta |r| - delta^2) beyond.

    Still a least-squares problem, once differentiable (Hartley, Zisserman, Multiple View Geometry, A6.8).
    """

    def one(r):
        large = jnp.abs(r) > delta
        far = jnp.where(large, jnp.abs(r), delta)
        return jnp.where(large, jnp.sign(r) * jnp.sqrt(2 * delta * far - delta**2), r)

    return jax.tree.map(one, residual)


def to_coordinates(params: PyTree) -> PyTree:
    """What is solved for: arrays themselves, and for each jaxlie group a zero tangent vector.

    Raises:
        ValueError: a leaf is not floating.
    """

    def one(leaf):
        if _is_group(leaf):
            return jnp.zeros((*leaf.get_batch_axes(), leaf.tangent_dim), leaf.parameters().dtype)
        if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            raise ValueError(
                f"params: a leaf is of {jnp.result_type(leaf)}; only floating ones can be solved for"
            )
        return leaf

    return jax.tree.map(one, params, is_leaf=_is_group)


def from_coordinates(params: PyTree, coordinates: PyTree) -> PyTree:
    """Parameters at `coordinates` around `params`: the arrays given, T exp(xi) for each jaxlie group T."""

    def one(leaf, at):
        return (leaf @ type(leaf).exp(at)).normalize() if _is_group(leaf) else at

    return jax.tree.map(one, params, coordinates, is_leaf=_is_group)


def _is_group(node: Any) -> bool:
    return isinstance(node, jaxlie.MatrixLieGroup)


def _traced(leaf: Any) -> Any:
    """Python numbers as arrays: `filter_jit` would compile anew for each value."""
    return jnp.asarray(leaf) if isinstance(leaf, int | float) else leaf


def _check(jac: str, damping: float) -> None:
    if jac not in ("fwd", "bwd"):
        raise ValueError(f'jac is "fwd" or "bwd", not {jac!r}')
    if not damping > 0:
        raise ValueError(f"damping must be above 0, not {damping}")


def _scaled(residual: Residual, params, batch, damping, step, key):
    """y -> (residual / sqrt(damping), aux): optimistix starts at lambda = 1, this makes it `damping`."""

    def fn(y):
        returned = residual(from_coordinates(params, y), batch, step=step, key=key)
        if not (isinstance(returned, tuple) and len(returned) == 2 and isinstance(returned[1], dict)):
            raise ValueError(
                "residual(params, batch, *, step, key) must return (pytree of arrays, dict, which may be "
                f"empty); got {type(returned).__name__}"
            )
        values, aux = returned
        values = reject_overflow(values, jnp.asarray(aux.get("overflow", False)))
        return jax.tree.map(lambda a: a * damping**-0.5, values), aux

    return fn


def _linearise(fn, y: PyTree, jac: str):
    """(residual, Jacobian as a dense operator, aux) of `fn` at y."""

    def twice(y):
        values, aux = fn(y)
        return values, (values, aux)

    jacobian = jax.jacfwd if jac == "fwd" else jax.jacrev
    matrix, (values, aux) = jacobian(twice, has_aux=True)(y)
    return values, lx.PyTreeLinearOperator(matrix, jax.eval_shape(lambda: values)), aux


def _half_sum_of_squares(values: PyTree) -> Float[Array, ""]:
    return 0.5 * sum(jnp.sum(a * a) for a in jax.tree.leaves(values))


def _no_tangent(a: Any) -> Any:
    """The zero tangent of one value of aux."""
    if jnp.issubdtype(jnp.result_type(a), jnp.inexact):
        return jnp.zeros_like(a)
    return np.zeros(np.shape(a), jax.dtypes.float0)
