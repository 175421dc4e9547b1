"""The summary of a deforming scene: held-out frames, temporal consistency, classes, and tracks."""

from typing import Any

from gsjax.engine.deform.scores import OVER_TIME
from gsjax.engine.folder import RunFolder
from gsjax.engine.messages import counted
from gsjax.engine.summary import (
    Column,
    Media,
    Metrics,
    Score,
    Summary,
    Table,
    at,
    cards_of,
    minutes,
    title_of,
)
from gsjax.viz.colors import label_color
from gsjax.viz.plots import losses_over_steps, save

SCORES = (
    Score("PSNR masked", "psnr_masked", "dB", 2, "more", at("test", "psnr_masked")),
    Score("SSIM", "ssim", "", 4, "more", at("test", "ssim")),
    Score("depth error", "depth_mm", "mm", 2, "less", at("test", "depth_mm")),
    Score("PSNR other camera", "psnr_other", "dB", 2, "more", at("test", "psnr_other")),
    Score("f-PSNR", "f_psnr", "dB", 2, "more", at("test", "f_psnr")),
    Score("IoU of classes", "iou", "", 3, "more", at("test", "iou")),
    Score("track error", "tracks_mm", "mm", 2, "less", at("tracks", "median_mm")),
    Score("rendering rate", "fps", "Hz", 1, "more", at("test", "fps"), "machine"),
    Score("Gaussians", "num_gaussians", "", None, "less", at("num_gaussians")),
    Score("time", "minutes", "min", 1, "less", minutes(), "machine"),
    Score("steps", "steps", "", None, None, at("steps")),
)
_FRAMES = (
    Column("frame", "frame"),
    Column("PSNR masked", "psnr_masked", "dB", 2),
    Column("SSIM", "ssim", "", 4),
    Column("MS-SSIM", "ms_ssim", "", 4),
    Column("f-PSNR", "f_psnr", "dB", 2),
    Column("depth error", "depth_mm", "mm", 2),
    Column("PSNR other camera", "psnr_other", "dB", 2),
)
_OVER_TIME = (
    Column("each frame and its neighbour", "which"),
    Column("t-SSIM", "t_ssim", "", 4),
    Column("flow-warped error", "flow_warp_error", "", 5),
    Column("warped SSIM", "warped_ssim", "", 4),
)
_CLASSES = (Column("class", "class"), Column("IoU", "iou", "", 4), Column("Dice (F1)", "dice", "", 4))
_TRACKS = (Column("", "which"), Column("median", "median", "mm", 3), Column("p95", "p95", "mm", 2))
_RECIPES = {
    "surst": "After SurstSplat",
    "clin": "After GaussianClin",
    "around": "For a camera around a moving object",
}


def summarize(folder: RunFolder, found: Metrics) -> Summary:
    """The summary of a deforming scene; also draws its losses into the folder."""
    plots, test, tracks, judged = [], found["test"], found["tracks"], found["judged_by"]
    frames = found["frames"]
    if found["curve"]:
        losses = [{name: value for name, value in row.items() if name != "psnr"} for row in found["curve"]]
        plot = save(losses_over_steps(losses), folder.plot("losses"))
        plots.append(Media(plot, "Weighted losses over steps"))
    names = [f"Names: {', '.join(found['names'])}."] if found["names"] else []
    return Summary(
        title=f"{title_of(found['dataset'])} deforms",
        subtitle=(
            f"{_RECIPES[found['preset']]}; {counted(frames['learned'], 'frame')} learned, "
            f"{frames['held_out']} held out; scores are of frames {judged}"
        ),
        cards=cards_of(SCORES, found),
        tables=[
            Table(f"Frames, {judged}", _FRAMES, found["scores"]),
            Table("Over time", _OVER_TIME, _over_time(test), _over_time_note(test), brief=True),
            Table(
                "Classes",
                _CLASSES,
                found["classes"],
                _class_note(test),
                colors=[label_color(label) for label in range(1, len(found["classes"]) + 1)],
                brief=True,
            ),
            *([] if tracks is None else [_track_table(tracks)]),
        ],
        plots=plots,
        strips=[
            Media(folder.path / row["picture"], f"frame {row['frame']}, {judged}; difference times five")
            for row in found["scores"]
            if "picture" in row
        ],
        notes=[*names, *found["notes"], f"{_memory(found)}."],
        machine=found["machine"],
        complete=found["complete"],
    )


def _over_time(test: Metrics) -> list[dict[str, Any]]:
    """The temporal consistency of neighbouring frames, compared with the recording."""
    if test["t_ssim"] is None:
        return []
    ends = {"the scene": "", "the recording": "_true", "difference": "_gap"}
    return [{"which": w} | {name: test[name + end] for name in OVER_TIME} for w, end in ends.items()]


def _over_time_note(test: Metrics) -> str:
    share = test["flow_warp_share"]
    note = "Nearer to the recording is better: what stands still is steadier than anything true."
    return note + (
        "" if share is None else f" Along the flow, {share:.0%} of the pixels that count were compared."
    )


def _class_note(test: Metrics) -> str:
    if test["iou"] is None:
        return ""
    return (
        f"Mean IoU {test['iou']:.4f}, mean Dice {test['dice']:.4f}; {test['accuracy']:.2%} of the pixels "
        "that count have the right name."
    )


def _track_table(tracks: Metrics) -> Table:
    rows = [
        {"which": "the scene", "median": tracks["median_mm"], "p95": tracks["p95_mm"]},
        {"which": "if nothing moved", "median": tracks["still_median_mm"], "p95": tracks["still_p95_mm"]},
    ]
    title = f"Errors of tracks of {tracks['points']} points that the first frame sees"
    return Table(title, _TRACKS, rows, brief=True)


def _memory(found: Metrics) -> str:
    memory = found["memory_mb"]
    words, device = f"Peak memory: {memory['process'] / 1e3:.2f} GB", memory["device"]
    return words if device is None else f"{words}, and {device / 1e3:.2f} GB on the device"
