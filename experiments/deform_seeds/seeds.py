"""Long optimisations of tissue with many seeds and patterns: the end against the best, and tracks."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

import gsjax
from gsjax.engine.deform.data import DeformData, deform_data
from gsjax.engine.deform.scores import draw, track_errors
from gsjax.engine.drive import Drive, Tick, drive
from gsjax.engine.messages import Notes
from gsjax.engine.teaching.choice import NO_TEACHER, TeacherChoice
from gsjax.methods.deform import PRESETS, Deform
from gsjax.methods.deform.method import PLAN
from gsjax.metrics.image import psnr

SIZE = "width=96&height=76"
PULL = 1.8
WINDOW = 100


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """A reconstruction of one tissue; its seed is that of the tissue too."""
    name = f"simulated:tissue?seed={seed}&{SIZE}&pull={PULL}&pattern={options['pattern']}"
    console = Console(quiet=True)
    how = ("leave-out", TeacherChoice(features=NO_TEACHER), 16, (), Notes(console), console)
    data = deform_data(gsjax.open_sequence(name), 8, *how)
    config = replace(PRESETS["surst"], seed=seed)
    method = Deform(config)
    ticks = drive(method, *method.start(data.frames))
    learned = (now for now in ticks if now.step > config.warmup and now.step % WINDOW == 0)
    curve = [_psnr(now, data, data.train) for now in learned]
    return {
        "psnr": curve[-1],
        "best": max(curve),
        "lost": max(curve) - curve[-1],
        "held_out": _psnr(ticks.tick, data, data.test),
        "curve": np.round(curve, 3).tolist(),
        "farthest": _farthest(ticks),
        "returns": ticks.run.guard.returns,
        **(track_errors(ticks.result.scene, ticks.result.moving, data, "leave-out") or {}),
    }


def _psnr(now: Tick, data: DeformData, frames: list[int]) -> float:
    """Mean PSNR of frames where pixels count."""
    scene, moving, plan = now.result.scene, now.result.moving, now.run.plans[PLAN]
    found = []
    for t in frames:
        frame = data.frame(t, 0, "leave-out")
        colors = draw(scene, moving, frame, plan).colors
        found.append(float(psnr(colors, frame.images[0] / 255.0, frame.masks[0])))
    return float(np.mean(found))


def _farthest(ticks: Drive) -> float:
    """The farthest that a Gaussian is displaced at any of nine times, in edges of the field's box."""
    scene, moving = ticks.result.scene, ticks.result.moving
    low, high = np.array(scene.field.bounds)
    at = jax.jit(lambda scene, time: jnp.abs(scene.at(time, moving).means - scene.gaussians.means).max())
    farthest = max(float(at(scene, jnp.float32(time))) for time in np.linspace(0, 1, 9))
    return farthest / float((high - low).max())


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """The end over the best, and tracks over standing still."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(9, 4.2), layout="constrained")
    left, right = drawing.subplots(1, 2)
    for pattern in dict.fromkeys(row["pattern"] for row in rows):
        mine = [row for row in rows if row["pattern"] == pattern]
        for axes, x, y in ((left, "best", "psnr"), (right, "p95_mm", "still_p95_mm")):
            axes.scatter([row[x] for row in mine], [row[y] for row in mine], s=14, label=pattern)
    for axes, x, y in (
        (left, "best of every 100 steps, dB", "end, dB"),
        (right, "tracks, p95, mm", "standing still, p95, mm"),
    ):
        axes.set(xlabel=x, ylabel=y)
        axes.axline((axes.get_xlim()[0],) * 2, slope=1, color="0.6", lw=1, zorder=0)
        axes.spines[["top", "right"]].set_visible(False)
    left.legend(frameon=False)
    drawing.savefig(path, dpi=150)
