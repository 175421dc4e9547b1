"""Gauss-Newton and Levenberg-Marquardt through optimistix: few parameters, many residuals.

A residual returns all the terms that a scalar loss would square and sum:

    residual(params, batch, *, step, key) -> (pytree of arrays, aux)        loss = 1/2 sum of squares

`solve` runs optimistix until it converges; `least_squares_step` is one iteration, as a Step that composes
with others. The default solver is `LevenbergMarquardt`; optimistix's GaussNewton and Dogleg work too, as do
other combinations of its descents and searches.

Both functions stay on the manifold: a leaf of `params` that is a jaxlie group T moves by T exp(xi), six
numbers for an SE3. Store a camera's pose as camera to world and an object's as object to world: then xi is in
its own frame.

The Jacobian is dense, [residuals, parameters] in memory. jac="fwd" builds it by columns (poses, intrinsics; a
plan with derivative="forward"), jac="bwd" by rows (Gaussians; a plan with the reverse derivative).

Damping is Levenberg's, (J^T J + lambda I) move = -J^T r: scale the parameters so that a unit of each matters
about equally.

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
    """optimistix's solver, which here also stops after a rejected move once the next is below its tolerances.

    At an optimum, rounding decides whether a move is accepted, and optimistix only tests accepted ones: it
    would render some thirty more images until its damping has shrunk the moves to nothing.
    """

    def terminate(self, fn, y, args, options, state, tags):
        """As in optimistix, and also true if a move was just rejected and the next is below the tolerances.

        Arguments as for `optimistix.AbstractLeastSquaresSolver.terminate`.
        """
        done, result = super().terminate(fn, y, args, options, state, tags)

        def still(at, to):
            return (jnp.abs(to - at) <= self.atol + self.rtol * jnp.abs(at)).all()

        small = jnp.stack(jax.tree.leaves(jax.tree.map(still, y, state.y_eval))).all()
        return done | (small & (state.num_steps_since_acceptance > 0)), result


LEVENBERG_MARQUARDT = LevenbergMarquardt(rtol=1e-4, atol=1e-5)
"""The default solver. Tighter tolerances would be below the rounding of float32 images."""


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

    Compiled once per residual function (the same object), shapes, `jac` and `max_steps`; works under jit,
    vmap and scan. It has no derivative.

    Args:
        residual: as above; aux is a dict, which may be empty. If `aux["overflow"]` is True, the values count
            as infinite (`reject_overflow`).
        params: initial parameters: floating arrays and jaxlie groups.
        batch: fixed inputs: observations, frozen scene, plan.
        solver: an optimistix solver, with its rtol and atol.
        jac: "fwd" or "bwd", the mode in which the Jacobian is computed.
        damping: initial lambda of LevenbergMarquardt. It is added to J^T J, which grows with the number of
            pixels: a value of that size is cautious, a far smaller one gives Gauss-Newton.
        max_steps: most iterations, including rejected ones.
        step, key: passed to the residual.

    Returns:
        (params, info). `info` is aux at the solution with `loss`, `steps`, `result` (optimistix.RESULTS),
        `converged`, and `skipped`: the outcome was not finite or had overflowed, and params are the initial
        ones. `overflow` and `needed`, if aux has them, also cover the next move: if that overflows, the plan
        is what ended the search, and `converged` is False. Parameters that do not affect the residual (an
        object that no camera sees) converge where they start.

    Raises:
        ValueError: `jac` is not one of these, `damping` is not positive, or `params` has a non-floating leaf.
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

    def widen(tree):  # arrays created by optimistix have the default type, and ours must match
        return jax.tree.map(lambda a: a.astype(float), tree)

    def fn(y):
        values, aux = inner(narrow(y))
        return widen(values), aux

    # For every product with the Jacobian, optimistix would push a tangent through the renderer again, which
    # it could not transpose. With a custom rule the Jacobian is built once per step, as a matrix.
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
    # If trials overflowed, the solver stops short of them and reports success. The next move reveals that.
    ahead = _move(solution.state.f_info, solution.value)
    capacity = _joined(aux, fn(jax.tree.map(jnp.add, solution.value, ahead))[1])
    stuck = jnp.asarray(capacity.get("overflow", False)).any()
    info = {
        "loss": loss,
        "steps": solution.stats["num_steps"],
        "result": solution.result,
        "converged": (solution.result == optx.RESULTS.successful) & sound & ~stuck,
        "skipped": ~sound,
    }
    return keep_if(sound, found, params), {**aux, **capacity, **info}


def _move(there, y: PyTree) -> PyTree:
    """The move that Levenberg-Marquardt would try first from y."""
    descent = optx.DampedNewtonDescent()
    move, _ = descent.step(jnp.array(1.0), descent.query(y, there, descent.init(y, there)))
    return jax.tree.map(lambda a: jnp.where(jnp.isfinite(a), a, 0.0), move)


def _joined(aux: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """`overflow` and `needed` of two evaluations, if present: whether either overflowed, the larger need."""
    joins = (("overflow", jnp.logical_or), ("needed", jnp.maximum))
    return {name: join(aux[name], other[name]) for name, join in joins if name in aux}


def least_squares_step(
    residual: Residual,
    solver: optx.AbstractLeastSquaresSolver = LEVENBERG_MARQUARDT,
    *,
    jac: str = "fwd",
    damping: float = 1.0,
) -> Step:
    """One iteration of `solver` on `residual`: a Jacobian, a move, and one more evaluation to test it.

    Arguments as for `solve`; the solver's tolerances are not used. The state is that of its search (1/lambda
    for LevenbergMarquardt), so the batch may change from update to update. Start each frame with a new
    `init`: rejections at the optimum of the previous one leave the damping high.

    `info` is aux at the returned params with `loss`, `accepted`, and `skipped`: the residual was not finite
    or had overflowed before the move, and params and state are unchanged. `overflow` and `needed` also cover
    a rejected move, so that the host re-plans.

    Raises:
        ValueError: as for `solve`; `params` are checked by `init`.
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
        # As in optimistix's own loop: the first step of a search only determines how long a move to try.
        length, _, _, search = solver.search.step(jnp.array(True), y, y, here, here, state)
        descent = solver.descent.query(y, here, solver.descent.init(y, here))
        move, _ = solver.descent.step(length, descent)
        moved = jax.tree.map(jnp.add, y, move)
        values, moved_aux = fn(moved)
        there = optx.FunctionInfo.Residual(values)
        _, accepted, _, search = solver.search.step(jnp.array(False), y, moved, here, there, search)

        sound = all_finite((params, here.as_min()))
        accepted &= sound & all_finite((moved, there.as_min()))
        # Factors of 3.5 and 1/4 over many frames must not reach 0 or infinity, from which no factor returns.
        search = jax.tree.map(lambda new, old: jnp.clip(new, 1e-6, 1e6).astype(old.dtype), search, state)
        capacity = _joined(aux, moved_aux)
        info = {
            "loss": damping * jnp.where(accepted, there.as_min(), here.as_min()),
            "accepted": accepted,
            "skipped": ~sound,
        }
        absent = {
            "overflow": jnp.array(False),
            "needed": jnp.int32(0),
        }  # of a residual that draws with no plan
        aux = {**absent, **keep_if(accepted, moved_aux, aux), **capacity, **info}
        params = keep_if(accepted, from_coordinates(params, moved), params)
        return params, keep_if(sound, search, state), aux

    return Step(init, update)


def reject_overflow(residual: PyTree, overflow: Bool[Array, "..."]) -> PyTree:
    """The residual, or infinity everywhere if any camera overflowed its plan, so that a solver rejects it.

    Args:
        residual: arrays of any shape.
        overflow: whether each camera overflowed, [..., C].
    """
    overflow = jnp.asarray(overflow).any()
    return jax.tree.map(lambda a: jnp.where(overflow, jnp.inf, a), residual)


def difference(
    rendered: Float[Array, "*shape"], observed: Float[Array, "*shape"]
) -> tuple[Float[Array, "*shape"], Int[Array, ""]]:
    """`rendered - observed` where the observation is finite, else 0; and the number of values left out.

    Mark missing measurements (depth 0, masked pixels) by NaN in `observed`.

    Raises:
        ValueError: the shapes differ, or an array is not floating.
    """
    if jnp.shape(rendered) != jnp.shape(observed):
        raise ValueError(
            f"observed must have the shape of rendered, {jnp.shape(rendered)}; got {jnp.shape(observed)}"
        )
    for name, array in (("rendered", rendered), ("observed", observed)):
        if not jnp.issubdtype(jnp.result_type(array), jnp.floating):
            raise ValueError(
                f"{name} must hold floats, colours from 0 to 1; got {jnp.result_type(array)}: divide 8-bit "
                "colours by 255"
            )
    known = jnp.isfinite(observed)
    return jnp.where(known, rendered - jnp.where(known, observed, 0.0), 0.0), jnp.sum(~known)


def huber(residual: PyTree, delta: float) -> PyTree:
    """Residuals whose half squares are Huber's loss: r to `delta`, sign(r) sqrt(2 delta |r| - delta^2) above.

    This is still a least-squares problem, once differentiable (Hartley, Zisserman, Multiple View Geometry,
    A6.8).
    """

    def one(r):
        large = jnp.abs(r) > delta
        far = jnp.where(large, jnp.abs(r), delta)
        return jnp.where(large, jnp.sign(r) * jnp.sqrt(2 * delta * far - delta**2), r)

    return jax.tree.map(one, residual)


def to_coordinates(params: PyTree) -> PyTree:
    """The coordinates that are optimized: arrays themselves, and a zero tangent vector for each jaxlie group.

    Raises:
        ValueError: a leaf is not floating.
    """

    def one(leaf):
        if _is_group(leaf):
            return jnp.zeros((*leaf.get_batch_axes(), leaf.tangent_dim), leaf.parameters().dtype)
        if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            raise ValueError(
                f"params: expected floating leaves, found {jnp.result_type(leaf)}; only floating ones can be "
                "optimized"
            )
        return leaf

    return jax.tree.map(one, params, is_leaf=_is_group)


def from_coordinates(params: PyTree, coordinates: PyTree) -> PyTree:
    """Parameters at `coordinates` around `params`: arrays as given, T exp(xi) for each jaxlie group T."""

    def one(leaf, at):
        return (leaf @ type(leaf).exp(at)).normalize() if _is_group(leaf) else at

    return jax.tree.map(one, params, coordinates, is_leaf=_is_group)


def _is_group(node: Any) -> bool:
    return isinstance(node, jaxlie.MatrixLieGroup)


def _traced(leaf: Any) -> Any:
    """Python numbers as arrays: `filter_jit` would recompile for each value."""
    return jnp.asarray(leaf) if isinstance(leaf, int | float) else leaf


def _check(jac: str, damping: float) -> None:
    if jac not in ("fwd", "bwd"):
        raise ValueError(f'jac must be "fwd" or "bwd", not {jac!r}')
    if not damping > 0:
        raise ValueError(f"damping must be above 0, not {damping}")


def _scaled(residual: Residual, params, batch, damping, step, key):
    """y -> (residual / sqrt(damping), aux): turns optimistix's initial lambda of 1 into `damping`."""

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
    return jnp.asarray(0.5 * sum(jnp.sum(a * a) for a in jax.tree.leaves(values)))


def _no_tangent(a: Any) -> Any:
    """The zero tangent of one value of aux."""
    if jnp.issubdtype(jnp.result_type(a), jnp.inexact):
        return jnp.zeros_like(a)
    return np.zeros(np.shape(a), jax.dtypes.float0)
