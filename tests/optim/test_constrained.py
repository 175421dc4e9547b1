"""Projection onto the simplex against brute force over its faces; descent to corners, edges and inside."""

import itertools
import re
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.test_util import check_grads
from jaxtyping import Array, Float

import gsjax
from gsjax.optim.constrained import project_simplex, simplex_descent
from gsjax.optim.step import Step, gradient_step, per_field_adam

project = jax.jit(project_simplex)
project_by_optax = jax.jit(optax.projections.projection_simplex)
entries = st.floats(-3, 3) | st.sampled_from([-1.0, 0.0, 0.25, 1.0])  # ties and kinks among them
rows = st.integers(1, 5).flatmap(lambda size: st.lists(entries, min_size=size, max_size=size))


def nearest(values):
    """By brute force over all faces: the nearest point of each face's plane, if it lies on the simplex."""
    found = []
    for size in range(1, len(values) + 1):
        for face in map(list, itertools.combinations(range(len(values)), size)):
            point = np.zeros(len(values))
            point[face] = values[face] + (1 - values[face].sum()) / size
            if (point >= -1e-12).all():
                found.append(point)
    return min(found, key=lambda point: np.sum((point - values) ** 2))


@pytest.mark.usefixtures("x64")
class TestProjection:
    @given(rows)
    def test_no_point_of_the_simplex_is_nearer(self, values):
        np.testing.assert_allclose(project(np.array(values)), nearest(np.array(values)), atol=1e-12)

    @given(rows)
    def test_the_conditions_of_karush_kuhn_and_tucker(self, values):
        point = np.asarray(project(np.array(values)))
        assert (point >= 0).all()
        np.testing.assert_allclose(point.sum(), 1, atol=1e-12)
        pull = point - np.array(values)
        multiplier = pull[point > 0]
        np.testing.assert_allclose(multiplier, multiplier[0], atol=1e-12)
        assert (pull >= multiplier[0] - 1e-12).all()

    @given(rows, st.floats(-100, 100))
    def test_twice_is_once_and_a_constant_changes_nothing(self, values, constant):
        point = project(np.array(values))
        np.testing.assert_allclose(project(point), point, atol=1e-12)
        np.testing.assert_allclose(project(np.array(values) + constant), point, atol=1e-12)

    @given(rows)
    def test_optax_has_the_same(self, values):
        values = np.array(values)
        np.testing.assert_allclose(project(values), project_by_optax(values), atol=1e-12)

    @pytest.mark.parametrize("seed", range(4))
    def test_derivatives_away_from_kinks(self, seed):
        values = np.random.default_rng(seed).normal(size=(3, 5))
        point = np.asarray(project(jnp.asarray(values)))
        taken = np.max(values - point, axis=1, keepdims=True, where=point > 0, initial=-np.inf)
        assert (np.abs(values - taken) > 1e-3).all()  # no entry is about to reach or leave 0
        check_grads(project, (values,), order=1, modes=["fwd", "rev"], eps=1e-5)

    def test_a_batch_is_a_loop(self):
        values = np.random.default_rng(0).normal(size=(2, 3, 4))
        loop = np.stack([np.stack([project(row) for row in rows]) for rows in values])
        np.testing.assert_allclose(project(values), loop, atol=1e-15)
        np.testing.assert_allclose(jax.vmap(project)(values), loop, atol=1e-15)


def test_large_values_lose_nothing_in_float32():
    """At this size float32 resolves only halves, and sums of two values only whole numbers."""
    point = project(np.float32([0.5, 0.0, -5.0]) + np.float32(2**22))
    assert point.dtype == np.float32
    np.testing.assert_allclose(point, [0.75, 0.25, 0.0], atol=1e-6)


def test_what_is_not_finite_stays_in_its_row():
    values = np.float32([[0.2, np.nan, 0.1], [0.3, 0.5, -np.inf], [np.inf, 0.0, 0.0], [0.0, 2.0, 0.0]])
    point = np.asarray(project(values))
    assert np.isnan(point[[0, 2]]).all()
    np.testing.assert_allclose(point[[1, 3]], [[0.4, 0.6, 0.0], [0.0, 1.0, 0.0]], atol=1e-6)


def least_squares(seed, num=20, parts=4):
    """|A w - b|^2 / 2 per row, with known optima w on the simplex: on corners, edges, faces and inside.

    b is chosen such that the gradient there meets the Karush-Kuhn-Tucker conditions: one number on the
    entries above 0, and more on the others. That number is large, as when all handles err the same way.
    """
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(num, parts, parts)) + 2 * np.eye(parts)
    best, gradient = np.zeros((num, parts)), np.full((num, parts), 5.0)
    for row in range(num):
        order = rng.permutation(parts)
        above, zero = np.split(order, [1 + row % parts])
        best[row, above] = rng.dirichlet(np.ones(len(above)))
        gradient[row, zero] += rng.uniform(0.5, 3.0, len(zero))
    residual = np.linalg.solve(A.swapaxes(1, 2), gradient[..., None])[..., 0]
    b = np.einsum("npq,nq->np", A, best) - residual
    return np.float32(A), np.float32(b), best


def even(best):
    """Equal weights."""
    return np.full(best.shape, 1 / best.shape[1], np.float32)


def misfit(weights, batch, *, step, key):
    A, b, scale = batch
    return jnp.sum((scale * (jnp.einsum("npq,nq->np", A, weights) - b)) ** 2) / 2, {}


def run(step: Step, weights, batch, count):
    def body(carry, i):
        *carry, info = step.update(*carry, batch, step=i, key=None)
        return tuple(carry), (carry[0], info["skipped"])

    start = weights, jax.jit(step.init)(weights)
    return jax.device_get(jax.jit(lambda c: jax.lax.scan(body, c, jnp.arange(count)))(start)[1])


@pytest.mark.parametrize("seed", range(3))
def test_it_descends_to_the_best_weights_and_never_leaves_the_simplex(seed):
    """Whatever the scales of the rows: some Gaussians cover few pixels and some many."""
    A, b, best = least_squares(seed)
    scale = np.float32(10 ** np.linspace(-2.0, 2.0, len(best)))[:, None]
    step = gradient_step(misfit, simplex_descent(optax.cosine_decay_schedule(0.1, 500)))
    path, skipped = run(step, even(best), (A, b, scale), 500)
    assert not skipped.any()
    assert (path >= 0).all()
    np.testing.assert_allclose(path.sum(-1), 1, atol=1e-6)
    np.testing.assert_allclose(path[-1], best, atol=2e-3)
    assert ((np.asarray(path[-1]) == 0) == (best == 0)).mean() > 0.95


def test_adam_alone_before_the_projection_stops_at_wrong_places():
    """The reason why `simplex_descent` has one second moment per row: see its docstring."""
    A, b, best = least_squares(0)
    onto = optax.stateless(lambda u, w: project_simplex(w + u) - w)
    adam = gradient_step(misfit, optax.chain(optax.adam(optax.cosine_decay_schedule(0.1, 500)), onto))
    path, _ = run(adam, even(best), (A, b, 1.0), 500)
    assert np.abs(path[-1] - best).max() > 0.1


def test_loss_terms_that_depend_only_on_row_sums_do_not_matter():
    A, b, best = least_squares(1)
    start = even(best)

    def other(weights, batch, *, step, key):
        loss, aux = misfit(weights, batch, step=step, key=key)
        return loss + 3 * jnp.sum(weights), aux

    plain, shifted = (
        run(gradient_step(loss, simplex_descent(0.01)), start, (A, b, 1.0), 20)[0] for loss in (misfit, other)
    )
    np.testing.assert_allclose(plain[-1], shifted[-1], atol=1e-5)


def test_the_first_step_has_the_length_of_the_rate_and_leads_onto_the_simplex():
    step = gradient_step(lambda w, batch, *, step, key: (1e-6 * w[0, 0], {}), simplex_descent(0.01))
    weights = np.full((1, 2), 0.5, np.float32)
    state, update = jax.jit(step.init)(weights), jax.jit(step.update)
    new, _, _ = update(weights, state, None, step=0, key=None)
    np.testing.assert_allclose(new, [[0.49, 0.51]], atol=1e-6)
    new, _, _ = update(3 * weights, state, None, step=0, key=None)
    np.testing.assert_allclose(np.asarray(new).sum(), 1, atol=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_step_that_is_not_finite_changes_no_bit(bad):
    A, b, best = least_squares(2)
    step = gradient_step(misfit, simplex_descent(0.05))
    weights, update, broken = even(best), jax.jit(step.update), b.copy()
    broken[3] = bad
    weights, state, _ = update(weights, jax.jit(step.init)(weights), (A, b, 1.0), step=0, key=None)
    new, new_state, info = update(weights, state, (A, broken, 1.0), step=1, key=None)
    assert info["skipped"]
    jax.tree.map(np.testing.assert_array_equal, (new, new_state), (weights, state))


class Scene(eqx.Module):
    weights: Float[Array, "n p"]
    places: Float[Array, "p"]


def test_it_serves_one_field_among_others():
    def loss(scene, batch, *, step, key):
        return jnp.sum((scene.weights @ scene.places - batch) ** 2), {}

    optimizer = per_field_adam({"places": 0.01}, others={"weights": simplex_descent(0.05)})
    step = gradient_step(loss, optimizer)
    scene = Scene(jnp.full((3, 2), 0.5), jnp.array([0.0, 1.0]))
    state = jax.jit(step.init)(scene)
    update = jax.jit(step.update)
    for i in range(60):
        scene, state, info = update(scene, state, np.float32([0.1, 0.5, 1.2]), step=i, key=None)
    assert info["loss"] < 1e-3
    assert scene.places[1] > 1.1  # no weights reach beyond the outermost place
    np.testing.assert_allclose(np.asarray(scene.weights).sum(1), 1, atol=1e-6)


def test_no_other_module_imports_jaxopt():
    package = Path(gsjax.__file__).parent
    users = [
        file
        for file in package.rglob("*.py")
        if re.search(r"^\s*(import|from) jaxopt", file.read_text(encoding="utf-8"), re.M)
    ]
    assert [file.relative_to(package).as_posix() for file in users] == ["optim/constrained.py"]


@pytest.mark.thorough
def test_entries_that_are_not_allowed_act_as_if_absent():
    A, b, best = least_squares(2)
    optimizer, allowed = simplex_descent(0.05), np.array([True, True, True, True, False])
    start = even(best)

    @jax.jit
    def descended(weights, **options):
        state = optimizer.init(weights)
        for _ in range(5):
            slope = jax.grad(lambda w: misfit(w, (A, b, 1.0), step=0, key=None)[0])(weights[:, :4])
            slope = jnp.pad(slope, ((0, 0), (0, weights.shape[1] - 4)), constant_values=-7.0)
            updates, state = optimizer.update(slope, state, weights, **options)
            weights = optax.apply_updates(weights, updates)
        return weights

    alone = descended(start)
    with_another = np.asarray(descended(np.pad(start, ((0, 0), (0, 1))), allowed=allowed))
    np.testing.assert_allclose(with_another[:, :4], alone, atol=1e-6)
    assert (with_another[:, 4] == 0).all()
