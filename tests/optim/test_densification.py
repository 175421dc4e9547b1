"""Relocation keeps the image and fills only allowed slots; exploration noise spares opaque Gaussians."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsjax.optim.densification import (
    DEAD,
    EMPTY_LOGIT,
    exploration,
    is_alive,
    relocate,
    reset_rows,
    split_into_copies,
)
from gsjax.optim.step import per_field_adam
from gsjax.scene.gaussians import Gaussians


def some(opacities, seed=0) -> Gaussians:
    """Gaussians with these opacities at random positions."""
    random, count = np.random.default_rng(seed), len(opacities)
    opacities = jnp.asarray(opacities, jnp.float32)
    logits = jnp.where(opacities > 0, jnp.log(opacities) - jnp.log1p(-opacities), EMPTY_LOGIT)
    fields = {"means": 3, "quats": 4, "log_scales": 3}
    arrays = {
        name: jnp.asarray(random.normal(size=(count, size)), jnp.float32) for name, size in fields.items()
    }
    return Gaussians(
        **arrays, logit_opacities=logits, sh0=jnp.asarray(random.normal(size=(count, 1, 3)), jnp.float32)
    )


@pytest.mark.usefixtures("x64")
@given(st.floats(0.01, 0.999), st.integers(1, 20))
def test_copies_at_one_place_transmit_as_much_light_as_the_original(opacity, copies):
    """Eq. 8: the integrals of 1 - (1 - o' G(x / s'))^n and of o G(x) are equal."""
    each, factor = (float(a[0]) for a in split_into_copies(jnp.array([opacity]), jnp.array([copies])))
    x = np.linspace(-12, 12, 20_001)
    one = opacity * np.exp(-(x**2) / 2)
    together = 1 - (1 - each * np.exp(-((x / factor) ** 2) / 2)) ** copies
    if each > 1.01 * DEAD:  # lower opacities are clipped
        np.testing.assert_allclose(np.trapezoid(together, x), np.trapezoid(one, x), rtol=1e-4)
        np.testing.assert_allclose(1 - (1 - each) ** copies, opacity, rtol=1e-6)


@pytest.mark.parametrize("copies", [1, 2, 30, 51])
def test_single_precision_is_enough_for_many_copies(copies):
    opacities = jnp.array([0.01, 0.5, 0.99, 1.0])
    with jax.enable_x64(True):
        exact = split_into_copies(jnp.asarray(np.asarray(opacities), float), jnp.full(4, copies))
    for found, wanted in zip(split_into_copies(opacities, jnp.full(4, copies)), exact, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=2e-2)


def test_no_copy_starts_dead():
    """Neither before nor after its opacity is stored as a logit."""
    each, _ = split_into_copies(jnp.array([0.0051, 0.006, 0.009, 0.04]), jnp.array([1, 2, 3, 30]))
    assert (each > DEAD).all()
    assert is_alive(some(each)).all()


@pytest.mark.thorough
def test_dead_slots_become_copies_of_what_is_opaque_and_no_others_are_touched():
    gaussians = some([0.8, 0.0, 0.6, 0.002, 0.5, 0.0, 0.0])
    moved, touched = relocate(gaussians, jax.random.key(0), jnp.int32(6))
    assert np.asarray(is_alive(moved)).tolist() == [True] * 6 + [False]  # the seventh slot may not be filled
    assert np.asarray(touched)[[1, 3, 5]].all()
    assert not touched[6]
    alive = np.asarray(gaussians.means)[[0, 2, 4]]
    for slot in (1, 3, 5):
        source = np.flatnonzero((alive == np.asarray(moved.means)[slot]).all(1))
        assert len(source) == 1
        row = [0, 2, 4][source[0]]
        assert touched[row]
        assert moved.opacities[slot] == moved.opacities[row] < gaussians.opacities[row]
    for row in np.flatnonzero(~np.asarray(touched)):
        for before, after in zip(jax.tree.leaves(gaussians), jax.tree.leaves(moved), strict=True):
            np.testing.assert_array_equal(before[row], after[row])


def test_copies_are_drawn_in_proportion_to_opacity():
    gaussians = some([0.75, 0.25] + [0.0] * 2000)
    moved, _ = relocate(gaussians, jax.random.key(3), jnp.int32(2002))
    of_first = (np.asarray(moved.means)[2:] == np.asarray(gaussians.means)[0]).all(1).mean()
    assert abs(of_first - 0.75) < 0.04


@pytest.mark.parametrize("opacities", [[0.0, 0.001, 0.0], [0.9, 0.8, 0.7]])
def test_where_all_are_dead_or_none_is_nothing_moves(opacities):
    gaussians = some(opacities)
    moved, touched = relocate(gaussians, jax.random.key(0), jnp.int32(3))
    assert not touched.any()
    jax.tree.map(np.testing.assert_array_equal, moved, gaussians)


def test_only_the_given_rows_of_an_optimizer_are_reset():
    gaussians = some([0.5] * 4)
    optimizer = per_field_adam({"means": 0.1, "logit_opacities": 0.2})
    _, state = optimizer.update(jax.tree.map(jnp.ones_like, gaussians), optimizer.init(gaussians), gaussians)
    rows = jnp.array([False, True, False, True])
    after = reset_rows(state, rows)
    known = 0
    for old, new in zip(jax.tree.leaves(state), jax.tree.leaves(after), strict=True):
        if old.ndim == 0:
            assert old == new
            continue
        known += 1
        assert not new[rows].any()
        np.testing.assert_array_equal(old[~rows], new[~rows])
    assert known == 4  # two moments of two fields


@pytest.mark.thorough
def test_noise_is_as_wide_as_the_gaussian_and_spares_what_is_opaque():
    count = 4000
    gaussians = some([0.001] * count)
    gaussians = jax.tree.map(lambda a: jnp.broadcast_to(a[:1], a.shape), gaussians)
    walk = np.asarray(exploration(gaussians, jax.random.key(0), 2.0), np.float64)
    rotation = np.asarray(jax.vmap(lambda q: q)(gaussians.quats[:1]))[0]
    from scipy.spatial.transform import Rotation

    axes = Rotation.from_quat(rotation, scalar_first=True).as_matrix()
    covariance = axes @ np.diag(np.exp(2 * np.asarray(gaussians.log_scales[0], np.float64))) @ axes.T
    faint = 1 / (1 + np.exp(-100 * (0.005 - 0.001)))
    wanted = (2 * faint) ** 2 * covariance @ covariance
    np.testing.assert_allclose(np.cov(walk.T), wanted, atol=0.08 * np.abs(wanted).max())
    assert np.abs(exploration(some([0.9] * 5), jax.random.key(0), 1.0)).max() < 1e-30
