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


offsets_at = jax.jit(lambda field, *arguments: field(*arguments))
deformed = jax.jit(deform)
deformed_rows = jax.jit(deform_rows)
matrices = jax.jit(quats_to_matrices)


def initial(config, bounds=BOX, features=0):
    return jax.jit(lambda key: init_deformation(key, config, bounds, features))(jax.random.key(0))


def moving(field, seed=1):
    """The field with a random last layer, so that gradients reach all its parameters."""
    rng = np.random.default_rng(seed)
    last = jax.tree.map(
        lambda leaf: jnp.asarray((0.3 * rng.normal(size=leaf.shape)).astype(leaf.dtype)), field.layers[-1]
    )
    return eqx.tree_at(lambda f: f.layers[-1], field, last)


@pytest.mark.usefixtures("x64")
class TestDeform:
    @given(seed=st.integers(0, 1000))
    def test_axis_and_angle_turn_before_the_rotation(self, seed):
        gaussians, rng = scene(seed), np.random.default_rng(seed)
        offsets = Offsets(*(jnp.asarray(rng.normal(size=(6, 3))) for _ in range(3)))
        found = deformed(gaussians, offsets)
        turns = Rotation.from_rotvec(np.array(offsets.turns)).as_matrix()
        before = np.asarray(matrices(gaussians.quats))
        np.testing.assert_allclose(matrices(found.quats), turns @ before, atol=1e-9)
        gaussians, offsets = jax.device_get((gaussians, offsets))
        np.testing.assert_allclose(found.means, gaussians.means + offsets.means)
        np.testing.assert_allclose(found.scales, gaussians.scales * np.exp(offsets.log_scales))

    def test_differences_of_quaternions(self):
        gaussians, step = scene(), np.random.default_rng(2).normal(size=(6, 4))
        found = deformed(gaussians, Offsets(np.zeros((6, 3)), step, np.zeros((6, 3))))
        quats = np.asarray(gaussians.quats)
        unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
        expected = (unit + step) / np.linalg.norm(unit + step, axis=1, keepdims=True)
        np.testing.assert_allclose(found.quats, expected, atol=1e-12)

    def test_a_quaternion_that_is_cancelled_stays_a_rotation(self):
        quats = np.tile([1.0, 0, 0, 0], (6, 1))
        gaussians = eqx.tree_at(lambda g: g.quats, scene(), quats)
        found = deformed(gaussians, Offsets(np.zeros((6, 3)), -quats, np.zeros((6, 3))))
        assert np.isfinite(found.quats).all()
        np.testing.assert_allclose(np.linalg.norm(found.quats, axis=1), 1.0)

    def test_fields_without_offsets_are_unchanged(self):
        gaussians = scene(features=2)

        @jax.jit
        def found(offsets):
            found = deform(gaussians, offsets)
            for name in ("logit_opacities", "sh0", "features"):
                assert getattr(found, name) is getattr(gaussians, name)
            return found

        assert found(Offsets(*(np.ones((6, 3)),) * 3)).shN is None


@pytest.mark.parametrize("kind", ["hexplane", "mlp", "voxels"])
class TestField:
    def config(self, kind, **options):
        return DeformationConfig(kind=kind, **SMALL | options)

    def test_at_first_nothing_moves(self, kind):
        gaussians = scene(features=2)
        config = self.config(kind, semantic=True, color=True, opacity=True, feature=True)
        found = deformed_rows(gaussians, initial(config, features=2), TIME)
        for name in ("logit_opacities", "sh0", "features"):
            np.testing.assert_array_equal(getattr(found, name), getattr(gaussians, name))
        np.testing.assert_array_equal(found.means, gaussians.means)
        np.testing.assert_array_equal(found.log_scales, gaussians.log_scales)
        np.testing.assert_allclose(matrices(found.quats), matrices(gaussians.quats), atol=1e-6)

    @pytest.mark.thorough
    @pytest.mark.usefixtures("x64")
    def test_slopes(self, kind):
        gaussians = scene(features=2)
        config = self.config(kind, semantic=True, color=True, opacity=True, feature=True)
        field = moving(initial(config, features=2))
        field = jax.tree.map(lambda a: np.asarray(a, np.float64), field)
        # The network's ReLU has no derivative at its kink; these values are away from it.
        check_grads(
            jax.jit(lambda f, g, t: jax.tree.leaves(deform_rows(g, f, t))),
            (field, gaussians, np.asarray(TIME)),
            order=1,
            rtol=1e-4,
            atol=1e-6,
        )

    def test_units_of_length_do_not_matter(self, kind):
        """A scene in millimetres moves by a thousand times as many units."""
        means = np.asarray(scene().means)
        field = moving(initial(self.config(kind)))
        larger = moving(initial(self.config(kind), 1000 * BOX))
        few, many = (offsets_at(f, m, TIME).means for f, m in ((field, means), (larger, 1000 * means)))
        np.testing.assert_allclose(many, 1000 * np.asarray(few), rtol=1e-3, atol=1e-2)

    def test_some_rows(self, kind):
        gaussians = scene()
        field = moving(initial(self.config(kind)))
        rows = np.array([4, 1, gaussians.num, gaussians.num])  # the last two pad the list
        whole, some = (jax.device_get(deformed_rows(gaussians, field, TIME, r)) for r in (None, rows))
        gaussians = jax.device_get(gaussians)
        np.testing.assert_allclose(some.means[rows[:2]], whole.means[rows[:2]], atol=1e-6)
        still = np.array([0, 2, 3, 5])
        np.testing.assert_array_equal(some.means[still], gaussians.means[still])
        np.testing.assert_array_equal(some.quats[still], gaussians.quats[still])

    @pytest.mark.thorough
    def test_nodes_at_every_gaussian_are_the_gaussians(self, kind):
        gaussians = scene(features=2)
        config = self.config(kind, color=True, opacity=True, feature=True)
        field = moving(initial(config, features=2))
        each = Nodes(np.arange(6), np.arange(6)[:, None], np.ones((6, 1)))
        whole = deformed_rows(gaussians, field, TIME)
        by_nodes = jax.jit(deform_by_nodes)(gaussians, field, TIME, each)
        for one, other in zip(jax.tree.leaves(whole), jax.tree.leaves(by_nodes), strict=True):
            np.testing.assert_allclose(one, other, atol=1e-5)


def test_a_position_that_is_not_a_number_leaves_the_gradients_of_others():
    gaussians = scene()
    means = np.array(gaussians.means)
    means[2] = np.nan
    broken = eqx.tree_at(lambda g: g.means, gaussians, jnp.asarray(means))
    field = moving(initial(DeformationConfig(**SMALL)))

    def height(field):
        return jnp.nansum(deform_rows(broken, field, jnp.asarray(TIME)).means)

    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(jax.jit(jax.grad(height))(field)))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"resolution": 1}, "resolution: expected at least 2, found 1"),
        ({"hidden": 0}, "hidden: expected at least 1"),
        ({"kind": "voxels", "resolution": 256}, "resolution: expected at most 255 with voxels, found 256"),
    ],
)
def test_sizes_are_checked(options, words):
    with pytest.raises(ValueError, match=words):
        DeformationConfig(**options)


@pytest.mark.thorough
def test_a_field_of_features_needs_them():
    config = DeformationConfig(**SMALL, semantic=True)
    with pytest.raises(ValueError, match="feature_size"):
        init_deformation(jax.random.key(0), config, BOX)
    field = init_deformation(jax.random.key(0), config, BOX, 2)
    with pytest.raises(ValueError, match="features: expected an array, as this field"):
        field(jnp.zeros((1, 3)), jnp.asarray(0.0))
    with pytest.raises(ValueError, match="bounds"):
        init_deformation(jax.random.key(0), DeformationConfig(**SMALL), np.array([[0, 0, 0], [1, 0, 1]]))
