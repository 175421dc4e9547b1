"""What a fit came to: its curve, its scores, pictures of views that it never saw, and the report."""

import json
from dataclasses import dataclass, field
from typing import Any

import cv2
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table as Grid

from gsjax.cli.machine import in_words
from gsjax.cli.report import Media, Table, write_report
from gsjax.cli.run_folder import RunFolder
from gsjax.geometry.cameras import Camera
from gsjax.io.atomic import atomic_write
from gsjax.methods.reconstruction import Fitted, Problem, View
from gsjax.metrics.image import depth_error, psnr, ssim
from gsjax.optim.densification import is_alive
from gsjax.scene.gaussians import Gaussians, cull_invalid, take
from gsjax.scene.render import plan_render, render
from gsjax.viz.colors import side_by_side
from gsjax.viz.plots import fit_curve, save

_SHOWN = 8  # views in the report
_LEAST_SIDE = 11  # of SSIM's window


@dataclass
class Curve:
    """How a fit went on.

    Attributes:
        rows: step, seconds, loss, psnr (of the photograph of that step), alive, test_psnr or None.
        seconds: of all steps so far, without what compiled.
        compile_seconds: that compiling took.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = 0.0
    compile_seconds: float = 0.0
    _rate: float = 0.0

    @staticmethod
    def of(metadata: dict[str, Any]) -> "Curve":
        """The inverse of `metadata`."""
        return Curve(metadata["rows"], metadata["seconds"], metadata["compile_seconds"])

    def metadata(self) -> dict[str, Any]:
        """What JSON can hold of it."""
        return {"rows": self.rows, "seconds": self.seconds, "compile_seconds": self.compile_seconds}

    def took(self, seconds: float, compile_seconds: float) -> None:
        """One step more."""
        self.seconds += seconds
        self.compile_seconds += compile_seconds
        self._rate = 0.95 * self._rate + 0.05 * seconds if self._rate else seconds

    def add(self, fitted: Fitted, test_psnr: float | None, folder: RunFolder) -> None:
        """A row, which stands in metrics.jsonl at once."""
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

    def in_words(self, fitted: Fitted, judged: bool) -> str:
        """For the progress bar."""
        tested = [row["test_psnr"] for row in self.rows if row["test_psnr"] is not None]
        test = f", held out {tested[-1]:.1f} dB" if judged and tested else ""
        count = int(fitted.info["alive"])
        return (
            f"loss {float(fitted.info['loss']):.3f}{test}, {count:,} Gaussians, {1 / self._rate:.1f} steps/s"
        )


def _finite(row: dict[str, Any]) -> dict[str, Any]:
    """JSON has no infinity: a picture that is hit to the bit has no PSNR."""
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in row.items()}


@dataclass(frozen=True)
class Scores:
    """How views are seen, one row each."""

    rows: list[dict[str, Any]]

    def mean(self) -> dict[str, float | None]:
        """Over the views that have a number."""
        names = ("psnr", "ssim", "depth_mm")
        known = {
            name: [r[name] for r in self.rows if r[name] is not None and np.isfinite(r[name])]
            for name in names
        }
        return {name: float(np.mean(values)) if values else None for name, values in known.items()}


def living(gaussians: Gaussians) -> tuple[Gaussians, int]:
    """Those that hold something, and how many slots did not."""
    alive, _ = cull_invalid(take(gaussians, np.asarray(is_alive(gaussians))))
    return alive, gaussians.num - alive.num


def judge(
    problem: Problem, gaussians: Gaussians, views: list[tuple[str, View]], folder: RunFolder | None = None
) -> Scores:
    """Draw views and compare them with their photographs; with a folder, write them side by side there."""
    rows, plans = [], {}
    for name, view in views:
        height, width = view.image.shape[:2]
        camera = Camera(
            jnp.asarray(view.viewmat, jnp.float32)[None],
            jnp.asarray(view.K, jnp.float32)[None],
            width,
            height,
        )
        drawn, plans[width, height] = _drawn(problem, gaussians, camera, plans.get((width, height)))
        image, truth = np.clip(np.asarray(drawn.colors[0]), 0, 1), view.image / 255
        if view.mask is not None:
            image = np.where(view.mask[..., None], image, truth)
        row: dict[str, Any] = {
            "view": name,
            "psnr": psnr(image, truth, view.mask),
            "ssim": None,
            "depth_mm": None,
        }
        if folder is not None:
            if min(width, height) >= _LEAST_SIDE:
                row["ssim"] = ssim(image, truth, view.mask)
            if view.depth is not None:
                covered = np.asarray(drawn.alphas[0]) > 0.5
                row["depth_mm"] = depth_error(np.asarray(drawn.depths[0]), view.depth, covered).mean_abs_mm
            row["picture"] = _write_picture(folder, len(rows), image, truth)
        rows.append(row)
    return Scores(rows)


def _drawn(problem, gaussians, camera, plan):
    """The view, and a plan that held it."""
    background = jnp.array([problem.background or (0.0, 0.0, 0.0)])
    mode = "antialiased" if problem.config.antialiased else "classic"
    while True:
        if plan is None or plan.sh_degree != gaussians.sh_degree:
            plan = plan_render(gaussians, camera, headroom=1.3, rasterize_mode=mode)
        drawn = render(gaussians, camera, plan, backgrounds=background)
        if not bool(drawn.meta.overflow.any()):
            return drawn, plan
        plan = plan.grown(int(drawn.meta.needed.max()), 1.3)


def _write_picture(folder: RunFolder, number: int, image: np.ndarray, truth: np.ndarray) -> str:
    path = folder.render("held_out", number)
    both = side_by_side(truth, image, captions=("photograph", "rendered", "difference"))
    with atomic_write(path) as temporary:
        if not cv2.imwrite(str(temporary), both[..., ::-1]):
            raise OSError(f"{path}: could not be written")
    return str(path.relative_to(folder.path))


def write_results(folder: RunFolder, found: dict[str, Any], curve: Curve) -> None:
    """Writes the curve and report.html."""
    plot = folder.plot("curve")
    save(fit_curve(curve.rows), plot)
    test, cards = found["test"], {}
    if test and test["psnr"] is not None:
        cards["PSNR, held out"] = (f"{test['psnr']:.2f}", "dB")
        if test["ssim"] is not None:
            cards["SSIM, held out"] = f"{test['ssim']:.3f}"
    cards["Gaussians"] = found["num_gaussians"]
    cards["Fitted for"] = (f"{found['seconds']['fit'] / 60:.1f}", "minutes")
    rows = [[row["view"], row["psnr"], row["ssim"], row["depth_mm"]] for row in found["views"]]
    times = [[name, value] for name, value in found["seconds"].items()]
    shown = found["views"][:: max(1, len(found["views"]) // _SHOWN)][:_SHOWN]
    photographs = found["photographs"]
    write_report(
        folder.report,
        title=found["dataset"] + ("" if found["complete"] else " (partial run)"),
        subtitle=f"{photographs['fitted']} photographs fitted, {photographs['held_out']} held out",
        summary=cards,
        images=[Media(folder.path / row["picture"], row["view"]) for row in shown],
        plots=[Media(plot, "Held-out PSNR, and the number of Gaussians, over minutes")],
        tables=[
            Table(
                "Views",
                ("view", "PSNR", "SSIM", "depth"),
                rows,
                ("", "dB", "", "mm"),
                decimals=(None, 2, 3, 1),
            ),
            Table("Time", ("part", "seconds"), times, ("", "s"), decimals=(None, 1)),
        ],
        notes=[*found["notes"], f"Machine: {in_words(found['machine'])}."],
    )


def print_results(folder: RunFolder, found: dict[str, Any]) -> None:
    """The run in a few lines."""
    console, grid = Console(highlight=False), Grid.grid(padding=(0, 3, 0, 0))
    photographs, seconds = found["photographs"], found["seconds"]
    test = found["test"]
    if test and test["psnr"] is not None:
        words = f"{test['psnr']:.2f} dB" + ("" if test["ssim"] is None else f", SSIM {test['ssim']:.3f}")
        words += "" if test["depth_mm"] is None else f", depth {test['depth_mm']:.0f} mm off"
        grid.add_row("[bold]held out[/]", f"{words} (mean of {photographs['held_out']} views)")
    grid.add_row("[bold]scene[/]", f"{found['num_gaussians']:,} Gaussians, SH degree {found['sh_degree']}")
    rate = found["steps"] / seconds["fit"] if seconds["fit"] else 0
    part = "" if found["complete"] else " [bold yellow](partial run; go on with --resume)[/]"
    words = f"{found['steps']:,} steps in {seconds['fit'] / 60:.1f} min ({rate:.1f} a second)"
    grid.add_row("[bold]fit[/]", f"{words}, {seconds['compile']:.0f} s compiling{part}")
    console.print()
    console.print(grid)
    console.print(f"[bold]report[/]  {folder.report}", soft_wrap=True)
