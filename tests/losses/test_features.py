"""Feature losses against their definitions in float64, and central differences."""

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given

from gsjax.losses.features import (
    contrastive_loss,
    cosine_error,
    cycle_error,
    feature_error,
    likeness,
    likeness_to_map,
    max_pooled,
    pooled_ids,
)
from gsjax.losses.regularization import total_variation

PIXELS, CHANNELS, DIMENSION, KINDS = 12, 5, 9, 4


def case(seed: int):
    random = np.random.default_rng(seed)
    return {
        "rendered": random.normal(size=(PIXELS, CHANNELS)),
        "weights": random.normal(size=(DIMENSION, CHANNELS)),
        "codebook": random.normal(size=(KINDS, DIMENSION)),
        "alphas": random.uniform(size=PIXELS),
        "ids": random.integers(0, KINDS, PIXELS, np.int32),
    }


@jax.jit
def errors(rendered, weights, codebook, alphas, ids, target):
    """(likeness, squared error, cosine error, likeness to a map of the target)."""
    like = likeness(rendered, weights, codebook, ids)
    of_map = likeness_to_map(rendered, weights, target)
    return like, feature_error(like, alphas, DIMENSION), cosine_error(like), of_map


contrast = jax.jit(contrastive_loss)
contrast_and_slope = jax.jit(jax.value_and_grad(contrastive_loss))
cycle = jax.jit(cycle_error)
variation = jax.jit(total_variation)


@pytest.mark.usefixtures("x64")
@given(st.integers(0, 1000))
def test_rec_and_cos_equal_their_definitions_in_the_teachers_channels(seed):
    inputs = case(seed)
    lifted, target = inputs["rendered"] @ inputs["weights"].T, inputs["codebook"][inputs["ids"]]
    rec = ((lifted - inputs["alphas"][:, None] * target) ** 2).mean(1)
    cos = 1 - (lifted * target).sum(1) / np.linalg.norm(lifted, axis=1) / np.linalg.norm(target, axis=1)
    like, found_rec, found_cos, of_map = errors(**inputs, target=target)
    np.testing.assert_allclose(found_rec, rec, rtol=1e-9)
    np.testing.assert_allclose(found_cos, cos, rtol=1e-9)
    for one, other in zip(of_map, like, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9)


def contrast_by_hand(features, ids, gamma):
    """Eq. 6 pair by pair."""
    shares = []
    for a in range(len(ids)):
        kernel = {
            b: np.exp(-gamma * ((features[a] - features[b]) ** 2).sum())
            for b in range(len(ids))
            if b != a and ids[b] >= 0
        }
        same = [k for b, k in kernel.items() if ids[b] == ids[a]]
        if ids[a] >= 0 and same:
            shares.append(np.log(sum(same) / sum(kernel.values())))
    return -np.mean(shares) if shares else 0.0


@pytest.mark.usefixtures("x64")
@given(st.integers(0, 1000), st.sampled_from([0.1, 1.0, 3.0]))
def test_the_contrastive_loss_equals_the_sum_over_pairs(seed, gamma):
    random = np.random.default_rng(seed)
    features, ids = random.normal(size=(9, 3)), random.integers(-1, 3, 9, np.int32)
    got = jax.jit(contrastive_loss, static_argnums=2)(features, ids, gamma)
    np.testing.assert_allclose(got, contrast_by_hand(features, ids, gamma), rtol=1e-9, atol=1e-12)


def test_the_contrastive_loss_ignores_single_pixels_and_pixels_without_an_id():
    features = np.float32(np.random.default_rng(0).normal(size=(4, 3)))
    for ids in ([0, 1, 2, 3], [-1, -1, -1, -1], [0, -1, -1, 1]):
        value, slope = contrast_and_slope(features, np.int32(ids))
        assert value == 0
        np.testing.assert_array_equal(slope, 0)
    # With a single id there is no loss, wherever the features lie.
    np.testing.assert_allclose(contrast(features, np.zeros(4, np.int32)), 0, atol=1e-6)


def test_the_contrastive_loss_is_finite_if_its_kernel_underflows_or_features_are_equal():
    far = 500 + 30 * np.float32([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    ids = np.int32([0, 1, 0, 1])
    value, slope = contrast_and_slope(far, ids)
    # The two nearest are equally near, and one of them has the same id.
    np.testing.assert_allclose(value, np.log(2), rtol=1e-3)
    assert np.isfinite(slope).all()
    value, slope = contrast_and_slope(np.ones((4, 2), np.float32), ids)
    np.testing.assert_allclose(value, np.log(3), rtol=1e-6)
    assert np.isfinite(slope).all()


def test_zero_features_have_no_gradient_and_no_nan():
    inputs = case(0)
    inputs["rendered"][0] = inputs["codebook"][2] = 0.0

    def value(rendered, weights, codebook, ids):
        return cosine_error(likeness(rendered, weights, codebook, ids)).sum()

    given_ = [inputs[name] for name in ("rendered", "weights", "codebook", "ids")]
    slope = np.asarray(jax.jit(jax.grad(value))(*given_))
    assert np.isfinite(slope).all()
    np.testing.assert_array_equal(slope[0], 0)
    np.testing.assert_array_equal(slope[inputs["ids"] == 2], 0)


@jax.jit
def whole(inputs):
    """The sum of all losses."""
    like = likeness(inputs["rendered"], inputs["weights"], inputs["codebook"], inputs["ids"])
    image = inputs["rendered"].reshape(3, 4, CHANNELS)
    value = (feature_error(like, inputs["alphas"], DIMENSION) + cosine_error(like)).sum()
    value += contrastive_loss(inputs["rendered"], inputs["ids"])
    return value + total_variation(image) + (max_pooled(image, 2) ** 2).sum()


@pytest.mark.usefixtures("x64")
def test_slopes_are_those_of_central_differences_and_jvp_agrees_with_vjp():
    inputs = case(1)
    floats = {name: inputs[name] for name in ("rendered", "weights", "codebook", "alphas")}

    def value(floats):
        return whole(inputs | floats)

    slopes = jax.device_get(jax.jit(jax.grad(value))(floats))
    push = jax.jit(lambda floats, along: jax.jvp(value, (floats,), (along,))[1])
    random = np.random.default_rng(2)
    for name, slope in slopes.items():
        along = {k: np.zeros_like(a) for k, a in floats.items()}
        along[name] = random.normal(size=slope.shape)
        ahead, behind = (
            float(value(jax.tree.map(lambda a, d, step=step: a + step * d, floats, along)))
            for step in (1e-6, -1e-6)
        )
        np.testing.assert_allclose((slope * along[name]).sum(), (ahead - behind) / 2e-6, rtol=2e-6)
        np.testing.assert_allclose(push(floats, along), (slope * along[name]).sum(), rtol=1e-9)


def test_float32_is_near_to_float64():
    inputs = case(3)
    single = whole({k: np.float32(a) if k != "ids" else a for k, a in inputs.items()})
    with jax.enable_x64(True):
        double = whole(inputs)
    np.testing.assert_allclose(single, double, rtol=1e-5)


def test_a_batch_is_a_loop():
    many = [case(i) for i in range(3)]
    stacked = jax.tree.map(lambda *a: np.stack(a), *many)
    np.testing.assert_allclose(jax.vmap(whole)(stacked), [whole(one) for one in many], rtol=1e-5)


def test_pooling_takes_whole_windows_and_keeps_ids_of_uniform_ones():
    image = jnp.asarray(np.arange(5 * 7, dtype=np.float32).reshape(5, 7, 1))
    np.testing.assert_array_equal(np.asarray(max_pooled(image, 2))[..., 0], [[8, 10, 12], [22, 24, 26]])
    ids = jnp.array([[1, 1, 2, 0], [1, 1, 0, 2], [-1, -1, 3, -1], [-1, -1, 3, 3]])
    np.testing.assert_array_equal(jax.jit(pooled_ids, static_argnums=1)(ids, 2), [[1, -1], [-1, -1]])


def test_strips_of_total_variation_add_up():
    image = np.float32(np.random.default_rng(0).normal(size=(9, 6, 2)))
    by_hand = np.abs(np.diff(image, axis=0)).sum() + np.abs(np.diff(image, axis=1)).sum()
    np.testing.assert_allclose(variation(image), by_hand, rtol=1e-6)
    lower = np.concatenate([image[4:], np.full((2, 6, 2), 7, np.float32)])  # with rows outside the image
    inside = np.arange(7) < 5
    parts = np.asarray(variation(image[:4])) + np.asarray(variation(lower, image[3], inside))
    np.testing.assert_allclose(parts, by_hand, rtol=1e-6)


@pytest.mark.usefixtures("x64")
@given(st.integers(0, 1000))
def test_the_cycle_error_covers_both_ways_and_vanishes_for_an_inverse(seed):
    random = np.random.default_rng(seed)
    low, weights = random.normal(size=(PIXELS, CHANNELS)), random.normal(size=(DIMENSION, CHANNELS))
    inverse, high = random.normal(size=(CHANNELS, DIMENSION)), random.normal(size=(PIXELS, DIMENSION))
    want = np.abs(high @ inverse.T - low).sum(1) + np.abs(low @ weights.T - high).sum(1)
    np.testing.assert_allclose(cycle(low, high, weights, inverse), want, rtol=1e-9)
    back = np.linalg.pinv(weights)
    np.testing.assert_allclose(cycle(low, low @ weights.T, weights, back), 0, atol=1e-9)
    along = random.normal(size=inverse.shape)
    ahead, behind = (
        np.asarray(cycle(low, high, weights, inverse + step * along)).mean() for step in (1e-7, -1e-7)
    )
    slope = np.asarray(slope_by_inverse(inverse, low, high, weights))
    np.testing.assert_allclose((slope * along).sum(), (ahead - behind) / 2e-7, rtol=1e-4, atol=1e-6)


@jax.jit
@jax.grad
def slope_by_inverse(inverse, low, high, weights):
    return cycle_error(low, high, weights, inverse).mean()
