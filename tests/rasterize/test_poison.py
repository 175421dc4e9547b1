"""Values that cannot be drawn, in each input: neighbours are unaffected, and everything stays finite."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.fuzz import check
from benchmarks.poisons import INPUTS, INTEGERS, MODES, PER_GAUSSIAN, PLACES, POISONS, Case, scene_of
from benchmarks.scenes import ARRAYS
from gsjax.rasterize.plan import Plan
from gsjax.rasterize.rasterization import rasterization
from gsjax.rasterize.reference import rasterization_reference

PLAN = Plan(33, 17, 4096, render_mode="RGB+ED", sh_degree=1, rasterize_mode="antialiased")
TINY = np.finfo(np.float32).smallest_subnormal


@jax.jit
def run(scene, weights):
    def loss(scene):
        colors, alphas, meta = rasterization(**scene, width=33, height=17, plan=PLAN)
        images = (colors, alphas, meta.features)
        return sum(jnp.vdot(a, w) for a, w in zip(images, weights, strict=True)), (images, meta)

    gradient, (images, meta) = jax.grad(loss, has_aux=True)(scene)
    return images, gradient, meta


@pytest.fixture
def scene(small):
    return small(render_mode="RGB+ED", sh_degree=1, feature_channels=2)[1]


@pytest.fixture
def weights():
    rng = np.random.default_rng(0)
    return [jnp.asarray(rng.normal(size=(1, 17, 33, d)), jnp.float32) for d in (4, 1, 2)]


def busiest(scene, weights) -> int:
    """The Gaussian whose opacity has the largest gradient, and which is therefore visible."""
    return int(jnp.abs(run(scene, weights)[1]["opacities"]).argmax())


def assert_finite(tree):
    for leaf in jax.tree.leaves(tree):
        assert np.isfinite(leaf).all()


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "value", "culled"),
    [(name, value, 1) for name in PER_GAUSSIAN for value in (np.nan, np.inf, -np.inf)]
    + [(name, 1e38, 1) for name in ("quats", "scales", "colors", "features")]
    + [("quats", 0.0, 1), ("quats", TINY, 1), ("quats", 1e-7, 1), ("scales", 1e12, 1)]
    # Not drawn because of their position or low opacity, and so not counted as culled.
    + [
        ("means", 1e38, 0),
        ("means", -1e38, 0),
        ("opacities", 0.0, 0),
        ("opacities", TINY, 0),
        ("opacities", -1.0, 0),
    ],
)
@pytest.mark.parametrize("whole_row", [True, False])
def test_a_poisoned_gaussian_is_as_if_it_were_absent(scene, weights, name, value, culled, whole_row):
    k = busiest(scene, weights)
    at = (k,) if whole_row or scene[name].ndim == 1 else (k, ..., 1)
    if name == "quats" and abs(value) < 1 and not whole_row:
        pytest.skip("one small component leaves a rotation")
    if name == "scales" and value == 1e12 and not whole_row:
        pytest.skip("an endless needle can be drawn")
    got, gradient, meta = run(scene | {name: scene[name].at[at].set(value)}, weights)
    want, clean, _ = run(scene | {"opacities": scene["opacities"].at[k].set(0.0)}, weights)
    assert int(meta.culled[0]) == culled
    for a, b in zip(got, want, strict=True):
        np.testing.assert_array_equal(a, b)
    for key in gradient:
        np.testing.assert_array_equal(gradient[key], clean[key], err_msg=key)
    for key in PER_GAUSSIAN:
        assert not np.any(gradient[key][k])
    assert_finite((got, gradient))


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["viewmats", "Ks"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_camera_that_is_not_finite_sees_nothing_and_culls_everything(scene, weights, name, value):
    images, gradient, meta = run(scene | {name: scene[name].at[0, 0, 0].set(value)}, weights)
    assert int(meta.culled[0]) == 40
    assert not np.any(images[1])
    assert_finite((images, gradient))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e38])
def test_a_background_that_cannot_be_squared_counts_as_black(scene, weights, value):
    images, gradient, _ = run(scene | {"backgrounds": scene["backgrounds"].at[0, 1].set(value)}, weights)
    black, same, _ = run(scene | {"backgrounds": scene["backgrounds"].at[0, 1].set(0.0)}, weights)
    np.testing.assert_array_equal(images[0], black[0])
    np.testing.assert_array_equal(gradient["means"], same["means"])
    assert_finite((images, gradient))


@pytest.mark.parametrize(
    ("at", "value"),
    [((0, 2), 1e38), ((0, 2), -1e38), ((0,), 1e38), ((0,), 1e-19), ((1, 1), np.finfo(np.float32).tiny)],
)
def test_a_camera_beyond_what_can_be_squared_has_finite_gradients(scene, weights, at, value):
    images, gradient, _ = run(scene | {"Ks": scene["Ks"].at[(0, *at)].set(value)}, weights)
    assert_finite((images, gradient))


def place(scene, k, depth, sideways=0.0):
    """The scene with Gaussian k at `depth` in front of the camera."""
    viewmat = np.float64(scene["viewmats"][0])
    world = (np.array([sideways, 0.0, depth]) - viewmat[:3, 3]) @ viewmat[:3, :3]
    return scene | {"means": scene["means"].at[k].set(jnp.asarray(world, scene["means"].dtype))}


@pytest.mark.parametrize("depth", [-1.0, 0.0, 0.00999])
def test_at_and_behind_the_near_plane_nothing_is_drawn(scene, weights, depth):
    k = busiest(scene, weights)
    got, gradient, meta = run(place(scene, k, depth), weights)
    want, clean, _ = run(scene | {"opacities": scene["opacities"].at[k].set(0.0)}, weights)
    assert int(meta.culled[0]) == 0
    np.testing.assert_array_equal(got[0], want[0])
    for key in gradient:
        np.testing.assert_array_equal(gradient[key], clean[key])


@pytest.mark.parametrize(
    "change",
    [
        # Just beyond the near plane, with the camera inside the Gaussian.
        lambda s: place(s, 0, 0.0101),
        lambda s: place(s, 0, 0.0101, sideways=1e30),
        lambda s: place(s, 0, 1e6),
        lambda s: s | {"scales": s["scales"].at[:5].set(0.0)},
        lambda s: s | {"scales": s["scales"].at[:5].set(1e-12)},
        lambda s: s | {"scales": s["scales"].at[0].set(1e6)},
        lambda s: s | {"scales": s["scales"].at[:, 1].set(1e12)},
        lambda s: s | {"scales": s["scales"].at[:, 1:].mul(1e-8)},
        lambda s: s | {"opacities": jnp.ones_like(s["opacities"])},
        lambda s: s | {"means": s["means"].at[:].set(s["means"][0])},
        lambda s: s | {"means": s["means"] + 1e6},
        lambda s: s | {"Ks": s["Ks"].at[0, [0, 1], [0, 1]].set(1.0)},
        lambda s: s | {"Ks": s["Ks"].at[0, [0, 1], [0, 1]].set(1e5)},
        lambda s: s | {"colors": s["colors"].at[0].set(1e18)},
    ],
)
def test_extremes_that_can_be_drawn_stay_finite(scene, weights, change):
    images, gradient, _ = run(change(scene), weights)
    assert_finite((images, gradient))


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(
    "change",
    [
        lambda s: s | {"scales": s["scales"].at[:5].set(0.0)},
        lambda s: s | {"scales": s["scales"].at[:5].set(1e-12)},
        lambda s: s | {"scales": s["scales"].at[:, 1:].mul(1e-8)},
        lambda s: s | {"scales": s["scales"].at[0].set(1e12)},
        lambda s: s | {"opacities": jnp.ones_like(s["opacities"])},
        lambda s: place(s, 0, 0.0101),
        lambda s: s | {"quats": s["quats"] * 1e30},
    ],
)
def test_extremes_that_can_be_drawn_equal_the_reference(scene, weights, change):
    changed = change({k: jnp.asarray(v, jnp.float64) for k, v in scene.items()})
    images, gradient, _ = run(changed, [jnp.asarray(w, jnp.float64) for w in weights])
    want = _reference(changed)
    certain = ~np.asarray(want.doubtful)
    np.testing.assert_allclose(np.asarray(images[0][0])[certain], np.asarray(want.colors)[certain], atol=1e-9)
    np.testing.assert_allclose(np.asarray(images[1][0])[certain], np.asarray(want.alphas)[certain], atol=1e-9)
    assert_finite(gradient)


@jax.jit
def _reference(scene):
    return rasterization_reference(
        *(scene[name] for name in ARRAYS[:5]),
        scene["viewmats"][0],
        scene["Ks"][0],
        33,
        17,
        background=scene["backgrounds"][0],
        features=scene["features"],
        sh_degree=1,
        render_mode="RGB+ED",
        rasterize_mode="antialiased",
    )


@st.composite
def poisons(draw, modes):
    mode, name = draw(st.sampled_from(modes)), draw(st.sampled_from(INPUTS))
    shape = scene_of(mode, 0)[name].shape
    shape = shape if name in PER_GAUSSIAN else shape[1:]
    row, column = draw(st.integers(0, shape[0] - 1)), draw(st.integers(-1, math.prod(shape[1:]) - 1))
    table = INTEGERS if name == "reads" else POISONS | (PLACES if name == "means" else {})
    poison = draw(st.sampled_from(list(table)))
    column = -1 if len(shape) == 1 or poison in PLACES else column
    return Case(mode, draw(st.integers(0, 3)), name, row, column, poison)


def assert_sound(case):
    _, failure = check(case)
    assert not failure, f"python -m benchmarks.fuzz --case '{case}'  # {failure}"


# Here one mode with matmuls and one with forward derivatives; all others are in the slow test.
@pytest.mark.thorough
@settings(max_examples=150)
@given(poisons(["channels", "forward"]))
def test_poison_anywhere_is_culled_and_counted_or_drawn_as_the_reference_draws_it(case):
    assert_sound(case)


@pytest.mark.slow
@settings(max_examples=1500)
@given(poisons(list(MODES)))
def test_poison_anywhere_in_every_mode(case):
    assert_sound(case)
