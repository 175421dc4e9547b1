"""What a deforming scene came to, in a few lines and as a report."""

from typing import Any

from rich.table import Table as Grid

from gsjax.engine.deform.scores import OVER_TIME
from gsjax.engine.ending import print_grid
from gsjax.engine.folder import RunFolder
from gsjax.engine.machine import in_words
from gsjax.engine.report import Media, Table, write_report
from gsjax.viz.colors import label_color
from gsjax.viz.plots import losses_over_steps, save

_RECIPES = {"surst": "After SurstSplat", "clin": "After GaussianClin"}
_COLUMNS = (  # key, head, unit and decimals, where frames have it
    ("frame", "frame", "", None),
    ("psnr_masked", "PSNR where it counts", "dB", 2),
    ("ssim", "SSIM", "", 4),
    ("ms_ssim", "MS-SSIM", "", 4),
    ("f_psnr", "f-PSNR", "dB", 2),
    ("depth_mm", "depth is off by", "mm", 2),
    ("psnr_other", "PSNR, other camera", "dB", 2),
)


def write_results(folder: RunFolder, found: dict[str, Any]) -> None:
    """Writes the losses' plot and report.html."""
    plots = []
    if found["curve"]:
        losses = [{name: value for name, value in row.items() if name != "psnr"} for row in found["curve"]]
        save(losses_over_steps(losses), folder.plot("losses"))
        plots.append(Media(folder.plot("losses"), "What each loss adds, over steps"))
    test, tracks, judged = found["test"], found["tracks"], found["judged_by"]
    cards: dict[str, Any] = {}
    for key, words, unit, digits in (
        ("psnr_masked", f"PSNR, {judged}", "dB", 2),
        ("ssim", "SSIM", "", 4),
        ("depth_mm", "depth is off by", "mm", 2),
        ("psnr_other", "PSNR, other camera", "dB", 2),
    ):
        if test[key] is not None:
            cards[words] = (f"{test[key]:.{digits}f}", unit)
    if tracks is not None:
        cards["tracks are off by, median"] = (f"{tracks['median_mm']:.2f}", "mm")
    if test["iou"] is not None:
        cards["IoU of classes"] = f"{test['iou']:.3f}"
    cards["frames a second"] = f"{test['fps']:.1f}"
    cards["Gaussians"] = found["num_gaussians"]
    minutes = (found["seconds"]["steps"] + found["seconds"]["compile"]) / 60
    cards["Learned for"] = (f"{minutes:.1f}", "minutes")
    columns = [c for c in _COLUMNS if any(row.get(c[0]) is not None for row in found["scores"])]
    keys, heads, units, decimals = zip(*columns, strict=True)
    rows = [[row.get(key) for key in keys] for row in found["scores"]]
    tables = [Table(f"Frames, {judged}", heads, rows, units=units, decimals=decimals)]
    tables += [*_over_time(test), *_of_classes(found["classes"], test)]
    if tracks is not None:
        words = ("the scene", tracks["median_mm"], tracks["p95_mm"])
        still = ("if nothing moved", tracks["still_median_mm"], tracks["still_p95_mm"])
        title = f"Tracks of {tracks['points']} points that the first frame sees"
        tables.append(
            Table(title, ("", "median", "p95"), [words, still], units=("", "mm", "mm"), decimals=(None, 3, 2))
        )
    shown = [
        Media(folder.path / row["picture"], f"frame {row['frame']}, {judged}; difference times five")
        for row in found["scores"]
        if "picture" in row
    ]
    frames = found["frames"]
    write_report(
        folder.report,
        title=f"{found['dataset']} deforms" + ("" if found["complete"] else " (partial run)"),
        subtitle=(
            f"{_RECIPES[found['preset']]}; {frames['learned']} frames learned, {frames['held_out']} held out"
        ),
        summary=cards,
        strips=shown,
        plots=plots,
        tables=tables,
        notes=[*found["notes"], f"{_memory(found)}.", f"Machine: {in_words(found['machine'])}."],
    )


def _over_time(test: dict[str, Any]) -> list[Table]:
    """How steady neighbouring frames are, beside the recording."""
    if test["t_ssim"] is None:
        return []
    heads = ("each frame and its neighbour", "t-SSIM", "flow-warped error", "warped SSIM")
    ends = (("the scene", ""), ("the recording", "_true"), ("apart", "_gap"))
    rows = [[words, *(test[name + end] for name in OVER_TIME)] for words, end in ends]
    share = test["flow_warp_share"]
    note = "Nearer to the recording is better: what stands still is steadier than anything true."
    note += "" if share is None else f" Along the flow, {share:.0%} of the pixels that count were compared."
    return [Table("Over time", heads, rows, note=note, decimals=(None, 4, 5, 4))]


def _of_classes(classes: list[dict[str, Any]], test: dict[str, Any]) -> list[Table]:
    """How well classes are told apart in what is drawn."""
    if not classes:
        return []
    keys = ("class", "iou", "dice")
    rows = [[one[key] for key in keys] for one in classes]
    note, heads = "", ("class", "IoU", "Dice (F1)")
    if test["iou"] is not None:
        note = f"On average an IoU of {test['iou']:.4f} and a Dice of {test['dice']:.4f}; "
        note += f"{test['accuracy']:.2%} of the pixels that count are named right."
    colors = [label_color(label) for label in range(1, len(rows) + 1)]
    return [Table("What is what", heads, rows, note=note, decimals=(None, 4, 4), colors=colors)]


def _memory(found: dict[str, Any]) -> str:
    """What learning took at most."""
    memory = found["memory_mb"]
    words, device = f"Memory, at most: {memory['process'] / 1e3:.2f} GB", memory["device"]
    return words if device is None else f"{words}, and {device / 1e3:.2f} GB on the device"


def print_results(folder: RunFolder, found: dict[str, Any]) -> None:
    """The run in a few lines."""
    grid = Grid.grid(padding=(0, 3, 0, 0))
    test, tracks, seconds = found["test"], found["tracks"], found["seconds"]
    words = [f"{test['psnr_masked']:.2f} dB"] if test["psnr_masked"] is not None else []
    for key, name in (("ssim", "SSIM"), ("ms_ssim", "MS-SSIM")):
        words += [f"{name} {test[key]:.4f}"] if test[key] is not None else []
    words += [f"depth off by {test['depth_mm']:.2f} mm"] if test["depth_mm"] is not None else []
    grid.add_row(f"[bold]{found['judged_by']}[/]", ", ".join(words))
    if test["psnr_other"] is not None:
        grid.add_row("[bold]other camera[/]", f"{test['psnr_other']:.2f} dB")
    if test["t_ssim"] is not None and test["flow_warp_error"] is not None:
        words = f"t-SSIM {test['t_ssim']:.4f} (recorded {test['t_ssim_true']:.4f}: the nearer, the better)"
        words += f", flow-warped {test['flow_warp_error']:.5f} ({test['flow_warp_error_true']:.5f})"
        grid.add_row("[bold]over time[/]", words)
    if tracks is not None:
        grid.add_row(
            "[bold]tracks[/]",
            f"{tracks['median_mm']:.2f} mm median, {tracks['p95_mm']:.2f} mm p95 (if nothing moved: "
            f"{tracks['still_median_mm']:.2f}, {tracks['still_p95_mm']:.2f})",
        )
    if found["names"]:
        grid.add_row("[bold]names[/]", ", ".join(found["names"]))
    if test["iou"] is not None and test["f_psnr"] is not None:
        words = f"IoU {test['iou']:.4f}, Dice {test['dice']:.4f}, accuracy {test['accuracy']:.4f}"
        words += f", f-PSNR {test['f_psnr']:.2f} dB"
        grid.add_row("", words)
    grid.add_row(
        "[bold]scene[/]", f"{found['num_gaussians']:,} Gaussians, drawn {test['fps']:.1f} times a second"
    )
    took = f"{found['steps']:,} in {seconds['steps'] / 60:.1f} min"
    took += f" ({seconds['steps'] / max(1, found['steps']):.2f} s each)" if seconds["steps"] else ""
    grid.add_row("[bold]steps[/]", f"{took}, compiling {seconds['compile'] / 60:.1f} min")
    print_grid(folder, found, grid)
