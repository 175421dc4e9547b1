"""The scenes that the knobs are tried on: one simulated, two real."""

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import workloads
from gsjax.geometry.spherical_harmonics import SH_C0


class Scene(NamedTuple):
    """Gaussians as `rasterization` takes them, and one camera."""

    gaussians: dict[str, jax.Array]
    viewmats: jax.Array
    Ks: jax.Array
    width: int
    height: int


def _with_camera(scene: workloads.Scene, width: int, height: int) -> Scene:
    gaussians = {name: getattr(scene, name) for name in ("means", "quats", "scales", "opacities", "colors")}
    return Scene(gaussians, scene.viewmat[None], scene.K[None], width, height)


# The benchmarks' own, so that figures of both are of the same scenes.
SCENES = {
    "ball": lambda seed: _with_camera(workloads.ball(100_000, 640, 480, seed=seed), 640, 480),
    "garden": lambda seed: _with_camera(workloads.garden(0), 648, 420),
    "guitar": lambda seed: _with_camera(workloads.guitar(), 640, 480),
}


@cache
def load(name: str, seed: int, with_sh: bool) -> Scene:
    """The scene; with random spherical harmonics of degree 3 around its colours where asked for."""
    rng = np.random.default_rng(seed)
    scene = SCENES[name](seed)
    if not with_sh:
        return scene
    colors = scene.gaussians["colors"]
    rest = jnp.asarray(0.15 * rng.normal(size=(len(colors), 15, 3)), jnp.float32)
    harmonics = jnp.concatenate([(colors[:, None] - 0.5) / SH_C0, rest], axis=1)
    return scene._replace(gaussians=scene.gaussians | {"colors": harmonics})
