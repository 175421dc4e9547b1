"""Least squares agree with scipy, stay on manifolds, and reject moves that overflow or are not finite."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import optimistix as optx
import pytest
import scipy.optimize

from gsjax.optim.least_squares import (
    difference,
    from_coordinates,
    huber,
    least_squares_step,
    reject_overflow,
    solve,
    to_coordinates,
)
from tests.optim.iterations import SOLVERS, falls, scanned

# ------------------------------------------------------------------ a curve, where scipy knows the answer


def curve(params, batch, *, step, key):
    """y = a exp(-b x), which "overflows" for b > limit."""
    values = params["a"] * jnp.exp(-params["b"] * batch["x"]) - batch["y"]
    overflow = jnp.stack([params["b"] > batch.get("limit", jnp.inf), jnp.array(False)])
    return {"curve": values}, {"overflow": overflow, "needed": jnp.int32(params["b"] * 100)}


def points(noise=0.02, dtype=np.float32):
    x = np.linspace(0, 3, 30)
    y = 2 * np.exp(-0.7 * x) + noise * np.random.default_rng(0).normal(size=30)
    return {"x": x.astype(dtype), "y": y.astype(dtype)}


def start(dtype=np.float32):
    return {"a": jnp.asarray(1.0, dtype), "b": jnp.asarray(0.1, dtype)}


def updated(step, params, batch):
    """Returns the result of the first update."""
    state = jax.jit(step.init)(params)
    return jax.jit(step.update)(params, state, batch, step=0, key=None)


def by_scipy(batch, **options):
    x, y = np.asarray(batch["x"], np.float64), np.asarray(batch["y"], np.float64)
    return scipy.optimize.least_squares(
        lambda p: p[0] * np.exp(-p[1] * x) - y, [1.0, 0.1], xtol=1e-12, ftol=1e-12, gtol=1e-12, **options
    )


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("jac", ["fwd", "bwd"])
@pytest.mark.parametrize("name", SOLVERS)
def test_a_curve_fit_is_that_of_scipy(name, jac):
    batch, want = points(dtype=np.float64), by_scipy(points(dtype=np.float64))
    solver = eqx.tree_at(lambda s: (s.rtol, s.atol), SOLVERS[name], (1e-10, 1e-10))
    params, info = solve(curve, start(np.float64), batch, solver=solver, jac=jac)
    np.testing.assert_allclose([params["a"], params["b"]], want.x, rtol=1e-8)
    np.testing.assert_allclose(info["loss"], want.cost, rtol=1e-12)  # scipy's cost is half the sum as well
    assert info["converged"]
    assert info["result"] == optx.RESULTS.successful
    assert not info["skipped"]
    assert 3 < info["steps"] < 30
    stepped, infos = scanned(least_squares_step(curve, solver, jac=jac), start(np.float64), batch, 15)
    np.testing.assert_allclose([stepped["a"], stepped["b"]], want.x, rtol=1e-8)
    np.testing.assert_allclose(infos["loss"][-1], want.cost, rtol=1e-12)


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("name", SOLVERS)
def test_float32_stays_float32_where_x64_is_on(name):
    params, _ = solve(curve, start(), points(), solver=SOLVERS[name])
    stepped, _ = scanned(least_squares_step(curve, SOLVERS[name]), start(), points(), 8)
    for found in (params, stepped):
        assert found["a"].dtype == found["b"].dtype == np.float32
        np.testing.assert_allclose([found["a"], found["b"]], by_scipy(points()).x, rtol=1e-4)


def test_gauss_newton_is_the_normal_equations():
    batch = points()
    x, y = np.asarray(batch["x"], np.float64), np.asarray(batch["y"], np.float64)
    step = least_squares_step(curve, SOLVERS["GN"])
    params, _, info = updated(step, start(), batch)
    e = np.exp(-0.1 * x)
    jacobian = np.stack([e, -x * e], axis=-1)
    move = np.linalg.solve(jacobian.T @ jacobian, -jacobian.T @ (e - y))
    np.testing.assert_allclose([params["a"] - 1.0, params["b"] - 0.1], move, rtol=1e-4)
    assert info["accepted"]


@pytest.mark.parametrize("damping", [1e-2, 1.0, 30.0])
def test_damping_is_what_is_added_to_the_normal_equations(damping):
    batch = points()
    x, y = np.asarray(batch["x"], np.float64), np.asarray(batch["y"], np.float64)
    step = least_squares_step(curve, SOLVERS["LM"], damping=damping)
    params, _, info = updated(step, start(), batch)
    e = np.exp(-0.1 * x)
    jacobian = np.stack([e, -x * e], axis=-1)
    move = np.linalg.solve(jacobian.T @ jacobian + damping * np.eye(2), -jacobian.T @ (e - y))
    np.testing.assert_allclose([params["a"] - 1.0, params["b"] - 0.1], move, rtol=1e-4)
    a, b = float(params["a"]), float(params["b"])
    np.testing.assert_allclose(info["loss"], 0.5 * np.sum((a * np.exp(-b * x) - y) ** 2), rtol=1e-4)


def test_one_step_after_another_is_what_optimistix_does():
    batch = points()
    stepped, infos = scanned(least_squares_step(curve, SOLVERS["LM"]), start(), batch, 3)
    assert infos["accepted"].all()
    # Optimistix's first iteration only evaluates, so four of its iterations are three of ours.
    solved, info = solve(curve, start(), batch, solver=SOLVERS["LM"], max_steps=4)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6), stepped, solved)
    assert not info["converged"]
    assert info["result"] == optx.RESULTS.nonlinear_max_steps_reached


def test_the_default_solver_ends_where_rounding_rejects_moves():
    def rounded(params, batch, *, step, key):  # as images are by their thresholds
        values = curve(params, batch, step=step, key=key)[0]["curve"]
        return values + jax.lax.stop_gradient(jnp.round(values * 1e3) / 1e3 - values), {}

    theirs, long = solve(rounded, start(), points(), solver=optx.LevenbergMarquardt(1e-4, 1e-5))
    ours, short = solve(rounded, start(), points())
    jax.tree.map(partial(np.testing.assert_allclose, atol=1e-3), ours, theirs)
    assert short["converged"]
    assert short["steps"] < 0.7 * long["steps"]
    # Heavily damped moves are short as well, but they are not rejected.
    crept, info = solve(curve, start(), points(), damping=1e4, max_steps=4)
    assert not info["converged"]
    assert 1.0 < crept["a"] < 1.2


def test_huber_is_scipys_and_forgives_an_outlier():
    batch = points(noise=0.01)
    batch["y"][3] += 4

    def robust(params, batch, *, step, key):
        values, aux = curve(params, batch, step=step, key=key)
        return huber(values, 0.05), aux

    params, info = solve(robust, start(), batch, solver=SOLVERS["LM"])
    want = by_scipy(batch, loss="huber", f_scale=0.05)
    np.testing.assert_allclose([params["a"], params["b"]], want.x, rtol=2e-3)
    np.testing.assert_allclose(info["loss"], want.cost, rtol=1e-4)
    np.testing.assert_allclose([params["a"], params["b"]], [2.0, 0.7], atol=0.02)
    plain, _ = solve(curve, start(), batch, solver=SOLVERS["LM"])
    assert abs(plain["a"] - 2.0) > 0.3


def test_huber_has_its_slope_on_both_sides_of_delta_and_leaves_infinity():
    r = np.float32([0.0, 0.1, 0.2, 0.2001, -3.0, -0.1, np.inf])
    along = np.ones(7, np.float32)
    pushed = jax.jit(lambda r: jax.jvp(lambda r: huber(r, 0.2), (r,), (along,)))
    values, slopes = jax.device_get(pushed(r))
    rho = np.where(np.abs(r) <= 0.2, 0.5 * r**2, 0.2 * (np.abs(r) - 0.1))
    np.testing.assert_allclose(0.5 * values**2, rho, rtol=1e-5)
    np.testing.assert_allclose(slopes[:4], 1.0, rtol=1e-3)
    np.testing.assert_allclose(slopes[4], 0.2 / np.sqrt(2 * 0.2 * 3 - 0.04), rtol=1e-5)


@pytest.mark.parametrize("name", SOLVERS)
def test_a_start_that_is_not_finite_or_overflows_is_kept_and_reported(name):
    broken = np.where(np.arange(30) == 0, np.float32(np.nan), points()["y"])
    step = least_squares_step(curve, SOLVERS[name])
    state, update = jax.jit(step.init)(start()), jax.jit(step.update)
    for bad in ({"y": broken}, {"limit": np.float32(0)}):
        batch = points() | {"limit": np.float32(np.inf)} | bad
        params, new_state, info = update(start(), state, batch, step=0, key=None)
        solved, solved_info = solve(curve, start(), batch, solver=SOLVERS[name], max_steps=5)
        assert info["skipped"]
        assert solved_info["skipped"]
        assert not solved_info["converged"]
        assert solved_info["overflow"].any() == ("limit" in bad)
        jax.tree.map(np.testing.assert_array_equal, (params, new_state), (start(), state))
        jax.tree.map(np.testing.assert_array_equal, solved, start())


def test_a_move_into_overflow_is_rejected_reported_and_shortened():
    batch = points() | {"limit": np.float32(0.6)}  # the curve's own b is 0.7
    step = least_squares_step(curve, SOLVERS["LM"], damping=0.1)
    params, infos = jax.device_get(scanned(step, start(), batch, 30))
    assert 0.5 < params["b"] <= 0.6
    assert falls(infos["loss"])
    rejected = ~infos["accepted"]
    assert rejected.any()
    assert not infos["skipped"].any()
    np.testing.assert_array_equal(infos["overflow"].any(-1)[rejected], True)
    assert (infos["needed"][rejected] >= 60).all()
    solved, info = solve(curve, start(), batch, solver=SOLVERS["LM"], damping=0.1)
    assert 0.5 < solved["b"] <= 0.6
    assert info["overflow"].any()
    assert not info["converged"]


def test_gauss_newton_does_not_move_into_overflow():
    batch = points() | {"limit": np.float32(0.3)}
    step = least_squares_step(curve, SOLVERS["GN"])
    params, infos = jax.device_get(scanned(step, start(), batch, 3))
    jax.tree.map(np.testing.assert_array_equal, params, start())
    assert not infos["accepted"].any()
    assert infos["overflow"].any(-1).all()


def test_a_long_wait_at_the_optimum_does_not_lock_the_damping():
    step = least_squares_step(curve, SOLVERS["LM"])
    params, state, update = start(), jax.jit(step.init)(start()), jax.jit(step.update)
    for noise in (0.02, 0.0):  # a new frame, with the old state
        for i in range(60):
            params, state, _ = update(params, state, points(noise), step=i, key=None)
    np.testing.assert_allclose([params["a"], params["b"]], [2.0, 0.7], atol=1e-4)
    assert all(1e-7 < a < 1e7 for a in jax.tree.leaves(state))


def test_many_frames_compile_once():
    traces = []

    def counted(params, batch, *, step, key):
        traces.append(1)
        return curve(params, batch, step=step, key=key)

    step = least_squares_step(counted, SOLVERS["LM"])
    update = jax.jit(step.update)
    state, after = step.init(start()), []
    for i in range(4):
        update(start(), state, points(noise=0.01 * i), step=i, key=None)
        solve(counted, start(), points(noise=0.01 * i), solver=SOLVERS["LM"], step=i)
        after.append(len(traces))
    assert after == [after[0]] * 4


@pytest.mark.thorough
def test_vmap_is_the_loop():
    batches = [points(noise) for noise in (0.0, 0.02, 0.05)]
    many = jax.tree.map(lambda *a: np.stack(a), *batches)
    step = least_squares_step(curve)
    together = jax.jit(jax.vmap(lambda b: (solve(curve, start(), b), scanned(step, start(), b, 4))))
    (solved, info), (stepped, _) = jax.device_get(together(many))
    for i, batch in enumerate(batches):
        alone, _ = solve(curve, start(), batch)
        jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a[i], b, rtol=1e-5), solved, alone)
        alone, _ = scanned(step, start(), batch, 4)
        jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a[i], b, rtol=1e-5), stepped, alone)
    assert info["converged"].all()


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="jac must be"):
        solve(curve, start(), points(), jac="forward")
    with pytest.raises(ValueError, match="damping must be above 0"):
        least_squares_step(curve, damping=0.0)
    with pytest.raises(ValueError, match="only floating ones"):
        solve(curve, {"a": jnp.array(1), "b": jnp.array(0.1)}, points())
    with pytest.raises(RuntimeError, match="has no derivative"):
        jax.grad(lambda y: solve(curve, start(), points() | {"y": y})[0]["a"])(points()["y"])


@pytest.mark.parametrize("damping", [1.0, 1e-3])
def test_a_search_that_the_plan_ended_has_not_converged(damping):
    """The optimum, 3, lies beyond 1, where the plan overflows: the search stops short and reports it."""

    def residual(x, batch, *, step, key):
        full = jnp.any(x > batch)
        return x - 3.0, {"overflow": full, "needed": jnp.where(full, 99, 1)}

    x, info = solve(residual, jnp.zeros(2), 1.0, damping=damping)
    assert (np.asarray(x) < 1.0).all()
    assert not info["converged"]
    assert info["overflow"]
    assert info["needed"] == 99
    x, info = solve(residual, jnp.zeros(2), 5.0, damping=damping)
    np.testing.assert_allclose(x, 3.0, atol=1e-3)
    assert info["converged"]
    assert not info["overflow"]
    assert info["needed"] == 1


def test_a_start_that_is_not_a_number_is_reported_even_if_residuals_are_finite():
    """For example, a camera that is not finite sees nothing, so its image is finite."""

    def residual(x, batch, *, step, key):
        return jnp.where(jnp.isfinite(x), x, 1.0), {}

    bad = np.float32([np.nan, 1.0])
    _, info = solve(residual, bad, None)
    assert info["skipped"]
    assert not info["converged"]
    step = least_squares_step(residual)
    _, _, info = updated(step, bad, None)
    assert info["skipped"]
    assert not info["accepted"]


def test_a_residual_of_another_form_is_named():
    with pytest.raises(ValueError, match=r"must return \(pytree of arrays, dict.*got "):
        solve(lambda x, batch, *, step, key: x, jnp.ones(2), None)


def test_observations_have_the_form_of_images():
    with pytest.raises(ValueError, match=r"the shape of rendered, \(2, 4, 5, 3\); got \(4,"):
        difference.__wrapped__(jnp.zeros((2, 4, 5, 3)), jnp.zeros((4, 5, 3)))
    says = r"observed must hold floats.*got uint8: divide 8-bit colours by 255"
    with pytest.raises(ValueError, match=says):
        difference.__wrapped__(jnp.zeros((4, 3)), jnp.zeros((4, 3), jnp.uint8))


def test_reject_overflow_and_difference():
    residual = {"a": jnp.ones((2, 3)), "b": jnp.zeros(2)}
    rejecting = jax.jit(reject_overflow)
    kept = rejecting(residual, np.array([False, False]))
    jax.tree.map(np.testing.assert_array_equal, kept, residual)
    lost = rejecting(residual, np.array([False, True]))
    assert all(np.isposinf(a).all() for a in jax.tree.leaves(lost))

    observed = np.float32([1.0, np.nan, np.inf, 0.5])
    rendered = np.float32([2.0, 3.0, 4.0, 0.25])
    apart = jax.jit(difference)
    values, ignored = apart(rendered, observed)
    np.testing.assert_array_equal(values, [1.0, 0.0, 0.0, -0.25])
    assert ignored == 2
    slopes = jax.jit(jax.grad(lambda r: apart(r, observed)[0].sum()))(rendered)
    np.testing.assert_array_equal(slopes, [1.0, 0.0, 0.0, 1.0])


# ------------------------------------------------------------------ manifolds


def test_groups_move_in_their_own_frame_and_arrays_are_themselves():
    pose = jaxlie.SE3.exp(jnp.array([0.3, -0.2, 0.5, 0.4, 0.1, -0.6]))
    poses = jax.tree.map(lambda a: jnp.stack([a, a]), pose)
    params = {"pose": pose, "poses": poses, "K": jnp.array([1.0, 2.0])}
    zero, moved = jax.jit(to_coordinates)(params), jax.jit(from_coordinates)
    assert (zero["pose"].shape, zero["poses"].shape) == ((6,), (2, 6))
    same = moved(params, zero)
    np.testing.assert_allclose(same["pose"].as_matrix(), pose.as_matrix(), atol=1e-6)
    np.testing.assert_array_equal(same["K"], params["K"])

    forward = moved(params, zero | {"pose": np.float32([0.0, 0, 2, 0, 0, 0])})["pose"]
    ahead = pose.translation() + 2 * pose.rotation().as_matrix()[:, 2]
    np.testing.assert_allclose(forward.translation(), ahead, atol=1e-6)
    turned = moved(params, zero | {"pose": np.float32([0.0, 0, 0, 0.1, 0, 0])})["pose"]
    np.testing.assert_array_equal(turned.translation(), pose.translation())


def test_a_rotation_is_found_from_far_and_stays_a_rotation():
    rng = np.random.default_rng(0)
    points, truth = jnp.asarray(rng.normal(size=(8, 3)), jnp.float32), jaxlie.SO3.exp(jnp.array([1.5, -1, 1]))

    def residual(params, batch, *, step, key):
        return jax.vmap(params.apply)(points) - batch, {}

    seen = jax.vmap(truth.apply)(points)
    found, _ = scanned(least_squares_step(residual), jaxlie.SO3.identity(), seen, 15)
    np.testing.assert_allclose((found.inverse() @ truth).log(), 0.0, atol=1e-5)
    np.testing.assert_allclose(jnp.linalg.norm(found.wxyz), 1.0, atol=1e-6)
    solved, info = solve(residual, jaxlie.SO3.identity(), seen)
    np.testing.assert_allclose((solved.inverse() @ truth).log(), 0.0, atol=1e-5)
    assert info["converged"]
