"""What are exposures, the search for jumps and the refinement worth on a real recording? One is switched off,
or made otherwise, at a time."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments.parts_basketball.basketball import HELD_OUT, NEAR, ball_scores
from experiments.shared.discoveries import FIT, Options, canonical_of, discovered, with_parts
from experiments.shared.recordings import recorded

SCALE, FRAMES, ANCHOR = 0.5, "0:30:3", 9
VARIANTS: dict[str, dict[str, Any]] = {
    "all on": {},
    "without exposures": {"top": {"exposures": False}},
    "without the search for jumps": {"stream": {"search": False}},
    "without refinement": {"refine": {"iterations": 0}},
    "poses refined slowly": {"refine": {"pose_rate": 0.05}},
}


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One discovery on every third frame with one variant; all begin with the same canonical scene."""
    told = Options(
        str(recorded("panoptic_basketball")),
        folder / "run",
        frames=FRAMES,
        eval_cameras=HELD_OUT,
        scale=SCALE,
        overwrite=True,
        read=NEAR,
        anchor=ANCHOR,
        fit=replace(FIT, steps=4_000, cap=30_000, start=replace(FIT.start, count=20_000)),
    )
    told = with_parts(told, **VARIANTS[options["variant"]])
    told = replace(with_parts(told, top={"seed": seed}), scene=canonical_of(told, folder))
    return discovered(told) | ball_scores(told.out)


PANELS = (
    ("held_out_psnr", "held-out PSNR [dB]"),
    ("held_out_ssim", "SSIM"),
    ("ball_found", "ball found [%]"),
    ("parts", "parts"),
    ("minutes", "minutes"),
)


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """A panel for each score, a bar for each variant."""
    from experiments.shared.plots import draw_ablation

    draw_ablation(rows, PANELS, path)
