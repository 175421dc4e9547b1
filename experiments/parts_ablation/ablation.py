"""What is each part of the discovery of parts worth? One is switched off, or made otherwise, at a time."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments.shared.discoveries import Options, canonical_of, discovered, steadiness, with_parts
from experiments.shared.recordings import recorded

HELD_OUT, ANCHOR = (3, 8), 0
NO_SPLITS = {"every": 0, "least_gain": 0.0}
TABLE = {"field_rate": 0.01}
VARIANTS: dict[str, dict[str, Any]] = {
    "all on": {},
    # the paper's Table 3
    "segmenter only": {
        "discover": {"difference": False},
        "stream": {"field_rate": 0.0, "past": 0},
        "unify": NO_SPLITS,
    },
    "without the difference image": {"discover": {"difference": False}},
    "without the grid: logits": {"top": {"weights": "table"}, "stream": TABLE},
    "without temporal consistency": {"stream": {"past": 0}},
    # its Fig. 6, and what it has none of
    "without unify and split": {"unify": NO_SPLITS},
    "three past frames": {"stream": {"past": 3}},
    "without the grid: simplex": {"top": {"weights": "simplex"}, "stream": TABLE},
    # ours
    "nothing given up in the end": {"unify": {"least_gain": 0.0}},
    "no cost of tearing": {"stream": {"tear_weight": 0.0}},
    "weights not held": {"stream": {"hold_weight": 0.0}},
    "colours alone": {"stream": {"depth_weight": 0.0}},
    "scene not refined": {"refine": {"iterations": 0}},
}


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One discovery on articulated_0 with one variant; all begin with the same canonical scene."""
    told = Options(
        str(recorded("articulated_0")), folder / "run", eval_cameras=HELD_OUT, anchor=ANCHOR, overwrite=True
    )
    told = with_parts(told, top={"seed": seed})
    told = replace(with_parts(told, **VARIANTS[options["variant"]]), scene=canonical_of(told, folder))
    return discovered(told) | steadiness(told.out)


PANELS = (
    ("ari", "adjusted Rand index"),
    ("parts", "parts (6 are true)"),
    ("point_mm", "median point error [mm]"),
    ("held_out_psnr", "held-out PSNR [dB]"),
    ("update_s", "seconds a frame"),
)


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """A panel for each score, a bar for each variant."""
    from matplotlib.figure import Figure

    from experiments.shared.plots import draw_variants

    drawing = Figure(figsize=(16, 1.0 + 0.32 * len(rows)), dpi=100, layout="constrained")
    panels = drawing.subplots(1, len(PANELS), sharey=True)
    names = [row["variant"] for row in rows]
    for axes, (key, title) in zip(panels, PANELS, strict=True):
        draw_variants(axes, names, [row[key] or 0.0 for row in rows], title)
    panels[0].invert_yaxis()
    drawing.savefig(path, format=path.suffix.removeprefix(".") or "png")
