"""The feature grid against its formula in plain loops; dense levels have no collisions, outputs are
continuous across cells, and NaN stays local."""

import itertools
import re
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.test_util import check_grads

from gsjax.scene.feature_grid import FeatureGridConfig, init_feature_grid, locate

BOUNDS = np.array([[-1.0, 0.5, 2.0], [2.0, 1.5, 6.0]])
# Its levels have resolutions 4, 6, 10 and 18; the last two do not fit into 2^9 entries.
SMALL = FeatureGridConfig(
    levels=4, least_resolution=4, most_resolution=18, log2_entries=9, features=2, hidden=5, depth=1
)
seeds = st.integers(0, 10_000)


@partial(jax.jit, static_argnums=(1, 2))
def initial(key, config, outputs):
    return init_feature_grid(key, config, outputs, BOUNDS)


located_in = jax.jit(locate)
encoded = jax.jit(lambda grid, located: grid.encode(located))
values_at = jax.jit(lambda grid, positions: grid(positions))
slopes_by_position = jax.jit(jax.grad(lambda positions, grid: grid(positions).sum()))


def some_grid(config=SMALL, outputs=3, seed=0):
    """A grid with features of order 1, so that their effect is visible."""
    grid = initial(jax.random.key(seed), config, outputs)
    return eqx.tree_at(lambda g: g.table, grid, 1e4 * grid.table)


def some_positions(num, seed=0, beyond=0.0):
    """Random positions in the box, extended by the fraction `beyond` of its edges."""
    low, high = BOUNDS
    share = np.random.default_rng(seed).uniform(-beyond, 1 + beyond, (num, 3))
    return low + share * (high - low)


def by_loops(grid, position):
    """Features of one position, as in instant-ngp's paper and code, with plain Python numbers."""
    low, high = grid.bounds
    begins, features = 0, []
    size = 2**grid.config.log2_entries
    table = np.asarray(grid.table, np.float64)
    for resolution in (4, 6, 10, 18):
        where = [
            (resolution - 1) * min(max((x - a) / (b - a), 0.0), 1.0) + 0.5
            for x, a, b in zip(position, low, high, strict=True)
        ]
        cell = [int(np.floor(x)) for x in where]
        edge = resolution + 1
        total = np.zeros(grid.config.features)
        for corner in np.ndindex(2, 2, 2):
            x, y, z = (c + d for c, d in zip(cell, corner, strict=True))
            if edge**3 <= size:
                entry = x + edge * (y + edge * z)
            else:
                entry = ((x * 1) ^ (y * 2654435761) ^ (z * 805459861)) % 2**32 % size
            weight = 1.0
            for i in range(3):
                fraction = where[i] - cell[i]
                weight *= fraction if corner[i] else 1 - fraction
            total += weight * table[begins + entry]
        features.append(total)
        begins += min(edge**3, size)
    return np.concatenate(features)


class TestConfig:
    def test_resolutions_are_those_of_float64(self):
        """They double every five levels. Rounded down without a margin, the sixth would be 31 in float32,
        and one of the finer grid 63 in float64."""
        expected = (16, 18, 21, 24, 27, 32, 36, 42, 48, 55, 64, 73, 84, 97, 111, 128)
        assert FeatureGridConfig().resolutions == expected
        finer = FeatureGridConfig(levels=31, least_resolution=16, most_resolution=1024)
        assert finer.resolutions[::5] == (16, 32, 64, 128, 256, 512, 1024)

    @given(st.integers(2, 64), st.integers(2, 300), st.integers(0, 5000), st.integers(3, 24))
    def test_resolutions_follow_the_formula_from_the_least_to_the_most(self, levels, least, more, log2):
        config = FeatureGridConfig(levels, least, least + more, log2)
        resolutions = np.array(config.resolutions)
        assert (resolutions[0], resolutions[-1]) == (least, least + more)
        growth = np.exp((np.log(least + more) - np.log(least)) / (levels - 1))
        powers = least * growth ** np.arange(levels)
        assert (resolutions <= powers + 2e-6).all()
        assert (resolutions > powers - 1).all()
        assert config.dense == tuple((resolutions + 1) ** 3 <= 2**log2)
        assert all(size <= 2**log2 for size in config.entries)

    def test_counts_of_fd_3dgs(self):
        """14 dense levels and 2 hashed ones."""
        config = FeatureGridConfig()
        assert config.dense == (True,) * 14 + (False,) * 2
        dense = sum((n + 1) ** 3 for n in config.resolutions[:14])
        assert sum(config.entries) == dense + 2 * 2**20

    @pytest.mark.parametrize(
        ("wrong", "says"),
        [
            ({"levels": 0}, "levels: expected at least 1 and at most 64, found 0"),
            ({"least_resolution": 1}, "least_resolution: expected at least 2 and at most 1048576, found 1"),
            ({"most_resolution": 8}, "most_resolution: expected at least 16 and at most 1048576, found 8"),
            ({"log2_entries": 25}, "log2_entries: expected at least 3 and at most 24, found 25"),
            ({"features": 0}, "features: expected at least 1, found 0"),
            ({"hidden": 0}, "hidden: expected at least 1, found 0"),
            ({"depth": -1}, "depth: expected at least 0, found -1"),
            ({"levels": 1}, "levels: expected at least 2 from resolution 16 to 128, found 1; make both"),
        ],
    )
    def test_wrong_sizes_are_named(self, wrong, says):
        with pytest.raises(ValueError, match=f"^{re.escape(says)}"):
            FeatureGridConfig(**wrong)


class TestInit:
    @pytest.mark.thorough
    @pytest.mark.parametrize("depth", [0, 1, 2])
    def test_shapes_and_counts(self, depth):
        config = FeatureGridConfig(4, 4, 18, 9, features=2, hidden=5, depth=depth)
        grid = some_grid(config)
        entries = 5**3 + 7**3 + 2 * 2**9
        assert grid.table.shape == (entries, 2)
        widths = [8, *[5] * depth, 3]
        assert [layer.weight.shape for layer in grid.layers] == list(
            zip(widths[1:], widths[:-1], strict=True)
        )
        network = sum(out * (inp + 1) for inp, out in itertools.pairwise(widths))
        assert sum(leaf.size for leaf in jax.tree.leaves(grid)) == 2 * entries + network
        assert all(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in jax.tree.leaves(grid))
        assert values_at(grid, some_positions(6)).shape == (6, 3)

    def test_first_features_are_small_and_keys_differ(self):
        config = FeatureGridConfig(4, 4, 18, 9, hidden=5, depth=3)
        one, other = (jax.device_get(initial(jax.random.key(i), config, 3)) for i in (0, 1))
        np.testing.assert_allclose([one.table.min(), one.table.max()], [-1e-4, 1e-4], rtol=0.01)
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
            assert not (a == b).any()
        assert not (one.layers[1].weight == one.layers[2].weight).any()  # layers of equal shape

    @pytest.mark.parametrize(
        "bounds",
        [
            [[0, 0, 0], [1, 0, 1]],
            [[0, 0], [1, 1]],
            [[0, 0, 0], [1, np.nan, 1]],
            [[0, 0, 1e6], [1, 1, 1e6 + 1e-3]],
        ],
        ids=["flat", "of a plane", "nan", "flat in float32"],
    )
    def test_invalid_boxes_are_refused(self, bounds):
        with pytest.raises(ValueError, match=r"^bounds: expected \[2, 3\].*give a flat scene a margin"):
            init_feature_grid(jax.random.key(0), SMALL, 3, np.array(bounds))

    def test_outputs_are_required(self):
        with pytest.raises(ValueError, match=r"^outputs: expected at least 1, found 0"):
            init_feature_grid(jax.random.key(0), SMALL, 0, BOUNDS)


@pytest.mark.usefixtures("x64")
class TestFormula:
    def test_features_are_those_of_loops(self):
        grid = some_grid()
        positions = some_positions(40, beyond=0.2)
        expected = [by_loops(grid, position) for position in positions]
        found = encoded(grid, located_in(grid, positions))
        np.testing.assert_allclose(found, expected, atol=1e-12)

    @pytest.mark.thorough
    def test_the_network_is_relu_between_affine_maps(self):
        grid = some_grid(FeatureGridConfig(4, 4, 18, 9, 2, hidden=5, depth=2))

        @jax.jit
        def both(positions):
            located = locate(grid, positions)
            return grid.encode(located), grid.at(located), grid(positions)

        values, found, by_call = both(some_positions(10))
        for i, layer in enumerate(grid.layers):
            values = np.asarray(layer.weight) @ values[..., None]
            values = values[..., 0] + np.asarray(layer.bias)
            values = np.maximum(values, 0) if i < 2 else values
        np.testing.assert_allclose(found, values, atol=1e-12)
        np.testing.assert_array_equal(by_call, found)

    @given(seeds)
    def test_weights_are_a_partition_of_unity_that_reproduces_the_position(self, seed):
        """The weighted mean of a dense level's vertices is the position."""
        config = FeatureGridConfig(1, 4, 4, 9)
        grid = some_grid(config)
        positions = some_positions(5, seed)
        located = jax.device_get(located_in(grid, positions))
        assert (located.weights >= 0).all()
        np.testing.assert_allclose(located.weights.sum(-1), 1, atol=1e-14)
        vertices = np.stack(np.unravel_index(located.indices, (5, 5, 5), order="F"), axis=-1)
        found = np.einsum("nlc,nlci->ni", located.weights, vertices)
        low, high = BOUNDS
        np.testing.assert_allclose((found - 0.5) / 3 * (high - low) + low, positions, atol=1e-12)

    def test_outputs_are_continuous_where_cells_meet_but_derivatives_jump(self):
        """Halfway along x, where the levels of 4, 6, 10 and 18 all have a vertex."""
        grid = some_grid()
        low, high = BOUNDS
        middle = some_positions(1)
        middle[0, 0] = (low[0] + high[0]) / 2
        step = np.array([1e-9, 0, 0])
        before, after = middle - step, middle + step
        indices = [np.asarray(located_in(grid, x).indices) for x in (before, after)]
        assert (indices[0] != indices[1]).any(-1).all()
        np.testing.assert_allclose(values_at(grid, before), values_at(grid, after), atol=1e-7)
        slope = jax.jit(jax.jacfwd(values_at, argnums=1))
        slopes = [np.asarray(slope(grid, x))[0, :, 0, 0] for x in (before, after)]
        assert np.abs(slopes[0] - slopes[1]).min() > 1e-2

    def test_outside_counts_as_on_the_surface(self):
        grid = some_grid()
        low, high = BOUNDS
        outside = np.array([[-9.0, 1.0, 9.0], [np.inf, -np.inf, 3.0], [0.0, 0.0, 0.0]])
        inside = np.clip(outside, low, high)
        np.testing.assert_array_equal(values_at(grid, outside), values_at(grid, inside))
        slopes = np.asarray(slopes_by_position(outside, grid))
        np.testing.assert_array_equal(slopes == 0, (outside < low) | (outside > high))

    def test_on_the_surface_the_derivative_is_that_of_inside(self):
        grid = some_grid()
        low, high = BOUNDS
        for surface, inwards in ((low, 1e-7), (high, -1e-7)):
            at, inside = (slopes_by_position(surface[None] + shift, grid) for shift in (0.0, inwards))
            np.testing.assert_allclose(at, inside, rtol=1e-4)


class TestEntries:
    """Without x64, as in use: the hash overflows 32 bits."""

    def test_dense_levels_have_no_collisions(self):
        config = FeatureGridConfig(levels=3, least_resolution=3, most_resolution=7, log2_entries=9)
        assert config.dense == (True,) * 3
        grid = some_grid(config)
        steps = np.linspace(0, 1, 15)
        low, high = BOUNDS.astype(np.float32)
        share = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3).astype(np.float32)
        indices = np.asarray(located_in(grid, low + share * (high - low)).indices)
        begins = np.cumsum([0, *config.entries])
        for level in range(3):
            used = indices[:, level]
            assert len(np.unique(used, axis=0)) == config.resolutions[level] ** 3  # one set per cell
            np.testing.assert_array_equal(np.unique(used), np.arange(begins[level], begins[level + 1]))

    @pytest.mark.parametrize("log2", [3, 19])
    def test_hashed_rows_stay_in_their_level_and_spread_over_it(self, log2):
        config = FeatureGridConfig(2, 2**10, 2**20, log2, features=1, hidden=1)
        grid = initial(jax.random.key(0), config, 1)
        indices = np.asarray(located_in(grid, some_positions(3000)).indices)
        assert indices.dtype == np.int32
        for level in range(2):
            rows = indices[:, level] - level * 2**log2
            assert rows.min() >= 0
            assert rows.max() < 2**log2
            # The number of entries that a uniform hash of as many vertices is expected to use.
            fair = 2**log2 * -np.expm1(-len(np.unique(rows, axis=0)) * 8 / 2**log2)
            assert len(np.unique(rows)) > 0.95 * fair

    def test_the_corners_of_the_box_at_the_most_resolution(self):
        """At the limit of float32, no vertex lies beyond the last."""
        config = FeatureGridConfig(2, 2, 2**20, 10, features=1, hidden=1)
        grid = initial(jax.random.key(0), config, 1)
        located = jax.device_get(located_in(grid, np.float32(BOUNDS)))
        assert (located.indices[:, 0] < 3**3).all()
        np.testing.assert_array_equal(located.weights[:, 1], np.full((2, 8), 0.125))


@jax.jit
def forward_and_back(arguments, tangents, cotangent):
    """Returns a JVP and a VJP of a grid."""
    _, pull = jax.vjp(values_at, *arguments)
    return jax.jvp(values_at, arguments, tangents)[1], pull(cotangent)


class TestDerivatives:
    @pytest.mark.thorough
    @pytest.mark.usefixtures("x64")
    def test_by_everything_against_finite_differences(self):
        """Away from the faces of cells and the kink of ReLU, which have only one-sided derivatives."""
        config = FeatureGridConfig(2, 4, 10, 9, features=2, hidden=3)
        grid = some_grid(config, outputs=2)
        positions = some_positions(4, seed=3)
        scaled = (positions - BOUNDS[0]) / np.ptp(BOUNDS, axis=0)
        scaled = scaled[:, None] * np.array([[3], [9]]) + 0.5
        assert np.abs(scaled - np.round(scaled)).min() > 1e-3
        leaves, structure = jax.tree.flatten(grid)

        @jax.jit
        def outputs(leaves, positions):
            return jax.tree.unflatten(structure, leaves)(positions)

        check_grads(outputs, (leaves, positions), order=1, modes=["fwd", "rev"], eps=1e-6)

    @pytest.mark.usefixtures("x64")
    @pytest.mark.parametrize("seed", range(3))
    def test_jvp_is_the_transpose_of_vjp(self, seed):
        grid, positions = some_grid(seed=seed), some_positions(6, seed, beyond=0.1)
        rng = np.random.default_rng(seed)
        tangents = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape), (grid, positions))
        cotangent = rng.normal(size=(6, 3))
        forward, pulled = forward_and_back((grid, positions), tangents, cotangent)
        products = jax.tree.map(np.vdot, tangents, pulled)
        np.testing.assert_allclose(np.vdot(cotangent, forward), sum(jax.tree.leaves(products)), rtol=1e-10)

    def test_only_the_entries_around_a_position_have_gradients(self):
        grid = some_grid()
        located = located_in(grid, some_positions(2))
        pulled = jax.jit(jax.grad(lambda g: jnp.sum(g.at(located) ** 2)))(grid).table
        rows = np.flatnonzero(np.abs(pulled).max(axis=1))
        np.testing.assert_array_equal(rows, np.unique(located.indices))


def test_a_batch_of_grids_and_positions_is_a_loop():
    grids = [some_grid(seed=seed) for seed in range(3)]
    places = [some_positions(4, seed) for seed in range(3)]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *grids)
    batch = np.asarray(jax.vmap(values_at)(stacked, np.stack(places)))
    for one, grid, x in zip(batch, grids, places, strict=True):
        np.testing.assert_allclose(one, values_at(grid, x), rtol=1e-5, atol=1e-6)


@jax.jit
@partial(jax.grad, argnums=(0, 1))
def slopes_of_kept(grid, positions, kept):
    return jnp.sum(jnp.where(kept[:, None], grid(positions), 0.0) ** 2)


@pytest.mark.parametrize("axis", range(3))
def test_nan_makes_one_row_nan_and_touches_no_gradient(axis):
    grid, positions, kept = some_grid(), some_positions(5), np.arange(5) != 2
    poisoned = positions.copy()
    poisoned[2, axis] = np.nan
    outputs, sound = (np.asarray(values_at(grid, x)) for x in (poisoned, positions))
    np.testing.assert_array_equal(np.isnan(outputs), np.repeat(~kept[:, None], 3, axis=1))
    np.testing.assert_allclose(outputs[kept], sound[kept], rtol=1e-5)
    located = located_in(grid, poisoned)
    assert np.isin(located.indices, np.arange(len(grid.table))).all()
    assert (np.asarray(encoded(grid, located))[2] == 0).all()

    gradients, wanted = (slopes_of_kept(grid, x, kept) for x in (poisoned, positions))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), gradients, wanted)


@pytest.mark.thorough
def test_it_learns_a_segmentation_of_the_box():
    """As in the warm-up of skinning weights: two halves of the box belong to two parts."""
    config = FeatureGridConfig(4, 4, 18, 9, features=2, hidden=16)
    grid = initial(jax.random.key(0), config, 2)
    located = located_in(grid, some_positions(200))
    first = some_positions(200)[:, 0] < 0.5

    def loss(grid):
        chances = jax.nn.log_softmax(grid.at(located))
        return -jnp.where(first, chances[:, 0], chances[:, 1]).mean()

    optimizer = optax.adam(1e-2)

    def step(carry, _):
        grid, state = carry
        value, gradient = jax.value_and_grad(loss)(grid)
        updates, state = optimizer.update(gradient, state)
        return (optax.apply_updates(grid, updates), state), value

    @jax.jit
    def learned(grid):
        (grid, _), losses = jax.lax.scan(step, (grid, optimizer.init(grid)), length=200)
        return grid, losses

    grid, losses = learned(grid)
    assert losses[0] > 0.5
    assert losses[-1] < 0.01
    others = some_positions(500, seed=1)
    guessed = np.argmax(values_at(grid, others), axis=1) == 0
    assert (guessed == (others[:, 0] < 0.5)).mean() > 0.9
