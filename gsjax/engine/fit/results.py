"""What a fit came to: its curve, its scores, pictures of views that it never saw, and the report."""

from typing import Any

from rich.table import Table as Grid

from gsjax.engine.ending import print_grid
from gsjax.engine.fit.orbit import NAME as ORBIT
from gsjax.engine.folder import RunFolder
from gsjax.engine.machine import in_words
from gsjax.engine.messages import counted
from gsjax.engine.report import Media, Table, write_report
from gsjax.viz.plots import fit_curve, save

_SHOWN = 8  # views in the report
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
