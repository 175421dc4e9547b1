"""What each format preserves of a scene: `python -m benchmarks.formats SCENE [--up UP] [--out TABLE.json]`.

The scene is rendered in eight views on a circle around it, 320 x 240 pixels. The figure is the lowest PSNR
between these renders and those of the file, read back by us and by other programs where they are installed
(tests/io/converters.py); likewise for the files that those programs write of the scene, read by us.
"""

import argparse
import json
import tempfile
from pathlib import Path
from time import perf_counter

import jax.numpy as jnp
import numpy as np

from gsjax.engine import machine
from gsjax.geometry.cameras import Camera, intrinsics
from gsjax.io.scenes import FORMATS, read_gaussians, write_gaussians
from gsjax.metrics.image import psnr
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import render
from tests.io.converters import CONVERTERS, Converter

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


class Judge:
    """Rates copies of a scene by the lowest PSNR of its views, in dB, to a tenth; "exact" if none differs."""

    def __init__(self, gaussians: Gaussians, up: np.ndarray):
        """
        Args:
            gaussians: the scene itself.
            up: unit vector, [3].
        """
        self._cameras = cameras_around(gaussians, up)
        self._wanted = np.asarray(render(gaussians, self._cameras).colors)

    def __call__(self, gaussians: Gaussians) -> float | str:
        """Judge another scene.

        Args:
            gaussians: the scene to judge.
        """
        found = np.asarray(render(gaussians, self._cameras).colors)
        worst = min(psnr(a, b) for a, b in zip(found, self._wanted, strict=True))
        return "exact" if np.isinf(worst) else round(worst, 1)


def measure(scene: Gaussians, judge: Judge, folder: Path) -> dict[str, dict]:
    """The row of each format: size, seconds, and dB by writer and reader.

    Args:
        scene: the scene.
        judge: the judge of that scene.
        folder: an empty folder.
    """
    programs = [program for program in CONVERTERS.values() if program.installed]
    plain, rows = folder / "plain.ply", {}
    write_gaussians(plain, scene)
    for ending in FORMATS:
        file, begun = folder / f"scene{ending}", perf_counter()
        write_gaussians(file, scene)
        row = {"bytes": file.stat().st_size, "written_s": round(perf_counter() - begun, 2)}
        if ending not in (".glb", ".html"):
            begun = perf_counter()
            back, _ = read_gaussians(file)
            row |= {"read_s": round(perf_counter() - begun, 2), "ours": judge(back)}
        for program in programs:
            if ending in program.reads:
                theirs = folder / "read_by_them.ply"
                program(file, theirs)
                row[f"read by {program.name}"] = _judged(theirs, ending, program, judge)
            if ending in program.writes:
                theirs = folder / f"written_by_them{ending}"
                program(plain, theirs)
                row[f"written by {program.name}"] = _judged(theirs, ending, program, judge)
        rows[ending] = row
    return rows


def _judged(file: Path, ending: str, program: Converter, judge: Judge) -> float | str:
    back, _ = read_gaussians(file)
    return judge(program.axes(back, ending))


def table(rows: dict[str, dict], count: int) -> str:
    """The rows in Markdown.

    Args:
        rows: as returned by `measure`.
        count: number of Gaussians.
    """
    said = [key for row in rows.values() for key in row if key.startswith(("read by", "written by"))]
    others = list(dict.fromkeys(said))
    lines = [
        " | ".join(["format", "MB", "bytes a Gaussian", "written, s", "read, s", "dB", *others]),
        " | ".join(["---"] * (6 + len(others))),
    ]
    for ending, row in rows.items():
        cells = [f"`{ending}`", f"{row['bytes'] / 1e6:.2f}", f"{row['bytes'] / count:.1f}", row["written_s"]]
        cells += [row.get(key, "–") for key in ("read_s", "ours", *others)]
        lines.append(" | ".join(map(str, cells)))
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description="what each format makes of a scene")
    parser.add_argument("scene", help="a file of Gaussians")
    parser.add_argument("--up", choices=UPS, default="-y", help="its up direction")
    parser.add_argument("--out", type=Path, help="a .json for the table")
    arguments = parser.parse_args()
    scene, _ = read_gaussians(arguments.scene)
    judge = Judge(scene, np.array(UPS[arguments.up]))
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(scene, judge, Path(folder))
    print(table(rows, scene.num))
    if arguments.out:
        record = {"machine": machine.describe(), "scene": Path(arguments.scene).name}
        record |= {"gaussians": scene.num, "sh_degree": scene.sh_degree, "formats": rows}
        arguments.out.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
