"""Deformation: both papers' formulas, what stays unchanged, and evaluation at selected rows or nodes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from gsjax.geometry.rotations import quats_to_matrices
from gsjax.scene.deformation import (
    DeformationConfig,
    Nodes,
    Offsets,
    deform,
    deform_by_nodes,
    deform_rows,
    init_deformation,
)
from gsjax.scene.gaussians import Gaussians

BOX = np.array([[-3.0, -3.0, -3.0], [3.0, 3.0, 3.0]])
SMALL = {"resolution": 4, "time_resolution": 3, "levels": 1, "channels": 2, "hidden": 4, "frequencies": 2}
TIME = 0.3


def scene(seed=0, num=6, features=None):
    rng = np.random.default_rng(seed)
    shapes = ((num, 3), (num, 4), (num, 3), (num,), (num, 1, 3))
    fields = [jnp.asarray(rng.normal(size=shape)) for shape in shapes]
    return Gaussians(
        *fields, features=None if features is None else jnp.asarray(rng.normal(size=(num, features)))
    )


def moving(field, seed=1):
    """The field with a random last layer, so that its gradients reach everything."""
    rng = np.random.default_rng(seed)
    last = jax.tree.map(
        lambda leaf: jnp.asarray(0.3 * rng.normal(size=leaf.shape), leaf.dtype), field.layers[-1]
    )
    return eqx.tree_at(lambda f: f.layers[-1], field, last)


@pytest.mark.usefixtures("x64")
class TestDeform:
    @given(seed=st.integers(0, 1000))
    def test_axis_and_angle_turn_before_the_rotation(self, seed):
        gaussians, rng = scene(seed), np.random.default_rng(seed)
        offsets = Offsets(*(jnp.asarray(rng.normal(size=(6, 3))) for _ in range(3)))
        found = deform(gaussians, offsets)
        turns = Rotation.from_rotvec(np.array(offsets.turns)).as_matrix()
        before = np.asarray(quats_to_matrices(gaussians.quats))
        np.testing.assert_allclose(quats_to_matrices(found.quats), turns @ before, atol=1e-9)
        np.testing.assert_allclose(found.means, gaussians.means + offsets.means)
        np.testing.assert_allclose(found.scales, gaussians.scales * np.exp(offsets.log_scales))

    def test_differences_of_quaternions(self):
        gaussians, step = scene(), jnp.asarray(np.random.default_rng(2).normal(size=(6, 4)))
        found = deform(gaussians, Offsets(jnp.zeros((6, 3)), step, jnp.zeros((6, 3))))
        unit = gaussians.quats / jnp.linalg.norm(gaussians.quats, axis=1, keepdims=True)
        expected = (unit + step) / jnp.linalg.norm(unit + step, axis=1, keepdims=True)
        np.testing.assert_allclose(found.quats, expected, atol=1e-12)

    def test_a_quaternion_that_is_cancelled_stays_a_rotation(self):
        gaussians = eqx.tree_at(lambda g: g.quats, scene(), jnp.tile(jnp.array([1.0, 0, 0, 0]), (6, 1)))
        found = deform(gaussians, Offsets(jnp.zeros((6, 3)), -gaussians.quats, jnp.zeros((6, 3))))
        assert jnp.isfinite(found.quats).all()
        np.testing.assert_allclose(jnp.linalg.norm(found.quats, axis=1), 1.0)

    def test_fields_without_offsets_are_unchanged(self):
        gaussians = scene(features=2)
        found = deform(gaussians, Offsets(*(jnp.ones((6, 3)),) * 3))
        for name in ("logit_opacities", "sh0", "features"):
            assert getattr(found, name) is getattr(gaussians, name)
        assert found.shN is None


@pytest.mark.parametrize("kind", ["hexplane", "mlp", "voxels"])
class TestField:
    def config(self, kind, **options):
        return DeformationConfig(kind=kind, **SMALL | options)

    def test_at_first_nothing_moves(self, kind):
        gaussians = jax.tree.map(lambda a: a.astype(jnp.float32), scene(features=2))
        config = self.config(kind, semantic=True, color=True, opacity=True, feature=True)
        found = deform_rows(gaussians, init_deformation(jax.random.key(0), config, BOX, 2), jnp.asarray(TIME))
        for name in ("logit_opacities", "sh0", "features"):
            np.testing.assert_array_equal(getattr(found, name), getattr(gaussians, name))
        np.testing.assert_array_equal(found.means, gaussians.means)
        np.testing.assert_array_equal(found.log_scales, gaussians.log_scales)
        np.testing.assert_allclose(
            quats_to_matrices(found.quats), quats_to_matrices(gaussians.quats), atol=1e-6
        )

    @pytest.mark.usefixtures("x64")
    def test_slopes(self, kind):
        gaussians = scene(features=2)
        config = self.config(kind, semantic=True, color=True, opacity=True, feature=True)
        field = moving(init_deformation(jax.random.key(0), config, BOX, 2))
        field = jax.tree.map(lambda a: a.astype(jnp.float64), field)
        # The network's ReLU has no derivative at its kink; these values are away from it.
        check_grads(
            jax.jit(lambda f, g, t: jax.tree.leaves(deform_rows(g, f, t))),
            (field, gaussians, jnp.asarray(TIME)),
            order=1,
            rtol=1e-4,
            atol=1e-6,
        )

    def test_units_of_length_do_not_matter(self, kind):
        """A scene in millimetres moves by a thousand times as many units."""
        gaussians = jax.tree.map(lambda a: a.astype(jnp.float32), scene())
        field = moving(init_deformation(jax.random.key(0), self.config(kind), BOX))
        larger = moving(init_deformation(jax.random.key(0), self.config(kind), 1000 * BOX))
        few = field(gaussians.means, jnp.asarray(TIME)).means
        many = larger(1000 * gaussians.means, jnp.asarray(TIME)).means
        np.testing.assert_allclose(many, 1000 * few, rtol=1e-3, atol=1e-2)

    def test_some_rows(self, kind):
        gaussians = jax.tree.map(lambda a: a.astype(jnp.float32), scene())
        field = moving(init_deformation(jax.random.key(0), self.config(kind), BOX))
        whole = deform_rows(gaussians, field, jnp.asarray(TIME))
        rows = jnp.array([4, 1, gaussians.num, gaussians.num])  # the last two pad the list
        some = deform_rows(gaussians, field, jnp.asarray(TIME), rows)
        np.testing.assert_allclose(some.means[rows[:2]], whole.means[rows[:2]], atol=1e-6)
        still = np.array([0, 2, 3, 5])
        np.testing.assert_array_equal(some.means[still], gaussians.means[still])
        np.testing.assert_array_equal(some.quats[still], gaussians.quats[still])

    def test_nodes_at_every_gaussian_are_the_gaussians(self, kind):
        gaussians = jax.tree.map(lambda a: a.astype(jnp.float32), scene(features=2))
        config = self.config(kind, color=True, opacity=True, feature=True)
        field = moving(init_deformation(jax.random.key(0), config, BOX, 2))
        each = Nodes(jnp.arange(6), jnp.arange(6)[:, None], jnp.ones((6, 1)))
        whole, by_nodes = (
            deform_rows(gaussians, field, jnp.asarray(TIME)),
            deform_by_nodes(gaussians, field, jnp.asarray(TIME), each),
        )
        for one, other in zip(jax.tree.leaves(whole), jax.tree.leaves(by_nodes), strict=True):
            np.testing.assert_allclose(one, other, atol=1e-5)


def test_a_position_that_is_not_a_number_leaves_the_gradients_of_others():
    gaussians = jax.tree.map(lambda a: a.astype(jnp.float32), scene())
    broken = eqx.tree_at(lambda g: g.means, gaussians, gaussians.means.at[2].set(jnp.nan))
    field = moving(init_deformation(jax.random.key(0), DeformationConfig(**SMALL), BOX))

    def height(field):
        return jnp.nansum(deform_rows(broken, field, jnp.asarray(TIME)).means)

    assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(jax.jit(jax.grad(height))(field)))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"resolution": 1}, "resolution: expected at least 2, found 1"),
        ({"hidden": 0}, "hidden: expected at least 1"),
    ],
)
def test_sizes_are_checked(options, words):
    with pytest.raises(ValueError, match=words):
        DeformationConfig(**options)


def test_a_field_of_features_needs_them():
    config = DeformationConfig(**SMALL, semantic=True)
    with pytest.raises(ValueError, match="feature_size"):
        init_deformation(jax.random.key(0), config, BOX)
    field = init_deformation(jax.random.key(0), config, BOX, 2)
    with pytest.raises(ValueError, match="features: expected an array, as this field"):
        field(jnp.zeros((1, 3)), jnp.asarray(0.0))
    with pytest.raises(ValueError, match="bounds"):
        init_deformation(jax.random.key(0), DeformationConfig(**SMALL), np.array([[0, 0, 0], [1, 0, 1]]))
