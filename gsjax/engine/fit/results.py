"""The summary of a fit: its scores, its curve, and pictures of held-out views."""

from gsjax.engine.fit.orbit import NAME as ORBIT
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
    time_table,
    title_of,
)
from gsjax.viz.plots import fit_curve, save

SCORES = (
    Score("PSNR", "psnr", "dB", 2, "more", at("test", "psnr"), "views"),
    Score("PSNR, colours matched", "psnr_matched", "dB", 2, "more", at("test", "psnr_matched"), "views"),
    Score("SSIM", "ssim", "", 3, "more", at("test", "ssim"), "views"),
    Score("MS-SSIM", "ms_ssim", "", 3, "more", at("test", "ms_ssim"), "views"),  # of `gsjax eval`
    Score("LPIPS", "lpips", "", 3, "less", at("test", "lpips"), "views"),
    Score("depth error", "depth_mm", "mm", 1, "less", at("test", "depth_mm"), "views"),
    Score("Gaussians", "num_gaussians", "", None, "less", at("num_gaussians")),
    Score("time", "minutes", "min", 1, "less", minutes("fit"), "machine"),
    Score("steps", "steps", "", None, None, at("steps")),
)
"""Scores of held-out views, and what they cost."""
_VIEWS = (
    Column("view", "view"),
    Column("PSNR", "psnr", "dB", 2),
    Column("SSIM", "ssim", "", 3),
    Column("depth error", "depth_mm", "mm", 1),
)
_SHOWN = 8  # views in the report
_TIMES = {
    "fit": "steps",
    "compile": "compiling them",
    "pruning": "removing Gaussians that no photograph needs",
    "scores": "scoring held-out views",
    "parts": "the ablation of the scene's parts",
    "video": "the video",
    "total": "total, reading and the start included",
}


def summarize(folder: RunFolder, found: Metrics) -> Summary:
    """The summary of a fit; also draws its curve into the folder."""
    photographs = found["photographs"]
    looked = f"of {counted(photographs['looked_at'], 'held-out view')}"
    plot = save(fit_curve(found["curve"]), folder.plot("curve"))
    ablation = (
        Column("scene", "part"),
        Column("Gaussians", "gaussians"),
        Column("SH degree", "sh_degree"),
        Column(f"PSNR {looked}", "psnr", "dB", 2),
    )
    shown = found["views"][:: max(1, len(found["views"]) // _SHOWN)][:_SHOWN]
    orbit = folder.video(ORBIT)
    return Summary(
        title=title_of(found["dataset"]),
        subtitle=f"{counted(photographs['fitted'], 'photograph')} fitted, {photographs['held_out']} held out",
        cards=cards_of(SCORES, found),
        tables=[
            Table("Views", _VIEWS, found["views"]),
            Table("The scene as it is, and with less of it (not fitted again)", ablation, found["parts"]),
            time_table(_TIMES, found["seconds"]),
        ],
        videos=[Media(orbit, "Around the scene")] if orbit.exists() else [],
        plots=[Media(plot, f"PSNR {looked} (blue), and the number of Gaussians (grey), over minutes")],
        strips=[Media(folder.path / row["picture"], row["view"]) for row in shown],
        notes=found["notes"],
        machine=found["machine"],
        complete=found["complete"],
    )
