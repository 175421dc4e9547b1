"""The laws that every step of the package keeps, each tested on a small problem for each step.

A step keeps the tree and shapes of its state; an update that is not finite, or that overflowed its plan,
changes neither params nor state; `info` has loss, skipped, overflow and needed; `step` may be traced; it runs
in `jax.lax.scan`; and it still works when another step wraps it.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from gsjax.optim.least_squares import least_squares_step
from gsjax.optim.step import Step, gradient_step
from tests.engine import cases

KEY = jax.random.key(7)


class Case(NamedTuple):
    """A step and the inputs it is tested with.

    Attributes:
        step: the step.
        params: the initial params.
        batch: a sound batch.
        sick: a batch with a number that is not finite.
        first: a batch that the step must see before the others; None if it needs none.
    """

    step: Step
    params: Any
    batch: Any
    sick: Any
    first: Any = None


def of_a_gradient() -> Case:
    def loss(params, batch, *, step, key):
        return jnp.sum((params - batch) ** 2), {}

    return Case(gradient_step(loss, optax.adam(0.1)), jnp.zeros(3), jnp.ones(3), jnp.full(3, jnp.nan))


def of_least_squares() -> Case:
    def residual(params, batch, *, step, key):
        return params - batch, {}

    return Case(least_squares_step(residual), jnp.zeros(3), jnp.ones(3), jnp.full(3, jnp.nan))


CASES: dict[str, Callable[[], Case]] = {
    "gradient": of_a_gradient,
    "least squares": of_least_squares,
    **{name: (lambda make=make: Case(*make())) for name, make in cases.STEPS.items()},
}


@cache
def case_of(name: str) -> Case:
    return CASES[name]()


def averaged(step: Step) -> Step:
    """A step that wraps another and keeps a running average of its params, as is common for evaluation."""

    def update(params, state, batch, *, step_=step, step, key):
        inner, mean = state
        params, inner, info = step_.update(params, inner, batch, step=step, key=key)
        moved = jax.tree.map(lambda m, p: jnp.where(info["skipped"], m, 0.9 * m + 0.1 * p), mean, params)
        return params, (inner, jax.tree.map(lambda m, p: m.astype(p.dtype), moved, params)), info

    return Step(lambda params: (step.init(params), params), update)


@cache
def jitted(name: str) -> Callable:
    """The jitted update of a case's wrapped step: one program for the laws of the step and of its wrapper."""
    update = averaged(case_of(name).step).update
    return jax.jit(lambda params, state, batch, step: update(params, state, batch, step=step, key=KEY))


def updated(name: str, params: Any, state: Any, batch: Any, step: int = 3) -> tuple[Any, Any, dict]:
    """Params, state and info after one update."""
    params, (state, _), info = jitted(name)(params, (state, case_of(name).params), batch, jnp.asarray(step))
    return params, state, info


@cache
def state_of(name: str) -> Any:
    case = case_of(name)
    state = case.step.init(case.params)
    return state if case.first is None else updated(name, case.params, state, case.first)[1]


@pytest.fixture(params=CASES)
def name(request) -> str:
    return request.param


def shapes(tree):
    return jax.tree.map(lambda a: (jnp.shape(a), jnp.result_type(a)), tree)


def assert_same(new, old):
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(np.asarray(a), np.asarray(b)), new, old)


@pytest.mark.thorough
def test_params_and_state_keep_their_form_and_info_has_its_names(name):
    case = case_of(name)
    state = state_of(name)
    params, after, info = updated(name, case.params, state, case.batch)
    assert shapes(params) == shapes(case.params)
    assert shapes(after) == shapes(state)
    assert {"loss", "skipped", "overflow", "needed"} <= set(info)
    assert info["loss"].shape == info["skipped"].shape == info["overflow"].shape == ()
    assert not bool(info["skipped"])
    assert not bool(info["overflow"])
    assert np.isfinite(float(info["loss"]))
    changed = jax.tree.map(lambda a, b: bool(jnp.any(a != b)), (params, after), (case.params, state))
    assert any(jax.tree.leaves(changed))


@pytest.mark.thorough
def test_what_is_not_finite_changes_nothing(name):
    case = case_of(name)
    state = state_of(name)
    params, after, info = updated(name, case.params, state, case.sick)
    assert bool(info["skipped"])
    assert_same((params, after), (case.params, state))


@pytest.mark.thorough
@pytest.mark.parametrize("name", [name for name in cases.STEPS if name not in cases.WITHOUT_PLAN])
def test_where_a_plan_is_too_small_nothing_changes_and_what_is_needed_is_told(name):
    case = case_of(name)
    state, large, batch = state_of(name), cases.enlarged(case.params), cases.enlarged(case.batch)
    params, after, info = updated(name, large, state, batch)
    assert bool(info["overflow"])
    assert bool(info["skipped"])
    assert_same((params, after), (large, state))
    small = updated(name, case.params, state, case.batch)[2]
    more = jax.tree.map(lambda a, b: bool(np.any(np.asarray(a) > b)), info["needed"], small["needed"])
    assert any(jax.tree.leaves(more))


@pytest.mark.thorough
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name in ("fit", "track") else pytest.mark.slow) for name in CASES],
    indirect=True,
)
def test_it_runs_in_a_scan_as_it_does_alone(name):
    case = case_of(name)
    params, state = case.params, state_of(name)

    def both(carry, step):
        *carry, info = case.step.update(*carry, case.batch, step=step, key=KEY)
        return tuple(carry), info["loss"]

    carry, losses = jax.jit(lambda carry: jax.lax.scan(both, carry, jnp.arange(2)))((params, state))
    for i in range(2):
        params, state, info = updated(name, params, state, case.batch, i)
    np.testing.assert_allclose(losses[-1], info["loss"], rtol=1e-3, atol=1e-6)
    assert shapes(carry) == shapes((params, state))


@pytest.mark.thorough
def test_a_step_that_wraps_it_works(name):
    case = case_of(name)
    wrapped = averaged(case.step)
    assert shapes(wrapped.init(case.params)) == shapes((case.step.init(case.params), case.params))
    before = state_of(name), jax.tree.map(jnp.zeros_like, case.params)
    params, (_, mean), info = jitted(name)(case.params, before, case.batch, jnp.asarray(0))
    assert np.isfinite(float(info["loss"]))
    assert shapes(mean) == shapes(params)
    for m, p in zip(jax.tree.leaves(mean), jax.tree.leaves(params), strict=True):
        np.testing.assert_allclose(m, (0.1 * np.asarray(p)).astype(m.dtype), rtol=1e-5)
