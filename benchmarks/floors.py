"""Lower bounds for any implementation: exp for every pair, copying inputs and outputs once, and, for
features, a matrix product over pairs and channels."""

import math
from collections.abc import Sequence
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.timing import sample
from gsjax.optim.compiler import host_options
from gsjax.rasterize.plan import Plan
from gsjax.rasterize.projection import project_gaussians

TILE = 16  # of the rectangle pairs, independent of the rasterizer's tiles
BLOCK = 2**20  # float32 values in 4 MB, which fit in the cache
PASSES = 32
COPY = 2**26  # float32 values in 256 MB, which do not fit
SIDE = 1024  # of the matrices that are multiplied
CALM = 1.25  # a floor that changed by more than this while a workload ran makes it noisy


class Floors(NamedTuple):
    """Floors of the machine at one time."""

    exp_ns: float  # nanoseconds per exp of a float32
    copy_gb_s: float  # gigabytes read, and the same amount written, per second
    product_gflop_s: float  # 1e9 multiplications and additions per second of float32 matrices

    def exp_ms(self, rectangle_pairs: int) -> float:
        """Time of exp alone over all pixels of the rectangle pairs."""
        return 1e-6 * self.exp_ns * rectangle_pairs * TILE * TILE

    def copy_ms(self, num_bytes: int) -> float:
        """Time to copy the given number of bytes."""
        return 1e-6 * num_bytes / self.copy_gb_s

    def product_ms(self, pixel_pairs: int, channels: int, products: int) -> float:
        """Time of matrix products alone, of the weights of pixel pairs and the channels of features."""
        return 2e-6 * products * pixel_pairs * channels / self.product_gflop_s


@cache
def _programs():
    # Negation, because XLA would remove a plain copy; it runs this on all cores.
    exp = jax.jit(
        lambda x: jax.lax.fori_loop(0, PASSES, lambda _, y: jnp.exp(-y), x),
        compiler_options=host_options() or None,
    )
    return exp, jax.jit(jnp.negative), jax.jit(jnp.matmul)


def measure_floors(repeats: int = 9) -> Floors:
    """Measure the floors now, on all cores."""
    exp, copy, multiply = _programs()
    block, large, square = jnp.linspace(0.0, 1.0, BLOCK), jnp.ones(COPY), jnp.ones((SIDE, SIDE))
    exp_s = float(np.median(sample(lambda _: exp(block), repeats)))
    copy_s = float(np.median(sample(lambda _: copy(large), 3)))
    product_s = float(np.median(sample(lambda _: multiply(square, square), repeats)))
    return Floors(1e9 * exp_s / (PASSES * BLOCK), 1e-9 * large.nbytes / copy_s, 2e-9 * SIDE**3 / product_s)


def between(before: Floors, after: Floors) -> Floors:
    """The geometric mean: the reference for calls between two measurements."""
    return Floors(*(math.sqrt(a * b) for a, b in zip(before, after, strict=True)))


def is_calm(before: Floors, after: Floors) -> bool:
    """Whether the exp floor changed by at most 25 %."""
    return max(before.exp_ns, after.exp_ns) <= CALM * min(before.exp_ns, after.exp_ns)


@partial(jax.jit, static_argnames="plan")
def _project(means, quats, scales, opacities, viewmat, K, plan: Plan):
    usable = jnp.ones(len(means), bool)
    projected = project_gaussians(means, quats, scales, opacities, usable, viewmat, K, plan)
    return projected.means2d, projected.extents, projected.visible


def rectangle_pairs(gaussians: Sequence, viewmat, K, width: int, height: int) -> int:
    """Total number of 16x16 tiles in the bounding boxes of all visible Gaussians.

    This is what a simple rasterizer would draw, so it depends only on the scene, not on our culling.

    Args:
        gaussians: means, quats, scales, opacities.
        viewmat, K: pose and intrinsics of one camera, [4, 4] and [3, 3].
        width, height: size of its image, pixels.
    """
    projected = _project(*gaussians, viewmat, K, Plan(width, height, capacity=0))
    means2d, extents, visible = map(np.asarray, projected)
    tiles = -(-np.array([width, height]) // TILE)
    first = np.clip(np.floor((means2d - extents) / TILE), 0, tiles)
    last = np.clip(np.ceil((means2d + extents) / TILE), 0, tiles)
    counts = np.prod((last - first).astype(np.int64), axis=1)
    return int(counts[visible].sum())
