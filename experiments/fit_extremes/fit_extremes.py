"""`gsjax fit` with extreme data."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from experiments.shared.commands import ended
from gsjax.data.simulated import tabletop
from gsjax.geometry.cameras import OPENGL_TO_OPENCV
from gsjax.io.ply import read_ply

SMALL = ["--fit.steps", "300", "--fit.cap", "2000", "--fit.start.count", "1000", "--judge-every", "100"]


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One fit, in its own process."""
    data, out = folder / "data", folder / "run"
    more = CASES[options["case"]](data)
    ran = ended("fit", data, "--out", out, "--overwrite", *SMALL, *more)
    if "Traceback" in ran.output:
        raise RuntimeError(ran.output)
    row = {"code": ran.code, "memory_mb": ran.memory_mb}
    if ran.code:
        return row | {"said": next(line for line in ran.output.splitlines() if line.startswith("error"))}
    found = json.loads((out / "metrics.json").read_text())
    gaussians, _ = read_ply(out / "scene.ply")
    leaves = (
        gaussians.means,
        gaussians.quats,
        gaussians.log_scales,
        gaussians.logit_opacities,
        gaussians.sh0,
    )
    scores = [view["psnr"] for view in found["views"] if view["psnr"] is not None]
    return row | {
        "psnr": float(np.mean(scores)) if scores else None,
        "gaussians": found["num_gaussians"],
        "finite": all(bool(np.isfinite(np.asarray(leaf)).all()) for leaf in leaves),
        "skipped": found["skipped"],
        "seconds_a_step": found["seconds"]["fit"] / found["steps"],
        "said": " ".join(found["notes"]).replace(f"{folder}/", ""),
    }


def photographs(
    folder: Path, count: int = 6, size=(64, 48), image=None, turned=None, points=None, masked: bool = False
) -> None:
    """Write a transforms.json with pictures: those of the built-in table, or others from its cameras."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    sequence = tabletop(frames=-(-count // 3), width=64, height=48)
    frames = []
    for i in range(count):
        t, c = divmod(i, 3)
        shown = sequence.image(t, c) if image is None else image
        viewmat = sequence.viewmats[t, c]
        if turned is not None:  # a camera that rotates in place sees another part of the same picture
            K, viewmat, turn = sequence.Ks[0, 0], sequence.viewmats[0, 0].copy(), _turn(turned * (i - 2.5))
            viewmat[:3] = turn @ viewmat[:3]
            shown = cv2.warpPerspective(sequence.image(0, 0), K @ turn @ np.linalg.inv(K), (64, 48))
        name = f"images/{i}.png"
        cv2.imwrite(str(folder / name), cv2.resize(shown, size, interpolation=cv2.INTER_CUBIC)[..., ::-1])
        pose = np.linalg.inv(viewmat) @ OPENGL_TO_OPENCV
        K = sequence.Ks[t, c] * np.array([[size[0] / 64], [size[1] / 48], [1]])
        own = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
        frame = {"file_path": name, "transform_matrix": pose.tolist(), **own}
        if masked:
            cv2.imwrite(str(folder / f"images/mask_{i}.png"), np.zeros(size[::-1], np.uint8))
            frame["mask_path"] = f"images/mask_{i}.png"
        frames.append(frame)
    transforms: dict[str, Any] = {"frames": frames}
    if points is not None:
        rows = "\n".join(f"{x} {y} {z} 200 100 50" for x, y, z in points)
        head = "ply\nformat ascii 1.0\nelement vertex {}\n" + "".join(
            f"property {kind} {name}\n"
            for kind, names in (("float", "xyz"), ("uchar", ("red", "green", "blue")))
            for name in names
        )
        (folder / "points.ply").write_text(head.format(len(points)) + "end_header\n" + rows + "\n")
        transforms["ply_file_path"] = "points.ply"
    (folder / "transforms.json").write_text(json.dumps(transforms))


def _turn(angle: float) -> np.ndarray:
    """Rotation about the camera's y axis."""
    return np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])


def _poisoned() -> np.ndarray:
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (200, 3))
    points[::7, 1], points[::11, 0] = np.nan, np.inf
    return points


ALL = ["--test-every", "0"]
CASES = {
    "one photograph": lambda at: photographs(at, count=1) or ALL,
    "two Gaussians": lambda at: photographs(at) or [*ALL, "--fit.cap", "2", "--fit.start.count", "2"],
    "white photographs": lambda at: photographs(at, image=np.full((48, 64, 3), 255, np.uint8)) or ALL,
    "all cameras at one place": lambda at: photographs(at, turned=0.05) or ALL,
    "all cameras the same": lambda at: photographs(at, turned=0.0) or ALL,
    "photographs of 8x8": lambda at: photographs(at, size=(8, 8)) or ALL,
    "photographs of 4000x3000": lambda at: (
        photographs(at, size=(4000, 3000), count=3) or [*ALL, "--fit.steps", "12", "--fit.cap", "20000"]
    ),
    "points that are not numbers": lambda at: photographs(at, points=_poisoned()) or ALL,
    "points a million times further": lambda at: (
        photographs(at, points=1e6 * np.random.default_rng(0).uniform(-1, 1, (200, 3))) or ALL
    ),
    "everything masked": lambda at: photographs(at, masked=True) or ALL,
}
