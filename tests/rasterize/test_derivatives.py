"""Central differences, jvp against vjp, vmap against loops, permutations, and repeated runs."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.geometry.cameras import look_at
from gsjax.rasterize.plan import Plan
from gsjax.rasterize.rasterization import plan, rasterization

WIDTH, HEIGHT = 20, 14


def images(scene, plan):
    colors, alphas, meta = rasterization(**scene, width=plan.width, height=plan.height, plan=plan)
    return (colors, alphas) if meta.features is None else (colors, alphas, meta.features)


def smooth_scene(dtype=np.float64):
    """Gaussians so large and faint that no threshold (1/255, clamp, early stop) is near any pixel."""
    rng = np.random.default_rng(0)
    n = 5
    scene = {
        "means": rng.uniform(-0.3, 0.3, (n, 3)),
        "quats": rng.normal(size=(n, 4)),
        "scales": rng.uniform(2.5, 4.0, (n, 3)),
        "opacities": rng.uniform(0.3, 0.5, n),
        "colors": rng.normal(size=(n, 4, 3)) * 0.1,
        "viewmats": look_at(np.array([3.0, 0.5, 1.0]), np.zeros(3))[None],
        "Ks": np.array([[[20.0, 0.4, 9.0], [0.0, 22.0, 8.0], [0.0, 0.0, 1.0]]]),
        "backgrounds": rng.uniform(size=(1, 3)),
        "features": rng.normal(size=(n, 2)),
        "means2d_offset": rng.normal(size=(1, n, 2)) * 0.1,
    }
    return {k: np.asarray(v, dtype) for k, v in scene.items()}


SMOOTH = Plan(WIDTH, HEIGHT, 4096, sh_degree=1, render_mode="RGB+ED", rasterize_mode="antialiased")
FORWARD = dataclasses.replace(SMOOTH, derivative="forward")


@jax.jit
def pushed(scene, tangents):
    return jax.jvp(partial(images, plan=FORWARD), (scene,), (tangents,))


@jax.jit
def pulled(scene, weights):
    values, pull = jax.vjp(partial(images, plan=SMOOTH), scene)
    return values, pull(weights)[0]


def directions(scene, seed=1):
    rng = np.random.default_rng(seed)
    return {k: np.asarray(rng.normal(size=v.shape), v.dtype) for k, v in scene.items()}


def weights_for(values, seed=2):
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda a: np.asarray(rng.normal(size=a.shape), a.dtype), values)


def inner(a, b) -> float:
    return float(sum(jax.tree.leaves(jax.tree.map(np.vdot, a, b))))


def only(name, tree):
    return {k: v if k == name else np.zeros_like(v) for k, v in tree.items()}


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("name", smooth_scene(np.float32))
def test_each_argument_by_central_differences_and_jvp_against_vjp(name):
    scene = smooth_scene()
    v = only(name, directions(scene))
    weights = weights_for(jax.eval_shape(partial(images, plan=SMOOTH), scene))
    _, gradient = pulled(scene, weights)
    by_vjp = inner(gradient, v)
    _, push = pushed(scene, v)
    np.testing.assert_allclose(inner(push, weights), by_vjp, rtol=1e-9)

    def central(step):
        ahead, behind = (
            pulled({k: scene[k] + sign * step * v[k] for k in scene}, weights)[0] for sign in (1, -1)
        )
        return (inner(ahead, weights) - inner(behind, weights)) / (2 * step)

    step = 3e-6  # fourth order allows a larger step: with 1e-6 rounding alone reaches the bound
    difference = (4 * central(step) - central(2 * step)) / 3
    np.testing.assert_allclose(difference, by_vjp, rtol=1e-6)
    assert abs(by_vjp) > 1e-6


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
def test_the_dot_product_test_holds_on_scenes_with_every_threshold(small, geometry):
    this, scene = small(1, np.float64, render_mode="RGB+ED", feature_channels=5)
    reverse = plan(*geometry(scene), this.width, this.height, render_mode="RGB+ED")
    forward = dataclasses.replace(reverse, derivative="forward")
    v = directions(scene)
    push = jax.jit(lambda s, v: jax.jvp(partial(images, plan=forward), (s,), (v,)))
    weights = weights_for(jax.eval_shape(partial(images, plan=forward), scene))

    @jax.jit
    def pull(scene):
        values, vjp = jax.vjp(partial(images, plan=reverse), scene)
        return values, vjp(weights)[0]

    values, gradient = pull(scene)
    for name in scene:
        same, pushed = push(scene, only(name, v))
        np.testing.assert_allclose(values[0], same[0], atol=1e-12)
        np.testing.assert_allclose(
            inner(pushed, weights), inner(gradient[name], v[name]), rtol=1e-8, err_msg=name
        )


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
def test_reverse_plans_refuse_jvp_and_linearize_works_on_forward_ones():
    scene, tangents = smooth_scene(), directions(smooth_scene())
    with pytest.raises(TypeError, match="forward-mode"):
        jax.jvp(partial(images, plan=SMOOTH), (scene,), (tangents,))
    _, push = jax.linearize(jax.jit(partial(images, plan=FORWARD)), scene)
    for got, want in zip(push(tangents), pushed(scene, tangents)[1], strict=True):
        np.testing.assert_allclose(got, want, atol=1e-10)


@pytest.fixture(scope="module")
def loss_and_plan(small, geometry):
    this, scene = small(feature_channels=2)
    p = plan(*geometry(scene), this.width, this.height, headroom=3.0)
    weights = weights_for(jax.eval_shape(partial(images, plan=p), scene))

    def loss(scene):
        values = images(scene, p)
        return sum(jnp.vdot(a, w) for a, w in zip(values, weights, strict=True)), values

    return jax.device_get(scene), p, jax.jit(jax.value_and_grad(loss, has_aux=True)), loss


def assert_close(got, want, rtol=1e-5):
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(a, b, atol=rtol * np.abs(b).max() + 1e-30)


@pytest.mark.thorough
def test_runs_are_equal_bit_for_bit(loss_and_plan):
    scene, _, run, _ = loss_and_plan
    for a, b in zip(jax.tree.leaves(run(scene)), jax.tree.leaves(run(scene)), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.thorough
def test_the_order_of_gaussians_does_not_matter(loss_and_plan):
    scene, _, run, _ = loss_and_plan
    order = np.random.default_rng(0).permutation(40)
    per_gaussian = ("means", "quats", "scales", "opacities", "colors", "features")
    shuffled = {k: v[order] if k in per_gaussian else v for k, v in scene.items()}
    (_, values), gradient = jax.device_get(run(scene))
    (_, same), moved = run(shuffled)
    assert_close(same, values, 1e-6)
    assert_close(moved, {k: v[order] if k in per_gaussian else v for k, v in gradient.items()})


def test_vmap_over_scenes_equals_a_loop_and_so_do_leading_axes(loss_and_plan):
    scene, p, run, loss = loss_and_plan
    scenes = [
        scene,
        scene
        | {"means": scene["means"] * np.float32(1.02), "opacities": scene["opacities"] * np.float32(0.8)},
    ]
    stacked = {k: np.stack([s[k] for s in scenes]) for k in scene}
    mapped = jax.jit(jax.vmap(jax.value_and_grad(loss, has_aux=True)))(stacked)
    (_, values), gradients = jax.device_get(mapped)
    batched = jax.device_get(jax.jit(partial(images, plan=p))(stacked))
    for i, one in enumerate(scenes):
        (_, want), gradient = run(one)
        assert_close(jax.tree.map(lambda a: a[i], values), want, 1e-6)  # noqa: B023
        assert_close(jax.tree.map(lambda a: a[i], gradients), gradient)  # noqa: B023
        assert_close(jax.tree.map(lambda a: a[i], batched), want, 1e-6)  # noqa: B023


@pytest.mark.thorough
def test_many_cameras_equal_each_alone_also_under_vmap(loss_and_plan):
    scene, p, run, loss = loss_and_plan
    cameras = ("viewmats", "Ks", "backgrounds")
    views = [scene[k] for k in cameras]
    turned = views[0].copy()
    turned[:, :3, 3] += np.float32([0.1, -0.05, 0.2])
    both = {
        "viewmats": np.concatenate([views[0], turned]),
        "Ks": np.concatenate([views[1], views[1] * np.float32(1.01)]),
    }
    both["backgrounds"] = np.concatenate([views[2], views[2][:, ::-1]])
    together = jax.device_get(jax.jit(partial(images, plan=p))(scene | both))
    axes = {k: 0 if k in cameras else None for k in scene}
    singles = {k: both[k][:, None] if k in cameras else scene[k] for k in scene}
    mapped = jax.jit(jax.vmap(jax.value_and_grad(loss, has_aux=True), in_axes=(axes,)))(singles)
    mapped = jax.device_get(mapped)
    for i in range(2):
        (_, want), gradient = run(scene | {k: both[k][i : i + 1] for k in cameras})
        assert_close(jax.tree.map(lambda a: a[i : i + 1], together), want, 1e-6)  # noqa: B023
        assert_close(jax.tree.map(lambda a: a[i], mapped[0][1]), want, 1e-6)  # noqa: B023
        assert_close(jax.tree.map(lambda a: a[i], mapped[1]), gradient)  # noqa: B023
