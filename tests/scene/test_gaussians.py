"""The Gaussians pytree: activation and its inverse, wrong shapes, and joining, taking and culling rows."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.geometry.spherical_harmonics import evaluate_sh
from gsjax.scene.gaussians import Gaussians, Tags, concatenate, cull_invalid, gaussians_from_activated, take


def activated(count=5, seed=0):
    rng = np.random.default_rng(seed)
    return {
        "means": rng.normal(size=(count, 3)),
        "quats": rng.normal(size=(count, 4)),
        "scales": rng.uniform(0.01, 1.0, (count, 3)),
        "opacities": rng.uniform(0.1, 0.9, count),
        "colors": rng.uniform(0, 1, (count, 3)),
    }


def test_activation_inverts_the_constructor():
    values = activated()
    gaussians = gaussians_from_activated(**values)
    np.testing.assert_allclose(gaussians.scales, values["scales"], rtol=1e-5)
    np.testing.assert_allclose(gaussians.opacities, values["opacities"], rtol=1e-5)
    colors = evaluate_sh(0, gaussians.sh, jnp.ones((5, 3)))
    np.testing.assert_allclose(colors, values["colors"], atol=1e-6)
    assert (gaussians.num, gaussians.sh_degree, gaussians.sh.shape) == (5, 0, (5, 1, 3))


def test_extreme_activated_values_stay_finite():
    values = activated(2) | {"scales": np.zeros((2, 3)), "opacities": np.array([0.0, 1.0])}
    gaussians = gaussians_from_activated(**values)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gaussians))


@pytest.mark.parametrize("dtype", [jnp.bfloat16, jnp.float16])
def test_extreme_activated_values_stay_finite_in_half_precision(dtype):
    """Where 1 - 1e-6 is 1, and 1e-12 may be 0."""
    values = activated() | {"scales": np.zeros((5, 3)), "opacities": np.array([0.0, 0.3, 0.6, 0.9999, 1.0])}
    gaussians = gaussians_from_activated(**values, dtype=dtype)
    assert {leaf.dtype for leaf in jax.tree.leaves(gaussians)} == {jnp.dtype(dtype)}
    assert cull_invalid(gaussians)[1] == 0
    full = gaussians_from_activated(**values)
    for found, wanted in zip(jax.tree.leaves(gaussians), jax.tree.leaves(full), strict=True):
        np.testing.assert_array_equal(found, np.asarray(wanted).astype(dtype))


@pytest.mark.usefixtures("x64")
def test_activated_values_stay_in_double_precision():
    values = activated()
    np.testing.assert_allclose(
        gaussians_from_activated(**values, dtype=float).scales, values["scales"], rtol=1e-14
    )


@pytest.mark.parametrize(("degree", "rest"), [(1, 3), (2, 8), (3, 15)])
def test_sh_joins_its_two_fields(degree, rest):
    gaussians = gaussians_from_activated(**activated(), shN=np.full((5, rest, 3), 2.0))
    assert gaussians.sh_degree == degree
    np.testing.assert_array_equal(gaussians.sh[:, :1], gaussians.sh0)
    np.testing.assert_array_equal(gaussians.sh[:, 1:], gaussians.shN)


def test_absent_fields_are_no_leaves_and_grad_takes_the_whole():
    gaussians = gaussians_from_activated(**activated())
    assert len(jax.tree.leaves(gaussians)) == 5
    gradient = jax.jit(jax.grad(lambda g: jnp.sum(g.scales) + jnp.sum(g.opacities)))(gaussians)
    np.testing.assert_allclose(gradient.log_scales, gaussians.scales, rtol=1e-6)
    assert gradient.shN is None


@pytest.mark.parametrize(
    ("name", "shape", "wanted"),
    [
        ("means", (5, 2), r"\[5, 3\]"),
        ("quats", (4, 4), r"\[5, 4\]"),
        ("scales", (5,), r"\[5, 3\]"),
        ("opacities", (5, 1), r"\[5\]"),
        ("colors", (5, 4), r"\[5, 3\]"),
    ],
)
def test_the_constructor_names_the_argument_that_does_not_fit(name, shape, wanted):
    with pytest.raises(ValueError, match=rf"{name}: expected shape {wanted}"):
        gaussians_from_activated(**activated() | {name: np.ones(shape)})


@pytest.mark.usefixtures("as_users_run")
@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("means", jnp.ones(3), r"Gaussians.means: expected shape \[3, 3\].*, found \(3,\)"),
        ("sh0", jnp.ones((5, 3)), r"Gaussians.sh0: expected shape \[5, 1, 3\].*, found \(5, 3\)"),
        ("shN", jnp.ones((5, 4, 3)), r"Gaussians.shN: expected shape .*degree 1, 2 or 3.*found"),
        ("features", jnp.ones((4, 7)), r"Gaussians.features: expected shape \[5, any\].*, found \(4, 7\)"),
        ("logit_opacities", jnp.ones(5, int), r"expected floats .*, found dtype int32"),
    ],
)
def test_the_class_names_the_field_that_does_not_fit(name, value, message):
    gaussians = gaussians_from_activated(**activated())
    fields = {
        key: getattr(gaussians, key) for key in ("means", "quats", "log_scales", "logit_opacities", "sh0")
    }
    with pytest.raises(ValueError, match=message):
        Gaussians(**fields | {name: value})


def test_transformations_may_add_axes():
    gaussians = gaussians_from_activated(**activated())
    stacked = jax.vmap(lambda shift: eqx.tree_at(lambda g: g.means, gaussians, gaussians.means + shift))(
        jnp.arange(3.0)
    )
    assert stacked.means.shape == (3, 5, 3)


def test_concatenate_pads_missing_harmonics_with_zeros():
    flat = gaussians_from_activated(**activated(2))
    rich = gaussians_from_activated(**activated(3), shN=np.ones((3, 8, 3)))
    joined = concatenate([flat, rich])
    assert (joined.num, joined.sh_degree) == (5, 2)
    np.testing.assert_array_equal(joined.shN[:2], 0.0)
    np.testing.assert_array_equal(joined.shN[2:], 1.0)
    np.testing.assert_array_equal(joined.means, np.concatenate([flat.means, rich.means]))


def test_concatenate_refuses_nothing_and_mixed_features():
    plain = gaussians_from_activated(**activated(2))
    featured = gaussians_from_activated(**activated(2), features=np.ones((2, 4)))
    with pytest.raises(ValueError, match="no parts"):
        concatenate([])
    with pytest.raises(ValueError, match="features must have one size"):
        concatenate([plain, featured])


def test_take_by_index_and_by_mask():
    gaussians = gaussians_from_activated(**activated())
    tags = Tags(labels=jnp.arange(5))
    np.testing.assert_array_equal(take(gaussians, np.array([3, 1])).means, gaussians.means[jnp.array([3, 1])])
    chosen = take(tags, np.array([True, False, True, False, False]))
    np.testing.assert_array_equal(chosen.labels, [0, 2])
    assert chosen.alive is None
    assert take(Tags(), np.arange(0)).labels is None
    for wrong, says in (
        (np.array([True, False]), r"a mask of shape \(5,\), found \(2,\)"),
        (np.array([0, 5]), "rows below 5, found 5"),
        (np.array([-6, 1]), "rows below 5, found -6"),
        (np.array([-5, 5]), "rows below 5, found 5"),
    ):
        with pytest.raises(ValueError, match=says):
            take(gaussians, wrong)


@pytest.mark.usefixtures("as_users_run")
def test_an_empty_list_takes_nothing():
    assert len(take(Tags(labels=jnp.arange(5)), []).labels) == 0


def test_colors_may_be_whole_numbers_and_traced():
    values = activated()
    values["colors"] = np.eye(5, 3, dtype=int)
    expected = gaussians_from_activated(**values).sh0
    traced = jax.jit(lambda colors: gaussians_from_activated(**values | {"colors": colors}).sh0)
    np.testing.assert_allclose(traced(jnp.asarray(values["colors"], jnp.float32)), expected, atol=1e-6)


def test_colors_in_bytes_are_refused():
    with pytest.raises(ValueError, match="colors: expected RGB from 0 to 1, found uint8; divide by 255"):
        gaussians_from_activated(**activated() | {"colors": np.full((5, 3), 255, np.uint8)})


@pytest.mark.parametrize("poison", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(
    "field", ["means", "quats", "log_scales", "logit_opacities", "sh0", "shN", "features"]
)
def test_cull_invalid_removes_poisoned_rows_and_no_other(field, poison):
    gaussians = gaussians_from_activated(**activated(), shN=np.ones((5, 3, 3)), features=np.ones((5, 2)))
    value = getattr(gaussians, field)
    poisoned = eqx.tree_at(
        lambda g: getattr(g, field), gaussians, value.at[(2,) + (0,) * (value.ndim - 1)].set(poison)
    )
    clean, removed = cull_invalid(poisoned)
    assert removed == 1
    expected = take(gaussians, np.array([0, 1, 3, 4]))
    assert eqx.tree_equal(clean, expected)


def test_cull_invalid_removes_quaternions_of_no_length_only():
    gaussians = gaussians_from_activated(**activated(4))
    quats = jnp.array([[0.0, 0, 0, 0], [1e-7, 0, 0, 0], [2e-6, 0, 0, 0], [1e30, 0, 0, 0]])
    clean, removed = cull_invalid(eqx.tree_at(lambda g: g.quats, gaussians, quats))
    assert removed == 2
    np.testing.assert_array_equal(clean.quats, quats[2:])


def test_cull_invalid_leaves_a_sound_or_empty_scene_alone():
    for count in (0, 3):
        gaussians = gaussians_from_activated(**activated(count))
        clean, removed = cull_invalid(gaussians)
        assert removed == 0
        assert clean.num == count
