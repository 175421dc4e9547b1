"""Makes docs/gallery.md with its short films and pictures in docs/gallery, the figure of all speed/accuracy
trade-offs, and the film of the README.

    .venv/bin/python docs/make_gallery.py            # `make gallery`

First, small runs on built-in scenes are written to runs/gallery, unless they are already there and complete:
some 20 minutes on two busy cores. Figures of experiments are shown from where they are committed; nothing is
measured here.
"""

import json
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from PIL import Image

from gsjax.engine.folder import is_finished
from gsjax.io.video import read_video_frames

ROOT = Path(__file__).resolve().parents[1]
RUNS, PICTURES, PAGE = ROOT / "runs/gallery", ROOT / "docs/gallery", ROOT / "docs/gallery.md"
WIDTH, QUALITY = 900, 85  # of a picture, pixels at most, and of its JPEG
OF_README, OF_README_WIDTH = ROOT / "docs/images/tracking.webp", 728
FILM_WIDTH, FILM_HZ, FILM_QUALITY = 480, 10, 60  # of a film, and of its animated WebP

TABLE = "simulated:tabletop?width=160&height=120&frames=1"
TISSUE = "simulated:tissue?width=160&height=128&frames=16"
FURNITURE = "simulated:articulated?width=200&height=150&frames=10"
COMMANDS = {
    "demo": f"track simulated:tabletop?width=240&height=180 --out {RUNS}/demo --frames 0:30 --cameras 0 1 "
    "--mask-camera 1 --eval-cameras 2 --track.start.iterations 60",
    "demo/field": f"distill {RUNS}/demo --preset solve",
    "demo/field/query": f"query {RUNS}/demo/field can",
    "table": f"track {TABLE} --out {RUNS}/table",
    "table/field": f"distill {RUNS}/table",
    "table/field/query": f"query {RUNS}/table/field can",
    "tissue": f"deform {TISSUE} --tools draw --deform.warmup 60 --deform.iterations 240 --out {RUNS}/tissue",
    "tissue/query": f"query {RUNS}/tissue tool",
    "furniture": f"parts {FURNITURE} --eval-cameras 3 --fit.steps 800 --fit.cap 6000 "
    f"--parts.stream.iterations 20 --parts.refine.iterations 100 --out {RUNS}/furniture",
    "furniture/edit/ops": f"edit {RUNS}/furniture --op ghost:parts=1,opacity=0.15",
}
"""The commands run for the gallery, by the folder that each writes."""


def main() -> None:
    """Run what is missing, and write the pictures and the page."""
    for folder, command in COMMANDS.items():
        if not made(RUNS / folder, command):
            subprocess.run([sys.executable, "-m", "gsjax.cli", *anew(command)], check=True, cwd=ROOT)
    PICTURES.mkdir(exist_ok=True)
    draw_trades(PICTURES / "trades.png")
    shown = {name: _write(name, picture) for name, picture in pictures().items()}
    for name, video in films().items():
        shown[name] = write_film(PICTURES / f"{name}.webp", read_video_frames(video))
    write_film(OF_README, panels_in_a_row(read_video_frames(films()["tracker"])), OF_README_WIDTH)
    PAGE.write_text(page(shown), encoding="utf-8")


def anew(command: str) -> list[str]:
    """The words of a command that replaces an interrupted run."""
    return [*command.split(), *([] if command.startswith("query") else ["--overwrite"])]


def made(folder: Path, command: str) -> bool:
    """Whether the output of a command exists and is complete; the command may have been interrupted."""
    if command.startswith("query"):  # its answer is written atomically
        return folder.exists()
    if command.startswith("edit"):
        file = folder / "metrics.json"
        return file.is_file() and json.loads(file.read_text(encoding="utf-8"))["complete"]
    return is_finished(folder)


def pictures() -> dict[str, np.ndarray]:
    """Pictures from the runs, RGB, by the name of the file."""
    return {"field": read(RUNS / "table/field/query/overview.png")}


def films() -> dict[str, Path]:
    """Videos of the runs, by the name of the film."""
    return {
        "tracker": RUNS / "demo/video_1.mp4",
        "asked": RUNS / "demo/field/query/video.mp4",
        "parts": next(RUNS.glob("furniture/video_*.mp4")),
        "edit": RUNS / "furniture/edit/ops/video.mp4",
        "tissue": RUNS / "tissue/query/video.mp4",
    }


def panels_in_a_row(frames: np.ndarray, gap: int = 4) -> np.ndarray:
    """From frames with input and rendering above, error and labels below: all but the error, in a row."""
    height, width = frames.shape[1] // 2, frames.shape[2] // 2
    panels = frames[:, :height, :width], frames[:, :height, width:], frames[:, height:, width:]
    white = np.full((len(frames), height, gap, 3), 255, np.uint8)
    return np.concatenate([panels[0], white, panels[1], white, panels[2]], axis=2)


def write_film(path: Path, video: np.ndarray, most: int = FILM_WIDTH) -> str:
    """Writes frames [T,H,W,3] as an animated WebP of at most that width, which browsers play as they are;
    returns its path relative to the page."""
    frames = [Image.fromarray(frame) for frame in video]
    width, height = frames[0].size
    scale = min(1.0, most / width)
    small = [
        one.resize((round(scale * width), round(scale * height)), Image.Resampling.LANCZOS) for one in frames
    ]
    often = {"duration": round(1000 / FILM_HZ), "loop": 0, "quality": FILM_QUALITY, "method": 6}
    small[0].save(path, save_all=True, append_images=small[1:], **often)
    return f"gallery/{path.name}"


def read(path: Path) -> np.ndarray:
    """A picture, RGB."""
    return cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)


def _write(name: str, picture: np.ndarray) -> str:
    scale = min(1.0, WIDTH / picture.shape[1])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    path = PICTURES / f"{name}.jpg"
    cv2.imwrite(str(path), cv2.cvtColor(small, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return f"gallery/{path.name}"


# -- the page ------------------------------------------------------------------------------------------------

SECTIONS = {
    "The tracker": ("tracker", ("tracker_trade", "tracker_ablation", "optimizers", "basin")),
    "Parts": ("parts", ("parts_ablation", "parts_trade", "parts_failures", "parts_tracked", "bar_blends")),
    "Edits": ("edit", ("parts_edits",)),
    "Semantic fields": ("field", ("field_ladder", "field_levels")),
    "Semantic fields, over time": ("asked", ()),
    "Scenes that deform": ("tissue", ("deform_trade", "deform_pulling", "deform_flow")),
    "Static fit": (None, ("static_fit", "fit_trade", "known_scene")),
    "Grasping and policies": (None, ("grasping", "policies")),
    "Rasterizer": (None, ("rasterizer_trade/simulated", "rasterizer_trade/real")),
}
"""The sections of the page: the picture of a run, and the experiments whose figures are shown."""

CAPTIONS = {
    "tracker_trade": "Errors, IoU and PSNR against the update rate, with one line per knob.",
    "tracker_ablation": "Each variant on both recordings; the dotted line marks the full tracker.",
    "optimizers": "Point error against time; the dotted line is the error without any motion.",
    "basin": "Convergence of a displaced carton: gradient cosine (left), success rate (right).",
    "parts_ablation": "Each variant; the dotted line marks the full discovery.",
    "parts_trade": "The line joins the settings that no faster setting beats.",
    "parts_failures": "IoU with the hard part, from easy cases to hopeless ones.",
    "parts_tracked": "IoU with the ground-truth masks, frame by frame.",
    "bar_blends": "Three blends of rotations on a bar that is bent and twisted by handles.",
    "parts_edits": "Edits of discovered parts: unchanged pixels, requested motion seen, and frame rate.",
    "field_ladder": "Quality against the time to compute a field.",
    "field_levels": "Queries for parts, a pair and whole things, with fields of one level and of three.",
    "deform_trade": "One setting is changed at a time; the star is the reference.",
    "deform_pulling": "PSNR of held-out frames (real): deforming, static, and copies of other frames.",
    "deform_flow": "Share of pixels whose scene-flow error is below each value (real).",
    "static_fit": "Held-out PSNR against time (real).",
    "fit_trade": "Held-out PSNR against time and against the number of Gaussians (real).",
    "known_scene": "PSNR of unseen views of a scene whose Gaussians are known.",
    "grasping": "Success rate with 95 % intervals, and tracking error when the fingers begin to close.",
    "policies": "Success rate with 95 % intervals; each dot is a training seed.",
    "rasterizer_trade/simulated": "PSNR and gradient cosine against time for each knob.",
    "rasterizer_trade/real": "The same for the garden and the guitar.",
}
"""The caption of each experiment's figure."""

SAYS = {
    "tracker": ("demo", "Camera 1: input and rendering (top), error and labels (bottom)."),
    "asked": ("demo/field/query", "The can, found once, then carried along by the tracked Gaussians."),
    "parts": ("furniture", "One camera: input, rendering, error, and the parts in colour."),
    "edit": ("furniture/edit/ops", "The first discovered part; everything else is faded."),
    "field": ("table/field/query", "The can: marked in the photograph, scores, alone, removed, recoloured."),
    "tissue": ("tissue/query", "The reconstructed scene with and without the tool."),
}
"""The run that each picture is from, and its caption."""


def page(shown: dict[str, str]) -> str:
    """The page's Markdown."""
    lines = [
        "# Gallery",
        "",
        "This page shows films and pictures of small runs on built-in scenes, with the commands that produce "
        "them, and figures of [experiments](experiments.md). The built-in scenes are simulated, and their "
        "films are illustrations, not results. `gsjax experiment run NAME` reproduces the figure of an "
        "experiment; its full caption is in `experiments/NAME/results.md`. `make gallery` takes 20 minutes "
        "the first time.",
        "",
        "## Speed against accuracy",
        "",
        "![Six plots: errors and scores over time](gallery/trades.png)",
        "",
        "*[Choosing](choosing.md) explains each plot.*",
        "",
    ]
    for title, (picture, experiments) in SECTIONS.items():
        lines += [f"## {title}", ""]
        if picture is not None:
            folder, says = SAYS[picture]
            lines += [f"![{title}]({shown[picture]})", "", f"*{says}*", ""]
            lines += ["```sh", *commands_of(folder), "```", ""]
        for name in experiments:
            lines += [f"![{name}](../experiments/{name}/figure.png)", "", f"*{CAPTIONS[name]}* `{name}`", ""]
    return "\n".join(lines)


def commands_of(folder: str) -> list[str]:
    """The commands that write a folder: its own, after those of the runs that contain it."""
    needed = [command for name, command in COMMANDS.items() if f"{folder}/".startswith(f"{name}/")]
    return [f"gsjax {shlex.join(each.replace(f'{RUNS}/', 'runs/gallery/').split())}" for each in needed]


# -- speed against accuracy ----------------------------------------------------------------------------------

INK, FRONT = "#4b5563", "#d55e00"
TRADES = (
    ("tracker: tabletop_1", "update, times that of fast", "centroid error [mm]", "lower"),
    ("static fit: fox", "minutes", "held-out PSNR [dB]", "higher"),
    ("parts: articulated_0", "seconds a frame", "median point error [mm]", "lower"),
    ("field: articulated_0", "minutes", "mIoU, 3D query", "higher"),
    ("deforming: tissue_0", "all steps, times the first row's", "held-out PSNR [dB]", "higher"),
    ("rasterizer: garden", "forward and backward, times the defaults", "PSNR against them [dB]", "higher"),
)


def rows(name: str) -> Iterator[tuple[dict, dict]]:
    """Options and result of each row of an experiment."""
    for row in json.loads((ROOT / f"experiments/{name}/results.json").read_text(encoding="utf-8"))["rows"]:
        yield row["options"], row["result"]


def points() -> list[list[tuple[float, float, bool]]]:
    """The points of each trade-off: cost, gain, and whether it is the reference that the others vary."""
    tracker = [(o, r) for o, r in rows("tracker_trade") if o["recording"] == "tabletop_1"]
    fast = {"knob": "preset", "value": "fast"}
    fox = [(o["setting"] == "default", r["curve"]) for o, r in rows("fit_trade") if o["scene"] == "fox"]
    # A region of interest leaves part of the image unrendered, and that part is not compared.
    garden = [(o, r) for o, r in rows("rasterizer_trade/real") if o["scene"] == "garden"]
    drawn = [(o, r) for o, r in garden if o["knob"] != "roi"]
    return [
        [(r["ratio"], r["centroid_mm"], fast.items() <= o.items()) for o, r in tracker],
        [(*at, default) for default, curve in fox for at in curve],
        [(r["update_s"], r["point_mm"], o["setting"] == "default") for o, r in rows("parts_trade")],
        [(r["minutes"], r["miou_3d"], o == {"iterations": 100}) for o, r in rows("field_trade")],
        # Paces were measured beside the first row's, minutes were not; by default there are 100 + 300 steps.
        [
            (r["pace"] * (100 + o.get("iterations", 300)) / 400, r["psnr"], o == {"kind": "hexplane"})
            for o, r in rows("deform_trade")
        ],
        [(r["both_ratio"], r["psnr"], r["is_default"]) for _, r in drawn],
    ]


def draw_trades(path: Path) -> None:
    """One plot for each method: every measured setting, and the best result at each cost."""
    drawing = Figure(figsize=(11, 6.4), facecolor="white", layout="constrained")
    for axes, trade, found in zip(drawing.subplots(2, 3).flat, TRADES, points(), strict=True):
        _draw(axes, *trade, found)
    drawing.savefig(path, dpi=80)


def _draw(axes: Axes, title: str, cost: str, gain: str, better: str, found: list) -> None:
    costs, gains, default = (np.array(column) for column in zip(*found, strict=True))
    axes.set_xscale("log")
    if better == "lower":
        axes.set_yscale("log")
    axes.plot(costs[~default], gains[~default], "o", color=INK, ms=4, alpha=0.7)
    axes.plot(costs[default], gains[default], "*", color=INK, ms=12, label="what the others differ from")
    order = np.argsort(costs, kind="stable")
    best = (np.minimum if better == "lower" else np.maximum).accumulate(gains[order])
    axes.step(costs[order], best, where="post", color=FRONT, lw=1.5, label="best at that cost")
    axes.set(title=title, xlabel=cost, ylabel=gain)
    for axis in (axes.xaxis, axes.yaxis)[: 2 if better == "lower" else 1]:
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")
    axes.grid(color="#e4e7eb")
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.legend(frameon=False, fontsize="small")


if __name__ == "__main__":
    main()
