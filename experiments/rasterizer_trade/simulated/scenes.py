"""The scenes that the knobs are tried on: one simulated, two real."""

import os
from functools import cache
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import gsjax
from gsjax.geometry.cameras import intrinsics, look_at
from gsjax.geometry.spherical_harmonics import SH_C0

DATA = Path(os.environ.get("GSJAX_DATA") or Path(__file__).resolve().parents[4] / "shared" / "data")


class Scene(NamedTuple):
    """Gaussians as `rasterization` takes them, and one camera."""

    gaussians: dict[str, jax.Array]
    viewmats: jax.Array
    Ks: jax.Array
    width: int
    height: int


def ball(rng: np.random.Generator, num: int = 100_000) -> Scene:
    """A simulated ball of small Gaussians, which is opaque about a quarter of the way in."""
    away = rng.normal(size=(num, 3))
    means = away / np.linalg.norm(away, axis=1, keepdims=True) * rng.uniform(size=(num, 1)) ** (1 / 3)
    scales = np.exp(rng.uniform(np.log(0.3), np.log(1.5), (num, 3))) * 0.7 / num ** (1 / 3)
    arrays = (means, rng.normal(size=(num, 4)), scales, rng.uniform(0.05, 1, num), rng.uniform(size=(num, 3)))
    viewmat = look_at(np.array([2.2, 0.4, 0.9]), np.zeros(3))
    return _scene(arrays, viewmat, intrinsics(0.9 * 640, 640, 480), 640, 480)


def garden(rng: np.random.Generator) -> Scene:
    """Real points and camera (Mip-NeRF 360), with random shapes as gsplat's benchmark draws them."""
    found = np.load(_existing(DATA / "garden_points" / "test_garden.npz"))
    near = (np.abs(found["means3d"]) <= 2).all(1)
    means, n = found["means3d"][near], int(near.sum())
    shapes = (rng.normal(size=(n, 4)), rng.uniform(1e-4, 0.02, (n, 3)), rng.uniform(size=n))
    arrays = (means, *shapes, found["colors"][near] / 255.0)
    return _scene(arrays, found["viewmats"][0], found["Ks"][0], 648, 420)


def guitar(rng: np.random.Generator) -> Scene:
    """A real trained object, seen from one and a half times its extent; its y points down."""
    found, _ = gsjax.read_ply(_existing(DATA / "guitar" / "guitar.compressed.ply"))
    means = np.asarray(found.means)
    low, high = means.min(0), means.max(0)
    eye = (low + high) / 2 + 1.5 * (high - low).max() * np.array([0.3, -0.2, 0.93])
    viewmat = look_at(eye, (low + high) / 2, np.array([0.0, -1.0, 0.0]))
    colors = np.maximum(np.asarray(found.sh0)[:, 0] * SH_C0 + 0.5, 0)
    arrays = (means, found.quats, found.scales, found.opacities, colors)
    return _scene(arrays, viewmat, intrinsics(0.9 * 640, 640, 480), 640, 480)


SCENES = {"ball": ball, "garden": garden, "guitar": guitar}


def _existing(path: Path) -> Path:
    if not path.exists():
        raise FileNotFoundError(
            f"{path}: not there; set GSJAX_DATA to the folder that holds {path.parent.name}"
        )
    return path


def _scene(arrays, viewmat, K, width: int, height: int) -> Scene:
    names = ("means", "quats", "scales", "opacities", "colors")
    gaussians = {name: jnp.asarray(a, jnp.float32) for name, a in zip(names, arrays, strict=True)}
    return Scene(gaussians, *(jnp.asarray(a, jnp.float32)[None] for a in (viewmat, K)), width, height)


@cache
def load(name: str, seed: int, with_sh: bool) -> Scene:
    """The scene; with random spherical harmonics of degree 3 around its colours where asked for."""
    rng = np.random.default_rng(seed)
    scene = SCENES[name](rng)
    if not with_sh:
        return scene
    colors = scene.gaussians["colors"]
    rest = jnp.asarray(0.15 * rng.normal(size=(len(colors), 15, 3)), jnp.float32)
    harmonics = jnp.concatenate([(colors[:, None] - 0.5) / SH_C0, rest], axis=1)
    return scene._replace(gaussians=scene.gaussians | {"colors": harmonics})
