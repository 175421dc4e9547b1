"""Least squares: it agrees with scipy, finds poses, intrinsics and Gaussians, and refuses what overflowed."""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import optimistix as optx
import pytest
import scipy.optimize

from gsjax.geometry.cameras import intrinsics, look_at
from gsjax.optim.least_squares import (
    LevenbergMarquardt,
    difference,
    from_coordinates,
    huber,
    least_squares_step,
    reject_overflow,
    solve,
    to_coordinates,
)
from gsjax.rasterize.rasterization import plan, rasterization

WIDTH, HEIGHT = 48, 32
SOLVERS = {
    "default": LevenbergMarquardt(1e-6, 1e-6),
    "LM": optx.LevenbergMarquardt(1e-6, 1e-6),
    "GN": optx.GaussNewton(1e-6, 1e-6),
    "dogleg": optx.Dogleg(1e-6, 1e-6),
}


# ------------------------------------------------------------------ a curve, where scipy knows the answer


def curve(params, batch, *, step, key):
    """y = a exp(-b x); nothing is known of b > limit, where it "overflows"."""
    values = params["a"] * jnp.exp(-params["b"] * batch["x"]) - batch["y"]
    overflow = jnp.stack([params["b"] > batch.get("limit", jnp.inf), jnp.array(False)])
    return {"curve": values}, {"overflow": overflow, "needed": jnp.int32(params["b"] * 100)}


def points(noise=0.02, dtype=np.float32):
    x = np.linspace(0, 3, 30)
    y = 2 * np.exp(-0.7 * x) + noise * np.random.default_rng(0).normal(size=30)
    return {"x": jnp.asarray(x, dtype), "y": jnp.asarray(y, dtype)}


def start(dtype=np.float32):
    return {"a": jnp.asarray(1.0, dtype), "b": jnp.asarray(0.1, dtype)}


def by_scipy(batch, **options):
    x, y = np.asarray(batch["x"], np.float64), np.asarray(batch["y"], np.float64)
    return scipy.optimize.least_squares(
        lambda p: p[0] * np.exp(-p[1] * x) - y, [1.0, 0.1], xtol=1e-12, ftol=1e-12, gtol=1e-12, **options
    )


def scanned(step, params, batch, num):
    """Infos of `num` updates on one batch, stacked, after the last parameters."""

    def body(carry, i):
        *carry, info = step.update(*carry, batch, step=i, key=None)
        return tuple(carry), info

    (params, _), infos = jax.lax.scan(body, (params, step.init(params)), jnp.arange(num))
    return params, infos


def falls(losses) -> bool:
    """Never up, but for the rounding of two ways to compute one image."""
    return bool((np.diff(losses) <= 1e-6 * losses[:-1]).all())


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
    params, _, info = step.update(start(), step.init(start()), batch, step=0, key=None)
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
    params, _, info = step.update(start(), step.init(start()), batch, step=0, key=None)
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
    # Its first iteration only looks, so that four of its are three of ours.
    solved, info = solve(curve, start(), batch, solver=SOLVERS["LM"], max_steps=4)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6), stepped, solved)
    assert not info["converged"]
    assert info["result"] == optx.RESULTS.nonlinear_max_steps_reached


def test_the_default_solver_ends_where_rounding_rejects_moves():
    def rounded(params, batch, *, step, key):  # as images are, by their thresholds
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
    batch["y"] = batch["y"].at[3].add(4.0)

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
    r = jnp.array([0.0, 0.1, 0.2, 0.2001, -3.0, -0.1, jnp.inf])
    values, slopes = jax.jvp(lambda r: huber(r, 0.2), (r,), (jnp.ones(7),))
    rho = np.where(np.abs(r) <= 0.2, 0.5 * r**2, 0.2 * (np.abs(r) - 0.1))
    np.testing.assert_allclose(0.5 * values**2, rho, rtol=1e-5)
    np.testing.assert_allclose(slopes[:4], 1.0, rtol=1e-3)
    np.testing.assert_allclose(slopes[4], 0.2 / np.sqrt(2 * 0.2 * 3 - 0.04), rtol=1e-5)


@pytest.mark.parametrize("name", SOLVERS)
def test_a_start_that_is_not_finite_or_overflows_is_kept_and_said(name):
    for bad in ({"y": points()["y"].at[0].set(jnp.nan)}, {"limit": jnp.array(0.0)}):
        batch = points() | {"limit": jnp.array(jnp.inf)} | bad
        step = least_squares_step(curve, SOLVERS[name])
        state = step.init(start())
        params, new_state, info = step.update(start(), state, batch, step=0, key=None)
        solved, solved_info = solve(curve, start(), batch, solver=SOLVERS[name], max_steps=5)
        assert info["skipped"]
        assert solved_info["skipped"]
        assert not solved_info["converged"]
        assert solved_info["overflow"].any() == ("limit" in bad)
        jax.tree.map(np.testing.assert_array_equal, (params, new_state), (start(), state))
        jax.tree.map(np.testing.assert_array_equal, solved, start())


def test_a_move_into_overflow_is_rejected_said_and_tried_shorter():
    batch = points() | {"limit": jnp.array(0.6)}  # the curve's own b is 0.7
    step = least_squares_step(curve, SOLVERS["LM"], damping=0.1)
    params, infos = scanned(step, start(), batch, 30)
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


def test_gauss_newton_stands_still_before_what_overflows():
    batch = points() | {"limit": jnp.array(0.3)}
    params, infos = scanned(least_squares_step(curve, SOLVERS["GN"]), start(), batch, 3)
    jax.tree.map(np.testing.assert_array_equal, params, start())
    assert not infos["accepted"].any()
    assert infos["overflow"].any(-1).all()


def test_a_long_wait_at_the_optimum_does_not_lock_the_damping():
    step = least_squares_step(curve, SOLVERS["LM"])
    params, state = start(), step.init(start())
    for noise in (0.02, 0.0):  # a new frame, with the old state
        for i in range(60):
            params, state, _ = jax.jit(step.update)(params, state, points(noise), step=i, key=None)
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


def test_vmap_is_the_loop():
    batches = [points(noise) for noise in (0.0, 0.02, 0.05)]
    many = jax.tree.map(lambda *a: jnp.stack(a), *batches)
    solved, info = jax.vmap(lambda b: solve(curve, start(), b))(many)
    stepped, _ = jax.vmap(lambda b: scanned(least_squares_step(curve), start(), b, 4))(many)
    for i, batch in enumerate(batches):
        alone, _ = solve(curve, start(), batch)
        jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a[i], b, rtol=1e-5), solved, alone)
        alone, _ = scanned(least_squares_step(curve), start(), batch, 4)
        jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a[i], b, rtol=1e-5), stepped, alone)
    assert info["converged"].all()


def test_what_cannot_be_asked_for_is_named():
    with pytest.raises(ValueError, match="jac is"):
        solve(curve, start(), points(), jac="forward")
    with pytest.raises(ValueError, match="damping must be above 0"):
        least_squares_step(curve, damping=0.0)
    with pytest.raises(ValueError, match="only floating ones"):
        solve(curve, {"a": jnp.array(1), "b": jnp.array(0.1)}, points())
    with pytest.raises(RuntimeError, match="has no derivative"):
        jax.grad(lambda y: solve(curve, start(), points() | {"y": y})[0]["a"])(points()["y"])


@pytest.mark.parametrize("damping", [1.0, 1e-3])
def test_a_search_that_the_plan_ended_has_not_converged(damping):
    """The optimum, 3, lies behind 1, where the plan overflows: the search stops short of that and says so."""

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


def test_a_start_that_is_no_number_is_said_where_residuals_do_not_show_it():
    """As of a camera that is not finite: it sees nothing, so the image is finite."""

    def residual(x, batch, *, step, key):
        return jnp.where(jnp.isfinite(x), x, 1.0), {}

    bad = jnp.array([jnp.nan, 1.0])
    _, info = solve(residual, bad, None)
    assert info["skipped"]
    assert not info["converged"]
    step = least_squares_step(residual)
    _, _, info = step.update(bad, step.init(bad), None, step=0, key=None)
    assert info["skipped"]
    assert not info["accepted"]


def test_a_residual_of_another_form_is_named():
    with pytest.raises(ValueError, match=r"must return \(pytree of arrays, dict.*got "):
        solve(lambda x, batch, *, step, key: x, jnp.ones(2), None)


def test_observations_have_the_form_of_images():
    with pytest.raises(ValueError, match=r"the shape of rendered, \(2, 4, 5, 3\); got \(4,"):
        difference.__wrapped__(jnp.zeros((2, 4, 5, 3)), jnp.zeros((4, 5, 3)))
    with pytest.raises(ValueError, match=r"observed must hold floats.*got uint8: of 8 bits, divide by 255"):
        difference.__wrapped__(jnp.zeros((4, 3)), jnp.zeros((4, 3), jnp.uint8))


def test_reject_overflow_and_difference():
    residual = {"a": jnp.ones((2, 3)), "b": jnp.zeros(2)}
    kept = reject_overflow(residual, jnp.array([False, False]))
    jax.tree.map(np.testing.assert_array_equal, kept, residual)
    lost = reject_overflow(residual, jnp.array([False, True]))
    assert all(jnp.isposinf(a).all() for a in jax.tree.leaves(lost))

    observed = jnp.array([1.0, jnp.nan, jnp.inf, 0.5])
    rendered = jnp.array([2.0, 3.0, 4.0, 0.25])
    values, ignored = difference(rendered, observed)
    np.testing.assert_array_equal(values, [1.0, 0.0, 0.0, -0.25])
    assert ignored == 2
    slopes = jax.grad(lambda r: difference(r, observed)[0].sum())(rendered)
    np.testing.assert_array_equal(slopes, [1.0, 0.0, 0.0, 1.0])


# ------------------------------------------------------------------ manifolds


def test_groups_move_in_their_own_frame_and_arrays_are_themselves():
    pose = jaxlie.SE3.exp(jnp.array([0.3, -0.2, 0.5, 0.4, 0.1, -0.6]))
    poses = jax.tree.map(lambda a: jnp.stack([a, a]), pose)
    params = {"pose": pose, "poses": poses, "K": jnp.array([1.0, 2.0])}
    zero = to_coordinates(params)
    assert (zero["pose"].shape, zero["poses"].shape) == ((6,), (2, 6))
    same = from_coordinates(params, zero)
    np.testing.assert_allclose(same["pose"].as_matrix(), pose.as_matrix(), atol=1e-6)
    np.testing.assert_array_equal(same["K"], params["K"])

    forward = from_coordinates(params, zero | {"pose": jnp.array([0.0, 0, 2, 0, 0, 0])})["pose"]
    ahead = pose.translation() + 2 * pose.rotation().as_matrix()[:, 2]
    np.testing.assert_allclose(forward.translation(), ahead, atol=1e-6)
    turned = from_coordinates(params, zero | {"pose": jnp.array([0.0, 0, 0, 0.1, 0, 0])})["pose"]
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


# ------------------------------------------------------------------ through the rasterizer


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(0)
    n = 100
    arrays = {
        "means": rng.uniform(-0.6, 0.6, (n, 3)),
        "quats": rng.normal(size=(n, 4)),
        "scales": rng.uniform(0.03, 0.12, (n, 3)),
        "opacities": rng.uniform(0.3, 0.9, n),
        "colors": rng.uniform(size=(n, 3)),
    }
    return {k: jnp.asarray(v, jnp.float32) for k, v in arrays.items()}


VIEWMAT = jnp.asarray(look_at(np.array([1.6, 0.3, 0.9]), np.zeros(3)), jnp.float32)
K = jnp.asarray(intrinsics(50.0, WIDTH, HEIGHT), jnp.float32)
POSE = jaxlie.SE3.from_matrix(jnp.linalg.inv(VIEWMAT))  # camera to world


def planned(scene, **options):
    geometry = [scene[k] for k in ("means", "quats", "scales", "opacities")]
    return plan(*geometry, VIEWMAT[None], K[None], WIDTH, HEIGHT, **options)


def drawn(scene, pose, K, plan):
    viewmats = pose.inverse().as_matrix()[None]
    image, _, meta = rasterization(
        **scene, viewmats=viewmats, Ks=K[None], width=WIDTH, height=HEIGHT, plan=plan
    )
    return image[0], meta


observe = jax.jit(lambda *a: drawn(*a)[0], static_argnums=3)


def of_pose(pose, batch, *, step, key):
    image, meta = drawn(batch["scene"], pose, K, batch["plan"])
    values, ignored = difference(image, batch["image"])
    return values, {"overflow": meta.overflow, "needed": meta.needed, "ignored": ignored}


def of_intrinsics(params, batch, *, step, key):
    fx, fy, cx, cy = params
    camera = K.at[0, 0].set(fx).at[1, 1].set(fy).at[0, 2].set(cx).at[1, 2].set(cy)
    image, meta = drawn(batch["scene"], POSE, camera, batch["plan"])
    return image - batch["image"], {"overflow": meta.overflow, "needed": meta.needed}


@pytest.fixture(scope="module")
def forward(scene):
    return planned(scene, headroom=2.0, derivative="forward")


def off_by(seed):
    """A pose 3 cm and 3 degrees away from POSE."""
    v, w = np.random.default_rng(seed).normal(size=(2, 3))
    xi = np.concatenate([0.03 * v / np.linalg.norm(v), np.deg2rad(3) * w / np.linalg.norm(w)])
    return POSE @ jaxlie.SE3.exp(jnp.asarray(xi, jnp.float32))


def pose_error(a, b) -> float:
    return float(jnp.abs((a.inverse() @ b).log()).max())


def test_a_pose_is_found_by_levenberg_marquardt_also_with_pixels_missing(scene, forward):
    poses = [off_by(seed) for seed in range(3)]
    images = [observe(scene, pose, K, forward) for pose in poses]
    holes = images[2].at[5:20, 10:30].set(jnp.nan).at[0, 0].set(jnp.inf)
    for pose, image, ignored in zip(poses, [*images[:2], holes], (0, 0, 15 * 20 * 3 + 3), strict=True):
        batch = {"scene": scene, "image": image, "plan": forward}
        found, info = solve(of_pose, POSE, batch, max_steps=20)
        assert pose_error(POSE, pose) > 0.02
        assert pose_error(found, pose) < 1e-4
        assert info["loss"] < 1e-6
        assert info["ignored"] == ignored
        assert info["converged"]
        assert info["steps"] < 15
        assert not info["overflow"].any()


def test_gauss_newton_tracks_poses_from_frame_to_frame_in_a_scan(scene, forward):
    step = least_squares_step(of_pose, SOLVERS["GN"])
    poses = [off_by(seed) for seed in range(3)]
    images = jnp.stack([observe(scene, pose, K, forward) for pose in poses])

    @jax.jit
    def track(pose, images):
        def frame(pose, image):
            batch = {"scene": scene, "image": image, "plan": forward}

            def iteration(carry, i):
                *carry, info = step.update(*carry, batch, step=i, key=None)
                return tuple(carry), info

            (pose, _), infos = jax.lax.scan(iteration, (pose, step.init(pose)), jnp.arange(6))
            return pose, (pose, infos)

        return jax.lax.scan(frame, pose, images)[1]

    found, infos = track(POSE, images)
    for i, pose in enumerate(poses):
        assert pose_error(jax.tree.map(lambda a, i=i: a[i], found), pose) < 1e-4
    assert infos["accepted"].all()
    assert (infos["loss"][:, -1] < 1e-6).all()


def test_intrinsics_are_found(scene, forward):
    truth = K.at[0, 0].set(53.0).at[1, 1].set(48.0).at[:2, 2].add(jnp.array([1.5, -1.0]))
    batch = {"scene": scene, "image": observe(scene, POSE, truth, forward), "plan": forward}
    found, info = solve(of_intrinsics, jnp.array([50.0, 50.0, 24.0, 16.0]), batch, max_steps=20)
    np.testing.assert_allclose(found, [53.0, 48.0, 25.5, 15.0], atol=2e-3)
    assert info["converged"]


def of_size(size, batch, *, step, key):
    scene = batch["scene"] | {"scales": size * batch["scene"]["scales"]}
    image, meta = drawn(scene, POSE, K, batch["plan"])
    return image - batch["image"], {"overflow": meta.overflow, "needed": meta.needed}


def test_gaussians_that_outgrow_the_plan_are_rejected(scene, forward):
    nothing = {"scene": scene, "image": jnp.zeros(()), "plan": forward}
    image, at_truth = of_size(jnp.array(2.0), nothing, step=0, key=None)
    _, at_edge = of_size(jnp.array(1.3), nothing, step=0, key=None)
    tight = dataclasses.replace(forward, capacity=int(at_edge["needed"][0]))
    assert at_truth["needed"][0] > tight.capacity
    batch = {"scene": scene, "image": image, "plan": tight}
    step = least_squares_step(of_size, damping=1e-3)
    run = jax.jit(lambda p, b: scanned(step, p, b, 12))
    size, infos = run(jnp.ones(()), batch)
    first = jax.tree.map(lambda a: a[0], infos)
    assert first["overflow"].any()
    assert not first["accepted"]
    assert (first["needed"] > tight.capacity).all()
    assert not infos["skipped"].any()
    assert infos["accepted"].any()  # shorter ones were taken
    assert 1.0 < size < 1.4
    assert np.isfinite(infos["loss"]).all()
    beyond, infos = run(jnp.full((), 1.7), batch)  # the plan is too small to begin with
    assert infos["skipped"].all()
    assert beyond == jnp.float32(1.7)


class Painted(eqx.Module):
    means: jax.Array
    colors: jax.Array


def of_gaussians(params, batch, *, step, key):
    scene = batch["scene"] | {"means": params.means, "colors": params.colors}
    image, meta = drawn(scene, POSE, K, batch["plan"])
    return image[::4, ::4] - batch["image"][::4, ::4], {"overflow": meta.overflow}


@pytest.mark.slow
def test_gaussians_are_refined_with_the_reverse_plan(scene):
    reverse = planned(scene, headroom=2.0)
    rng = np.random.default_rng(1)
    batch = {"scene": scene, "image": observe(scene, POSE, K, reverse), "plan": reverse}
    params = Painted(
        scene["means"] + jnp.asarray(rng.normal(size=(100, 3)) * 0.02, jnp.float32),
        scene["colors"] + jnp.asarray(rng.normal(size=(100, 3)) * 0.1, jnp.float32),
    )
    step = least_squares_step(of_gaussians, jac="bwd", damping=0.1)
    _, infos = jax.jit(lambda p, b: scanned(step, p, b, 8))(params, batch)
    assert falls(infos["loss"])
    assert infos["loss"][-1] < 1e-2 * infos["loss"][0]
    assert not infos["skipped"].any()
