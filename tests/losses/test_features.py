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
        "ids": random.integers(0, KINDS, PIXELS),
    }


def arrays(case):
    return {name: jnp.asarray(a, jnp.int32 if name == "ids" else None) for name, a in case.items()}


@pytest.mark.usefixtures("x64")
@given(st.integers(0, 1000))
def test_rec_and_cos_equal_their_definitions_in_the_teachers_channels(seed):
    inputs = case(seed)
    given_ = arrays(inputs)
    like = likeness(given_["rendered"], given_["weights"], given_["codebook"], given_["ids"])
    lifted, target = inputs["rendered"] @ inputs["weights"].T, inputs["codebook"][inputs["ids"]]
    rec = ((lifted - inputs["alphas"][:, None] * target) ** 2).mean(1)
    cos = 1 - (lifted * target).sum(1) / np.linalg.norm(lifted, axis=1) / np.linalg.norm(target, axis=1)
    np.testing.assert_allclose(feature_error(like, given_["alphas"], DIMENSION), rec, rtol=1e-9)
    np.testing.assert_allclose(cosine_error(like), cos, rtol=1e-9)
    of_map = likeness_to_map(given_["rendered"], given_["weights"], jnp.asarray(target))
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
    features, ids = random.normal(size=(9, 3)), random.integers(-1, 3, 9)
    got = contrastive_loss(jnp.asarray(features), jnp.asarray(ids, jnp.int32), gamma)
    np.testing.assert_allclose(got, contrast_by_hand(features, ids, gamma), rtol=1e-9, atol=1e-12)


def test_the_contrastive_loss_ignores_single_pixels_and_pixels_without_an_id():
    features = jnp.asarray(np.random.default_rng(0).normal(size=(4, 3)), jnp.float32)
    for ids in ([0, 1, 2, 3], [-1, -1, -1, -1], [0, -1, -1, 1]):
        value, slope = jax.jit(jax.value_and_grad(contrastive_loss))(features, jnp.array(ids))
        assert value == 0
        np.testing.assert_array_equal(slope, 0)
    # A single id has no loss, wherever its features lie.
    np.testing.assert_allclose(contrastive_loss(features, jnp.zeros(4, jnp.int32)), 0, atol=1e-6)


def test_the_contrastive_loss_is_finite_if_its_kernel_underflows_or_features_are_equal():
    far = 500.0 + 30 * jnp.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    ids = jnp.array([0, 1, 0, 1])
    value, slope = jax.jit(jax.value_and_grad(contrastive_loss))(far, ids)
    # Two others are equally near, one with the same id.
    np.testing.assert_allclose(value, np.log(2), rtol=1e-3)
    assert np.isfinite(slope).all()
    value, slope = jax.jit(jax.value_and_grad(contrastive_loss))(jnp.ones((4, 2)), ids)
    np.testing.assert_allclose(value, np.log(3), rtol=1e-6)
    assert np.isfinite(slope).all()


def test_zero_features_have_no_gradient_and_no_nan():
    inputs = arrays(case(0))
    inputs["rendered"] = inputs["rendered"].at[0].set(0.0)
    inputs["codebook"] = inputs["codebook"].at[2].set(0.0)

    def value(rendered):
        return cosine_error(likeness(rendered, inputs["weights"], inputs["codebook"], inputs["ids"])).sum()

    slope = jax.jit(jax.grad(value))(inputs["rendered"])
    assert np.isfinite(slope).all()
    np.testing.assert_array_equal(slope[0], 0)
    np.testing.assert_array_equal(slope[np.asarray(inputs["ids"]) == 2], 0)


def whole(inputs):
    """The sum of all losses."""
    like = likeness(inputs["rendered"], inputs["weights"], inputs["codebook"], inputs["ids"])
    image = inputs["rendered"].reshape(3, 4, CHANNELS)
    value = (feature_error(like, inputs["alphas"], DIMENSION) + cosine_error(like)).sum()
    value += contrastive_loss(inputs["rendered"], inputs["ids"])
    return value + total_variation(image) + (max_pooled(image, 2) ** 2).sum()


@pytest.mark.usefixtures("x64")
def test_slopes_are_those_of_central_differences_and_jvp_agrees_with_vjp():
    inputs = arrays(case(1))
    floats = {name: inputs[name] for name in ("rendered", "weights", "codebook", "alphas")}

    def value(floats):
        return whole(inputs | floats)

    slopes = jax.jit(jax.grad(value))(floats)
    random = np.random.default_rng(2)
    for name, slope in slopes.items():
        along = {k: jnp.zeros_like(a) for k, a in floats.items()}
        along[name] = jnp.asarray(random.normal(size=slope.shape))
        ahead, behind = (
            value(jax.tree.map(lambda a, d, step=step: a + step * d, floats, along)) for step in (1e-6, -1e-6)
        )
        np.testing.assert_allclose((slope * along[name]).sum(), (ahead - behind) / 2e-6, rtol=2e-6)
        np.testing.assert_allclose(
            jax.jvp(value, (floats,), (along,))[1], (slope * along[name]).sum(), rtol=1e-9
        )


def test_float32_is_near_to_float64():
    inputs = case(3)
    single = whole(arrays({k: np.float32(a) if k != "ids" else a for k, a in inputs.items()}))
    with jax.enable_x64(True):
        double = whole(arrays(inputs))
    np.testing.assert_allclose(single, double, rtol=1e-5)


def test_a_batch_is_a_loop():
    many = [arrays(case(i)) for i in range(3)]
    stacked = jax.tree.map(lambda *a: jnp.stack(a), *many)
    np.testing.assert_allclose(jax.vmap(whole)(stacked), [whole(one) for one in many], rtol=1e-5)


def test_pooling_takes_whole_windows_and_keeps_ids_of_uniform_ones():
    image = jnp.arange(5 * 7).reshape(5, 7, 1).astype(float)
    np.testing.assert_array_equal(max_pooled(image, 2)[..., 0], [[8, 10, 12], [22, 24, 26]])
    ids = jnp.array([[1, 1, 2, 0], [1, 1, 0, 2], [-1, -1, 3, -1], [-1, -1, 3, 3]])
    np.testing.assert_array_equal(pooled_ids(ids, 2), [[1, -1], [-1, -1]])


def test_strips_of_total_variation_add_up():
    image = jnp.asarray(np.random.default_rng(0).normal(size=(9, 6, 2)), jnp.float32)
    by_hand = np.abs(np.diff(image, axis=0)).sum() + np.abs(np.diff(image, axis=1)).sum()
    np.testing.assert_allclose(total_variation(image), by_hand, rtol=1e-6)
    lower = jnp.concatenate([image[4:], jnp.full((2, 6, 2), 7.0)])  # with rows outside the image
    inside = jnp.arange(7) < 5
    parts = total_variation(image[:4]) + total_variation(lower, image[3], inside)
    np.testing.assert_allclose(parts, by_hand, rtol=1e-6)


@pytest.mark.usefixtures("x64")
@given(st.integers(0, 1000))
def test_the_cycle_error_covers_both_ways_and_vanishes_for_an_inverse(seed):
    random = np.random.default_rng(seed)
    low, weights = random.normal(size=(PIXELS, CHANNELS)), random.normal(size=(DIMENSION, CHANNELS))
    inverse, high = random.normal(size=(CHANNELS, DIMENSION)), random.normal(size=(PIXELS, DIMENSION))
    want = np.abs(high @ inverse.T - low).sum(1) + np.abs(low @ weights.T - high).sum(1)
    given_ = [jnp.asarray(a) for a in (low, high, weights, inverse)]
    np.testing.assert_allclose(cycle_error(*given_), want, rtol=1e-9)
    back = jnp.asarray(np.linalg.pinv(weights))
    np.testing.assert_allclose(cycle_error(given_[0], given_[0] @ given_[2].T, given_[2], back), 0, atol=1e-9)
    along = jnp.asarray(random.normal(size=inverse.shape))

    def loss(inverse):
        return cycle_error(*given_[:3], inverse).mean()

    step = 1e-7 * along
    numeric = (loss(given_[3] + step) - loss(given_[3] - step)) / 2e-7
    np.testing.assert_allclose(
        (jax.jit(jax.grad(loss))(given_[3]) * along).sum(), numeric, rtol=1e-4, atol=1e-6
    )
