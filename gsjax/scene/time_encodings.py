"""Encodings of position and time for deformation fields: planes, sinusoids, or voxels.

Positions range from 0 to 1 along each axis of the scene's box, the time from 0 to 1 over the whole recording.
"""

from itertools import product

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num, PRNGKeyArray

from gsjax.scene.feature_grid import FeatureGrid, FeatureGridConfig, init_feature_grid, interpolated, locate

_PAIRS = ((0, 1), (0, 2), (1, 2))
_UNIT_BOX = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])


def within(
    positions: Float[Array, "N 3"], bounds: tuple[tuple[float, ...], tuple[float, ...]]
) -> Float[Array, "N 3"]:
    """Positions in a box, scaled to 0 to 1; outside, they are clamped to its surface, with zero gradient. NaN
    becomes 0.5, also with zero gradient."""
    low, high = jnp.asarray(bounds, positions.dtype)
    return _clamped((positions - low) / (high - low))


def _clamped(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    # Not `clip`, which halves the derivative on the surface, where the outermost points of a scene lie.
    x = jnp.where(jnp.isnan(x), 0.5, x)
    return jnp.where(x < 0, 0.0, jnp.where(x > 1, 1.0, x))


class HexPlane(eqx.Module):
    """Planes for all pairs of x, y, z and t; a position and a time are encoded as the product of the six
    planes' values there (4DGS, Wu et al. 2023, eq. 6, after HexPlane, Cao and Johnson 2023), concatenated
    over levels.

    At a fixed time the planes of t reduce to lines, which are computed once for all positions.

    Attributes:
        space: for each level, the planes xy, xz, yz; R vertices per axis.
        time: for each level, the planes xt, yt, zt; T vertices along t.
    """

    space: tuple[Float[Array, "3 _ _ F"], ...]
    time: tuple[Float[Array, "3 T _ F"], ...]

    @property
    def size(self) -> int:
        """Number of output channels."""
        return sum(plane.shape[-1] for plane in self.space)

    def __call__(self, places: Float[Array, "N 3"], time: Float[Array, ""]) -> Float[Array, "N size"]:
        levels = []
        for space, planes in zip(self.space, self.time, strict=True):
            resolution, channels = space.shape[1], space.shape[3]
            below, above = _between(places, resolution)  # [N,3] of (vertex, weight)
            corners = list(product((below, above), repeat=2))
            rows = [
                [(plane * resolution + one[0][:, i]) * resolution + other[0][:, j] for one, other in corners]
                for plane, (i, j) in enumerate(_PAIRS)
            ]
            weights = [[one[1][:, i] * other[1][:, j] for one, other in corners] for i, j in _PAIRS]
            value = interpolated(space.reshape(-1, channels), *map(_stacked, (weights, rows)))
            rows = [[axis * resolution + one[0][:, axis] for one in (below, above)] for axis in range(3)]
            weights = [[one[1][:, axis] for one in (below, above)] for axis in range(3)]
            lines = _line(planes, time).reshape(-1, channels)
            value *= interpolated(lines, *map(_stacked, (weights, rows)))
            # The gradient of `prod` takes 50 times as long.
            levels.append(value[:, 0] * value[:, 1] * value[:, 2])
        return jnp.concatenate(levels, axis=-1)


def init_hexplane(
    key: PRNGKeyArray, resolution: int, time_resolution: int, levels: int, channels: int
) -> HexPlane:
    """Spatial planes initialised uniformly from 0.1 to 0.5 and time planes to 1 (K-Planes, Fridovich-Keil et
    al. 2023): at first nothing depends on time.

    Args:
        key: random key for the spatial planes.
        resolution: vertices per side of the coarsest planes; each level doubles it.
        time_resolution: vertices along the time axis, on all levels.
        levels: number of levels.
        channels: channels per vertex.
    """
    space, time = [], []
    for level, one in enumerate(jax.random.split(key, levels)):
        side = resolution * 2**level
        space.append(jax.random.uniform(one, (3, side, side, channels), minval=0.1, maxval=0.5))
        time.append(jnp.ones((3, time_resolution, side, channels)))
    return HexPlane(tuple(space), tuple(time))


def _between(places: Float[Array, "*n"], resolution: int):
    """The vertices below and above positions on an axis with `resolution` vertices, each with its weight."""
    scaled = places * (resolution - 1)
    first = jnp.clip(jnp.floor(jax.lax.stop_gradient(scaled)), 0, resolution - 2)
    share = scaled - first
    index = first.astype(jnp.int32)
    return (index, 1 - share), (index + 1, share)


def _stacked(nested: list[list[Array]]) -> Num[Array, "N L C"]:
    return jnp.stack([jnp.stack(one, axis=-1) for one in nested], axis=1)


def _line(planes: Float[Array, "3 T R F"], time: Float[Array, ""]) -> Float[Array, "3 R F"]:
    """Time planes evaluated at one time."""
    (now, most), (then, rest) = _between(_clamped(time), planes.shape[1])
    return most * planes[:, now] + rest * planes[:, then]


class Sinusoids(eqx.Module):
    """Positions and time, and their sines and cosines of 1, 2, 4, ... periods over the whole range.

    Attributes:
        frequencies: number of frequencies.
    """

    frequencies: int = eqx.field(static=True)

    @property
    def size(self) -> int:
        """Number of output channels."""
        return 4 * (1 + 2 * self.frequencies)

    def __call__(self, places: Float[Array, "N 3"], time: Float[Array, ""]) -> Float[Array, "N size"]:
        times = jnp.broadcast_to(_clamped(time), (len(places), 1))
        return sinusoids(jnp.concatenate([places, times], axis=1), self.frequencies)


def sinusoids(values: Float[Array, "N D"], frequencies: int) -> Float[Array, "N size"]:
    """Values rescaled from 0..1 to -1..1, with their sines and cosines (SurstSplat, section 2.1: gamma)."""
    centered = 2 * values - 1
    phases = centered[..., None] * (np.pi * 2.0 ** np.arange(frequencies)).astype(values.dtype)
    waves = jnp.concatenate([jnp.sin(phases), jnp.cos(phases)], axis=-1)
    return jnp.concatenate([centered, waves.reshape(len(values), -1)], axis=-1)


class Voxels(eqx.Module):
    """Dense neural voxels (SurstSplat, section 2.1) with sinusoids of time. The voxels encode what is where,
    "organ or background", so semantic features are read from them too.

    Attributes:
        grid: a single dense level, whose network is the projection to semantic features.
        frequencies: number of frequencies of the time.
    """

    grid: FeatureGrid
    frequencies: int = eqx.field(static=True)

    @property
    def size(self) -> int:
        """Number of output channels."""
        return self.grid.config.features + 1 + 2 * self.frequencies

    def __call__(self, places: Float[Array, "N 3"], time: Float[Array, ""]) -> Float[Array, "N size"]:
        waves = sinusoids(_clamped(time)[None, None], self.frequencies)
        here = self.grid.encode(locate(self.grid, places))
        return jnp.concatenate([here, jnp.broadcast_to(waves, (len(places), waves.shape[1]))], axis=-1)

    def meaning(self, places: Float[Array, "N 3"]) -> Float[Array, "N outputs"]:
        """Semantic features at positions, the same at all times."""
        return self.grid(places)


def init_voxels(key: PRNGKeyArray, resolution: int, channels: int, frequencies: int, outputs: int) -> Voxels:
    """Voxels with small random features.

    Args:
        key: random key.
        resolution: voxels per side.
        channels: channels per voxel.
        frequencies: number of frequencies of the time.
        outputs: size of the semantic features.
    """
    entries = int(np.ceil(np.log2((resolution + 1) ** 3)))
    config = FeatureGridConfig(
        levels=1,
        least_resolution=resolution,
        most_resolution=resolution,
        log2_entries=max(3, entries),
        features=channels,
        depth=0,
    )
    grid = init_feature_grid(key, config, outputs, _UNIT_BOX)
    still = jax.tree.map(jnp.zeros_like, grid.layers[-1])  # at first, features are unchanged
    return Voxels(eqx.tree_at(lambda g: g.layers[-1], grid, still), frequencies)
