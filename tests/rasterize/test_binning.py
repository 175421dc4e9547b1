"""Tile lists against brute force: every pair that some pixel sees is listed, in order of depth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsjax.rasterize.binning import bin_gaussians, needed_capacity, total
from gsjax.rasterize.plan import Plan
from gsjax.rasterize.projection import project_gaussians

PLAN = Plan(70, 40, capacity=4096)
N = 30


@jax.jit
def binned(means, quats, scales, opacities):
    K = jnp.array([[50.0, 0.0, 35.0], [0.0, 50.0, 20.0], [0.0, 0.0, 1.0]])
    projected = project_gaussians(means, quats, scales, opacities, jnp.ones(N, bool), jnp.eye(4), K, PLAN)
    return projected, bin_gaussians(projected, None, PLAN), needed_capacity(projected, None, PLAN)


def seen_pairs(projected) -> set[tuple[int, int]]:
    """The pairs (tile, Gaussian) for which alpha exceeds 1/255 by more than rounding at some pixel."""
    means, conics, opacities = (np.float64(a) for a in (*projected[:2], projected.opacities))
    x, y = np.meshgrid(np.arange(PLAN.width) + 0.5, np.arange(PLAN.height) + 0.5)
    tile = (y // PLAN.tile_size * PLAN.tiles_x + x // PLAN.tile_size).astype(int)
    pairs = set()
    for i in np.flatnonzero(np.asarray(projected.visible)):
        dx, dy = x - means[i, 0], y - means[i, 1]
        a, b, c = conics[i]
        alpha = opacities[i] * np.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
        pairs |= {(int(t), int(i)) for t in np.unique(tile[alpha >= 1.0001 / 255])}
    return pairs


@pytest.mark.thorough
@given(seed=st.integers(0, 10_000), size=st.sampled_from([0.001, 0.03, 0.3, 3.0]), needle=st.booleans())
def test_lists_hold_every_pair_that_a_pixel_sees_front_to_back(seed, size, needle):
    rng = np.random.default_rng(seed)
    means = rng.uniform([-3, -2, 0.5], [3, 2, 4], (N, 3))
    scales = size * rng.uniform(0.3, 1.5, (N, 3)) * ([1, 1e-3, 1e-3] if needle else [1, 1, 1])
    arrays = (means, rng.normal(size=(N, 4)), scales, rng.uniform(0, 1, N))
    projected, lists, needed = binned(*(jnp.asarray(a, jnp.float32) for a in arrays))
    ids, starts, counts = map(np.asarray, lists[:3])
    depths = np.asarray(projected.depths)
    listed = set()
    for tile in range(PLAN.num_tiles):
        here = ids[starts[tile] : starts[tile] + counts[tile]]
        assert len(set(here)) == len(here)
        assert (np.diff(depths[here]) >= 0).all()
        listed |= {(tile, int(i)) for i in here}
    seen = seen_pairs(projected)
    assert not seen - listed
    assert len(listed - seen) <= 0.1 * len(seen) + 3  # between pixel centres, or within rounding
    assert len(listed) == int(lists.pairs) <= int(lists.needed) == int(needed)


def test_equal_depths_keep_the_order_of_the_input():
    means = jnp.zeros((N, 3)).at[:, 2].set(2.0)
    ones = jnp.ones((N, 3))
    _, lists, _ = binned(means, jnp.ones((N, 4)), 0.1 * ones, 0.5 * ones[:, 0])
    first = int(np.flatnonzero(lists.counts)[0])
    np.testing.assert_array_equal(lists.ids[lists.starts[first] :][:N], np.arange(N))


def test_only_tiles_of_the_mask_get_lists():
    rng = np.random.default_rng(0)
    means = jnp.asarray(rng.uniform([-1, -1, 1], [1, 1, 3], (N, 3)), jnp.float32)
    ones = jnp.ones((N, 3))
    projected, lists, _ = binned(means, jnp.ones((N, 4)), 0.1 * ones, 0.5 * ones[:, 0])
    mask = jnp.arange(PLAN.num_tiles) % 2 == 0
    masked = jax.jit(bin_gaussians, static_argnames="plan")(projected, mask, PLAN)
    np.testing.assert_array_equal(masked.counts, jnp.where(mask, lists.counts, 0))


def test_a_count_beyond_int32_saturates_instead_of_wrapping():
    counts = jnp.full(100_000, 32_400, jnp.int32)  # 3.2e9 pairs
    assert int(total(counts)) == np.iinfo(np.int32).max
    assert int(total(counts[:10])) == 324_000


@pytest.mark.thorough
def test_the_needed_capacity_is_counted_in_parts_whatever_the_plan_holds():
    rng = np.random.default_rng(0)
    n, plan = 3000, Plan(70, 1600, capacity=0)  # 200 rows of tiles
    means = np.c_[rng.uniform(-0.5, 0.5, (n, 2)), rng.uniform(1, 2, n)]
    arrays = (means, rng.normal(size=(n, 4)), rng.uniform(5, 10, (n, 3)), rng.uniform(0.1, 1, n))
    K = jnp.array([[50.0, 0.0, 35.0], [0.0, 50.0, 800.0], [0.0, 0.0, 1.0]])
    projected = project_gaussians(
        *(jnp.asarray(a, jnp.float32) for a in arrays), jnp.ones(n, bool), jnp.eye(4), K, plan
    )
    enough = plan.grown(int(needed_capacity(projected, None, plan)))
    lists = jax.jit(bin_gaussians, static_argnames="plan")(projected, None, plan=enough)
    assert not lists.overflow
    assert int(lists.needed) == int(needed_capacity(projected, None, enough)) > 2 * 2**16
    mask = jnp.arange(plan.num_tiles) % 7 == 3
    lists = jax.jit(bin_gaussians, static_argnames="plan")(projected, mask, plan=enough)
    assert int(lists.needed) == int(needed_capacity(projected, mask, plan))
