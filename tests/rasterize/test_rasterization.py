"""What the public function draws: conventions, modes, backgrounds, roi, the smallest and emptiest scenes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.rasterize.plan import Plan
from gsjax.rasterize.rasterization import plan, rasterization
from gsjax.rasterize.reference import rasterization_reference

IDENTITY = jnp.eye(4)[None]
K = jnp.array([[[10.0, 0.0, 8.0], [0.0, 10.0, 8.0], [0.0, 0.0, 1.0]]])
draw16 = jax.jit(
    partial(rasterization, viewmats=IDENTITY, Ks=K, width=16, height=16, plan=Plan(16, 16, 4096))
)


def one(mean, scale=(0.05, 0.05, 0.05), quat=(1.0, 0.0, 0.0, 0.0), opacity=0.9, color=(1.0, 1.0, 1.0)):
    arrays = {"means": mean, "quats": quat, "scales": scale, "opacities": opacity, "colors": color}
    return {k: jnp.asarray(v, jnp.float32)[None] for k, v in arrays.items()}


def both(a, b):
    return {k: jnp.concatenate([a[k], b[k]]) for k in a}


def test_pixel_centres_stand_at_half_x_right_y_down():
    # u = 10 * 0.25 + 8 = 10.5, v = 10 * -0.35 + 8 = 4.5: the centre of column 10, row 4.
    _, alphas, meta = draw16(**one((0.25, -0.35, 1.0)))
    alpha = np.asarray(alphas[0, :, :, 0])
    assert np.unravel_index(alpha.argmax(), alpha.shape) == (4, 10)
    np.testing.assert_allclose(alpha[4, 9], alpha[4, 11], rtol=1e-5)
    np.testing.assert_allclose(alpha[3, 10], alpha[5, 10], rtol=1e-5)
    np.testing.assert_allclose(meta.means2d[0, 0], [10.5, 4.5], rtol=1e-6)
    np.testing.assert_allclose(alpha.max(), 0.9, rtol=1e-5)


def test_quaternions_are_wxyz():
    # A needle along x, turned by 90 degrees about the viewing axis, stands upright.
    half = np.sqrt(0.5)
    alpha = np.asarray(
        draw16(**one((0.0, 0.0, 1.0), (0.4, 0.02, 0.02), (half, 0.0, 0.0, half)))[1][0, ..., 0]
    )
    rows, columns = (alpha > 0.1).any(1).sum(), (alpha > 0.1).any(0).sum()
    assert rows >= 4 * columns


def test_quaternions_need_not_be_unit():
    a, b = (
        draw16(**one((0.1, 0, 1), (0.3, 0.05, 0.1), q)) for q in ((0.3, 0.4, 0.1, -0.2), (30, 40, 10, -20))
    )
    np.testing.assert_allclose(a[0], b[0], atol=1e-6)


def test_equal_depths_keep_the_order_of_the_input():
    red, blue = one((0, 0, 1), color=(1, 0, 0)), one((0, 0, 1), color=(0, 0, 1))
    over = draw16(**both(red, blue))[0][0, 8, 8]
    under = draw16(**both(blue, red))[0][0, 8, 8]
    assert over[0] > 1.5 * over[2]
    np.testing.assert_allclose(over, under[::-1], rtol=1e-6)


def test_opacity_0_and_1_at_their_ends_have_their_gradients():
    def brightness(opacity):
        return draw16(**one((0, 0, 1), opacity=opacity))[1].sum()

    steps = jnp.float32(1.0), jnp.float32(1.0 - 1e-3)
    at_end, inside = (jax.grad(brightness)(o) for o in steps)
    np.testing.assert_allclose(at_end, inside, rtol=0.01)  # not halved, as with clip at its bound
    assert float(jax.grad(brightness)(jnp.float32(1.5))) == 0.0
    assert float(brightness(jnp.float32(1.5))) == float(brightness(jnp.float32(1.0)))


@pytest.mark.parametrize(("mode", "channels"), [("RGB", 3), ("D", 1), ("ED", 1), ("RGB+D", 4), ("RGB+ED", 4)])
def test_channels_of_each_mode_colours_first_depth_last(mode, channels):
    scene = one((0.05, 0.05, 2.0), scale=(0.5, 0.5, 0.5), opacity=0.5, color=(0.2, 0.4, 0.6))
    colors, alphas, _ = rasterization(**scene, viewmats=IDENTITY, Ks=K, width=16, height=16, render_mode=mode)
    assert colors.shape == (1, 16, 16, channels)
    pixel, alpha = colors[0, 8, 8], float(alphas[0, 8, 8, 0])
    if "RGB" in mode:
        np.testing.assert_allclose(pixel[:3], alpha * np.array([0.2, 0.4, 0.6]), rtol=1e-5)
    if "D" in mode:
        np.testing.assert_allclose(pixel[-1], 2.0 if "ED" in mode else 2.0 * alpha, rtol=1e-5)


def test_backgrounds_fill_what_is_left(small):
    this, scene = small()
    p = Plan(this.width, this.height, 4096)
    run = jax.jit(lambda s: rasterization(**s, width=this.width, height=this.height, plan=p)[:2])
    with_it, alphas = run(scene)
    without, _ = run({k: v for k, v in scene.items() if k != "backgrounds"})
    want = without + (1 - alphas) * scene["backgrounds"][:, None, None]
    np.testing.assert_allclose(with_it, want, atol=1e-6)
    broken, _ = run(scene | {"backgrounds": scene["backgrounds"].at[0, 1].set(jnp.nan)})
    np.testing.assert_allclose(broken[..., 1], without[..., 1], atol=1e-5)


def test_colours_may_differ_from_camera_to_camera(small):
    this, scene = small()
    p = Plan(this.width, this.height, 4096)
    twice = scene | {k: jnp.repeat(scene[k], 2, 0) for k in ("viewmats", "Ks", "backgrounds")}
    run = jax.jit(lambda s: rasterization(**s, width=this.width, height=this.height, plan=p)[0])
    got = run(twice | {"colors": jnp.stack([scene["colors"], scene["colors"] * 0.5])})
    np.testing.assert_allclose(got[0], run(scene)[0], atol=1e-6)
    np.testing.assert_allclose(got[1], run(scene | {"colors": scene["colors"] * 0.5})[0], atol=1e-6)


def test_roi_draws_the_tiles_it_touches_exactly_and_leaves_the_others_to_the_background(small):
    this, scene = small()
    width, height = this.width, this.height
    p = Plan(width, height, 4096, tile_size=16)
    roi = jnp.zeros((1, height, width), bool).at[0, 3, 20].set(True)  # in the second tile
    kept = np.zeros((height, width), bool)
    kept[:16, 16:32] = True
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(1, height, width, 3)), jnp.float32)

    def loss(scene, weights, roi):
        image, _, meta = rasterization(**scene, width=width, height=height, plan=p, roi=roi)
        return jnp.vdot(image, weights), (image, meta)

    run = jax.jit(jax.grad(loss, has_aux=True))
    gradient, (image, meta) = run(scene, weights, roi)
    full_gradient, (full, full_meta) = run(scene, jnp.where(kept[..., None], weights, 0), jnp.ones_like(roi))
    np.testing.assert_array_equal(image[0][kept], full[0][kept])
    np.testing.assert_array_equal(
        image[0][~kept], np.broadcast_to(scene["backgrounds"][0], image[0][~kept].shape)
    )
    assert int(meta.pairs[0]) < int(full_meta.pairs[0])
    for name in gradient.keys() - {"backgrounds"}:
        tolerance = 1e-5 * float(jnp.abs(full_gradient[name]).max())
        np.testing.assert_allclose(gradient[name], full_gradient[name], atol=tolerance, err_msg=name)
    none, (empty, _) = run(scene, weights, jnp.zeros_like(roi))
    np.testing.assert_array_equal(empty, jnp.broadcast_to(scene["backgrounds"], empty.shape))
    assert not np.any(none["means"])


@pytest.mark.parametrize("batch", [(), (2,)])
def test_no_gaussians_show_the_background(batch):
    empty = {"means": (0, 3), "quats": (0, 4), "scales": (0, 3), "opacities": (0,), "colors": (0, 3)}
    arrays = {k: jnp.zeros((*batch, *s)) for k, s in empty.items()}
    cameras = {"viewmats": IDENTITY, "Ks": K, "backgrounds": jnp.array([[0.1, 0.2, 0.3]])}
    cameras = {k: jnp.broadcast_to(v, (*batch, *v.shape)) for k, v in cameras.items()}
    features = jnp.zeros((*batch, 0, 2))
    colors, alphas, meta = rasterization(**arrays, **cameras, features=features, width=20, height=10)
    np.testing.assert_allclose(colors, jnp.broadcast_to(jnp.array([0.1, 0.2, 0.3]), (*batch, 1, 10, 20, 3)))
    assert not np.any(alphas)
    assert meta.features.shape == (*batch, 1, 10, 20, 2)
    assert not np.any(meta.needed)


def test_cameras_that_see_nothing_are_empty_with_zero_gradients(small):
    this, scene = small()
    p = Plan(this.width, this.height, 4096)
    away = scene | {"viewmats": scene["viewmats"].at[:, 2, 3].add(-100.0)}

    def loss(scene):
        image, alphas, meta = rasterization(**scene, width=this.width, height=this.height, plan=p)
        return image.sum(), (alphas, meta)

    gradient, (alphas, meta) = jax.jit(jax.grad(loss, has_aux=True))(away)
    assert not np.any(alphas)
    assert (int(meta.pairs[0]), int(meta.culled[0])) == (0, 0)
    assert all(not np.any(gradient[k]) for k in gradient if k != "backgrounds")


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
    want = rasterization_reference(
        **arrays, viewmat=viewmats, K=Ks, background=backgrounds, width=width, height=height
    )
    assert colors.shape == (1, height, width, 3)
    np.testing.assert_allclose(colors[0], want.colors, atol=1e-9)
    np.testing.assert_allclose(alphas[0], want.alphas, atol=1e-9)


def test_meta_tells_radii_and_depths_of_what_is_visible(small, geometry):
    this, scene = small()
    p = plan(*geometry(scene), this.width, this.height)
    meta = rasterization(**scene, width=this.width, height=this.height, plan=p)[2]
    visible = np.asarray(meta.radii[0, :, 0] > 0)
    local = scene["means"] @ scene["viewmats"][0, :3, :3].T + scene["viewmats"][0, :3, 3]
    assert 0 < visible.sum() < 40
    np.testing.assert_allclose(
        np.asarray(meta.depths[0])[visible], np.asarray(local[:, 2])[visible], rtol=1e-5
    )
    assert int(meta.needed[0]) >= int(meta.pairs[0]) > 0


def test_the_offset_moves_projected_means_and_reads_their_gradient():
    scene = one((0.25, -0.35, 1.0))
    offset = jnp.array([[[2.0, 3.0]]])
    alpha = np.asarray(draw16(**scene, means2d_offset=offset)[1][0, ..., 0])
    assert np.unravel_index(alpha.argmax(), alpha.shape) == (7, 12)
    gradient = jax.grad(lambda o: draw16(**scene, means2d_offset=o)[1][0, 4, 11:].sum())(jnp.zeros((1, 1, 2)))
    assert float(gradient[0, 0, 0]) > 0.01


@pytest.mark.parametrize(
    "options",
    [{"tiles_per_batch": 2}, {"tile_size": 4}, {"tile_size": 16}, {"tile_size": 32}, {"sort": "device"}],
    ids=str,
)
def test_options_of_speed_do_not_change_the_image_or_its_gradient(small, options):
    _, scene = small()

    def run(plan):
        def loss(scene):
            image, alphas, _ = rasterization(**scene, width=33, height=17, plan=plan)
            return jnp.sum(image**2) + jnp.sum(alphas), image

        return jax.jit(jax.grad(loss, has_aux=True))(scene)

    (want, image), (got, other) = run(Plan(33, 17, 4096)), run(Plan(33, 17, 4096, **options))
    np.testing.assert_allclose(other, image, atol=1e-6)
    for name in want:
        tolerance = 1e-4 * float(jnp.abs(want[name]).max())
        np.testing.assert_allclose(got[name], want[name], atol=tolerance, err_msg=name)


def test_reads_of_an_earlier_call_change_nothing_but_the_order_of_work(small):
    _, scene = small()
    p = Plan(33, 17, 4096)
    run = jax.jit(lambda reads: rasterization(**scene, width=33, height=17, plan=p, reads=reads))
    image, alphas, meta = run(None)
    assert meta.reads.shape == (1, p.num_tiles)
    nonsense = jnp.asarray(np.random.default_rng(0).integers(-5, 2**31 - 1, meta.reads.shape), jnp.int32)
    for reads in (meta.reads, jnp.zeros_like(meta.reads), nonsense):
        again = run(reads)
        np.testing.assert_array_equal(again[0], image)
        np.testing.assert_array_equal(again[1], alphas)
        np.testing.assert_array_equal(again[2].reads, meta.reads)


def test_a_cap_on_lists_draws_the_nearest_alone(small):
    _, scene = small(3)
    whole = {"width": 32, "height": 16, "tile_size": 32}  # one tile
    _, _, meta = rasterization(**scene, **whole)
    inside = np.asarray(meta.radii[0]).all(axis=1)
    nearest = np.flatnonzero(inside)[np.argsort(np.asarray(meta.depths[0])[inside])][:5]
    rows = {
        k: v[nearest] for k, v in scene.items() if k in ("means", "quats", "scales", "opacities", "colors")
    }
    want, _, _ = rasterization(**scene | rows, **whole)
    got, _, meta = rasterization(**scene, **whole, max_per_tile=5)
    np.testing.assert_allclose(got, want, atol=1e-6)
    assert int(meta.pairs[0]) == 5


def test_a_saturated_tile_is_read_no_further():
    n = 400
    scene = {
        "means": jnp.tile(jnp.array([0.0, 0.0, 1.0]), (n, 1)).at[:, 2].add(jnp.arange(n) * 1e-3),
        "quats": jnp.ones((n, 4)),
        "scales": jnp.full((n, 3), 10.0),
        "opacities": jnp.full(n, 0.9),
        "colors": jnp.ones((n, 3)),
        "viewmats": jnp.eye(4)[None],
        "Ks": jnp.array([[[16.0, 0.0, 8.0], [0.0, 16.0, 8.0], [0.0, 0.0, 1.0]]]),
    }
    _, _, meta = rasterization(**scene, width=16, height=16)
    assert int(meta.pairs[0]) == 4 * n
    assert int(meta.reads.max()) <= 8  # 0.1^4 is the early stop


def test_any_capacity_serves_many_cameras(small):
    # Lists are laid out in rows of 256, so the next camera's begin a little after this one's capacity.
    this, scene = small()
    twice = scene | {k: jnp.repeat(scene[k], 2, 0) for k in ("viewmats", "Ks", "backgrounds")}
    images = [
        rasterization(
            **twice, width=this.width, height=this.height, plan=Plan(this.width, this.height, size)
        )[0]
        for size in (1001, 4096)
    ]
    np.testing.assert_array_equal(images[0][1], images[0][0])
    np.testing.assert_array_equal(images[0], images[1])
