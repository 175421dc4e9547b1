"""Vectors of Gaussians by a vote and then conjugate gradients, against a dense solution in float64."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.engine.drive import drive
from gsjax.geometry.neighbors import nearest_neighbors
from gsjax.methods.distill import (
    PRESETS,
    Distill,
    DistillConfig,
    SolveConfig,
    frozen_views,
    gaussian_cosines,
    teacher_of_maps,
    teacher_of_objects,
    with_maps,
)
from gsjax.methods.distill.field import FeatureField
from gsjax.methods.distill.solve import SolveState, _after_vote, _cg_step, _first_residual, basis_of
from gsjax.optim.conjugate_gradients import Conjugate
from gsjax.scene.feature_grid import FeatureGrid, FeatureGridConfig
from tests.methods.distill.two_balls import BOOK, DIMENSION, HEIGHT, WIDTH, cameras, painted, two_balls

SOLVE = SolveConfig(iterations=60, smoothness=0.02, neighbors=5)
GRID = FeatureGridConfig(
    levels=4, least_resolution=4, most_resolution=16, log2_entries=10, features=4, hidden=16
)


KINDS = ["both", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("masks", "maps"))]


@pytest.fixture(scope="module")
def scene():
    return two_balls()


def teacher_with(masks, kind: str = "masks"):
    """A teacher with true masks in which a few pixels are unknown; or with maps; or with both."""
    random = np.random.default_rng(3)
    holes = [np.where(random.uniform(size=mask.shape) < 0.1, -1, mask) for mask in masks]
    objects = teacher_of_objects(holes, [BOOK] * len(masks))
    maps = random.normal(size=(len(masks), HEIGHT // 4, WIDTH // 4, 3)) @ BOOK
    dense = teacher_of_maps(list(maps.astype(np.float32)), [(HEIGHT, WIDTH)] * len(masks))
    return {"masks": objects, "maps": dense, "both": with_maps(objects, dense)}[kind]


def solved(gaussians, teacher, config):
    method = Distill(config)
    ticks = drive(method, *method.start(gaussians, cameras(8), teacher))
    infos = [jax.device_get(now.info) for now in ticks]
    return ticks, infos


def dense(gaussians, teacher, config, problem):
    """The normal equations in float64, from the weights of single Gaussians: matrix, right-hand side, D."""
    n = gaussians.num
    A, b, d = np.zeros((n, n)), np.zeros((n, DIMENSION)), np.zeros(n)
    for v, (view, plan) in enumerate(frozen_views(gaussians, cameras(8))):
        image, alphas = painted(view, jnp.eye(n), plan)
        W, alpha = np.asarray(image, np.float64).reshape(-1, n), np.asarray(alphas, np.float64).ravel()
        m, e = np.zeros(len(W)), np.zeros((len(W), DIMENSION))
        if teacher.codebook is not None:
            ids = teacher.ids[v].ravel()
            m += ids >= 0
            e += np.where((ids >= 0)[:, None], teacher.codebook[np.maximum(ids, 0)], 0)
        if teacher.maps is not None:
            weight = 1.0 if teacher.codebook is None else config.weights.map
            resized = jax.image.resize(jnp.asarray(teacher.maps[v]), (HEIGHT, WIDTH, DIMENSION), "bilinear")
            m, e = m + weight, e + weight * np.asarray(resized, np.float64).reshape(-1, DIMENSION)
        A += W.T @ (m[:, None] * W)
        b += W.T @ (alpha[:, None] * e)
        d += W.T @ (m * alpha)
    near = np.asarray(problem.neighbors)
    L = np.zeros((n, n))
    for i, j in [(row, other) for row in range(n) for other in near[row] if row != other]:
        L[[i, j], [i, j]] += 1
        L[i, j] -= 1
        L[j, i] -= 1
    return A + config.solve.smoothness * d.sum() / (d > 1e-12).sum() * L, b, d


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_conjugate_gradients_reach_the_dense_solution_in_float64(scene, kind):
    gaussians, _, masks = scene
    teacher = teacher_with(masks, kind)
    config = DistillConfig(start="solve", solve=SOLVE, iterations=0)
    ticks, infos = solved(gaussians, teacher, config)
    A, b, _ = dense(gaussians, teacher, config, ticks.problem)
    wanted = np.linalg.solve(A, b)
    field = ticks.result.field
    found = np.asarray(field.encoding, np.float64) @ np.asarray(field.lift, np.float64).T
    assert np.abs(found - wanted).max() < 2e-5 * np.abs(wanted).max()
    losses = np.array([info["loss"] for info in infos])[15::8]  # after each pass except the vote
    assert (np.diff(losses) <= 1e-6 * infos[7]["loss"]).all()
    assert not any(info["skipped"] for info in infos)


@pytest.mark.thorough
@pytest.mark.parametrize("preset", ["vote", "solve"])
def test_what_is_seen_and_in_no_mask_is_nothing(scene, preset):
    """It does not take the vector of its neighbours: only one ball has masks, the rest has none."""
    gaussians, labels, masks = scene
    teacher = teacher_of_objects([np.where(mask == 1, 1, -1) for mask in masks], [BOOK] * len(masks))
    ticks, _ = solved(gaussians, teacher, PRESETS[preset])
    cosines = np.asarray(ticks.result.cosines(BOOK[1:2]))[:, 0]
    assert (cosines[labels == 1] > 0.99).all()
    assert (cosines[labels == 2] == 0).mean() > 0.8  # except at the outline of the first


def small_state(A, b, shown):
    """The state after the first pass over the pixels: the votes' sums, and a system without smoothness."""
    zeros, zero, one = jnp.zeros_like(b), jnp.float32(0), jnp.float32(1)
    begun, mass = Conjugate(zeros, zeros, zeros[0]), jnp.asarray(A.sum(1))
    return SolveState(jnp.asarray(b), zeros, mass, jnp.asarray(shown), zero, begun, zero, one, zero)


def test_what_is_beside_nothing_does_not_take_its_stray_vector():
    """The second Gaussian has no mask but for a stray pixel; the third, beside it, is in no pixel."""
    mass, b = np.diag([1, 0.01, 0]).astype(np.float32), np.float32([[1, 0], [0, 0.01], [0, 0]])
    state = small_state(mass, b, np.float32([1, 1, 0]))
    field = FeatureField(jnp.zeros((3, 2)), jnp.eye(2))
    field, _ = _after_vote(field, state, jnp.array([[1], [0], [1]]), 0.0)
    np.testing.assert_array_equal(field.encoding, [[1, 0], [0, 0], [0, 0]])


@pytest.mark.thorough
def test_conjugate_gradients_keep_nothing_at_zero():
    """They reach the least squares of the other Gaussians, and the loss is that of the solution."""
    W = np.random.default_rng(0).uniform(size=(8, 5)).astype(np.float32) / 5
    W[:, 4] *= 0.02
    A, b = W.T @ W, W.T @ np.random.default_rng(1).uniform(size=(8, 2)).astype(np.float32)
    neighbors = jnp.zeros((5, 1), jnp.int32)
    shown = np.float32([1, 1, 1, 1, 100]) * A.sum(1)
    field = FeatureField(jnp.zeros((5, 2)), jnp.eye(2))
    field, state = _after_vote(field, small_state(A, b, shown), neighbors, 0.0)
    for turn in range(1, 12):
        x = field.encoding if turn == 1 else state.conjugate.direction
        step = _first_residual if turn == 1 else _cg_step
        field, state = step(field, state._replace(total=jnp.asarray(A) @ x), neighbors)
        x = np.asarray(field.encoding)
        np.testing.assert_allclose(state.loss, np.sum(x * (A @ x - 2 * b)), rtol=1e-4)
    np.testing.assert_allclose(x[:4], np.linalg.solve(A[:4, :4], b[:4]), rtol=1e-2)
    np.testing.assert_array_equal(x[4], 0)


@pytest.mark.thorough
def test_a_scene_in_half_precision_is_solved_in_single(scene):
    gaussians, _, masks = scene
    half = jax.tree.map(lambda a: a.astype(jnp.bfloat16), gaussians)
    config = DistillConfig(start="solve", iterations=0, solve=SolveConfig(iterations=3))
    ticks, _ = solved(half, teacher_with(masks), config)
    vectors = ticks.result.field.encoding
    assert vectors.dtype == jnp.float32
    assert np.isfinite(vectors).all()


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("dtype", "error"), [(jnp.float64, 1e-7), (jnp.float32, 2e-5)])
def test_with_64_bits_they_reach_it_to_seven_digits(kind, dtype, error):
    gaussians, _, masks = two_balls()
    gaussians = jax.tree.map(lambda a: jnp.asarray(a, dtype), gaussians)
    teacher = teacher_with(masks, kind)
    config = DistillConfig(start="solve", solve=replace(SOLVE, iterations=120), iterations=0)
    ticks, _ = solved(gaussians, teacher, config)
    A, b, _ = dense(gaussians, teacher, config, ticks.problem)
    wanted = np.linalg.solve(A, b)
    field = ticks.result.field
    assert field.encoding.dtype == dtype
    found = np.asarray(field.encoding, np.float64) @ np.asarray(field.lift, np.float64).T
    assert np.abs(found - wanted).max() < error * np.abs(wanted).max()


@pytest.mark.thorough
def test_a_vote_is_the_mean_of_the_pixels_that_show_a_gaussian(scene):
    gaussians, labels, masks = scene
    teacher = teacher_with(masks)
    config = PRESETS["vote"]
    ticks, infos = solved(gaussians, teacher, config)
    _, b, d = dense(
        gaussians, teacher, replace(config, solve=SOLVE), ticks.problem._replace(neighbors=[[]] * 160)
    )
    field = ticks.result.field
    found = np.asarray(field.encoding) @ np.asarray(field.lift).T
    seen = d > 1e-3
    np.testing.assert_allclose(found[seen], b[seen] / d[seen, None], atol=1e-4)
    assert len(infos) == 8
    assert (
        np.asarray(gaussian_cosines(field, None, jnp.asarray(BOOK)))[:, 1:].argmax(-1) + 1 == labels
    ).all()


@pytest.mark.thorough
def test_strips_change_nothing(scene):
    gaussians, _, masks = scene
    teacher = teacher_with(masks, "both")
    config = DistillConfig(start="solve", solve=replace(SOLVE, iterations=3), iterations=0)
    whole, _ = solved(gaussians, teacher, config)
    strips, _ = solved(gaussians, teacher, replace(config, strip_megabytes=0.1))
    np.testing.assert_allclose(whole.result.field.encoding, strips.result.field.encoding, atol=2e-5)


@pytest.mark.thorough
def test_what_no_pixel_shows_has_the_vector_of_its_neighbours(scene):
    gaussians, _labels, masks = scene
    inside = np.array([[0.0, -0.5, 0.0], [0.0, 0.5, 0.0]], np.float32)  # centres of the balls, hidden
    means = np.concatenate([np.asarray(gaussians.means), inside, [[np.nan] * 3]]).astype(np.float32)
    rows = [*range(160), 0, 159, 0]
    both = jax.tree.map(lambda a: jnp.asarray(a)[np.array(rows)], gaussians)
    both = both.__class__(**{**vars(both), "means": jnp.asarray(means)})
    ticks, _ = solved(both, teacher_with(masks), DistillConfig(start="solve", solve=SOLVE, iterations=0))
    cosines = np.asarray(gaussian_cosines(ticks.result.field, None, jnp.asarray(BOOK)))
    assert cosines[160:162, 1:].argmax(-1).tolist() == [0, 1]
    assert np.isfinite(cosines).all()


@pytest.mark.thorough
def test_a_descent_begins_where_the_solution_ended(scene):
    gaussians, labels, masks = scene
    config = DistillConfig(
        start="solve", solve=replace(SOLVE, iterations=8), iterations=40, grid=GRID, contrast_patch=8
    )
    teacher = teacher_of_objects([np.where(mask > 0, mask, -1) for mask in masks], [BOOK] * 8)
    ticks, infos = solved(gaussians, teacher, config)
    assert isinstance(ticks.result.field.encoding, FeatureGrid)
    assert ticks.result.rows is not None
    assert infos[80]["cos"] < 0.05
    assert infos[80]["loss"] < 1
    cosines = ticks.result.cosines(BOOK)
    assert (np.asarray(cosines)[:, 1:].argmax(-1) + 1 == labels).mean() > 0.95
    table, _ = solved(gaussians, teacher_with(masks), replace(config, encoding="table", iterations=3))
    assert table.result.rows is None
    assert len(table.result.field.encoding) == 160


@pytest.mark.thorough
def test_a_resumed_solution_is_the_same_to_the_bit(scene):
    gaussians, _, masks = scene
    config = DistillConfig(
        start="solve", solve=replace(SOLVE, iterations=3), iterations=5, grid=GRID, contrast_patch=8
    )
    method = Distill(config)
    whole, _ = solved(gaussians, teacher_with(masks), config)
    problem, run = method.start(gaussians, cameras(8), teacher_with(masks))
    for stop in (13, 41, 44):
        ticks = drive(
            method, problem, jax.tree.map(lambda a: jnp.array(a) if isinstance(a, jax.Array) else a, run)
        )
        for now in ticks:
            if now.step == stop:
                break
        run = ticks.run
    *_, last = drive(method, problem, run)
    same = jax.tree.map(
        lambda a, b: bool((np.asarray(a) == np.asarray(b)).all()), last.run.params, whole.run.params
    )
    assert all(jax.tree.leaves(same))


def test_the_basis_spans_the_teacher(scene):
    _, _, masks = scene
    basis = basis_of(teacher_with(masks), PRESETS["solve"])
    assert basis.shape == (DIMENSION, 3)
    np.testing.assert_allclose(basis @ (basis.T @ BOOK.T), BOOK.T, atol=1e-5)
    assert basis_of(teacher_with(masks), replace(PRESETS["solve"], channels=2)).shape == (DIMENSION, 2)


def test_neighbours_are_the_nearest_others():
    random = np.random.default_rng(2)
    points = random.normal(size=(50, 3))
    points[[7, 8]] = points[9]
    points[20] = np.nan
    found = nearest_neighbors(points, 4)
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    apart[np.isnan(apart)] = np.inf
    for i in set(range(50)) - {20}:
        np.testing.assert_allclose(np.sort(apart[i, found[i]]), np.sort(apart[i])[:4])
        assert i not in found[i]
    assert (found[20] == 20).all()
    assert nearest_neighbors(points[:2], 4).tolist() == [[1, 0, 0, 0], [0, 1, 1, 1]]


def test_no_steps_at_all_are_refused():
    with pytest.raises(
        ValueError, match="iterations: expected at least 1 where the start is random, found 0"
    ):
        DistillConfig(iterations=0)


@pytest.mark.thorough
def test_many_views_of_which_the_last_show_more_end_with_their_vote(scene):
    """The energy of the target then rises with the views; this must not be taken for divergence."""
    gaussians, _, masks = scene
    some = [np.where((mask > 0) | (i < 120), mask, -1) for i, mask in enumerate(masks * 19)]
    method = Distill(PRESETS["vote"])
    teacher = teacher_of_objects(some, [BOOK] * 152)
    ticks = drive(method, *method.start(gaussians, cameras(8) * 19, teacher))
    *_, last = ticks
    assert last.step == 152
    assert not last.run.guard.is_settled
    assert np.abs(np.asarray(last.result.field.encoding)).sum(1).min() > 0
