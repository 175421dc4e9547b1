"""What each format makes of a scene: `python -m benchmarks.formats SCENE [UP]`, a table in Markdown.

Eight views on a circle around the scene, 320 x 240 pixels: the least PSNR of a render of the file read back,
against one of the scene itself. UP is that of the scene: -y (default), y, z.
"""

import sys
import tempfile
from pathlib import Path
from time import perf_counter

import jax.numpy as jnp
import numpy as np

from gsjax.geometry.cameras import Camera, intrinsics
from gsjax.io.scenes import FORMATS, read_gaussians, write_gaussians
from gsjax.metrics.image import psnr
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import render

WIDTH, HEIGHT, VIEWS = 320, 240, 8
UPS = {"-y": (0.0, -1.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def cameras_around(gaussians: Gaussians, up: np.ndarray) -> Camera:
    """Cameras on a circle around a scene, looking at its middle.

    Args:
        gaussians: the scene.
        up: unit vector, [3].
    """
    means = np.asarray(gaussians.means, np.float64)
    middle = np.median(means, axis=0)
    distance = 2.5 * np.quantile(np.linalg.norm(means - middle, axis=1), 0.9)
    side = np.roll(np.abs(up), 1)
    viewmats = np.tile(np.eye(4), (VIEWS, 1, 1))
    for viewmat, angle in zip(viewmats, np.arange(VIEWS) * 2 * np.pi / VIEWS, strict=True):
        forward = np.cos(angle) * side + np.sin(angle) * np.cross(up, side) - 0.2 * up
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ (middle - distance * forward)
    Ks = np.tile(intrinsics(1.2 * HEIGHT, WIDTH, HEIGHT), (VIEWS, 1, 1))
    return Camera(jnp.asarray(viewmats, jnp.float32), jnp.asarray(Ks, jnp.float32), WIDTH, HEIGHT)


def main(scene: str, up: str = "-y") -> None:
    """Print the table.

    Args:
        scene: a file of Gaussians.
        up: its up direction.
    """
    gaussians, _ = read_gaussians(scene)
    cameras = cameras_around(gaussians, np.array(UPS[up]))
    wanted = np.asarray(render(gaussians, cameras).colors)
    print(
        "| format | MB | bytes a Gaussian | PSNR, dB | written, s | read, s |", "| --- " * 6 + "|", sep="\n"
    )
    with tempfile.TemporaryDirectory() as folder:
        for ending in FORMATS:
            file, begun = Path(folder) / f"scene{ending}", perf_counter()
            write_gaussians(file, gaussians)
            size, written = file.stat().st_size, perf_counter() - begun
            row = f"| {ending} | {size / 1e6:.2f} | {size / gaussians.num:.1f}"
            if ending in (".glb", ".html"):
                print(f"{row} | – | {written:.2f} | – |")
                continue
            begun = perf_counter()
            back, _ = read_gaussians(file)
            seconds, found = perf_counter() - begun, np.asarray(render(back, cameras).colors)
            worst = min(psnr(a, b) for a, b in zip(found, wanted, strict=True))
            print(
                f"{row} | {'exact' if np.isinf(worst) else f'{worst:.1f}'} | {written:.2f} | {seconds:.2f} |"
            )


if __name__ == "__main__":
    main(*sys.argv[1:])
