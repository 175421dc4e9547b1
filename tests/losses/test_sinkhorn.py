"""Sinkhorn matching against its invariants, the optimal assignment, central differences and ott-jax."""

from functools import partial

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from scipy.optimize import linear_sum_assignment

from gsjax.losses.sinkhorn import sinkhorn

DERIVATIVES = ("unrolled", "implicit")
STATIC = ("iterations", "derivative")
matching = jax.jit(sinkhorn, static_argnames=STATIC)
SEEDS, TEMPERATURES = st.integers(0, 1000), st.floats(0.4, 10)
N, M, ENOUGH = 5, 7, 400  # enough iterations to converge at these temperatures


def match(*arguments, **options) -> np.ndarray:
    return np.asarray(matching(*arguments, **options))


def scores_of(seed: int, rows: int = N, columns: int = N) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(rows, columns))


def value(inputs, weights, iterations=20, derivative="unrolled", **there):
    """A weighted sum of the matching of scores at a temperature, optionally with a slack."""
    scores, temperature, *slack = inputs
    options = {"iterations": iterations, "derivative": derivative, **there}
    return jnp.vdot(weights, sinkhorn(scores, temperature, slack=slack[0] if slack else None, **options))


slopes_of = jax.jit(jax.grad(value), static_argnames=STATIC)


# -- laws ----------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("x64")
@given(SEEDS, TEMPERATURES)
def test_rows_and_columns_sum_to_one(seed, temperature):
    few, many = (match(scores_of(seed), temperature, iterations=i) for i in (2, ENOUGH))
    assert (few >= 0).all()
    np.testing.assert_allclose(few.sum(0), 1, rtol=1e-12)  # columns always do
    np.testing.assert_allclose(many.sum(0), 1, rtol=1e-12)
    np.testing.assert_allclose(many.sum(1), 1, rtol=1e-9)


@pytest.mark.usefixtures("x64")
@given(SEEDS, TEMPERATURES, st.floats(-3, 3))
def test_a_slack_takes_the_unmatched_and_less_for_a_lower_score(seed, temperature, slack):
    scores = scores_of(seed, N, M)
    found, lower = (match(scores, temperature, slack=s, iterations=ENOUGH) for s in (slack, slack - 0.5))
    assert (found.sum(0) < 1).all()
    assert (found.sum(1) < 1).all()
    assert found.sum() < lower.sum() < min(N, M)


@pytest.mark.usefixtures("x64")
@given(SEEDS, TEMPERATURES)
def test_there_is_a_slack_if_sizes_differ_or_one_is_given(seed, temperature):
    scores = scores_of(seed, N, M)
    np.testing.assert_array_equal(match(scores, temperature), match(scores, temperature, slack=0.0))
    square = scores[:, :N]
    assert match(square, temperature, slack=0.0).sum() < N - 1e-3
    one_less = np.arange(N) > 0
    np.testing.assert_array_equal(
        match(square, temperature, rows=one_less), match(square, temperature, rows=one_less, slack=0.0)
    )
    both = match(square, temperature, rows=one_less, columns=one_less)
    np.testing.assert_allclose(both.sum(0), one_less, rtol=1e-12)


@pytest.mark.usefixtures("x64")
@given(SEEDS, st.sampled_from([(3, 3), (1, 5), (4, 2)]))
def test_absent_rows_and_columns_act_as_if_not_in_the_matrix(seed, size):
    random = np.random.default_rng(seed)
    rows, columns = random.permutation(N) < size[0], random.permutation(M) < size[1]
    scores = scores_of(seed, N, M)
    found = match(scores, 0.7, rows=rows, columns=columns)
    np.testing.assert_allclose(
        found[np.ix_(rows, columns)], match(scores[np.ix_(rows, columns)], 0.7), rtol=1e-10
    )
    assert (found[~rows] == 0).all()
    assert (found[:, ~columns] == 0).all()


@pytest.mark.usefixtures("x64")
@given(SEEDS, TEMPERATURES)
def test_permuting_rows_and_columns_permutes_the_matching(seed, temperature):
    random = np.random.default_rng(seed)
    rows, columns = random.permutation(N), random.permutation(M)
    scores = scores_of(seed, N, M)
    np.testing.assert_allclose(
        match(scores[rows][:, columns], temperature), match(scores, temperature)[rows][:, columns], rtol=1e-10
    )


@pytest.mark.usefixtures("x64")
@given(SEEDS, st.floats(-1e4, 1e4))
def test_an_offset_of_a_row_or_a_column_or_all_scores_does_not_matter(seed, shift):
    random = np.random.default_rng(seed)
    scores = scores_of(seed)
    rows, columns = random.normal(size=(N, 1)), random.normal(size=N)
    np.testing.assert_allclose(match(scores + rows + shift, 0.7), match(scores, 0.7), rtol=1e-8)
    np.testing.assert_allclose(
        match(scores + columns, 0.7, iterations=ENOUGH), match(scores, 0.7, iterations=ENOUGH), rtol=1e-8
    )
    wide = scores_of(seed, N, M)
    np.testing.assert_allclose(
        match(wide + shift, 0.7, slack=shift - 0.3), match(wide, 0.7, slack=-0.3), rtol=1e-8
    )


# -- limits --------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("x64")
@given(SEEDS)
def test_it_is_the_best_assignment_when_cold_and_uniform_when_hot(seed):
    scores = scores_of(seed)
    rows, columns = linear_sum_assignment(scores, maximize=True)
    cold = match(scores, 0.01, iterations=20_000)
    np.testing.assert_array_equal(cold.argmax(1)[rows], columns)
    assert (scores * cold).sum() > scores[rows, columns].sum() - 0.05
    np.testing.assert_allclose(match(scores, 1e6), 1 / N, rtol=1e-4)
    np.testing.assert_allclose(match(scores_of(seed, N, M), 1e6), 1 / (N + M), rtol=1e-4)


@pytest.mark.usefixtures("x64")
@given(SEEDS, st.floats(-1, 1))
def test_when_cold_only_pairs_better_than_the_slack_are_matched(seed, slack):
    scores = scores_of(seed, N, M)
    gains = np.maximum(scores - slack, 0)
    rows, columns = linear_sum_assignment(gains, maximize=True)
    cold = match(scores, 0.01, slack=slack, iterations=20_000)
    assert ((scores - slack) * cold).sum() > gains[rows, columns].sum() - 0.1


# -- extremes ------------------------------------------------------------------------------------------------

EXTREMES = {
    "large": 1e4 * np.random.default_rng(0).normal(size=(4, 4)),
    "all large": np.full((4, 4), 1e4),
    "all small": np.full((4, 4), -1e4),
    "large against small": np.where(np.eye(4, k=1) > 0, 1e4, -1e4),
    "one row": np.arange(4.0)[None],
    "one column": np.arange(4.0)[:, None],
    "one pair": np.zeros((1, 1)),
    "no number": np.full((4, 4), np.nan),
    "nothing allowed": np.full((4, 4), -np.inf),
    "only one row's pairs allowed": np.where(np.arange(4)[:, None] == 0, 1.0, -np.inf),
    "no rows that could fit": np.where(np.arange(4) < 1, 1.0, np.where(np.eye(4) > 0, 1.0, -np.inf)),
}


@pytest.mark.thorough
@pytest.mark.parametrize("name", EXTREMES)
def test_the_matching_and_its_gradients_are_finite_whatever_the_scores(name):
    scores = np.float32(EXTREMES[name])
    weights = np.float32(np.random.default_rng(1).normal(size=scores.shape))
    for slack in ((), (np.float32(-0.5),)):
        inputs = scores, np.float32(0.5), *slack
        found = match(*inputs[:2], slack=slack[0] if slack else None)
        assert np.isfinite(found).all()
        assert (found >= 0).all()
        assert (found.sum(0) < 1 + 1e-5).all()
        for derivative in DERIVATIVES:
            for slope in slopes_of(inputs, weights, derivative=derivative):
                assert np.isfinite(slope).all()


def test_equal_scores_match_uniformly_and_a_single_pair_fully():
    for shift in (1e4, -1e4):
        np.testing.assert_allclose(match(np.full((4, 4), shift), 0.5), 0.25, rtol=1e-6)
    np.testing.assert_allclose(match(np.full((1, 1), -1e4), 0.5), 1)
    assert not match(np.full((4, 4), np.nan), 0.5).any()


@pytest.mark.parametrize("derivative", DERIVATIVES)
def test_a_row_or_column_of_nan_is_culled_and_does_not_spread(derivative):
    scores, weights = (np.random.default_rng(i).normal(size=(N, M)).astype(np.float32) for i in (0, 1))
    there = {"rows": np.arange(N) != 2, "columns": np.arange(M) != 4}
    want = match(scores, 0.5, **there)
    slope = slopes_of((scores, 0.5), weights, derivative=derivative, **there)[0]
    scores = np.where(there["rows"][:, None] & there["columns"], scores, np.float32(np.nan))
    np.testing.assert_allclose(match(scores, 0.5), want, rtol=1e-6)
    culled = np.asarray(slopes_of((scores, 0.5), weights, derivative=derivative)[0])
    np.testing.assert_allclose(culled, slope, rtol=1e-5, atol=1e-7)
    assert (culled[2] == 0).all()
    assert (culled[:, 4] == 0).all()


def test_float32_is_near_to_float64_also_where_all_scores_are_large():
    scores = 1000 + np.random.default_rng(0).normal(size=(N, N)).astype(np.float32)
    with jax.enable_x64(True):
        double = match(np.float64(scores), 0.5)
    np.testing.assert_allclose(match(scores, 0.5), double, rtol=2e-5)


# -- derivatives ---------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(("derivative", "iterations"), [("unrolled", 3), ("implicit", 60)])
def test_slopes_are_those_of_central_differences_and_jvp_agrees_with_vjp(derivative, iterations):
    random = np.random.default_rng(3)
    scores = scores_of(3, N, M)
    scores[1, 2], scores[4] = -np.inf, np.nan
    for columns, slack in ((M, (np.array(0.2),)), (N - 1, ())):
        inputs, weights = (scores[:, :columns], np.array(0.8), *slack), scores_of(4, N, columns)
        along = jax.tree.map(lambda a: np.asarray(random.normal(size=a.shape)), inputs)
        along = (np.where(np.isfinite(inputs[0]), along[0], 0.0), *along[1:])
        loss = jax.jit(partial(value, weights=weights, iterations=iterations, derivative=derivative))
        ahead, behind = (
            float(loss(jax.tree.map(lambda a, d, step=step: np.asarray(a + step * d), inputs, along)))
            for step in (1e-6, -1e-6)
        )
        slopes = jax.device_get(slopes_of(inputs, weights, iterations=iterations, derivative=derivative))
        by_slope = sum(map(np.vdot, slopes, along))
        np.testing.assert_allclose(by_slope, (ahead - behind) / 2e-6, rtol=1e-7)
        np.testing.assert_allclose(jax.jvp(loss, (inputs,), (along,))[1], by_slope, rtol=1e-9)
        for slope in slopes:  # and none vanishes
            assert np.abs(slope).max() > 1e-4


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
def test_the_implicit_gradient_is_the_unrolled_one_up_to_the_error_of_row_sums():
    inputs, weights = (scores_of(1), np.array(0.3)), scores_of(2)
    errors, gaps = [], []
    for iterations in (5, 20, ENOUGH):
        options = {"iterations": iterations}
        unrolled, implicit = (slopes_of(inputs, weights, **options, derivative=d)[0] for d in DERIVATIVES)
        errors.append(np.abs(np.subtract(implicit, unrolled)).max())
        gaps.append(np.abs(match(*inputs, **options).sum(1) - 1).max())
    assert errors[-1] < 1e-12
    assert errors[0] > errors[1] > 1e-6  # before convergence the two differ
    assert all(error < 5 * gap for error, gap in zip(errors[:2], gaps[:2], strict=True))


@pytest.mark.usefixtures("x64")
def test_second_derivatives_agree_too():
    weights, along = scores_of(2, 3, 3), scores_of(3, 3, 3)

    @partial(jax.jit, static_argnums=1)
    def second(scores, derivative):
        def slope(scores):
            return jax.grad(value)((scores, 1.0), weights, ENOUGH, derivative)[0]

        return jax.jvp(slope, (scores,), (along,))[1]

    unrolled, implicit = (second(scores_of(1, 3, 3), derivative) for derivative in DERIVATIVES)
    np.testing.assert_allclose(implicit, unrolled, atol=1e-12)
    assert np.abs(unrolled).max() > 1e-2


def test_a_sharp_matching_has_no_gradient_in_float32():
    slope = slopes_of((100 * np.eye(N), 1.0), scores_of(0), derivative="implicit")[0]
    np.testing.assert_allclose(slope, 0, atol=1e-6)


@pytest.mark.parametrize("derivative", DERIVATIVES)
def test_a_batch_is_a_loop(derivative):
    many, rows = np.stack([scores_of(i) for i in range(3)]), np.arange(N) < np.array([[N], [3], [0]])

    def slope(scores, rows):
        return slopes_of((scores, 0.5), scores_of(9), rows=rows, derivative=derivative)[0]

    np.testing.assert_allclose(jax.vmap(slope)(many, rows), list(map(slope, many, rows)), atol=1e-6)


# -- other implementations -----------------------------------------------------------------------------------


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
def test_it_agrees_with_ott():
    from ott.geometry.geometry import Geometry
    from ott.problems.linear.linear_problem import LinearProblem
    from ott.solvers.linear.sinkhorn import Sinkhorn

    temperature, slack = 0.3, 0.2
    scores, weights = scores_of(0, N, M), scores_of(1, N, M)

    @jax.jit
    @partial(jax.value_and_grad, has_aux=True)
    def theirs(scores):
        padded = jnp.pad(scores, (0, 1), constant_values=slack)
        masses = jnp.ones(N + 1).at[-1].set(M), jnp.ones(M + 1).at[-1].set(N)
        problem = LinearProblem(Geometry(-padded, epsilon=temperature), *masses)
        matching = Sinkhorn(threshold=1e-12)(problem).matrix[:-1, :-1]
        return jnp.vdot(weights, matching), matching

    (_, want), want_slope = theirs(scores)
    np.testing.assert_allclose(match(scores, temperature, slack=slack, iterations=ENOUGH), want, atol=1e-9)
    for derivative in DERIVATIVES:
        slope, *_ = slopes_of((scores, temperature, slack), weights, ENOUGH, derivative)
        np.testing.assert_allclose(slope, want_slope, atol=1e-5)


# -- mistakes ------------------------------------------------------------------------------------------------


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"derivative": "exact"}, "derivative='exact'.*'unrolled' or 'implicit'"),
        ({"iterations": 0}, "iterations=0.*1 or more"),
        ({"temperature": 0.0}, "temperature=0.0.*above 0"),
        ({"temperature": float("nan")}, "temperature=nan.*above 0"),
        ({"slack": float("-inf")}, "slack=-inf.*finite"),
    ],
)
def test_mistakes_are_named(options, says):
    with pytest.raises(ValueError, match=says):
        sinkhorn.__wrapped__(jnp.zeros((2, 2)), **{"temperature": 1.0} | options)
