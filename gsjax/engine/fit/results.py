"""What a fit came to: its curve, its scores, pictures of views that it never saw, and the report."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from rich.table import Table as Grid

from gsjax.engine.ending import print_grid
from gsjax.engine.folder import RunFolder
from gsjax.engine.machine import in_words
from gsjax.engine.messages import counted
from gsjax.engine.pictures import PANELS
from gsjax.engine.report import Media, Table, write_report
from gsjax.engine.scores import mean_scores
from gsjax.geometry.cameras import on_device
from gsjax.io.pictures import write_png
from gsjax.methods.fit import FitConfig
from gsjax.metrics.image import depth_error, psnr, ssim, with_matched_colors
from gsjax.rasterize.plan import Plan
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import render_with_room
from gsjax.viz.colors import side_by_side
from gsjax.viz.plots import fit_curve, save

ORBIT = "orbit"
"""The video about the scene, among those of cameras."""
_SHOWN = 8  # views in the report
_LEAST_SIDE = 11  # of SSIM's window
_PANEL_HEIGHT = 240  # pixels, at least, so that captions hide little
_COLUMNS = (  # key, head, unit and decimals, where views have it
    ("view", "view", "", None),
    ("psnr", "PSNR", "dB", 2),
    ("ssim", "SSIM", "", 3),
    ("depth_mm", "depth is off by", "mm", 1),
)
_TIMES = {
    "fit": "steps",
    "compile": "compiling them",
    "pruning": "leaving out what no photograph needs",
    "scores": "scoring held-out views",
    "parts": "looking at what each part is worth",
    "video": "the video",
    "total": "in all, with reading and the start",
}


@dataclass(frozen=True)
class Scores:
    """How views are seen, one row each."""

    rows: list[dict[str, Any]]

    def mean(self) -> dict[str, float | None]:
        """Over the views that have a number."""
        return mean_scores(self.rows, ("psnr", "ssim", "depth_mm", "psnr_matched"))


@dataclass(eq=False)
class Judge:
    """Draws photographs' views and compares. What one judge draws is drawn by the same programs.

    Attributes:
        config: of the fit.
        background: RGB behind the scene; black where None.
        plans: by the size of the photograph: what held a view.
    """

    config: FitConfig
    background: tuple[float, float, float] | None
    plans: dict[tuple[int, ...], Plan] = field(default_factory=dict)

    def __call__(
        self, gaussians: Gaussians, frames: Sequence[tuple[str, Frame]], folder: RunFolder | None = None
    ) -> Scores:
        """Scores of views, by their names; with a folder, pictures are written side by side there."""
        rows = []
        for name, frame in frames:
            seen = self.compare(gaussians, frame)
            row: dict[str, Any] = {"view": name, "psnr": seen.psnr(), "ssim": None, "depth_mm": None}
            if folder is not None:
                row |= {"ssim": seen.ssim(), "depth_mm": seen.depth_mm()}
                if self.config.exposure:  # which that of a photograph never fitted cannot be known
                    row["psnr_matched"] = seen.psnr_matched()
                path = folder.render("held_out", len(rows))
                write_panel(path, seen)
                row["picture"] = str(path.relative_to(folder.path))
            rows.append(row)
        return Scores(rows)

    def compare(self, gaussians: Gaussians, frame: Frame) -> "Compared":
        """A view as it is drawn beside its photograph.

        Args:
            gaussians: the scene.
            frame: of one camera, on the host.
        """
        size = frame.images.shape
        mode = "antialiased" if self.config.antialiased else "classic"
        behind = jnp.array([self.background or (0.0, 0.0, 0.0)])
        drawn, self.plans[size] = render_with_room(
            gaussians,
            on_device(frame.cameras),
            self.plans.get(size),
            backgrounds=behind,
            rasterize_mode=mode,
        )
        image, truth = np.clip(np.asarray(drawn.colors[0]), 0, 1), frame.images[0] / 255
        if frame.masks is not None:
            image = np.where(frame.masks[0][..., None], image, truth)
        depth, covered = np.asarray(drawn.depths[0]), np.asarray(drawn.alphas[0]) > 0.5
        return Compared(frame, image, truth, depth, covered)


@dataclass(frozen=True, eq=False)
class Compared:
    """A view as it is drawn, and as it was photographed.

    Attributes:
        frame: the photograph, its mask and its depth.
        image: drawn, [H,W,3], 0 to 1; where the photograph does not count, it stands here too.
        truth: the photograph, 0 to 1.
        depth: drawn, [H,W], metres; 0 where nothing is drawn.
        covered: where more than half of the light comes from Gaussians, [H,W].
    """

    frame: Frame
    image: np.ndarray
    truth: np.ndarray
    depth: np.ndarray
    covered: np.ndarray

    @property
    def mask(self) -> np.ndarray | None:
        """The pixels that count, [H,W]; None if all do."""
        return None if self.frame.masks is None else self.frame.masks[0]

    def psnr(self) -> float:
        """Where the photograph counts, dB."""
        return psnr(self.image, self.truth, self.mask)

    def psnr_matched(self) -> float:
        """The same, exposure and white balance apart."""
        return psnr(with_matched_colors(self.image, self.truth, self.mask), self.truth, self.mask)

    def ssim(self) -> float | None:
        """Where the photograph counts; None where it is smaller than the window."""
        if min(self.covered.shape) < _LEAST_SIDE:
            return None
        return ssim(self.image, self.truth, self.mask)

    def depth_mm(self) -> float | None:
        """How far depth is off, where something is drawn; None where none was measured."""
        if self.frame.depths is None:
            return None
        counted = self.covered if self.mask is None else self.covered & self.mask
        return depth_error(self.depth, self.frame.depths[0], counted).mean_abs_mm


def write_panel(path: Path, seen: Compared) -> None:
    """Writes the photograph, what is drawn, and how they differ, side by side; small ones enlarged."""
    times = -(-_PANEL_HEIGHT // len(seen.image))
    pair = [picture.repeat(times, 0).repeat(times, 1) for picture in (seen.truth, seen.image)]
    write_png(path, side_by_side(*pair, captions=PANELS))


def write_results(folder: RunFolder, found: dict[str, Any]) -> None:
    """Writes the curve and report.html."""
    plot = folder.plot("curve")
    save(fit_curve(found["curve"]), plot)
    test, cards = found["test"], {}
    if test and test["psnr"] is not None:
        cards["PSNR, held out"] = (f"{test['psnr']:.2f}", "dB")
        if test["ssim"] is not None:
            cards["SSIM, held out"] = f"{test['ssim']:.3f}"
    cards["Gaussians"] = found["num_gaussians"]
    photographs = found["photographs"]
    cards["Steps"] = found["steps"]
    cards["Fitted for"] = (f"{_minutes(found):.1f}", "minutes")
    columns = [c for c in _COLUMNS if c[0] == "view" or any(row[c[0]] is not None for row in found["views"])]
    keys, heads, units, decimals = zip(*columns, strict=True)
    rows = [[row[key] for key in keys] for row in found["views"]]
    times = [[_TIMES[name], value] for name, value in found["seconds"].items()]
    looked = f"of {counted(photographs['looked_at'], 'held-out view')}"
    shown = found["views"][:: max(1, len(found["views"]) // _SHOWN)][:_SHOWN]
    write_report(
        folder.report,
        title=found["dataset"] + ("" if found["complete"] else " (partial run)"),
        subtitle=f"{photographs['fitted']} photographs fitted, {photographs['held_out']} held out",
        summary=cards,
        strips=[Media(folder.path / row["picture"], row["view"]) for row in shown],
        videos=[Media(folder.video(ORBIT), "About the scene")] if folder.video(ORBIT).exists() else (),
        plots=[Media(plot, f"PSNR {looked} (blue), and the number of Gaussians (grey), over minutes")],
        tables=[
            Table("Views", heads, rows, units, decimals=decimals),
            *_tables_of_parts(found["parts"], looked),
            Table("Time", ("what for", "time"), times, ("", "s"), decimals=(None, 1)),
        ],
        notes=[*found["notes"], f"Machine: {in_words(found['machine'])}."],
    )


def _minutes(found: dict[str, Any]) -> float:
    """Of steps and of compiling them, which is what --minutes is about."""
    return (found["seconds"]["fit"] + found["seconds"]["compile"]) / 60


def _tables_of_parts(parts: list[dict[str, Any]], looked: str) -> list[Table]:
    """What each part of the scene is worth, where that was looked at."""
    if not parts:
        return []
    rows = [[row["part"], row["gaussians"], row["sh_degree"], row["psnr"]] for row in parts]
    title = "What each part bought: as it is, and with less of it (not fitted again)"
    heads, units = ("of the scene", "Gaussians", "SH degree", f"PSNR {looked}"), ("", "", "", "dB")
    return [Table(title, heads, rows, units, decimals=(None, 0, 0, 2))]


def print_results(folder: RunFolder, found: dict[str, Any]) -> None:
    """The run in a few lines."""
    grid = Grid.grid(padding=(0, 3, 0, 0))
    photographs, seconds = found["photographs"], found["seconds"]
    test = found["test"]
    if test and test["psnr"] is not None:
        words = f"{test['psnr']:.2f} dB" + ("" if test["ssim"] is None else f", SSIM {test['ssim']:.3f}")
        matched = test["psnr_matched"]
        words += "" if matched is None else f", {matched:.2f} dB with colours matched"
        words += "" if test["depth_mm"] is None else f", depth {test['depth_mm']:.0f} mm off"
        grid.add_row("[bold]held out[/]", f"{words} (mean of {photographs['held_out']} views)")
    grid.add_row("[bold]scene[/]", f"{found['num_gaussians']:,} Gaussians, SH degree {found['sh_degree']}")
    words = f"{found['steps']:,} steps in {_minutes(found):.1f} min"
    if seconds["fit"] > 1:  # the steps that compiled are not in it, and may be all there are
        words += f" ({found['steps'] / seconds['fit']:.1f} a second)"
    grid.add_row("[bold]fit[/]", f"{words}, {seconds['compile']:.0f} s of it compiling")
    print_grid(folder, found, grid)
