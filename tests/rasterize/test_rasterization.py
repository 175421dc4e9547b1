"""Images of the public function: conventions, modes, backgrounds, roi, and tiny or empty scenes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.rasterize.plan import Plan
from gsjax.rasterize.rasterization import plan, rasterization
from gsjax.rasterize.reference import rasterization_reference

IDENTITY = jnp.asarray(np.eye(4, dtype=np.float32)[None])
K = jnp.array([[[10.0, 0.0, 8.0], [0.0, 10.0, 8.0], [0.0, 0.0, 1.0]]])
PLAN = Plan(33, 17, 4096)  # for the small scenes
draw16 = jax.jit(
    partial(rasterization, viewmats=IDENTITY, Ks=K, width=16, height=16, plan=Plan(16, 16, 4096))
)


def one(mean, scale=(0.05, 0.05, 0.05), quat=(1.0, 0.0, 0.0, 0.0), opacity=0.9, color=(1.0, 1.0, 1.0)):
    arrays = {"means": mean, "quats": quat, "scales": scale, "opacities": opacity, "colors": color}
    return {k: np.float32(v)[None] for k, v in arrays.items()}


def both(a, b):
    return {k: np.concatenate([a[k], b[k]]) for k in a}


@jax.jit
def drawn(scene, **options):
    return rasterization(**scene, width=33, height=17, plan=PLAN, **options)


@partial(jax.jit, static_argnums=1)
@partial(jax.grad, has_aux=True)
def slopes(scene, plan):
    """Returns the gradient of a loss with respect to everything, and (image, alphas, meta)."""
    image, alphas, meta = rasterization(**scene, width=33, height=17, plan=plan)
    return jnp.sum(image**2) + jnp.sum(alphas), (image, alphas, meta)


@pytest.mark.thorough
def test_pixel_centres_stand_at_half_x_right_y_down():
    # u = 10 * 0.25 + 8 = 10.5, v = 10 * -0.35 + 8 = 4.5: the centre of column 10, row 4.
    _, alphas, meta = draw16(**one((0.25, -0.35, 1.0)))
    alpha = np.asarray(alphas)[0, :, :, 0]
    assert np.unravel_index(alpha.argmax(), alpha.shape) == (4, 10)
    np.testing.assert_allclose(alpha[4, 9], alpha[4, 11], rtol=1e-5)
    np.testing.assert_allclose(alpha[3, 10], alpha[5, 10], rtol=1e-5)
    np.testing.assert_allclose(np.asarray(meta.means2d)[0, 0], [10.5, 4.5], rtol=1e-6)
    np.testing.assert_allclose(alpha.max(), 0.9, rtol=1e-5)


def test_quaternions_are_wxyz():
    # A needle along x, rotated by 90 degrees about the viewing axis, stands upright.
    half = np.sqrt(0.5)
    needle = one((0.0, 0.0, 1.0), (0.4, 0.02, 0.02), (half, 0.0, 0.0, half))
    alpha = np.asarray(draw16(**needle)[1])[0, ..., 0]
    rows, columns = (alpha > 0.1).any(1).sum(), (alpha > 0.1).any(0).sum()
    assert rows >= 4 * columns


def test_quaternions_need_not_be_unit():
    a, b = (
        draw16(**one((0.1, 0, 1), (0.3, 0.05, 0.1), q)) for q in ((0.3, 0.4, 0.1, -0.2), (30, 40, 10, -20))
    )
    np.testing.assert_allclose(a[0], b[0], atol=1e-6)


@pytest.mark.thorough
def test_equal_depths_keep_the_order_of_the_input():
    red, blue = one((0, 0, 1), color=(1, 0, 0)), one((0, 0, 1), color=(0, 0, 1))
    over, under = (np.asarray(draw16(**both(*pair))[0])[0, 8, 8] for pair in ((red, blue), (blue, red)))
    assert over[0] > 1.5 * over[2]
    np.testing.assert_allclose(over, under[::-1], rtol=1e-6)


@pytest.mark.thorough
def test_opacity_0_and_1_at_their_ends_have_their_gradients():
    @jax.jit
    @jax.value_and_grad
    def brightness(opacity):
        return draw16(**one((0, 0, 1)) | {"opacities": opacity[None]})[1].sum()

    at_end, inside, beyond = (brightness(np.float32(o)) for o in (1.0, 1.0 - 1e-3, 1.5))
    np.testing.assert_allclose(at_end[1], inside[1], rtol=0.01)  # not halved, as by jnp.clip at its bound
    assert float(beyond[1]) == 0.0
    assert float(beyond[0]) == float(at_end[0])


@pytest.mark.thorough
@pytest.mark.parametrize(("mode", "channels"), [("RGB", 3), ("D", 1), ("ED", 1), ("RGB+D", 4), ("RGB+ED", 4)])
def test_channels_of_each_mode_colours_first_depth_last(mode, channels):
    scene = one((0.05, 0.05, 2.0), scale=(0.5, 0.5, 0.5), opacity=0.5, color=(0.2, 0.4, 0.6))
    scene = jax.tree.map(jnp.asarray, scene)
    colors, alphas, _ = rasterization(**scene, viewmats=IDENTITY, Ks=K, width=16, height=16, render_mode=mode)
    assert colors.shape == (1, 16, 16, channels)
    pixel, alpha = np.asarray(colors)[0, 8, 8], np.asarray(alphas)[0, 8, 8, 0]
    if "RGB" in mode:
        np.testing.assert_allclose(pixel[:3], alpha * np.array([0.2, 0.4, 0.6]), rtol=1e-5)
    if "D" in mode:
        np.testing.assert_allclose(pixel[-1], 2.0 if "ED" in mode else 2.0 * alpha, rtol=1e-5)


def seen_twice(scene):
    return scene | {k: np.repeat(scene[k], 2, 0) for k in ("viewmats", "Ks", "backgrounds")}


@pytest.mark.thorough
def test_backgrounds_fill_what_is_left(small):
    _, scene = small()
    backgrounds = np.array(scene["backgrounds"])
    with_it, alphas, _ = jax.device_get(drawn(scene))
    without, _, _ = jax.device_get(drawn({k: v for k, v in scene.items() if k != "backgrounds"}))
    want = without + (1 - alphas) * backgrounds[:, None, None]
    np.testing.assert_allclose(with_it, want, atol=1e-6)
    backgrounds[0, 1] = np.nan
    broken, _, _ = jax.device_get(drawn(scene | {"backgrounds": backgrounds}))
    np.testing.assert_allclose(broken[..., 1], without[..., 1], atol=1e-5)


@pytest.mark.thorough
def test_colours_may_differ_from_camera_to_camera(small):
    _, scene = small()
    colors = np.asarray(scene["colors"])
    dark = colors * np.float32(0.5)
    got = np.asarray(drawn(seen_twice(scene) | {"colors": np.stack([colors, dark])})[0])
    for image, alone in zip(got, (colors, dark), strict=True):
        np.testing.assert_allclose(image, np.asarray(drawn(scene | {"colors": alone})[0])[0], atol=1e-6)


@pytest.mark.thorough
def test_roi_draws_the_tiles_it_touches_exactly_and_leaves_the_others_to_the_background(small):
    this, scene = small()
    width, height = this.width, this.height
    p = Plan(width, height, 4096, tile_size=16)
    roi = np.zeros((1, height, width), bool)
    roi[0, 3, 20] = True  # in the second tile
    kept = np.zeros((height, width), bool)
    kept[:16, 16:32] = True
    weights = np.float32(np.random.default_rng(0).normal(size=(1, height, width, 3)))

    def loss(scene, weights, roi):
        image, _, meta = rasterization(**scene, width=width, height=height, plan=p, roi=roi)
        return jnp.vdot(image, weights), (image, meta)

    run = jax.jit(jax.grad(loss, has_aux=True))
    gradient, (image, meta) = jax.device_get(run(scene, weights, roi))
    everywhere = run(scene, np.where(kept[..., None], weights, np.float32(0)), np.ones_like(roi))
    full_gradient, (full, full_meta) = jax.device_get(everywhere)
    np.testing.assert_array_equal(image[0][kept], full[0][kept])
    np.testing.assert_array_equal(
        image[0][~kept], np.broadcast_to(scene["backgrounds"], image[0][~kept].shape)
    )
    assert int(meta.pairs[0]) < int(full_meta.pairs[0])
    for name in gradient.keys() - {"backgrounds"}:
        tolerance = 1e-5 * np.abs(full_gradient[name]).max()
        np.testing.assert_allclose(gradient[name], full_gradient[name], atol=tolerance, err_msg=name)
    none, (empty, _) = run(scene, weights, np.zeros_like(roi))
    np.testing.assert_array_equal(empty, np.broadcast_to(scene["backgrounds"], empty.shape))
    assert not np.any(none["means"])


@pytest.mark.parametrize("batch", [(), (2,)])
def test_no_gaussians_show_the_background(batch):
    empty = {"means": (0, 3), "quats": (0, 4), "scales": (0, 3), "opacities": (0,), "colors": (0, 3)}
    arrays = {k: jnp.zeros((*batch, *s)) for k, s in empty.items()}
    cameras = {"viewmats": IDENTITY, "Ks": K, "backgrounds": np.float32([[0.1, 0.2, 0.3]])}
    cameras = {k: jnp.asarray(np.broadcast_to(v, (*batch, *v.shape))) for k, v in cameras.items()}
    features = jnp.zeros((*batch, 0, 2))
    colors, alphas, meta = rasterization(**arrays, **cameras, features=features, width=20, height=10)
    np.testing.assert_allclose(colors, np.broadcast_to(np.float32([0.1, 0.2, 0.3]), (*batch, 1, 10, 20, 3)))
    assert not np.any(alphas)
    assert meta.features.shape == (*batch, 1, 10, 20, 2)
    assert not np.any(meta.needed)


@pytest.mark.thorough
def test_cameras_that_see_nothing_are_empty_with_zero_gradients(small):
    _, scene = small()
    viewmats = np.array(scene["viewmats"])
    viewmats[:, 2, 3] -= 100
    gradient, (_, alphas, meta) = jax.device_get(slopes(scene | {"viewmats": viewmats}, PLAN))
    assert not np.any(alphas)
    assert (int(meta.pairs[0]), int(meta.culled[0])) == (0, 0)
    assert all(not np.any(gradient[k]) for k in gradient if k != "backgrounds")


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(
    ("width", "height"), [(17, 33), *(pytest.param(1, h, marks=pytest.mark.slow) for h in (1, 64))]
)
def test_images_that_are_no_multiple_of_a_tile(small, width, height):
    _, scene = small(dtype=np.float64, width=width, height=height)
    scene["Ks"] = jnp.array([[[20.0, 0.0, width / 2], [0.0, 20.0, height / 2], [0.0, 0.0, 1.0]]])
    colors, alphas, _ = rasterization(**scene, width=width, height=height)
    arrays = dict(scene)
    viewmats, Ks, backgrounds = (arrays.pop(k)[0] for k in ("viewmats", "Ks", "backgrounds"))
    reference = jax.jit(partial(rasterization_reference, width=width, height=height))
    want = reference(**arrays, viewmat=viewmats, K=Ks, background=backgrounds)
    assert colors.shape == (1, height, width, 3)
    np.testing.assert_allclose(np.asarray(colors)[0], want.colors, atol=1e-9)
    np.testing.assert_allclose(np.asarray(alphas)[0], want.alphas, atol=1e-9)


def test_meta_tells_radii_and_depths_of_what_is_visible(small, geometry):
    this, scene = small()
    p = plan(*geometry(scene), this.width, this.height)
    drawn_with_it = rasterization(**scene, width=this.width, height=this.height, plan=p)
    meta = jax.device_get(drawn_with_it[2])
    visible = meta.radii[0, :, 0] > 0
    viewmat = np.asarray(scene["viewmats"])[0]
    local = np.asarray(scene["means"]) @ viewmat[:3, :3].T + viewmat[:3, 3]
    assert 0 < visible.sum() < 40
    np.testing.assert_allclose(meta.depths[0][visible], local[:, 2][visible], rtol=1e-5)
    assert int(meta.needed[0]) >= int(meta.pairs[0]) > 0


@pytest.mark.thorough
def test_the_offset_moves_projected_means_and_reads_their_gradient():
    scene = one((0.25, -0.35, 1.0))
    offset = np.float32([[[2.0, 3.0]]])
    alpha = np.asarray(draw16(**scene, means2d_offset=offset)[1])[0, ..., 0]
    assert np.unravel_index(alpha.argmax(), alpha.shape) == (7, 12)
    slope = jax.jit(jax.grad(lambda o: draw16(**scene, means2d_offset=o)[1][0, 4, 11:].sum()))
    assert float(np.asarray(slope(0 * offset))[0, 0, 0]) > 0.01


@pytest.mark.thorough
@pytest.mark.parametrize(
    "options",
    [{"tiles_per_batch": 2}, {"tile_size": 4}, {"tile_size": 16}, {"tile_size": 32}, {"sort": "device"}],
    ids=str,
)
def test_options_of_speed_do_not_change_the_image_or_its_gradient(small, options):
    """Moments of a tile's pixels are taken about its centre, so float32 rounds them by the square of its
    edge: by 1e-6 of the largest slope for tiles of 8 pixels, by up to 1.2e-4 for 32 (against float64)."""
    _, scene = small()
    share = 3e-4 if options.get("tile_size") == 32 else 1e-4
    plans = PLAN, Plan(33, 17, 4096, **options)
    (want, (image, *_)), (got, (other, *_)) = (jax.device_get(slopes(scene, p)) for p in plans)
    np.testing.assert_allclose(other, image, atol=1e-6)
    for name in want:
        tolerance = share * np.abs(want[name]).max()
        np.testing.assert_allclose(got[name], want[name], atol=tolerance, err_msg=name)


def test_reads_of_an_earlier_call_change_nothing_but_the_order_of_work(small):
    _, scene = small()
    image, alphas, meta = jax.device_get(drawn(scene))
    assert meta.reads.shape == (1, PLAN.num_tiles)
    nonsense = np.int32(np.random.default_rng(0).integers(-5, 2**31 - 1, meta.reads.shape))
    for reads in (meta.reads, np.zeros_like(meta.reads), nonsense):
        again = drawn(scene, reads=reads)
        np.testing.assert_array_equal(again[0], image)
        np.testing.assert_array_equal(again[1], alphas)
        np.testing.assert_array_equal(again[2].reads, meta.reads)


@pytest.mark.thorough
def test_a_cap_on_lists_draws_the_nearest_alone(small):
    _, scene = small(3)
    whole = {"width": 32, "height": 16, "tile_size": 32}  # one tile
    _, _, meta = rasterization(**scene, **whole)
    inside = np.asarray(meta.radii)[0].all(axis=1)
    nearest = np.flatnonzero(inside)[np.argsort(np.asarray(meta.depths)[0][inside])][:5]
    per_gaussian = ("means", "quats", "scales", "opacities", "colors")
    rows = {k: jnp.asarray(np.asarray(scene[k])[nearest]) for k in per_gaussian}
    want, _, _ = rasterization(**scene | rows, **whole)
    got, _, meta = rasterization(**scene, **whole, max_per_tile=5)
    np.testing.assert_allclose(got, want, atol=1e-6)
    assert int(meta.pairs[0]) == 5


@pytest.mark.thorough
def test_a_saturated_tile_is_read_no_further():
    n = 400
    depths = np.float32(1 + 1e-3 * np.arange(n))
    scene = {
        "means": jnp.asarray(depths[:, None] * np.float32([0, 0, 1])),
        "quats": jnp.ones((n, 4)),
        "scales": jnp.full((n, 3), 10.0),
        "opacities": jnp.full(n, 0.9),
        "colors": jnp.ones((n, 3)),
        "viewmats": IDENTITY,
        "Ks": jnp.array([[[16.0, 0.0, 8.0], [0.0, 16.0, 8.0], [0.0, 0.0, 1.0]]]),
    }
    _, _, meta = rasterization(**scene, width=16, height=16)
    assert int(meta.pairs[0]) == 4 * n
    assert int(meta.reads.max()) <= 8  # 0.1^4 is the early stop


@pytest.mark.thorough
def test_any_capacity_serves_many_cameras(small):
    # Lists are laid out in rows of 256, so the next camera's begin a little after this one's capacity.
    _, scene = small()
    twice = jax.tree.map(jnp.asarray, seen_twice(scene))
    images = [
        np.asarray(rasterization(**twice, width=33, height=17, plan=Plan(33, 17, size))[0])
        for size in (1001, 4096)
    ]
    np.testing.assert_array_equal(images[0][1], images[0][0])
    np.testing.assert_array_equal(images[0], images[1])
