"""Scenes in the ranges that every format has room for, and how far each may round them."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

from gsjax.io.scene_file import columns_of
from gsjax.scene.gaussians import SH_SIZES, Gaussians


def make_scene(count: int = 300, degree: int = 0, seed: int = 0) -> Gaussians:
    """Random Gaussians within 4 units of a place beside the origin."""
    rng = np.random.default_rng(seed)

    def values(low, high, *shape):
        return jnp.asarray(rng.uniform(low, high, shape), jnp.float32)

    rest = SH_SIZES[degree] - 1
    return Gaussians(
        means=values(-3, 5, count, 3),
        quats=jnp.asarray(rng.normal(size=(count, 4)), jnp.float32),
        log_scales=values(-8, 1, count, 3),
        logit_opacities=values(-4, 4, count),
        sh0=values(-1.6, 1.6, count, 1, 3),
        shN=values(-0.9, 0.9, count, rest, 3) if rest else None,
    )


@dataclass(frozen=True)
class Rounding:
    """The largest differences that a format may make: centres in units, rotations as 1 - |q1 . q2|, the
    others as they are; colours and opacities of 0 to 1."""

    means: float = 1e-6
    turn: float = 1e-6
    log_scales: float = 1e-5
    opacities: float = 1e-6
    colors: float = 1e-6
    rest: float = 1e-6
    degree: int = 3


BYTE = 0.51 / 255
ROUNDING = {
    ".ply": Rounding(),
    # 11 bits of a chunk that may be as large as the scene; 10 of a rotation; 1/32 of a coefficient
    ".compressed.ply": Rounding(8 / 1023, 4e-6, 9 / 1023, BYTE, BYTE, 0.016),
    ".splat": Rounding(turn=2e-4, log_scales=1e-6, opacities=BYTE, colors=BYTE, degree=0),
    ".spz": Rounding(2**-16, 5e-6, 0.0313, BYTE, 0.283 / 0.15 * BYTE, 8.6 / 128),
    ".sog": Rounding(1.6e-4, 6e-5, 0.04, BYTE, 0.01, 0.02),
}
"""By ending."""


def differences(a: Gaussians, b: Gaussians) -> dict[str, float]:
    """The largest differences of two scenes whose Gaussians come in any order."""
    left, right = columns_of(a), columns_of(b)
    assert len(left.means) == len(right.means)
    rows = cKDTree(right.means).query(left.means)[1]
    assert len(set(rows.tolist())) == len(rows)
    found = {"turn": 1 - np.abs(np.sum(left.quats * right.quats[rows], axis=1)).min()}
    for name in ("means", "log_scales", "opacities", "colors", "rest"):
        there = getattr(right, name)[rows]
        assert there.shape == getattr(left, name).shape, name
        found[name] = np.abs(there - getattr(left, name)).max(initial=0)
    return found


def assert_alike(a: Gaussians, b: Gaussians, rounding: Rounding, times: float = 1.0) -> None:
    """The scenes differ by no more than a format's rounding, `times` over."""
    for name, found in differences(a, b).items():
        assert found <= times * getattr(rounding, name), f"{name}: {found} > {getattr(rounding, name)}"
