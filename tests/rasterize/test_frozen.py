"""Frozen views: painting their stored lists gives the rasterizer's images, whole and in strips."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.rasterize.frozen import freeze_views, padded_view, paint, strip_of
from gsjax.rasterize.rasterization import rasterization

painted = jax.jit(paint, static_argnums=2)


def values_of(scene, seed, *shape):
    count = len(scene["means"])
    return np.float32(np.random.default_rng(seed).normal(size=(*shape[:-1], count, shape[-1])))


def view_of(views, i):
    return jax.tree.map(lambda a: np.asarray(a)[i], views)


def drawn(scene, values, **options):
    """The rasterizer's images and alphas."""
    shapes = {k: scene[k] for k in ("means", "quats", "scales", "opacities", "viewmats", "Ks")}
    colors, alphas, _ = rasterization(**shapes, colors=values, width=33, height=17, **options)
    return np.asarray(colors), np.asarray(alphas)[..., 0]


@pytest.fixture(scope="module")
def frozen(small, geometry):
    _, scene = small(3)
    return scene, *freeze_views(*geometry(scene), 33, 17)


@pytest.mark.thorough
@pytest.mark.parametrize("channels", [1, 3, 20])
def test_what_is_painted_is_what_the_rasterizer_draws(frozen, channels):
    scene, views, plan = frozen
    values = values_of(scene, 0, channels)
    colors, alphas = drawn(scene, jnp.asarray(values))
    for c in range(len(colors)):
        image, opacity = painted(view_of(views, c), values, plan)
        np.testing.assert_allclose(image, colors[c], atol=2e-5)
        np.testing.assert_allclose(opacity, alphas[c], atol=2e-5)


@pytest.mark.thorough
def test_a_scene_in_half_precision_is_seen_in_single(small, geometry):
    """As the rasterizer sees it; what is painted must not change its type on the way."""
    arrays = geometry(small(3)[1])
    half = [jnp.asarray(array, jnp.bfloat16) for array in arrays[:4]]
    views, plan = freeze_views(*half, *arrays[4:], 33, 17)
    single = [array.astype(jnp.float32) for array in half]
    expected = freeze_views(*single, *arrays[4:], 33, 17)
    assert plan == expected[1]
    assert {leaf.dtype for leaf in jax.tree.leaves(views)} == {jnp.dtype(jnp.float32), jnp.dtype(jnp.int32)}
    jax.tree.map(np.testing.assert_array_equal, views, expected[0])


@pytest.mark.thorough
def test_fisheyes_are_painted_as_the_rasterizer_draws_them(small, geometry):
    _, scene = small(3)
    lens = jnp.tile(jnp.array([0.3, -0.05, 0.01, 0.0]), (len(scene["viewmats"]), 1))
    views, plan = freeze_views(*geometry(scene), 33, 17, fisheye=lens)
    values = values_of(scene, 0, 3)
    colors, _ = drawn(scene, jnp.asarray(values), fisheye=lens)
    pinholes, _ = drawn(scene, jnp.asarray(values))
    assert np.abs(colors - pinholes).max() > 0.05
    for c in range(len(colors)):
        np.testing.assert_allclose(painted(view_of(views, c), values, plan)[0], colors[c], atol=2e-5)


@pytest.mark.thorough
def test_the_padding_of_a_view_is_not_seen(frozen):
    scene, views, plan = frozen
    view = view_of(views, 0)
    seen, pairs = len(view.rows) + 7, len(view.ids) + 50
    longer = padded_view(view, seen, pairs)
    assert {len(a) for a in (longer.rows, longer.means2d, longer.conics, longer.opacities)} == {seen}
    assert len(longer.ids) == pairs
    values = values_of(scene, 4, 3)
    for one, other in zip(painted(longer, values, plan), painted(view, values, plan), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.thorough
@pytest.mark.parametrize("rows", [1, 2, 3, 5])
def test_strips_below_each_other_are_the_image(frozen, rows):
    scene, views, plan = frozen
    view = view_of(views, 0)
    values = values_of(scene, 1, 12)
    whole, _ = painted(view, values, plan)
    cut = jax.jit(lambda view, values, i: paint(*_with(strip_of(view, plan, i, rows), values))[0])
    strips = [np.asarray(cut(view, values, np.int32(i))) for i in range(0, plan.tiles_y, rows)]
    assert strips[0].shape == (rows * plan.tile_size, 33, 12)
    together = np.concatenate(strips)
    np.testing.assert_allclose(together[:17], whole, atol=1e-5)
    np.testing.assert_array_equal(together[24:], 0)  # rows of tiles below the image


def _with(strip, values):
    view, plan = strip
    return view, values, plan


@pytest.mark.thorough
def test_slopes_by_the_values_are_those_of_the_whole_rasterizer_and_nothing_else_has_any(frozen):
    scene, views, plan = frozen
    view = view_of(views, 0)
    for channels in (3, 20):
        values = values_of(scene, 2, channels)
        weights = np.float32(np.random.default_rng(3).normal(size=(17, 33, channels)))
        slope = jax.jit(jax.grad(lambda v, w=weights: (painted(view, v, plan)[0] * w).sum()))(values)

        def whole(scene, values, w=weights):
            shapes = {k: scene[k] for k in ("means", "quats", "scales", "opacities", "viewmats", "Ks")}
            of_plan = dataclasses.replace(plan, capacity=4096)
            return (rasterization(**shapes, colors=values, width=33, height=17, plan=of_plan)[0][0] * w).sum()

        # Gradients with respect to everything, which use another backward pass, and to the values alone.
        both = jax.jit(jax.grad(whole, argnums=(0, 1), allow_int=True))(scene, values)[1]
        np.testing.assert_allclose(slope, both, atol=2e-4)
        np.testing.assert_allclose(jax.jit(jax.grad(whole, argnums=1))(scene, values), both, atol=2e-4)
        still = jax.jit(jax.grad(lambda view, v=values: painted(view, v, plan)[0].sum(), allow_int=True))(
            view
        )
        np.testing.assert_array_equal(still.means2d, 0)


def test_a_batch_of_values_is_a_loop_and_its_slopes_too(frozen):
    scene, views, plan = frozen
    view = view_of(views, 0)
    values = values_of(scene, 3, 3, 2)

    @jax.jit
    @jax.value_and_grad
    def value_and_slope(v):
        return (painted(view, v, plan)[0] ** 2).sum()

    together, slopes = jax.vmap(value_and_slope)(values)
    alone, slopes_alone = zip(*map(value_and_slope, values), strict=True)
    np.testing.assert_allclose(together, alone, rtol=1e-5)
    np.testing.assert_allclose(slopes, np.stack(slopes_alone), rtol=1e-4, atol=1e-4)


def test_what_cannot_be_drawn_is_in_no_list(small, geometry):
    _, scene = small(4)
    means = np.array(scene["means"])
    means[::3] = np.nan
    sick = dict(scene, means=jnp.asarray(means))
    views, plan = freeze_views(*geometry(sick), 33, 17)
    view = view_of(views, 0)
    values = np.where(np.arange(len(means))[:, None] % 3 == 0, np.float32(np.nan), np.float32(1))
    assert np.isfinite(painted(view, values, plan)[0]).all()
    listed = np.concatenate(
        [np.asarray(view.ids)[a : a + n] for a, n in zip(view.starts, view.counts, strict=True)]
    )
    assert not (np.asarray(view.rows)[listed] % 3 == 0).any()


@pytest.mark.thorough
def test_a_view_that_sees_nothing_is_empty(small, geometry):
    _, scene = small(5)
    away = dict(scene, means=jnp.asarray(np.asarray(scene["means"]) + np.float32(1e6)))
    views, plan = freeze_views(*geometry(away), 33, 17)
    image, alphas = painted(view_of(views, 0), np.ones((len(away["means"]), 2), np.float32), plan)
    np.testing.assert_array_equal(image, 0)
    np.testing.assert_array_equal(alphas, 0)


def test_of_no_gaussians_there_is_no_view(small, geometry):
    _, scene = small(5)
    with pytest.raises(ValueError, match="means: expected at least one Gaussian"):
        freeze_views(*geometry({name: value[:0] for name, value in scene.items()}), 33, 17)
