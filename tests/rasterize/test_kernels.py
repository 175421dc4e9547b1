"""The GPU kernels, run here on a CPU with one thread per tile, against XLA's loops."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gsjax
from benchmarks.scenes import case, compare
from gsjax.rasterize import fused
from gsjax.rasterize.binning import bin_gaussians
from gsjax.rasterize.compositing import Lists, Splats, composite_forward
from gsjax.rasterize.gradients import _gradients, _values_gradients
from gsjax.rasterize.lanes import slots
from gsjax.rasterize.projection import project_gaussians

pytest.importorskip("warp", reason="the kernels are written in Warp: pip install 'gsjax[cuda]'")

SLOW = pytest.mark.slow
ON_A_CARD = pytest.mark.skipif(not fused.available(), reason="what a warp does together needs a GPU")
WIDTH, HEIGHT, VIEWS = 70, 45, 2
K = jnp.array([[60.0, 0, WIDTH / 2], [0, 60.0, HEIGHT / 2], [0, 0, 1]])


def gaussians(num: int, seed: int = 0):
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(num, 3)) * [1, 1, 0.5] + [0, 0, 4]
    scales = np.exp(rng.normal(size=(num, 3)) * 0.7 - 2)
    arrays = (means, rng.normal(size=(num, 4)), scales, rng.uniform(size=num))
    return tuple(jnp.asarray(np.float32(a)) for a in arrays)


def cameras(views: int = VIEWS):
    viewmats = np.tile(np.eye(4, dtype=np.float32), (views, 1, 1))
    viewmats[:, 0, 3] = 0.3 * np.arange(views)
    return jnp.asarray(viewmats), jnp.asarray(np.tile(K, (views, 1, 1)))


def close(got, want, tolerance: float):
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(a, b, atol=tolerance * max(1e-9, float(np.abs(b).max(initial=0))))


@pytest.fixture
def on_kernels(monkeypatch):
    """The kernels in place of XLA's loops, as on a GPU but with one thread per tile."""
    jax.clear_caches()
    monkeypatch.setattr(fused, "by_platform", lambda _, kernels, *args: partial(kernels, lanes=1)(*args))
    yield
    jax.clear_caches()


@pytest.mark.thorough
@pytest.mark.parametrize("tile_size", [8, 16])
@pytest.mark.parametrize("masked", [False, True])
def test_lists_hold_the_same_gaussians_in_the_same_order(tile_size, masked):
    arrays, views = gaussians(400), cameras()
    plan = gsjax.plan(*arrays, *views, WIDTH, HEIGHT, tile_size=tile_size)
    mask = np.random.default_rng(1).uniform(size=(VIEWS, plan.num_tiles)) < 0.5 if masked else None
    mask = None if mask is None else jnp.asarray(mask)
    capacity = VIEWS * slots(plan.capacity).size

    @jax.jit
    def both(viewmats, mask):
        usable = jnp.ones(400, bool)
        projected = jax.vmap(lambda v: project_gaussians(*arrays, usable, v, K, plan))(viewmats)
        want = jax.vmap(partial(bin_gaussians, plan=plan), (0, None if mask is None else 0))(projected, mask)
        return want, fused.tile_lists(projected, mask, plan, capacity)

    want, (lists, pairs, needed, overflow) = jax.device_get(both(views[0], mask))
    np.testing.assert_array_equal(pairs, want.pairs)
    assert (needed <= want.needed).all()  # XLA counts tiles outside the mask too, in rows that touch it
    assert masked or (needed == want.needed).all()
    assert not overflow.any()
    for view in range(VIEWS):
        for tile in range(plan.num_tiles):
            start, count = want.starts[view, tile], want.counts[view, tile]
            own = view * plan.num_tiles + tile
            got = lists.ids[lists.starts[own] : lists.starts[own] + lists.counts[own]] - view * 400
            np.testing.assert_array_equal(got, want.ids[view, start : start + count])


@pytest.mark.thorough
@pytest.mark.parametrize("lanes", [1, pytest.param(32, marks=ON_A_CARD)])
@pytest.mark.parametrize(
    ("channels", "tile_size"),
    [pytest.param(3, 8, marks=SLOW), (1, 4), (4, 16), (13, 8), pytest.param(24, 32, marks=SLOW)],
)
def test_images_and_gradients_of_tiles(channels, tile_size, lanes):
    arrays, (viewmats, Ks) = gaussians(300), cameras(1)
    plan = gsjax.plan(*arrays, viewmats, Ks, WIDTH, HEIGHT, tile_size=tile_size)
    rng = np.random.default_rng(2)

    @jax.jit
    def images(values):
        projected = project_gaussians(*arrays, jnp.ones(300, bool), viewmats[0], K, plan)
        binned = bin_gaussians(projected, None, plan)
        lists = Lists(binned.ids, binned.starts, binned.counts)
        splats = Splats(projected.means2d, projected.conics, projected.opacities, values)
        want = composite_forward(splats, lists, None, plan)
        return splats, lists, want, fused.composite_forward(splats, lists, plan, lanes=lanes)

    @jax.jit
    def gradients(splats, lists, reads, image, cotangents):
        rest = (lists, reads, image, cotangents, plan)
        values_only = (lists, reads, cotangents[0], plan)
        want = _gradients(splats, *rest), _values_gradients(splats, *values_only)
        all_fields = fused.gradients(splats, *rest, lanes=lanes)
        return want, (all_fields, fused.values_gradients(splats, *values_only, lanes=lanes))

    values = jnp.asarray(np.float32(rng.normal(size=(300, channels))))
    splats, lists, want, got = images(values)
    close(got[:2], want[:2], 2e-6)
    np.testing.assert_array_equal(got[2], want[2])
    cotangents = tuple(jnp.asarray(np.float32(rng.normal(size=a.shape))) for a in want[:2])
    want, got = gradients(splats, lists, want[2], want[:2], cotangents)
    close(got, want, 1e-5)


@pytest.mark.parametrize("seed", [9, *(pytest.param(seed, marks=SLOW) for seed in (3, 17, 38))])
def test_agrees_with_the_float64_reference(seed, on_kernels):
    with jax.enable_x64(True):
        found = compare(case(seed, num=400), dtypes=("float32",))
    errors = found["float32"]
    assert max(errors.values()) < 1e-4, errors


@pytest.mark.thorough
def test_a_plan_that_is_too_small_draws_nothing_and_says_so(on_kernels):
    arrays, views = gaussians(2000, seed=5), cameras()
    plan = gsjax.Plan(WIDTH, HEIGHT, capacity=64)
    colors = jnp.ones((2000, 3))
    drawn = gsjax.rasterization(*arrays, colors, *views, WIDTH, HEIGHT, plan=plan)
    image, _, meta = jax.device_get(drawn)
    assert meta.overflow.all()
    assert (meta.needed > 64).all()
    assert (image == 0).all()
    grown = plan.grown(int(meta.needed.max()))
    drawn = gsjax.rasterization(*arrays, colors, *views, WIDTH, HEIGHT, plan=grown)
    image, _, meta = jax.device_get(drawn)
    assert not meta.overflow.any()
    assert (image > 0).any()


@pytest.mark.thorough
@pytest.mark.parametrize("dtype", [pytest.param("float32", marks=SLOW), "bfloat16"])
def test_options_of_a_call(dtype, monkeypatch):
    arrays, views = gaussians(600), cameras()
    colors = jnp.asarray(np.random.default_rng(4).uniform(size=(600, 3)), dtype)
    roi = np.zeros((VIEWS, HEIGHT, WIDTH), bool)
    roi[:, 10:30, 20:60] = True
    roi = jnp.asarray(roi)
    plan = gsjax.plan(*arrays, *views, WIDTH, HEIGHT, max_per_tile=7, render_mode="RGB+D")

    def image(colors):
        drawn, _, meta = gsjax.rasterization(*arrays, colors, *views, WIDTH, HEIGHT, plan=plan, roi=roi)
        return (drawn**2).sum(), (drawn, meta.reads)

    slopes = jax.jit(jax.grad(image, has_aux=True))
    want = slopes(colors)
    monkeypatch.setattr(fused, "by_platform", lambda _, kernels, *args: partial(kernels, lanes=1)(*args))
    jax.clear_caches()
    got = slopes(colors)
    jax.clear_caches()
    close(got[1], want[1], 2e-6)
    close(got[0].astype(jnp.float32), want[0].astype(jnp.float32), 1e-5 if dtype == "float32" else 1e-2)


@pytest.mark.thorough
def test_vmap_is_a_loop(on_kernels):
    (means, *others), views = gaussians(200), cameras()
    plan = gsjax.plan(means, *others, *views, WIDTH, HEIGHT, headroom=2.0)
    colors = jnp.asarray(np.random.default_rng(3).uniform(size=(200, 3)), jnp.float32)

    def loss(means, shift):
        image, _, _ = gsjax.rasterization(means + shift, *others, colors, *views, WIDTH, HEIGHT, plan=plan)
        return (image**2).sum()

    shifts = jnp.array([0.0, 0.05])
    slope = jax.grad(loss)
    got = jax.jit(jax.vmap(slope, (None, 0)))(means, shifts)
    one = jax.jit(slope)
    close(got, np.stack([one(means, shift) for shift in np.asarray(shifts)]), 1e-5)


@pytest.mark.skipif(jax.default_backend() == "gpu", reason="there they are available")
def test_without_a_gpu_xla_draws():
    assert not fused.available()
    assert fused.by_platform(lambda a: a + 1, lambda a, lanes: a + 2, jnp.zeros(())) == 1
