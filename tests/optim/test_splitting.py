"""Adaptive density control: Gaussians with large projected gradients multiply; unneeded ones are pruned."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.optim.densification import EMPTY_LOGIT, is_alive
from gsjax.optim.splitting import (
    RESET_OPACITY,
    SHRINK,
    Pull,
    accumulate_pull,
    densify,
    reset_opacities,
    strongly_pulled,
)
from gsjax.optim.step import gradient_step, per_field_adam
from gsjax.scene.gaussians import Gaussians, gaussians_from_activated


class Params(NamedTuple):
    a: jax.Array
    nudges: jax.Array


OPTIONS = {"threshold": 1.0, "large": 0.1, "too_large": 1.0}


def scene(scales, slots: int) -> Gaussians:
    """One Gaussian per scale, all with opacity 0.6, in a row; the other slots are empty."""
    count = len(scales)
    means = np.arange(slots)[:, None] * np.array([[1.0, 0.0, 0.0]])
    sizes = np.concatenate([scales, np.full(slots - count, 0.01)])
    quats = np.broadcast_to([1.0, 0, 0, 0], (slots, 4))
    opacities = np.where(np.arange(slots) < count, 0.6, 1e-6)
    colors = np.random.default_rng(0).uniform(size=(slots, 3))
    return gaussians_from_activated(means, quats, np.repeat(sizes[:, None], 3, axis=1), opacities, colors)


def pulled(*mean: float, slots: int) -> Pull:
    total = np.zeros(slots)
    total[: len(mean)] = 2 * np.asarray(mean)
    return Pull(jnp.asarray(total), jnp.full(slots, 2.0))


@pytest.mark.thorough
def test_a_small_one_is_cloned_and_a_large_one_split():
    before = scene([0.05, 0.5, 0.05], slots=6)
    after, touched = densify(before, pulled(2.0, 3.0, 0.5, slots=6), jax.random.key(0), 6, **OPTIONS)
    np.testing.assert_array_equal(is_alive(after), [True] * 5 + [False])
    # Gaussian 1 has the largest gradient and takes the first vacant slot, 3; Gaussian 0 takes slot 4.
    np.testing.assert_array_equal(touched, [False, True, False, True, True, False])
    for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(before), strict=True):
        np.testing.assert_array_equal(a[jnp.array([0, 2, 4])], b[jnp.array([0, 2, 0])])
    np.testing.assert_allclose(after.scales[jnp.array([1, 3])], 0.5 / SHRINK, rtol=1e-5)
    away = np.linalg.norm(after.means[jnp.array([1, 3])] - before.means[1], axis=1)
    assert (away > 0).all()
    assert away[0] != away[1]


def test_halves_are_sampled_from_the_original():
    slots = 4000
    before = scene([0.5] * (slots // 2), slots)
    after, _ = densify(
        before, pulled(*[2.0] * (slots // 2), slots=slots), jax.random.key(1), slots, **OPTIONS
    )
    origin = np.concatenate([before.means[: slots // 2]] * 2)
    away = np.asarray(after.means) - origin
    np.testing.assert_allclose(away.std(0), 0.5, rtol=0.05)
    np.testing.assert_allclose(away.mean(0), 0.0, atol=0.05)


def test_pruned_gaussians_vacate_slots_that_are_filled_at_once():
    before = scene([0.05, 2.0, 0.05], slots=3)
    after, touched = densify(before, pulled(2.0, 9.0, slots=3), jax.random.key(0), 3, **OPTIONS)
    np.testing.assert_array_equal(touched, [False, True, False])
    np.testing.assert_array_equal(after.means[1], before.means[0])
    unpulled, _ = densify(before, pulled(slots=3), jax.random.key(0), 3, **OPTIONS)
    np.testing.assert_array_equal(is_alive(unpulled), [True, False, True])
    assert float(unpulled.logit_opacities[1]) == EMPTY_LOGIT


@pytest.mark.parametrize(("slots", "filled"), [(3, []), (4, [2]), (5, [2, 1]), (6, [2, 1, 0])])
def test_where_slots_are_few_the_hardest_pulled_come_first(slots, filled):
    before = scene([0.05] * 3, slots=6)
    after, touched = densify(before, pulled(2.0, 3.0, 4.0, slots=6), jax.random.key(0), slots, **OPTIONS)
    assert int(touched.sum()) == len(filled)
    for place, source in enumerate(filled, start=3):
        np.testing.assert_array_equal(after.means[place], before.means[source])


def test_pull_is_the_mean_over_the_steps_that_pulled_and_moves_nothing():
    def loss(params, batch, *, step, key):
        weights = jnp.array([[3.0, 4.0], [0.0, 0.0], [0.0, 1.0]]) * batch
        return (params["nudges"][0] * weights).sum() + params["a"], {}

    params = Params(a=jnp.asarray(1.0), nudges=jnp.zeros((1, 3, 2)))
    step = gradient_step(
        lambda p, b, **options: loss(p._asdict(), b, **options),
        per_field_adam({"a": 0.1}, others={"nudges": accumulate_pull()}),
    )
    state = step.init(params)
    for scale in (1.0, 3.0):
        params, state, _ = step.update(params, state, scale, step=0, key=None)
    (pull,) = (
        leaf
        for leaf in jax.tree.leaves(state, is_leaf=lambda n: isinstance(n, Pull))
        if isinstance(leaf, Pull)
    )
    np.testing.assert_allclose(pull.mean, [10.0, 0.0, 2.0])
    np.testing.assert_array_equal(params.nudges, 0.0)
    assert float(params.a) < 1.0
    alive = scene([0.05] * 3, slots=3)
    np.testing.assert_array_equal(strongly_pulled(alive, pull, 5.0), [True, False, False])


def test_a_reset_lowers_opacities_and_raises_none():
    before = scene([0.05] * 2, slots=3)
    after = reset_opacities(before)
    np.testing.assert_allclose(after.opacities, [RESET_OPACITY, RESET_OPACITY, 1e-6], rtol=1e-4)
