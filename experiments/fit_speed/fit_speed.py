"""Time of a step of the static fit, part by part."""

from itertools import pairwise
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.workloads import ball
from gsjax.geometry.cameras import Camera
from gsjax.methods.fit import Batch, FitConfig, fit_loss, grow
from gsjax.methods.fit import step as fit_step
from gsjax.methods.fit.model import model_of, with_degree
from gsjax.optim.compiler import host_options
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import gaussians_from_activated
from gsjax.scene.render import plan_render, render

WIDTH, HEIGHT, REPEATS = 480, 270, 9
HALFWAY, RADIUS = 0.5, 1.0  # progress of the fit, and radius of the scene
PARTS = ("draw", "loss", "backward", "adam", "grow")


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """Programs that each include one more part of a step, called in turn."""
    count, config = options["count"], FitConfig(cap=options["count"])
    seen, start = (ball(count, WIDTH, HEIGHT, seed=seed + i) for i in range(2))
    camera = Camera(seen.viewmat[None], seen.K[None], WIDTH, HEIGHT)
    goal, gaussians = (gaussians_from_activated(*scene[:5]) for scene in (seen, start))
    model = with_degree(model_of(gaussians, config, 1), 1)
    target = jnp.round(255 * jnp.clip(render(goal, camera).colors, 0, 1)).astype(jnp.uint8)
    plan = plan_render(model.gaussians, camera, headroom=1.3)
    batch = Batch(Frame(target, None, camera), jnp.int32(0), jnp.zeros((1, 3)), HALFWAY, RADIUS, plan)
    step, loss = fit_step(config), fit_loss(config)
    state, key = step.init(model), jax.random.key(seed)

    def drawn(model, state, batch, key):
        return render(model.gaussians, batch.frame.cameras, batch.plan, backgrounds=batch.background)

    def compared(model, state, batch, key):
        return loss(model, batch, step=0, key=key)

    def differentiated(model, state, batch, key):
        return jax.value_and_grad(loss, has_aux=True)(model, batch, step=0, key=key)

    def stepped(model, state, batch, key):
        return step.update(model, state, batch, step=0, key=key)

    def grown(model, state, batch, key):
        return grow(model, state, key, config.cap, config.growth.factor, True)

    programs, compiling = {}, {}
    for function in (drawn, compared, differentiated, stepped, grown):
        begun = perf_counter()
        lowered = jax.jit(function, compiler_options=host_options()).lower(model, state, batch, key)
        programs[function.__name__] = lowered.compile()
        compiling[function.__name__] = perf_counter() - begun
    times: dict[str, list[float]] = {name: [] for name in programs}
    for turn in range(REPEATS + 1):  # the first is not counted
        for name, program in programs.items():
            begun = perf_counter()
            jax.block_until_ready(program(model, state, batch, key))
            times[name] += [perf_counter() - begun] if turn else []
    ms = {name: 1e3 * float(np.median(values)) for name, values in times.items()}
    ends = ["drawn", "compared", "differentiated", "stepped"]
    parts = [ms["drawn"], *(ms[b] - ms[a] for a, b in pairwise(ends)), ms["grown"]]
    memory = programs["stepped"].memory_analysis()
    held = sum(leaf.nbytes for leaf in jax.tree.leaves((model, state)))
    return {
        "pairs": int(programs["drawn"](model, state, batch, key).meta.pairs[0]),
        "steps_a_second": 1e3 / ms["stepped"],
        "p95_over_median": float(np.percentile(times["stepped"], 95)) * 1e3 / ms["stepped"],
        **{f"{name}_ms": value for name, value in zip(PARTS, parts, strict=True)},
        "step_over_draw": ms["stepped"] / ms["drawn"],
        "parameters_mb": held / 1e6,
        "temporary_mb": memory.temp_size_in_bytes / 1e6,
        "compile_s": compiling["stepped"],
    }


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """A stacked bar for each number of Gaussians."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(7, 2.6), layout="constrained")
    axes = drawing.subplots()
    left = np.zeros(len(rows))
    for part, label in zip(PARTS[:4], ("draw", "L1 and D-SSIM", "backward", "Adam and walk"), strict=True):
        widths = np.array([row[f"{part}_ms"] for row in rows])
        axes.barh([f"{row['count']:,}" for row in rows], widths, left=left, label=label)
        left += widths
    axes.set_xlabel("milliseconds a step")
    axes.set_ylabel("Gaussians")
    axes.legend(frameon=False, ncols=4, loc="upper center", bbox_to_anchor=(0.45, 1.25))
    drawing.savefig(path, dpi=120)
