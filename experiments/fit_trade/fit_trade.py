"""What is each part of a fit worth within a given time?"""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.shared.recordings import recorded
from experiments.shared.timing import median_ms
from experiments.static_fit.static_fit import SCENES
from gsjax.data import open_photographs
from gsjax.engine.drive import drive
from gsjax.engine.fit.judge import Judge
from gsjax.engine.photographs import split
from gsjax.engine.progress import Progress
from gsjax.geometry.cameras import on_device
from gsjax.methods.fit import Fit, FitConfig, SplitConfig, StartConfig, light_of, needed
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians, take
from gsjax.scene.render import plan_render, render

MINUTES, JUDGED_EVERY_S = 3.0, 20.0
DEFAULT = FitConfig(steps=30_000)
SETTINGS = {
    "default": DEFAULT,
    "degree 1 from step 200": replace(DEFAULT, sh_every=200),
    "degree 3 from step 600": replace(DEFAULT, sh_degree=3, sh_every=200),
    "at most 2000": replace(DEFAULT, cap=2_000, start=StartConfig(count=2_000)),
    "at most 5000": replace(DEFAULT, cap=5_000, start=StartConfig(count=5_000)),
    "at most 10000": replace(DEFAULT, cap=10_000, start=StartConfig(count=10_000)),
    "at most 20000": replace(DEFAULT, cap=20_000),
    "half the size": DEFAULT,
    "split": replace(DEFAULT, strategy="split", cap=200_000, split=SplitConfig(begin=100, end=0.7)),
    "no coarse stage": replace(DEFAULT, coarse_until=0.0),
}


@lru_cache(maxsize=2)
def frames_at(scene: str, size: float = 1.0) -> tuple[list[Frame], list[Frame]]:
    """Fitted and held-out photographs; `size` is relative to static_fit's."""
    how = SCENES[scene]
    photographs = open_photographs(str(recorded(scene)), how.get("read")).scaled(size * how["scale"])
    chosen, held_out = split(photographs, 8)
    return [photographs.frame(i) for i in chosen], [photographs.frame(i) for i in held_out]


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """A fit of a few minutes, scored at intervals."""
    jax.clear_caches()
    scene, setting = options["scene"], options["setting"]
    shown, held_out = frames_at(scene)
    frames = frames_at(scene, 0.5)[0] if setting == "half the size" else shown
    depth_weight = 0.0 if shown[0].depths is None else 0.5
    config = replace(SETTINGS[setting], seed=seed, depth_weight=depth_weight)
    method, spent, rows = Fit(config), Progress(), []
    problem, run = method.start(frames)
    judge = Judge(config, problem.background)

    def budget(step: int) -> float:
        return max(step / config.steps, spent.seconds / 60 / MINUTES)  # compiling is not on it

    judged = [(str(i), frame) for i, frame in enumerate(held_out)]
    recent: list[float] = []
    ticks = drive(method, problem, run, progress=budget)
    for now in ticks:
        recent = [*recent[-49:], now.seconds]
        spent.seconds += now.seconds
        if budget(now.step) >= 1 or spent.seconds > (len(rows) + 1) * JUDGED_EVERY_S:
            rows.append((spent.seconds / 60, judge(now.run.params.gaussians, judged).mean()["psnr"]))
    gaussians, steps = ticks.result, ticks.run.step
    kept = take(gaussians, needed(light_of(gaussians, shown), config.prune))
    seen = [judge.compare(kept, frame) for frame in held_out]
    return {
        "psnr": float(np.mean([one.psnr() for one in seen])),
        "ssim": float(np.mean([one.ssim() for one in seen])),
        "gaussians": kept.num,
        "unneeded": gaussians.num - kept.num,
        "steps": steps,
        "steps_a_second": steps / spent.seconds,
        "step_over_draw": 1e3 * float(np.median(recent)) / _draw_ms(gaussians, shown[0]),
        "curve": rows,
    }


def _draw_ms(gaussians: Gaussians, frame: Frame) -> float:
    """Median milliseconds of rendering a photograph's view, which a step is compared with."""
    camera = on_device(frame.cameras)
    return median_ms(render, gaussians, camera, plan_render(gaussians, camera))


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """A row for each scene: PSNR over minutes with the best so far, and over the number of Gaussians."""
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    colors = {name: f"C{i}" for i, name in enumerate(dict.fromkeys(row["setting"] for row in rows))}
    drawing = Figure(figsize=(10, 4 * len(scenes)), layout="constrained")
    for scene, (over_time, over_count) in zip(
        scenes, drawing.subplots(len(scenes), 2, sharey="row", squeeze=False), strict=True
    ):
        points = []
        for row in rows:
            if row["scene"] != scene:
                continue
            color, default = colors[row["setting"]], row["setting"] == "default"
            minutes, psnr = zip(*row["curve"], strict=True)
            points += row["curve"]
            over_time.plot(minutes, psnr, color=color, lw=2.5 if default else 1.2, label=row["setting"])
            over_count.plot(row["gaussians"], row["psnr"], "o", color=color, ms=8 if default else 6)
        minutes, psnr = zip(*sorted(points), strict=True)
        over_time.step(
            minutes,
            np.maximum.accumulate(psnr),
            where="post",
            color="0.7",
            lw=5,
            zorder=0,
            label="best so far",
        )
        over_time.set(title=scene, xlabel="minutes", ylabel="held-out PSNR [dB]")
        over_count.set(title=f"{scene}, in the end", xlabel="Gaussians that are needed", xscale="log")
        over_count.set_xticks(ticks := [2_000, 5_000, 10_000, 20_000, 50_000], [f"{n:,}" for n in ticks])
        over_count.minorticks_off()
        over_time.legend(frameon=False, fontsize=8)
        for axes in (over_time, over_count):
            axes.grid(color="0.9")
    drawing.savefig(path, dpi=120)
