"""Tiles and the image they make up, for few and for many channels."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import gsjax
from gsjax.rasterize.frozen import freeze_views, paint_shown
from gsjax.rasterize.plan import FEW_CHANNELS, Plan
from gsjax.rasterize.tiles import in_tiles, read_tiles, split_views, untile, write_tiles


def plan_of(width: int, height: int, tile_size: int = 4) -> Plan:
    return Plan(width=width, height=height, capacity=0, tile_size=tile_size)


@pytest.mark.thorough
@given(st.integers(1, 20), st.integers(1, 20), st.integers(1, 3), st.integers(0, 3))
def test_tiles_make_an_image_and_come_from_it(width, height, views, channels):
    plan = plan_of(width, height)
    shape = (views * plan.num_tiles, channels, plan.tile_pixels)
    tiles = jnp.arange(np.prod(shape)).reshape(shape).astype(jnp.float32)
    image = untile(tiles, plan)
    assert split_views(image, (views,), plan).shape == (views, height, width, channels)
    np.testing.assert_array_equal(in_tiles(image, plan), tiles)
    some = jnp.asarray([0, len(tiles) - 1])
    np.testing.assert_array_equal(read_tiles(image, some, plan), tiles[some].swapaxes(1, 2))


def test_pixels_of_an_image_lie_in_their_tile():
    plan = plan_of(8, 8)
    image = jnp.arange(64.0).reshape(8, 8, 1)
    np.testing.assert_array_equal(in_tiles(image, plan)[3, 0].reshape(4, 4), image[4:, 4:, 0])


def test_tiles_are_written_where_they_belong_and_none_where_there_is_none():
    plan, random = plan_of(12, 8), np.random.default_rng(0)
    image = jnp.asarray(random.normal(size=(8, 12, 9)), jnp.float32)
    values = jnp.asarray(random.normal(size=(3, 16, 9)), jnp.float32)
    written = write_tiles(image, jnp.asarray([4, 1, -1]), values, 2, plan)
    found = in_tiles(written, plan).swapaxes(1, 2)
    np.testing.assert_array_equal(found[jnp.asarray([4, 1])], values[:2])
    others = jnp.asarray([0, 2, 3, 5])
    np.testing.assert_array_equal(found[others], in_tiles(image, plan).swapaxes(1, 2)[others])


@pytest.mark.thorough
def test_many_channels_are_those_of_images_of_few(small, geometry):
    """Values, and gradients with respect to every argument. Nine tiles per camera, in batches of eight."""
    size = 24, 17
    random, channels = np.random.default_rng(1), 2 * FEW_CHANNELS
    _, scene = small(3, width=size[0], height=size[1])
    *shapes, viewmats, Ks = map(jnp.asarray, geometry(scene))
    colors = jnp.asarray(random.normal(size=(len(shapes[0]), channels)), jnp.float32)
    plan = gsjax.plan(*shapes, viewmats, Ks, *size)
    weights = jnp.asarray(random.normal(size=(len(Ks), size[1], size[0], channels)), jnp.float32)

    def total(shapes, *pieces):
        drawn = [gsjax.rasterization(*shapes, piece, viewmats, Ks, *size, plan=plan) for piece in pieces]
        image = jnp.concatenate([colors for colors, _, _ in drawn], axis=-1)
        alphas = sum(alphas for _, alphas, _ in drawn) / len(drawn)
        return jnp.sum(weights * image) + alphas.sum(), image

    def slopes(*pieces):
        slope = jax.value_and_grad(total, argnums=range(1 + len(pieces)), has_aux=True)
        (_, image), (by_shape, *by_color) = jax.jit(slope)(shapes, *pieces)
        return image, by_shape, jnp.concatenate(by_color, axis=1)

    found = slopes(colors)
    want = slopes(colors[:, :FEW_CHANNELS], colors[:, FEW_CHANNELS:])
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5 * max(1.0, float(jnp.abs(other).max())))


@pytest.mark.thorough
def test_many_channels_forwards_backwards_and_side_by_side(small, geometry):
    """jvp against vjp, and vmap against a loop, of views with an odd number of tiles."""
    random, channels = np.random.default_rng(2), FEW_CHANNELS + 1
    _, scene = small(3, width=24, height=17)
    *shapes, viewmats, Ks = geometry(scene)
    aside = viewmats[:1] + np.eye(4, k=3, dtype=np.float32) * 0.2
    viewmats, Ks = jnp.concatenate([viewmats[:1], aside]), jnp.concatenate([Ks[:1], Ks[:1]])
    shapes = list(map(jnp.asarray, shapes))
    views, plan = freeze_views(*shapes, viewmats, Ks, 24, 17)
    count = views.opacities.shape[1]
    values, tangent = (jnp.asarray(random.normal(size=(2, count, channels)), jnp.float32) for _ in range(2))
    weights = jnp.asarray(random.normal(size=(17, 24, channels)), jnp.float32)
    forward = dataclasses.replace(plan, derivative="forward")

    def painted(view, values, plan=plan):
        return paint_shown(view, values, plan)[0]

    def one(view, values, tangent):
        image, moved = jax.jvp(lambda some: painted(view, some, forward), (values,), (tangent,))
        (slope,) = jax.vjp(lambda some: painted(view, some), values)[1](weights)
        return image, moved, slope

    many = jax.jit(jax.vmap(one))(views, values, tangent)
    each = [jax.jit(one)(jax.tree.map(lambda a, c=c: a[c], views), values[c], tangent[c]) for c in range(2)]
    for together, apart in zip(many, zip(*each, strict=True), strict=True):
        np.testing.assert_allclose(together, jnp.stack(apart), atol=1e-5)
    for c in range(2):
        np.testing.assert_allclose(jnp.vdot(weights, many[1][c]), jnp.vdot(many[2][c], tangent[c]), rtol=1e-4)


@pytest.mark.thorough
@pytest.mark.parametrize("dtype", [jnp.bfloat16, jnp.float32])
def test_many_channels_of_no_gaussian_and_in_half_precision(dtype, small, geometry):
    _, scene = small(3, width=24, height=17)
    shapes, (viewmats, Ks) = geometry(scene)[:4], geometry(scene)[4:]
    colors = jnp.ones((len(shapes[0]), FEW_CHANNELS + 1), dtype)
    image, alphas, _ = gsjax.rasterization(*shapes, colors, viewmats, Ks, 24, 17)
    assert image.dtype == jnp.float32
    np.testing.assert_allclose(image, jnp.broadcast_to(alphas, image.shape), atol=1e-6)
    nothing = [jnp.asarray(a)[:0] for a in (*shapes, colors)]
    image, alphas, _ = gsjax.rasterization(*nothing, viewmats, Ks, 24, 17)
    assert image.shape == (len(Ks), 17, 24, FEW_CHANNELS + 1)
    assert not image.any()
