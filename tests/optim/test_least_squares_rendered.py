"""Least squares through the rasterizer finds poses, intrinsics and Gaussians, and rejects overflow."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from gsjax.geometry.cameras import intrinsics, look_at
from gsjax.optim.least_squares import difference, least_squares_step, solve
from gsjax.rasterize.rasterization import plan, rasterization
from tests.optim.iterations import SOLVERS, falls, scanned

WIDTH, HEIGHT = 48, 32


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


@pytest.mark.slow
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


@pytest.mark.thorough
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


@pytest.mark.slow
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


@pytest.mark.thorough
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
    assert infos["accepted"].any()  # shorter moves were accepted
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
