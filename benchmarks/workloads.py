"""The workloads: gsplat's garden, a trained guitar, and synthetic balls of growing size."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.geometry.cameras import intrinsics, look_at
from gsjax.geometry.spherical_harmonics import evaluate_sh
from gsjax.io.ply import read_ply

HEAVY_CHANNELS = 64  # with this many channels or more, only three calls are timed


class Scene(NamedTuple):
    """Activated Gaussians and one camera, float32."""

    means: jax.Array  # [N, 3]
    quats: jax.Array  # [N, 4]
    scales: jax.Array  # [N, 3]
    opacities: jax.Array  # [N]
    colors: jax.Array  # [N, 3]
    features: jax.Array | None  # [N, F]
    viewmat: jax.Array  # [4, 4]
    K: jax.Array  # [3, 3]


@dataclass(frozen=True)
class Workload:
    """One scene and image size.

    Attributes:
        name: name for `--only`.
        make: makes the scene; raises FileNotFoundError if its data are absent.
        width, height: size of the image, pixels.
        channels: composited channels: 3 for colours only, else the number of features next to colours.
        repeats: largest number of timed calls of each program; None leaves it to the run.
        sweeps: growth plots to which it belongs.
        variants: whether to measure it also stage by stage, under plain `jax.jit`, and without `reads`.
    """

    name: str
    make: Callable[[], Scene]
    width: int
    height: int
    channels: int = 3
    repeats: int | None = None
    sweeps: tuple[str, ...] = ()
    variants: bool = False


def data_folder() -> Path:
    """Folder of the recordings that are not part of the repository: `$GSJAX_DATA`, or `../shared/data` next
    to the checkout."""
    named = os.environ.get("GSJAX_DATA")
    return Path(named) if named else Path(__file__).resolve().parents[2] / "shared" / "data"


def _data_file(name: str) -> Path:
    path = data_folder() / name
    if not path.is_file():
        raise FileNotFoundError(
            f"{path}: expected a file, found none; point GSJAX_DATA to the folder of {Path(name).parent}"
        )
    return path


def _floats(*arrays) -> list:
    return [None if a is None else jnp.asarray(a, jnp.float32) for a in arrays]


def garden(camera: int) -> Scene:
    """gsplat's test scene: points of the Mip-NeRF 360 garden, with random shapes and opacities."""
    stored = np.load(_data_file("garden_points/test_garden.npz"))
    points = stored["means3d"]
    inside = (np.abs(points) <= 2).all(axis=1)
    n, rng = int(inside.sum()), np.random.default_rng(42)
    scales = rng.uniform(1e-4, 0.02, (n, 3))
    quats = rng.normal(size=(n, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    opacities = rng.uniform(size=n)
    colors = stored["colors"][inside] / 255
    view = stored["viewmats"][camera], stored["Ks"][camera]
    return Scene(*_floats(points[inside], quats, scales, opacities, colors, None, *view))


def guitar() -> Scene:
    """Trained Gaussians (PlayCanvas), seen from a distance of 1.5 times their extent; y points down."""
    gaussians, _ = read_ply(_data_file("guitar/guitar.compressed.ply"))
    low, high = np.min(gaussians.means, axis=0), np.max(gaussians.means, axis=0)
    center, extent = (low + high) / 2, float(np.max(high - low))
    eye = center + 1.5 * extent * np.array([np.sin(0.5), -0.3, np.cos(0.5)]) / np.hypot(1.0, 0.3)
    viewmat = look_at(eye, center, up=np.array([0.0, -1.0, 0.0]))
    colors = jnp.maximum(evaluate_sh(0, gaussians.sh0, gaussians.means), 0.0)
    arrays = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, colors)
    return Scene(*_floats(*arrays, None, viewmat, intrinsics(0.9 * 640, 640, 480)))


def ball(num: int, width: int, height: int, channels: int = 3, seed: int = 0) -> Scene:
    """A ball of small Gaussians that covers much of the image, independently of their number."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(num, 3))
    radii = rng.uniform(size=(num, 1)) ** (1 / 3)
    means = directions / np.linalg.norm(directions, axis=1, keepdims=True) * radii
    scales = np.exp(rng.uniform(np.log(0.3), np.log(1.5), (num, 3))) * 0.7 / num ** (1 / 3)
    arrays = (means, rng.normal(size=(num, 4)), scales, rng.uniform(0.05, 1, num), rng.uniform(size=(num, 3)))
    features = rng.normal(size=(num, channels)) if channels > 3 else None
    viewmat = look_at(np.array([2.2, 0.4, 0.9]), np.zeros(3))
    return Scene(*_floats(*arrays, features, viewmat, intrinsics(0.9 * width, width, height)))


def ball_workload(
    num: int,
    size: tuple[int, int],
    channels: int = 3,
    sweeps: tuple[str, ...] = (),
    variants: bool = False,
) -> Workload:
    digits = f"{num:.0e}".replace("+0", "")
    name = f"ball-{digits}-{size[0]}x{size[1]}" + (f"-ch{channels}" if channels > 3 else "")
    make = partial(ball, num, *size, channels)
    repeats = 3 if channels >= HEAVY_CHANNELS else None
    return Workload(name, make, *size, channels, repeats, sweeps, variants)


def _sweep(counts, sizes, channels, num: int, size: tuple[int, int], variants: bool) -> list[Workload]:
    """Sweeps over counts, sizes and channels through one common point, which is included once."""
    meeting = ball_workload(num, size, 3, ("gaussians", "pixels", "channels"), variants)
    return [
        meeting,
        *(ball_workload(n, size, 3, ("gaussians",), variants) for n in counts if n != num),
        *(ball_workload(num, s, 3, ("pixels",)) for s in sizes if s != size),
        *(ball_workload(num, size, c, ("channels",)) for c in channels if c != 3),
    ]


VGA, HD = (640, 480), (1920, 1080)
SUITE = [
    *(Workload(f"garden-{c}", partial(garden, c), 648, 420, variants=c == 0) for c in range(3)),
    Workload("guitar", guitar, 640, 480),
    *_sweep(
        counts=(1_000, 10_000, 1_000_000),
        sizes=((160, 120), (320, 240), (1280, 720), HD),
        channels=(16, 64, 512),
        num=100_000,
        size=VGA,
        variants=True,
    ),
    ball_workload(1_000_000, HD),
    ball_workload(50_000, (320, 240), 512),
]
QUICK = _sweep(
    counts=(1_000,),
    sizes=((160, 120),),
    channels=(16,),
    num=10_000,
    size=(320, 240),
    variants=False,
)


def choose(names: Sequence[str], patterns: Sequence[str]) -> list[str]:
    """The `names` selected by `patterns`: names, parts of names before the first hyphen, or globs.

    No patterns select all.

    Raises:
        ValueError: a pattern matches no name.
    """
    for pattern in patterns:
        if not any(_fits(name, pattern) for name in names):
            raise ValueError(
                f"--only: expected a workload, found {pattern!r}; choose from {', '.join(names)}"
            )
    return [n for n in names if not patterns or any(_fits(n, p) for p in patterns)]


def _fits(name: str, pattern: str) -> bool:
    return fnmatchcase(name, pattern) or name.split("-")[0] == pattern
