"""What a fit came to: its curve, its scores, pictures of views that it never saw, and the report."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from rich.table import Table as Grid

from gsjax.engine.ending import print_grid
from gsjax.engine.fit.orbit import NAME as ORBIT
from gsjax.engine.folder import RunFolder
from gsjax.engine.machine import in_words
from gsjax.engine.messages import counted
from gsjax.engine.pictures import PANELS
from gsjax.engine.report import Media, Table, write_report
from gsjax.engine.scores import mean_scores
from gsjax.geometry.cameras import Camera
from gsjax.io.atomic import atomic_write
from gsjax.io.pictures import write_png
from gsjax.methods.fit import Fitted, Problem, View
from gsjax.metrics.image import depth_error, psnr, ssim, with_matched_colors
from gsjax.optim.densification import is_alive
from gsjax.rasterize.plan import Plan
from gsjax.scene.gaussians import Gaussians, cull_invalid, take
from gsjax.scene.render import render_with_room
from gsjax.viz.colors import side_by_side
from gsjax.viz.plots import fit_curve, save

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


@dataclass
class Curve:
    """How a fit went on.

    Attributes:
        rows: step, seconds, loss, psnr (of the photograph of that step), alive, test_psnr or None.
        seconds: of all steps so far, without what compiled.
        compile_seconds: that compiling took.
        skipped: steps that would have made a number that is not finite, and changed nothing.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = 0.0
    compile_seconds: float = 0.0
    skipped: int = 0
    _rate: float = 0.0

    @staticmethod
    def of(metadata: dict[str, Any]) -> "Curve":
        """The inverse of `metadata`."""
        return Curve(**metadata)

    def metadata(self) -> dict[str, Any]:
        """What JSON can hold of it."""
        names = ("rows", "seconds", "compile_seconds", "skipped")
        return {name: getattr(self, name) for name in names}

    def took(self, seconds: float, compile_seconds: float) -> None:
        """One step more."""
        self.seconds += seconds
        self.compile_seconds += compile_seconds
        if not compile_seconds:
            self._rate = 0.95 * self._rate + 0.05 * seconds if self._rate else seconds

    def add(self, fitted: Fitted, test_psnr: float | None, folder: RunFolder) -> None:
        """A row, which stands in metrics.jsonl at once.

        Args:
            fitted: the step.
            test_psnr: of held-out photographs, dB, where they were looked at.
            folder: of the run.
        """
        row = {
            "step": fitted.state.step,
            "seconds": self.seconds + self.compile_seconds,
            "loss": float(fitted.info["loss"]),
            "psnr": float(fitted.info["psnr"]),
            "alive": int(fitted.info["alive"]),
            "shrink": fitted.shrink,
            "test_psnr": test_psnr,
        }
        self.rows.append(row)
        lines = "".join(json.dumps(_finite(row)) + "\n" for row in self.rows)
        with atomic_write(folder.metrics_lines) as temporary:
            temporary.write_text(lines, encoding="utf-8")

    def looks(self) -> list[dict[str, Any]]:
        """The rows with a look at held-out views."""
        return [row for row in self.rows if row["test_psnr"] is not None]

    def has_met(self, goal: float) -> bool:
        """Whether held-out views were seen with so many dB when they were last looked at."""
        return any(row["test_psnr"] >= goal for row in self.looks()[-1:])

    def in_words(self, fitted: Fitted, judged: bool) -> str:
        """For the progress bar."""
        tested = self.looks()
        test = f", {tested[-1]['test_psnr']:.1f} dB" if judged and tested else ""
        count = int(fitted.info["alive"])
        pace = f", {1 / self._rate:.0f}/s" if self._rate else ""
        return f"loss {float(fitted.info['loss']):.2f}{test}, {count:,} Gaussians{pace}"


def _finite(row: dict[str, Any]) -> dict[str, Any]:
    """JSON has no infinity: a picture that is hit to the bit has no PSNR."""
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in row.items()}


@dataclass(frozen=True)
class Scores:
    """How views are seen, one row each."""

    rows: list[dict[str, Any]]

    def mean(self) -> dict[str, float | None]:
        """Over the views that have a number."""
        return mean_scores(self.rows, ("psnr", "ssim", "depth_mm", "psnr_matched"))


def living(gaussians: Gaussians) -> tuple[Gaussians, int]:
    """Those that hold something, and how many slots did not."""
    alive, _ = cull_invalid(take(gaussians, np.asarray(is_alive(gaussians))))
    return alive, gaussians.num - alive.num


Plans = dict[tuple[int, ...], Plan]
"""By the size of the photograph: what held a view, and so a program that is compiled."""


def judge(
    problem: Problem,
    gaussians: Gaussians,
    views: list[tuple[str, View]],
    folder: RunFolder | None = None,
    plans: Plans | None = None,
) -> Scores:
    """Draw views and compare them with their photographs; with a folder, write them side by side there. What
    is judged with the same `plans` is drawn by the same programs."""
    rows, plans = [], {} if plans is None else plans
    for name, view in views:
        size = view.image.shape
        seen, plans[size] = look(
            gaussians, view, problem.background, problem.config.antialiased, plans.get(size)
        )
        row: dict[str, Any] = {"view": name, "psnr": seen.psnr(), "ssim": None, "depth_mm": None}
        if folder is not None:
            row |= {"ssim": seen.ssim(), "depth_mm": seen.depth_mm()}
            if problem.config.exposure:  # which that of a photograph never fitted cannot be known
                row["psnr_matched"] = seen.psnr_matched()
            path = folder.render("held_out", len(rows))
            write_panel(path, seen)
            row["picture"] = str(path.relative_to(folder.path))
        rows.append(row)
    return Scores(rows)


@dataclass(frozen=True, eq=False)
class Seen:
    """A view as it is drawn, and as it was photographed.

    Attributes:
        view: the photograph, its mask and its depth.
        image: drawn, [H,W,3], 0 to 1; where the photograph does not count, it stands here too.
        truth: the photograph, 0 to 1.
        depth: drawn, [H,W], metres; 0 where nothing is drawn.
        covered: where more than half of the light comes from Gaussians, [H,W].
    """

    view: View
    image: np.ndarray
    truth: np.ndarray
    depth: np.ndarray
    covered: np.ndarray

    def psnr(self) -> float:
        """Where the photograph counts, dB."""
        return psnr(self.image, self.truth, self.view.mask)

    def psnr_matched(self) -> float:
        """The same, exposure and white balance apart."""
        matched = with_matched_colors(self.image, self.truth, self.view.mask)
        return psnr(matched, self.truth, self.view.mask)

    def ssim(self) -> float | None:
        """Where the photograph counts; None where it is smaller than the window."""
        return (
            ssim(self.image, self.truth, self.view.mask) if min(self.covered.shape) >= _LEAST_SIDE else None
        )

    def depth_mm(self) -> float | None:
        """How far depth is off, where something is drawn; None where none was measured."""
        if self.view.depth is None:
            return None
        counted = self.covered if self.view.mask is None else self.covered & self.view.mask
        return depth_error(self.depth, self.view.depth, counted).mean_abs_mm


def look(
    gaussians: Gaussians,
    view: View,
    background: tuple[float, float, float] | None,
    antialiased: bool,
    plan: Plan | None = None,
) -> tuple[Seen, Plan]:
    """A view as it is drawn, and a plan that held it, for the next of its size.

    Args:
        gaussians: the scene.
        view: what is looked at.
        background: RGB behind the scene; black where None.
        antialiased: as the scene was fitted.
        plan: of an earlier view of the same size.
    """
    height, width = view.image.shape[:2]
    viewmat, K = (jnp.asarray(a, jnp.float32)[None] for a in (view.viewmat, view.K))
    camera, mode = Camera(viewmat, K, width, height, view.near), "antialiased" if antialiased else "classic"
    behind = jnp.array([background or (0.0, 0.0, 0.0)])
    drawn, plan = render_with_room(gaussians, camera, plan, backgrounds=behind, rasterize_mode=mode)
    image, truth = np.clip(np.asarray(drawn.colors[0]), 0, 1), view.image / 255
    if view.mask is not None:
        image = np.where(view.mask[..., None], image, truth)
    return Seen(view, image, truth, np.asarray(drawn.depths[0]), np.asarray(drawn.alphas[0]) > 0.5), plan


def write_panel(path: Path, seen: Seen) -> None:
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
