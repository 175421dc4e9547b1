"""What experiments with a camera around a moving scene share: a reconstruction of some length, and scores."""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from gsjax.engine.deform.scores import draw
from gsjax.engine.drive import Drive, drive
from gsjax.methods.deform import Deform, DeformConfig
from gsjax.methods.deform.method import PLAN
from gsjax.metrics.image import psnr, ssim
from gsjax.scene.frame import Frame

Color = tuple[float, float, float] | None


def reconstructed(
    frames: list[Frame], preset: DeformConfig, steps: int, background: Color, **changes: Any
) -> tuple[Drive, dict[str, float]]:
    """A scene of frames without depth, and what it took without compiling: milliseconds of a step at the end,
    and minutes. The warm-up takes the share of the steps that it has in the preset."""
    warmup = steps * preset.warmup // (preset.warmup + preset.iterations)
    method = Deform(replace(preset, warmup=warmup, iterations=steps - warmup, **changes))
    ticks = drive(method, *method.start(frames, background=background, hull=True))
    seconds = [now.seconds for now in ticks]
    return ticks, {"step_ms": 1e3 * float(np.median(seconds[steps // 2 :])), "minutes": sum(seconds) / 60}


def scores(ticks: Drive, frames: list[Frame], background: Color) -> Float[np.ndarray, "n 2"]:
    """PSNR and SSIM of each frame as it is drawn."""
    scene, moving, plan = ticks.result.scene, ticks.result.moving, ticks.run.plans[PLAN]
    found = []
    for frame in frames:
        drawn, true = draw(scene, moving, frame, plan, background).colors, np.asarray(frame.colors[0])
        pair = drawn.reshape(true.shape), true
        found.append((psnr(*pair), ssim(*pair)))
    return np.array(found)
