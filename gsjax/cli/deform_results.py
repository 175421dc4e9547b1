"""What a deforming scene came to: held-out frames, the other eye, tracks where truth has them; the report."""

from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table as Grid

from gsjax.cli.deform_data import DeformData, Tools
from gsjax.cli.fit_results import PANELS, mean_scores
from gsjax.cli.machine import in_words
from gsjax.cli.outputs import write_png
from gsjax.cli.report import Media, Table, write_report
from gsjax.cli.run_folder import RunFolder
from gsjax.geometry.cameras import Camera
from gsjax.methods.surgical import DeformingScene, Look, Moving, SurgicalProblem, SurgicalState
from gsjax.metrics.image import psnr, ssim
from gsjax.metrics.tracking import carried_points
from gsjax.rasterize.plan import Plan
from gsjax.scene.render import render
from gsjax.viz.colors import side_by_side, to_uint8
from gsjax.viz.plots import losses_over_steps, save

_SHOWN = 8  # frames in the report
_TIMED = 12  # frames drawn to say how many a second
_SEEN_WITHIN = 0.01  # of the depth: how far from what a pixel sees a tracked point may lie
_HEADROOM = 1.3
_LEAST_SIDE = 11  # of SSIM's window


def judge(
    folder: RunFolder, problem: SurgicalProblem, state: SurgicalState, data: DeformData, tools: Tools
) -> dict[str, Any]:
    """Scores of held-out frames, or of some that were learned from where none is, and pictures of them."""
    plan, scene, moving = problem.plan_for(state), state.scene, state.moving
    which = data.test or data.train[:: max(1, len(data.train) // _SHOWN)][:_SHOWN]
    rows: list[dict[str, Any]] = []
    for t in which:
        look = data.look(t, 0, tools)
        colors, depths = draw(scene, moving, look, plan)
        number = data.sequence.frame_ids[t]
        path = folder.path / "test" / f"{number:06d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, to_uint8(colors))
        row = {"frame": number, **_scores(colors, depths, look)}
        if data.sequence.num_cameras > 1:
            other = data.look(t, 1, tools)
            row["psnr_other"] = psnr(draw(scene, moving, other, plan)[0], other.image / 255.0, other.counts)
        if len(rows) < _SHOWN:
            panels = folder.render("held_out" if data.test else "learned", number)
            write_png(panels, side_by_side(look.image, colors, _difference(colors, look), captions=PANELS))
            row["picture"] = str(panels.relative_to(folder.path))
        rows.append(row)
    test = mean_scores(rows, ("psnr_masked", "ssim", "depth_mm", "psnr_other"))
    return {
        "judged_by": "held out" if data.test else "learned",
        "test": test | {"fps": _fps(scene, moving, data.look(0, 0, tools), plan)},
        "tracks": _tracks(scene, moving, data, tools),
        "scores": rows,
    }


def draw(scene: DeformingScene, moving: Moving, look: Look, plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Colours and depth of the scene where and when a look was."""
    height, width = look.image.shape[:2]
    viewmat, K = (jnp.asarray(a, jnp.float32)[None] for a in (look.viewmat, look.K))
    camera = Camera(viewmat, K, width, height, look.near)
    while True:
        time = jnp.asarray(look.time, jnp.float32)
        colors, depths, overflow, needed = _drawn(scene, moving, time, camera, plan)
        if not bool(overflow):  # views that nothing learned from may need a larger plan
            return np.asarray(colors), np.asarray(depths)
        plan = plan.grown(int(needed), _HEADROOM)


@jax.jit
def _drawn(scene: DeformingScene, moving: Moving, time, camera: Camera, plan: Plan):
    got = render(scene.at(time, moving), camera, plan)
    return jnp.clip(got.colors[0], 0, 1), got.depths[0], got.meta.overflow.any(), got.meta.needed.max()


def _scores(colors: np.ndarray, depths: np.ndarray, look: Look) -> dict[str, Any]:
    true = look.image / 255.0
    row: dict[str, Any] = {"psnr_masked": psnr(colors, true, look.counts)}
    row["ssim"] = ssim(colors, true, look.counts) if min(true.shape[:2]) >= _LEAST_SIDE else None
    row["depth_mm"] = None
    if look.depth is not None:
        known = look.depth > 0 if look.counts is None else look.counts & (look.depth > 0)
        if known.any():
            row["depth_mm"] = 1e3 * float(np.abs(depths - look.depth)[known].mean())
    return row


def _difference(colors: np.ndarray, look: Look) -> np.ndarray:
    """Five times the difference; grey where nothing counts."""
    off = 5 * np.abs(colors - look.image / 255.0)
    return to_uint8(
        np.clip(off if look.counts is None else np.where(look.counts[..., None], off, 0.25), 0, 1)
    )


def _fps(scene: DeformingScene, moving: Moving, look: Look, plan: Plan) -> float:
    """How often a second the scene is deformed and drawn; the median."""
    took = []
    for i in range(_TIMED):
        begun = perf_counter()
        draw(scene, moving, look._replace(time=i / _TIMED), plan)
        took.append(perf_counter() - begun)
    return 1 / float(np.median(took[2:]))


def _tracks(scene: DeformingScene, moving: Moving, data: DeformData, tools: Tools) -> dict[str, float] | None:
    """How far points that the first frame sees are from where they truly are; None without truth."""
    truth, count = data.sequence.truth, data.sequence.num_frames
    if truth is None or truth.tracks is None or count < 2:
        return None
    look = data.look(0, 0, tools)
    start = truth.tracks[0][_seen(truth.tracks[0], look)]
    if not len(start):
        return None
    at = jax.jit(lambda scene, moving, time: scene.at(time, moving).means)
    times = jnp.asarray(data.times, jnp.float32)
    means = [np.asarray(at(scene, moving, time)) for time in times]
    true = truth.tracks[:, _seen(truth.tracks[0], look)]
    errors = 1e3 * np.linalg.norm(carried_points(start, np.stack(means)) - true, axis=-1)[1:]
    still = 1e3 * np.linalg.norm(start - true, axis=-1)[1:]
    return {
        "points": len(start),
        "median_mm": float(np.median(errors)),
        "p95_mm": float(np.quantile(errors, 0.95)),
        "still_median_mm": float(np.median(still)),
        "still_p95_mm": float(np.quantile(still, 0.95)),
    }


def _seen(points: np.ndarray, look: Look) -> np.ndarray:
    """Which points a look sees, by its depth and masks."""
    local = points @ look.viewmat[:3, :3].T + look.viewmat[:3, 3]
    ahead = np.where(local[:, 2] > 0, local[:, 2], np.inf)
    x, y = ((local @ look.K.T)[:, :2] / ahead[:, None]).T
    height, width = look.image.shape[:2]
    inside = np.isfinite(ahead) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    column, row = (np.where(inside, a, 0).astype(int) for a in (x, y))
    counts = inside if look.counts is None else inside & look.counts[row, column]
    if look.depth is None:
        return counts
    depth = look.depth[row, column]
    return counts & (np.abs(depth - local[:, 2]) < _SEEN_WITHIN * depth)


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
    cards["frames a second"] = f"{test['fps']:.1f}"
    cards["Gaussians"] = found["num_gaussians"]
    minutes = (found["seconds"]["steps"] + found["seconds"]["compile"]) / 60
    cards["Learned for"] = (f"{minutes:.1f}", "minutes")
    keys = ("frame", "psnr_masked", "ssim", "depth_mm", "psnr_other")
    heads = ("frame", "PSNR where it counts", "SSIM", "depth is off by", "PSNR, other camera")
    rows = [[row.get(key) for key in keys] for row in found["scores"]]
    units, decimals = ("", "dB", "", "mm", "dB"), (None, 2, 4, 2, 2)
    tables = [Table(f"Frames, {judged}", heads, rows, units=units, decimals=decimals)]
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
        subtitle=f"{found['method']}; {frames['learned']} frames learned, {frames['held_out']} held out",
        summary=cards,
        strips=shown,
        plots=plots,
        tables=tables,
        notes=[*found["notes"], f"Machine: {in_words(found['machine'])}."],
    )


def print_results(folder: RunFolder, found: dict[str, Any]) -> None:
    """The run in a few lines."""
    console, grid = Console(highlight=False), Grid.grid(padding=(0, 3, 0, 0))
    test, tracks, seconds = found["test"], found["tracks"], found["seconds"]
    words = [f"{test['psnr_masked']:.2f} dB"] if test["psnr_masked"] is not None else []
    words += [f"SSIM {test['ssim']:.4f}"] if test["ssim"] is not None else []
    words += [f"depth off by {test['depth_mm']:.2f} mm"] if test["depth_mm"] is not None else []
    grid.add_row(f"[bold]{found['judged_by']}[/]", ", ".join(words))
    if test["psnr_other"] is not None:
        grid.add_row("[bold]other camera[/]", f"{test['psnr_other']:.2f} dB")
    if tracks is not None:
        grid.add_row(
            "[bold]tracks[/]",
            f"{tracks['median_mm']:.2f} mm median, {tracks['p95_mm']:.2f} mm p95 (if nothing moved: "
            f"{tracks['still_median_mm']:.2f}, {tracks['still_p95_mm']:.2f})",
        )
    if found["names"]:
        grid.add_row("[bold]names[/]", ", ".join(found["names"]))
    grid.add_row(
        "[bold]scene[/]", f"{found['num_gaussians']:,} Gaussians, drawn {test['fps']:.1f} times a second"
    )
    minutes = (seconds["steps"] + seconds["compile"]) / 60
    pace = f" ({seconds['steps'] / max(1, found['steps']):.2f} s each)" if seconds["steps"] else ""
    grid.add_row("[bold]steps[/]", f"{found['steps']:,} in {minutes:.1f} min{pace}")
    if not found["complete"]:
        grid.add_row("[bold]stopped[/]", "[bold yellow]partial run; go on with --resume[/]")
    console.print()
    console.print(grid)
    console.print(f"[bold]report[/]  {folder.report}", soft_wrap=True)
