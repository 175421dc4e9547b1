"""How good is a reconstruction of a real clip without depth, masks, poses and calibration?"""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

import gsjax
from experiments.shared.deforming import Reconstructed, copies_of, drawn, learned, one_frame, split, summary
from experiments.shared.recordings import recorded
from gsjax.data import DataWarning, Sequence
from gsjax.engine.deform.data import unit_times
from gsjax.methods.deform import DeformConfig
from gsjax.metrics.image import psnr, ssim
from gsjax.scene.frame import Frame

SCALE = 0.25  # of 640x512
BASE = DeformConfig(warmup=100, iterations=500, start_pixels=1.5, nodes=1024)
COPIES = {
    "previous": "copy of the frame before",
    "neighbors": "mean of both neighbours",
    "first": "copy of the first frame",
}


def clip() -> Sequence:
    """The clip; a field of view of 60 degrees is assumed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        return gsjax.open_sequence(recorded("endonerf_pulling") / "pulling_gt.mp4").scaled(SCALE)


def no_tool(image: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Pixels that are no tool by their colour: tools are grey or blue, large, and enter from the border, as
    do some highlights and the display's strip at the bottom."""
    height, width = image.shape[:2]
    red, green, blue = np.moveaxis(cv2.GaussianBlur(image, (0, 0), 1.0).astype(int), -1, 0)
    grey = ((red - blue < 25) & (red - green < 40)).astype(np.uint8)
    grey = cv2.morphologyEx(grey, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    grey = cv2.morphologyEx(grey, cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8))
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(grey)
    tool = np.zeros((height, width), np.uint8)
    for i, (x, y, across, down, area) in enumerate(boxes[1:], start=1):
        border = x == 0 or y == 0 or x + across >= width or y + down >= height - 4
        tool[(labels == i) & border & (area > 0.005 * width * height)] = 1
    return cv2.dilate(tool, np.ones((7, 7), np.uint8)) == 0


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """Every eighth frame held out; the camera is assumed static, and the scene starts on a plane."""
    sequence = clip()
    train, test = split(sequence.num_frames)
    config = replace(BASE, seed=seed)
    if options["variant"] == "static":
        config = replace(config, warmup=config.warmup + config.iterations, iterations=0, warmup_frames="all")

    def seen(t: int) -> Frame:
        image, view = sequence.image(t, 0), (sequence.viewmats[t, 0], sequence.Ks[t, 0])
        mask = None if options["pixels"] == "all" else no_tool(image)
        return one_frame(image, *view, float(unit_times(sequence)[t]), mask=mask)

    found = learned([seen(t) for t in train], config)
    rows = [_scores(found, seen(t)) | _copies(sequence, t, seen(t)) for t in test]
    return {
        **{name: float(np.mean([row[name] for row in rows])) for name in rows[0]},
        "psnr_learned": float(np.mean([_scores(found, seen(t))["psnr"] for t in train[::8]])),
        **summary(found),
        "frames": {str(t): row for t, row in zip(test, rows, strict=True)},
    }


def _scores(found: Reconstructed, frame: Frame) -> dict[str, float]:
    colors, true, mask = drawn(found, frame)[0], frame.images[0] / 255.0, _mask(frame)
    counted = 1.0 if mask is None else float(mask.mean())
    return {"psnr": psnr(colors, true, mask), "ssim": ssim(colors, true, mask), "counted": counted}


def _mask(frame: Frame) -> Bool[np.ndarray, "h w"] | None:
    return None if frame.masks is None else frame.masks[0]


def _copies(sequence: Sequence, t: int, frame: Frame) -> dict[str, float]:
    """PSNR of copies of other frames, over the same pixels."""
    true, mask = frame.images[0] / 255.0, _mask(frame)
    return {f"psnr_{name}": psnr(guess, true, mask) for name, guess in copies_of(sequence, t).items()}


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """PSNR of each held-out frame, beside copies of others."""
    from matplotlib.figure import Figure

    from experiments.shared.plots import BLUE, GREEN, GREY, ORANGE, PURPLE

    kinds = list(dict.fromkeys(row["pixels"] for row in rows))
    drawing = Figure(figsize=(5.2 * len(kinds), 3.6), dpi=100, layout="constrained")
    for axes, kind in zip(drawing.subplots(1, len(kinds), sharey=True, squeeze=False)[0], kinds, strict=True):
        some = {row["variant"]: row["frames"] for row in rows if row["pixels"] == kind}
        lines = [(variant, "psnr", frames) for variant, frames in some.items()]
        last = next(iter(some.values()))
        lines += [(words, f"psnr_{key}", last) for key, words in COPIES.items()]
        for (words, key, frames), color in zip(lines, (BLUE, ORANGE, GREY, GREEN, PURPLE), strict=False):
            values = [row[key] for row in frames.values()]
            axes.plot([int(t) for t in frames], values, "o-", color=color, label=words, markersize=4)
        axes.set_title(f"pixels: {kind}", fontsize=10)
        axes.set_xlabel("frame, held out")
        axes.grid(alpha=0.3)
    drawing.axes[0].set_ylabel("PSNR [dB]")
    drawing.axes[0].legend(fontsize=8)
    drawing.savefig(path, format="png")
