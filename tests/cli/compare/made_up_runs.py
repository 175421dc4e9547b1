"""Made-up run folders of each method, with as much in them as readers of their scores need."""

import json
from pathlib import Path

import yaml

MACHINE = {
    "processor": "x",
    "cores": 2,
    "avx512": False,
    "device": "cpu",
    "devices": 1,
    "jax": "0",
    "python": "3",
}
CONFIG = {
    "parts": {"parts": {"seed": 0}, "anchor": 0, "fit": {"steps": 9}, "eval_cameras": [3]},
    "distill": {"distill": {"seed": 0}, "features": "auto", "masks": "auto"},
    "deform": {
        "deform": {"channels": 16},
        "tools": "draw",
        "depth": "auto",
        "features": "auto",
        "masks": "auto",
        "eval_cameras": [],
    },
}


def metrics_of(kind: str, psnr: float) -> dict:
    shared = {
        "kind": kind,
        "dataset": "made up",
        "complete": True,
        "report": True,
        "machine": MACHINE,
        "notes": [],
    }
    if kind == "parts":
        part = {"part": 1, "name": "part 1", "iou": 0.5, "point_error_mm": 20.0}
        return shared | {
            "image": {"width": 96, "height": 72},
            "frames": {"first_id": 0, "last_id": 9, "asked": 10, "followed": 10},
            "tracked_cameras": [0, 1],
            "held_out_cameras": [3],
            "num_gaussians": 900,
            "num_parts": 2,
            "ari": 0.7,
            "parts": [part, part | {"iou": None, "point_error_mm": None}, part | {"iou": 0.7}],
            "tracked": {"psnr": psnr},
            "held_out": {"psnr": psnr - 1, "ssim": 0.8},
            "update_s": {"median": 3.0},
        }
    learned = {
        "size": [96, 72],
        "judged_by": "held out",
        "steps": 40,
        "seconds": {"steps": 90.0, "compile": 30.0},
    }
    if kind == "distill":
        return shared | learned | {"views": {"taught": 9}, "test": {"cosine": psnr / 100}, "trained": 12}
    test = {"psnr_masked": psnr, "ssim": 0.8, "depth_mm": 2.0}
    frames = {"learned": 8, "held_out": 2}
    return shared | learned | {"frames": frames, "test": test, "tracks": None, "num_gaussians": 5}


def write_run(folder: Path, kind: str, psnr: float, **settings) -> Path:
    folder.mkdir()
    (folder / "config.yml").write_text("# gsjax run\n" + yaml.safe_dump(CONFIG[kind] | settings))
    (folder / "metrics.json").write_text(json.dumps(metrics_of(kind, psnr)))
    return folder
