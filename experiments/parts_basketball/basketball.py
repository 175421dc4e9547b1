"""Parts of two people and a ball in a dome of real cameras: how are views seen that were held out?"""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from experiments.shared.discoveries import FIT, Options, discovered, steadiness
from experiments.shared.recordings import recorded
from gsjax.data import ReadOptions
from gsjax.engine.parts.saved import open_parts_run
from gsjax.engine.parts.views import part_views

HELD_OUT = (0, 10, 15, 30)  # the test cameras of Dynamic3DGaussians
NEAR = ReadOptions(near=0.5)  # cameras of the dome see each other
RED, BRIGHT = 1.9, 60 / 255  # how much redder than green and blue the ball is, and its least red
WIDTH = 320  # pixels of the pictures in which the ball's places are given
LARGE = 7.0  # radius of a ball that is clearly seen, in these pixels
NEARBY = 2.0  # radii within which a ball counts as where it is


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
        fit=replace(FIT, steps=4_000, cap=round(60_000 * options["scale"]), start=start, seed=seed),
    )
    found = discovered(told) | steadiness(told.out) | ball_scores(told.out)
    metrics = json.loads((told.out / "metrics.json").read_text())
    cameras = {camera: metrics["cameras"][str(camera)]["psnr"] for camera in HELD_OUT}
    canonical = json.loads((told.out / "canonical" / "metrics.json").read_text())
    return found | {
        "total_minutes": metrics["seconds"]["total"] / 60,
        "canonical_psnr": canonical["test"]["psnr"],
        "cameras": [f"{camera}: {psnr:.2f} dB" for camera, psnr in cameras.items()],
    }


def ball_scores(folder: Path) -> dict[str, Any]:
    """Where the ball is drawn in the test cameras, against where it is: the largest red disc of each picture.

    Only pictures count in which it is clearly seen, as a disc of at least the area that `LARGE` says. It is
    found if a red disc is drawn within two radii of its place; the median is over all pictures, infinite
    (None) if it is not found in half of them.
    """
    gaps = []
    for image, render in pictures(folder):
        there, radius = disc(image)
        if there is None or radius < LARGE:
            continue
        drawn, _ = disc(render)
        gap = np.inf if drawn is None else float(np.linalg.norm(drawn - there))
        gaps.append(gap if gap < NEARBY * radius else np.inf)
    median = float(np.median(gaps)) if gaps else np.inf
    return {
        "ball_pixels": median if np.isfinite(median) else None,
        "ball_found": 100 * float(np.isfinite(gaps).mean()) if gaps else None,
        "ball_pictures": len(gaps),
    }


def pictures(folder: Path) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The test pictures of a run, recorded and drawn."""
    run = open_parts_run(folder)
    for views in part_views(run.layer.scene, run.layer.trajectory, run.recording, run.blend):
        yield from ((view.image, view.render) for view in views if view.camera in HELD_OUT)


def disc(picture: Float[np.ndarray, "H W 3"]) -> tuple[Float[np.ndarray, "2"] | None, float]:
    """Middle and radius of the largest red disc, in pixels of a picture `WIDTH` wide; None and 0 if there is
    none."""
    size = WIDTH, round(WIDTH * picture.shape[0] / picture.shape[1])
    picture = cv2.resize(np.asarray(picture, np.float32), size, interpolation=cv2.INTER_AREA)
    red = (picture[..., 0] > RED * picture[..., 1:].max(-1)) & (picture[..., 0] > BRIGHT)
    opened = cv2.morphologyEx(red.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3)))
    count, _, sizes, middles = cv2.connectedComponentsWithStats(opened)
    if count < 2:
        return None, 0.0
    largest = 1 + int(np.argmax(sizes[1:, cv2.CC_STAT_AREA]))
    return middles[largest], float(np.sqrt(sizes[largest, cv2.CC_STAT_AREA] / np.pi))
