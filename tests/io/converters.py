"""Other programs that convert files of Gaussians between formats, to test our own against.

- splat-transform of PlayCanvas: `npm install -g @playcanvas/splat-transform`, or
  GSJAX_SPLAT_TRANSFORM=FOLDER/bin/cli.mjs.
- gsply: `pip install gsply imagecodecs`, or GSJAX_GSPLY=PYTHON, an interpreter that has both.
"""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from gsjax.geometry.spherical_harmonics import sh_bases
from gsjax.scene.gaussians import Gaussians

_SPLAT_TRANSFORM = os.environ.get("GSJAX_SPLAT_TRANSFORM") or shutil.which("splat-transform")
_GSPLY = os.environ.get("GSJAX_GSPLY") or (sys.executable if find_spec("gsply") else None)
_GSPLY_PROGRAM = """
import sys
from pathlib import Path

import gsply
from gsply.sog_reader import sogread

source, target = sys.argv[1:]
scene = {".spz": gsply.read_spz, ".sog": sogread}.get(Path(source).suffix, gsply.plyread)(source)
(gsply.write_spz if target.endswith(".spz") else gsply.plywrite)(target, scene)
"""


@dataclass(frozen=True)
class Converter:
    """A program, the file endings that it reads and writes, and whether it rotates a PLY to SPZ's axes, as
    Niantic's programs do, or keeps the PLY's axes in an SPZ (no header states which)."""

    name: str
    reads: tuple[str, ...]
    writes: tuple[str, ...]
    turns_spz: Callable[[], bool]
    command: Callable[[Path, Path], list]
    installed: bool

    def __call__(self, source: Path, target: Path) -> None:
        """Convert a file.

        Args:
            source, target: the files.

        Raises:
            RuntimeError: the program fails; the message is its output.
        """
        done = subprocess.run(self.command(source, target), capture_output=True, text=True, timeout=600)
        if done.returncode or not target.is_file():
            raise RuntimeError(done.stdout + done.stderr)

    def axes(self, scene: Gaussians, ending: str) -> Gaussians:
        """A scene in the axes of the program's files with an ending.

        Args:
            scene: the scene.
            ending: file ending.
        """
        return scene if ending != ".spz" or self.turns_spz() else half_turned(scene)


def half_turned(scene: Gaussians) -> Gaussians:
    """A scene rotated by 180 degrees about X, with signs of harmonics from the basis functions themselves.

    Args:
        scene: the scene.
    """
    axes = np.array([1.0, -1, -1])
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rest = None
    if scene.shN is not None:
        here, there = (
            np.asarray(sh_bases(3, jnp.asarray(d)))[:, 1:] for d in (directions, directions * axes)
        )
        signs = np.sign(np.sum(here * there, axis=0))[: scene.shN.shape[1]]
        rest = scene.shN * signs[:, None]
    quats = scene.quats * np.array([1.0, 1, -1, -1])
    return Gaussians(scene.means * axes, quats, scene.log_scales, scene.logit_opacities, scene.sh0, rest)


def _splat_transform(source: Path, target: Path) -> list:
    return [
        "node",
        _SPLAT_TRANSFORM,
        "-w",
        source,
        target,
        *(["-g", "cpu"] if target.suffix == ".sog" else []),
    ]


def _is_splat_transform_2() -> bool:
    """Whether it is older than version 3, which keeps the axes of a PLY in an SPZ."""
    said = subprocess.run(["node", _SPLAT_TRANSFORM, "--version"], capture_output=True, text=True, timeout=60)
    return int(re.search(r"v(\d+)\.", said.stdout + said.stderr)[1]) < 3


CONVERTERS = {
    program.name: program
    for program in (
        Converter(
            "splat-transform",
            (".ply", ".compressed.ply", ".splat", ".spz", ".sog", ".ksplat"),
            (".ply", ".compressed.ply", ".spz", ".sog"),
            _is_splat_transform_2,
            _splat_transform,
            _SPLAT_TRANSFORM is not None and shutil.which("node") is not None,
        ),
        Converter(
            "gsply",
            (".ply", ".compressed.ply", ".spz", ".sog"),
            (".ply", ".compressed.ply", ".spz"),
            lambda: False,
            lambda source, target: [_GSPLY, "-c", _GSPLY_PROGRAM, source, target],
            _GSPLY is not None,
        ),
    )
}
"""By name."""
