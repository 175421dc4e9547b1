"""A field over a box: features in a multiresolution hash grid, and a small network on them (Müller et al.
2022, "Instant Neural Graphics Primitives", section 3). The outputs are up to the user: logits of skinning
weights (MotionSplicer, section 3.3), or semantic features (FD-3DGS, section 3.3).

Level l has a resolution N_l, with b such that resolutions range from the least to the most (eq. 2, 3):

    N_l = floor(N_min b^l),    b = exp((ln N_max - ln N_min) / (L - 1))

A position x, 0 to 1 within the box, lies at (N_l - 1) x + 1/2 among the vertices 0, 1, ... N_l of each axis,
and its features are interpolated between the eight vertices around it. Scale and offset are those of
tiny-cuda-nn, the paper's own code, so that a field means the same here as there; the offset prevents the
cells of all levels from starting together on the faces of the box. There are two differences: tiny-cuda-nn
scales by b^l N_min - 1, without the floor; and it has entries for N_l vertices per axis, so that the last
vertex, which half a cell needs, shares an entry with another, while here it has its own.

A level whose vertices, (N_l + 1)^3, all fit the table is dense: each has its own entry. In finer levels they
share entries by the paper's hash (eq. 4).
"""

from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt32

_PRIMES = (1, 2_654_435_761, 805_459_861)
_FIRST_FEATURES = 1e-4  # largest initial value, as in the paper


@dataclass(frozen=True)
class FeatureGridConfig:
    """Sizes of a grid and its network; the defaults are those of FD-3DGS, section 4."""

    levels: int = 16
    """Number of resolutions, from the coarsest to the finest; a position has features from each."""
    least_resolution: int = 16
    """Resolution of the coarsest level."""
    most_resolution: int = 128
    """Resolution of the finest level."""
    log2_entries: int = 20
    """Base-2 logarithm of the most entries in a level; a level with more vertices is hashed."""
    features: int = 8
    """Number of features per entry."""
    hidden: int = 128
    """Width of the network's hidden layers."""
    depth: int = 1
    """Number of hidden layers."""

    def __post_init__(self):
        ranges = {
            "levels": (1, 64),
            "least_resolution": (2, 2**20),
            "most_resolution": (self.least_resolution, 2**20),
            "log2_entries": (3, 24),
            "features": (1, np.inf),
            "hidden": (1, np.inf),
            "depth": (0, np.inf),
        }
        for name, (low, high) in ranges.items():
            value = getattr(self, name)
            if not low <= value <= high:
                to = "" if high == np.inf else f" and at most {high}"
                raise ValueError(f"{name}: expected at least {low}{to}, found {value}")
        if self.levels == 1 and self.least_resolution != self.most_resolution:
            raise ValueError(
                f"levels: expected at least 2 from resolution {self.least_resolution} to "
                f"{self.most_resolution}, found 1; make both resolutions the same, or add levels"
            )

    @property
    def resolutions(self) -> tuple[int, ...]:
        """N_l of each level, from the coarsest to the finest.

        In float64 with a small margin before the floor: float32 would turn 32 into 31.
        """
        powers = np.geomspace(self.least_resolution, self.most_resolution, self.levels)
        return tuple(int(n) for n in np.floor(powers + 1e-6))

    @property
    def entries(self) -> tuple[int, ...]:
        """Number of entries in each level."""
        return tuple(min((n + 1) ** 3, 2**self.log2_entries) for n in self.resolutions)

    @property
    def dense(self) -> tuple[bool, ...]:
        """Whether each vertex of a level has its own entry."""
        return tuple((n + 1) ** 3 <= 2**self.log2_entries for n in self.resolutions)


class Located(NamedTuple):
    """N positions located in the grid: the entries around them and their interpolation weights.

    Attributes:
        indices: rows of the grid's table for the eight vertices around the position at each level.
        weights: interpolation weights of those vertices; they sum to 1, or are all 0 if a coordinate is NaN.
        valid: whether no coordinate is NaN.
    """

    indices: Int[Array, "N L 8"]
    weights: Float[Array, "N L 8"]
    valid: Bool[Array, "N"]


class FeatureGrid(eqx.Module):
    """A function of position. All leaves are floats, so `jax.grad` applies to the whole module.

    Attributes:
        table: features of the entries of all levels, one level after another.
        layers: layers of the network, with a ReLU between them.
        config: sizes.
        bounds: least and largest coordinates of the box, metres.
    """

    # One table for all levels, so one gather and one scatter-add: a table per level takes 1.4 times as long
    # on a CPU.
    table: Float[Array, "entries F"]
    layers: tuple[eqx.nn.Linear, ...]
    config: FeatureGridConfig = eqx.field(static=True)
    bounds: tuple[tuple[float, ...], tuple[float, ...]] = eqx.field(static=True)

    def __call__(self, positions: Float[Array, "N 3"]) -> Float[Array, "N outputs"]:
        """Outputs at positions in metres; those outside the box are clamped to its surface.

        A position with a NaN gives a row of NaN and affects nothing else: the gradients of the other rows are
        as they would be without it.
        """
        return self.at(locate(self, positions))

    @partial(jax.jit, inline=True)
    def at(self, located: Located) -> Float[Array, "N outputs"]:
        """Outputs at positions located by `locate`, which has to run only once for fixed positions."""
        values = jax.vmap(self.layers[-1])(self.hidden_at(located))
        # Only here: inside the network, a NaN would reach the gradient even if that row is not used.
        return jnp.where(located.valid[:, None], values, jnp.nan)

    @partial(jax.jit, inline=True)
    def hidden_at(self, located: Located) -> Float[Array, "N hidden"]:
        """Inputs of the last layer, which is linear: these can be summed with weights instead of outputs."""
        values = self.encode(located)
        for layer in self.layers[:-1]:
            values = jax.nn.relu(jax.vmap(layer)(values))
        return values

    def encode(self, located: Located) -> Float[Array, "N features"]:
        """Inputs of the network: the interpolated features of all levels; 0 where a position is NaN."""
        found = interpolated(self.table, located.weights, located.indices)
        return found.reshape(len(found), -1)


def init_feature_grid(
    key: PRNGKeyArray, config: FeatureGridConfig, outputs: int, bounds: ArrayLike
) -> FeatureGrid:
    """A grid of small random features and a network with `outputs` outputs.

    Args:
        key: random key for both.
        config: sizes.
        outputs: number of outputs per position.
        bounds: [2, 3], least and largest coordinates of the box, metres. They are static: a function compiled
            for a grid is recompiled for a grid with another box.

    Raises:
        ValueError: there are no outputs, or the box is invalid.
    """
    if outputs < 1:
        raise ValueError(f"outputs: expected at least 1, found {outputs}")
    box = np.asarray(bounds, np.float32)
    if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] < box[1]).all():
        raise ValueError(
            f"bounds: expected [2, 3], least and largest coordinates, found {box.tolist()}; the largest must "
            "be larger, also in float32: give a flat scene a margin"
        )
    low, high = box.tolist()
    table, layers = _random(key, config, outputs)
    return FeatureGrid(table, layers, config, (tuple(low), tuple(high)))


@partial(jax.jit, static_argnums=(1, 2), inline=True)
def _random(
    key: PRNGKeyArray, config: FeatureGridConfig, outputs: int
) -> tuple[Float[Array, "entries F"], tuple[eqx.nn.Linear, ...]]:
    """Random features and layers."""
    key, *keys = jax.random.split(key, config.depth + 2)
    shape = (sum(config.entries), config.features)
    table = jax.random.uniform(key, shape, minval=-_FIRST_FEATURES, maxval=_FIRST_FEATURES)
    widths = (config.levels * config.features, *[config.hidden] * config.depth, outputs)
    layers = [eqx.nn.Linear(*pair, key=one) for *pair, one in zip(widths[:-1], widths[1:], keys, strict=True)]
    return table, tuple(layers)


@partial(jax.jit, inline=True)
def locate(grid: FeatureGrid, positions: Float[Array, "N 3"]) -> Located:
    """Locate positions, in metres, in the grid; those outside the box are clamped to its surface.

    Weights are differentiable in the positions, except across faces of cells, where derivatives jump, and
    outside the box.
    """
    dtype = positions.dtype
    low, high = jnp.asarray(grid.bounds, dtype)
    valid = ~jnp.isnan(positions).any(axis=-1)
    inside = jnp.where(valid[:, None], (positions - low) / (high - low), 0.5)
    # Not `clip`, which halves the derivative on the surface, where the outermost points of a scene lie.
    inside = jnp.where(inside < 0, 0.0, jnp.where(inside > 1, 1.0, inside))

    edges = jnp.asarray(np.array(grid.config.resolutions) - 1, dtype)
    scaled = inside[:, None, :] * edges[:, None] + 0.5
    cells = jnp.floor(scaled)
    along = [(1 - upper, upper) for upper in jnp.moveaxis(scaled - cells, -1, 0)]
    weights = jnp.stack([x * y * z for x, y, z in product(*along)], axis=-1)
    weights = jnp.where(valid[:, None, None], weights, 0.0)
    return Located(_entries(grid.config, cells.astype(jnp.uint32)), weights, valid)


@jax.custom_jvp
def interpolated(
    table: Float[Array, "entries F"], weights: Float[Array, "N L C"], indices: Int[Array, "N L C"]
) -> Float[Array, "N L F"]:
    """Weighted sums of C rows of a table for each of L levels or planes: interpolation between vertices.

    With one vertex after another and positions along the last axis, XLA:CPU fuses gather, product and sum,
    which takes a sixth of the time of a materialised gather. The backward pass would not fuse, so the
    derivative uses the other form.

    Args:
        table: F features per entry.
        weights: weights of C vertices for each of N points.
        indices: rows of the table for these vertices.
    """
    columns, found = table.T, jnp.zeros((), table.dtype)
    for weight, rows in zip(
        jnp.moveaxis(weights, (2, 1), (0, 1)), jnp.moveaxis(indices, (2, 1), (0, 1)), strict=True
    ):
        found += weight * columns.at[:, rows].get(mode="promise_in_bounds")
    return found.transpose(2, 1, 0)


@partial(interpolated.defjvp, symbolic_zeros=True)
def _interpolated_jvp(primals, tangents):
    table, weights, indices = primals
    d_table, d_weights, _ = tangents
    found = interpolated(*primals)
    turned = jnp.zeros_like(found)
    if type(d_table) is not SymbolicZero:
        turned += jnp.einsum("nlc,nlcf->nlf", weights, d_table[indices], precision="highest")
    if type(d_weights) is not SymbolicZero:
        turned += jnp.einsum("nlc,nlcf->nlf", d_weights, table[indices], precision="highest")
    return found, turned


def _entries(config: FeatureGridConfig, cells: UInt32[Array, "N L 3"]) -> Int[Array, "N L 8"]:
    """Rows of the table of the eight vertices around each level's cell."""
    dense = np.array(config.dense)
    edges = np.array(config.resolutions) + 1
    strides = np.stack([np.ones_like(edges), edges, edges**2], axis=-1)
    factors = np.where(dense[:, None], strides, np.array(_PRIMES)).astype(np.uint32)
    # The products of the hash are modulo 2^32, as is arithmetic on uint32.
    begins = jnp.moveaxis(cells * factors, -1, 0)
    along = [(begin, begin + factor) for begin, factor in zip(begins, factors.T, strict=True)]
    mask = np.uint32(2**config.log2_entries - 1)
    rows = [jnp.where(dense, x + y + z, (x ^ y ^ z) & mask) for x, y, z in product(*along)]
    offsets = np.cumsum([0, *config.entries[:-1]]).astype(np.uint32)
    return (jnp.stack(rows, axis=-1) + offsets[:, None]).astype(jnp.int32)
