"""A recording in D-NeRF's layout, ray-cast from solids: a bar that bends and twists, a sliding block and a
bouncing ball on an empty background, seen by one camera that jumps around them.

    python -m tests.data.moving_object FOLDER --size 200
"""

import argparse
import json
from pathlib import Path

import numpy as np

from gsjax.data.simulated import raycaster
from gsjax.data.simulated.motion import rigid, turn
from gsjax.data.simulated.primitives import Primitive
from gsjax.data.simulated.raycaster import Light, Scene, trace
from gsjax.data.simulated.textures import GAMMA, Texture
from gsjax.geometry.cameras import OPENGL_TO_OPENCV, intrinsics, look_at
from tests.data import dots

COUNTS = {"train": 60, "val": 10, "test": 10}
_TARGET, _AWAY = np.array([0.0, 0.0, 0.26]), 1.8  # metres
_HALF_WIDTH = 0.5  # of the view at the target
_FINER = 3  # rays along each side of a pixel
_LAMP = (1.1, 0.9, 1.9)
_CHECKER = Texture("checker", ((0.4, 0.1, 0.4), (1, 0.8, 0.3)), 0.05)
_LABEL = Texture("label", ((0.1, 0.4, 0.6), (0.9, 0.9, 0.9)), 0.07, seed=4)
_STRIPES = Texture("stripes", ((0.7, 0.1, 0.1), (0.9, 0.6, 0.2)), 0.05, seed=5)
_NOISE = Texture("noise", ((0.2, 0.3, 0.2), (0.5, 0.6, 0.4)), 0.1, seed=6)
_SOLIDS = (
    Primitive("bent box", (0.07, 0.05, 0.22, 0, 0, 0), _CHECKER, 0),
    Primitive("box", (0.08, 0.05, 0.05), _LABEL, 1),
    Primitive("sphere", (0.06,), _STRIPES, 2),
    Primitive("cylinder", (0.3, 0.02), _NOISE, 3),
)


def write_dnerf(root: Path, size: int = 100, counts: dict[str, int] = COUNTS) -> None:
    """Write the splits, each spanning the times 0 to 1, as RGBA pictures of size x size pixels."""
    random = np.random.default_rng(0)
    for split, count in counts.items():
        frames = []
        for i, time in enumerate(np.linspace(0, 1, count)):
            azimuth, height = 2 * np.pi * random.uniform(), np.arcsin(random.uniform(0.1, 0.9))
            if split == "test":
                azimuth, height = 2 * np.pi * time, np.deg2rad(30)
            aside = np.cos(height)
            towards = np.array([aside * np.cos(azimuth), aside * np.sin(azimuth), np.sin(height)])
            viewmat = look_at(_TARGET + _AWAY * towards, _TARGET)
            name = f"./{split}/r_{i:03d}"
            dots.save(root / f"{name}.png", _picture(time, viewmat, size))
            pose = np.linalg.inv(viewmat) @ OPENGL_TO_OPENCV
            frames.append({"file_path": name, "time": time, "transform_matrix": pose.tolist()})
        listed = {"camera_angle_x": 2 * np.arctan(_HALF_WIDTH / _AWAY), "frames": frames}
        (root / f"transforms_{split}.json").write_text(json.dumps(listed))


def _picture(time: float, viewmat: np.ndarray, size: int) -> np.ndarray:
    """The picture at a time, RGBA, [size,size,4] uint8."""
    fine = _FINER * size
    wave = np.sin(np.pi * time)
    poses = rigid(
        None, np.array([[0, 0, 0.26], [0.2, 0.3 * time - 0.15, 0.09], [-0.2, 0.02, 0.1], [0, 0, 0.02]])
    )
    poses[1, :3, :3] = turn((0, 0, 1), 1.2 * time).as_matrix()
    poses[2, 2, 3] += 0.25 * abs(np.sin(2 * np.pi * time))
    scene = Scene(
        _SOLIDS,
        np.arange(len(_SOLIDS)),
        poses[None],
        Light(_LAMP),
        intrinsics(0.5 * fine * _AWAY / _HALF_WIDTH, fine, fine)[None, None],
        viewmat[None, None],
        fine,
        fine,
        {0: np.array([[0.07, 0.05, 0.22, 1.5 * wave, 0.9 * time, 0.5]])},
    )
    hits = trace(scene, 0, 0)
    radiance = raycaster._radiance(scene, 0, hits, np.array(_LAMP))
    both = np.concatenate([radiance, (hits.primitive >= 0)[None]])
    both = both.reshape(4, size, _FINER, size, _FINER).mean((2, 4))
    colors = np.clip(both[:3] / np.maximum(both[3:], 1e-9), 0, 1) ** (1 / GAMMA)
    return np.round(255 * np.concatenate([colors, both[3:]])).astype(np.uint8).transpose(1, 2, 0)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--size", type=int, default=100)
    arguments = parser.parse_args()
    write_dnerf(arguments.folder, arguments.size)
