"""Parts of two people and a ball in a dome of real cameras: how are views seen that were held out?"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments.shared.discoveries import FIT, Options, discovered, steadiness
from experiments.shared.recordings import recorded
from gsjax.data import ReadOptions

HELD_OUT = (0, 10, 15, 30)  # the test cameras of Dynamic3DGaussians
NEAR = ReadOptions(near=0.5)  # cameras of the dome see each other


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One discovery over all frames, the canonical scene included, as `gsjax parts` does it."""
    start = replace(FIT.start, count=20_000)
    told = Options(
        str(recorded("panoptic_basketball")),
        folder / "run",
        eval_cameras=HELD_OUT,
        scale=options["scale"],
        overwrite=True,
        read=NEAR,
        fit=replace(FIT, steps=4_000, cap=30_000, start=start, seed=seed),
    )
    found = discovered(told) | steadiness(told.out)
    metrics = json.loads((told.out / "metrics.json").read_text())
    cameras = {camera: metrics["cameras"][str(camera)]["psnr"] for camera in HELD_OUT}
    canonical = json.loads((told.out / "canonical" / "metrics.json").read_text())
    return found | {
        "total_minutes": metrics["seconds"]["total"] / 60,
        "canonical_psnr": canonical["test"]["psnr"],
        "cameras": [f"{camera}: {psnr:.2f} dB" for camera, psnr in cameras.items()],
    }
