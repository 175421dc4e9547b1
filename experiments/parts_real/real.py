"""What are exposures, the search for jumps and the refinement worth on a real recording? One is switched off,
or made otherwise, at a time."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.parts_basketball.basketball import HELD_OUT, NEAR, ball_scores
from experiments.shared.discoveries import FIT, Options, discovered, with_parts
from experiments.shared.recordings import recorded
from gsjax.engine.fit.run import Options as FitOptions
from gsjax.engine.fit.run import run as run_fit

SCALE, FRAMES, ANCHOR, LAST = 0.5, "0:30:3", 9, "27:28"
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
    )
    told = with_parts(told, **VARIANTS[options["variant"]])
    told = replace(with_parts(told, top={"seed": seed}), scene=_canonical(told, folder.parent / "canonical"))
    return discovered(told) | ball_scores(told.out)


def _canonical(options: Options, path: Path) -> Path:
    """The run of `gsjax fit` at the anchor, made once."""
    if not (path / "report.html").is_file():
        start = replace(FIT.start, count=20_000)
        run_fit(
            FitOptions(
                options.dataset,
                path,
                frames=LAST,
                eval_cameras=options.eval_cameras,
                scale=options.scale,
                overwrite=True,
                read=options.read,
                fit=replace(FIT, steps=4_000, cap=30_000, start=start),
            )
        )
    return path


PANELS = (
    ("held_out_psnr", "held-out PSNR [dB]"),
    ("held_out_ssim", "SSIM"),
    ("ball_found", "ball found [%]"),
    ("parts", "parts"),
    ("minutes", "minutes"),
)


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """A panel for each score, a bar for each variant: the mean of the seeds, and their range."""
    from matplotlib.figure import Figure

    from experiments.shared.plots import draw_variants

    names = list(dict.fromkeys(row["variant"] for row in rows))
    drawing = Figure(figsize=(16, 1.0 + 0.4 * len(names)), dpi=100, layout="constrained")
    panels = drawing.subplots(1, len(PANELS), sharey=True)
    for axes, (key, title) in zip(panels, PANELS, strict=True):
        scores = [[row[key] or 0.0 for row in rows if row["variant"] == name] for name in names]
        draw_variants(axes, names, [float(np.mean(values)) for values in scores], title)
        for at, values in enumerate(scores):
            axes.plot([min(values), max(values)], [at, at], color="#222222", linewidth=2)
    panels[0].invert_yaxis()
    drawing.savefig(path, format=path.suffix.removeprefix(".") or "png")
