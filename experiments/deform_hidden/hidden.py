"""Tissue under a tool: what holds its motion where no camera sees it?"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

import gsjax
from experiments.deform_seeds.seeds import PULL, SIZE
from gsjax.engine.deform.data import DeformData, deform_data
from gsjax.engine.deform.scores import draw
from gsjax.engine.drive import Drive, drive
from gsjax.engine.messages import Notes
from gsjax.engine.teaching.choice import NO_TEACHER, TeacherChoice
from gsjax.geometry.cameras import pixels_of
from gsjax.losses.extra import ExtraLoss
from gsjax.methods.deform import PRESETS, Deform
from gsjax.methods.deform.method import PLAN
from gsjax.metrics.image import psnr
from gsjax.metrics.tracking import carried_points
from gsjax.rasterize.plan import Plan
from gsjax.scene.render import plan_render, render

PATTERN = "noise"  # of which tracks are hardest
WEIGHT = 0.03  # of the total variation, as in G-SHARP's trainer
ROOM = 3.0  # of the plan of its pictures, which is not made again


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """A reconstruction of one tissue; its seed is that of the tissue too."""
    how = options["regularisation"]
    name = f"simulated:tissue?seed={seed}&{SIZE}&pull={PULL}&pattern={PATTERN}"
    console = Console(quiet=True)
    choice = TeacherChoice(features=NO_TEACHER)
    data = deform_data(gsjax.open_sequence(name), 8, "leave-out", choice, 16, (), Notes(console), console)
    config = replace(PRESETS["surst"], seed=seed)
    if how not in ("strains", "both"):
        config = replace(config, weights=replace(config.weights, rigidity=0.0))
    method = Deform(config)
    problem, started = method.start(data.frames)
    cameras = jax.tree.map(lambda *all: jnp.concatenate(all), *(f.cameras for f in problem.seen))
    plan = plan_render(started.params.gaussians, cameras, headroom=ROOM)
    if how in ("total variation", "both"):
        method = replace(method, extra_losses=(hidden_variation(plan),))
    ticks = drive(method, problem, started)
    seconds = [now.seconds for now in ticks if now.step > config.warmup + 100]
    for frame in problem.seen:
        there = ticks.result.scene.at(frame.time, ticks.result.moving)
        if render(there, frame.cameras, plan).meta.overflow.any():
            raise ValueError(
                f"ROOM: expected a plan for all frames, found {ROOM} times the first one too small"
            )
    return {
        "held_out": _held_out(ticks, data),
        "step_ms": 1e3 * float(np.median(seconds)),
        **_errors(ticks, data),
    }


def hidden_variation(plan: Plan) -> ExtraLoss:
    """The total variation of colours and depth over pairs of neighbouring pixels of which a frame hides one
    or both, a mean over its pixels.

    Args:
        plan: of pictures without masks.
    """

    def variation(scene, rendered, frame):
        drawn = render(scene.gaussians, frame.cameras, plan)
        pictures = jnp.concatenate([drawn.colors, drawn.depths[..., None]], axis=-1)[0]
        hidden, total = ~frame.masks[0], 0.0
        for image, here in ((pictures, hidden), (pictures.swapaxes(0, 1), hidden.T)):
            counts = here[1:] | here[:-1]
            total += (jnp.abs(jnp.diff(image, axis=0)) * counts[..., None]).sum()
        return WEIGHT * total / hidden.size

    return variation


def _held_out(ticks: Drive, data: DeformData) -> float:
    """Mean PSNR of held-out frames where pixels count."""
    scene, moving, plan = ticks.result.scene, ticks.result.moving, ticks.run.plans[PLAN]
    found = []
    for t in data.test:
        frame = data.frame(t, 0, "leave-out")
        colors = draw(scene, moving, frame, plan).colors
        found.append(float(psnr(colors, frame.images[0] / 255.0, frame.masks[0])))
    return float(np.mean(found))


def _errors(ticks: Drive, data: DeformData) -> dict[str, float]:
    """How far points that the first frame sees are from where they truly are, and those that are hidden at
    the time."""
    scene, moving, truth = ticks.result.scene, ticks.result.moving, data.sequence.truth
    assert truth is not None
    assert truth.tracks is not None
    seen = ~_hidden(truth.tracks[0], data, 0)
    true = truth.tracks[:, seen]
    at = jax.jit(lambda scene, moving, time: scene.at(time, moving).means)
    means = np.stack([np.asarray(at(scene, moving, jnp.float32(time))) for time in data.times])
    errors = 1e3 * np.linalg.norm(carried_points(true[0], means) - true, axis=-1)[1:]
    still = 1e3 * np.linalg.norm(true[0] - true, axis=-1)[1:]
    hidden = np.stack([_hidden(points, data, t) for t, points in enumerate(true)])[1:]
    return {
        "median_mm": float(np.median(errors)),
        "p95_mm": float(np.quantile(errors, 0.95)),
        "hidden_median_mm": float(np.median(errors[hidden])),
        "hidden_p95_mm": float(np.quantile(errors[hidden], 0.95)),
        "still_hidden_p95_mm": float(np.quantile(still[hidden], 0.95)),
        "hidden_share": 100 * float(hidden.mean()),
    }


def _hidden(points: np.ndarray, data: DeformData, t: int) -> np.ndarray:
    """Which points a frame does not see: under the tool, behind something, or outside of the view."""
    frame = data.frame(t, 0, "leave-out")
    camera = frame.cameras
    assert frame.masks is not None
    assert frame.depths is not None
    column, row, z, inside = pixels_of(points, camera.viewmat[0], camera.K[0], camera.width, camera.height)
    depth = np.asarray(frame.depths[0])[row, column]
    return ~(inside & np.asarray(frame.masks[0])[row, column] & (np.abs(depth - z) < 0.01 * depth))
