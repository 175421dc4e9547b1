"""What does each rung of the ladder of fields cost, and what is it worth: vote, solve, field, paper?"""

from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.shared.fields import (
    articulated,
    by_majority,
    codebook_of,
    first_tracked,
    fitted,
    flawed_teacher,
    scored,
)
from gsjax.data import ReadOptions
from gsjax.engine.distill.scene import FieldScene
from gsjax.engine.distill.scores import classes_of
from gsjax.engine.drive import Clock, drive
from gsjax.methods.distill import PRESETS, Distill, DistillConfig, DistillResult, Teacher, teacher_of_objects
from gsjax.methods.fit import FitConfig, StartConfig
from gsjax.optim.compiler import host_options

PAPER_STEPS = 300  # of 1,500: more do not help (docs/results-fields.md)
SNAP = 2  # pixels by which outlines of flawed masks are moved to edges
WITHHELD = (4, 12, 20, 27)  # cameras of the dome whose masks are used for scores only
HELD_OUT = (0, 10, 15, 30)  # and those that the scene is not fitted to; they have no masks
FIT = FitConfig(steps=4_000, cap=30_000, sh_degree=0, start=StartConfig(count=20_000))
QUERIES = 20  # that are timed


class Lesson(NamedTuple):
    """A scene, the names and vectors of its labels, the teacher, and the labels that its masks mean."""

    scene: FieldScene
    names: dict[int, str]
    codes: np.ndarray
    teacher: Teacher
    ids: list[np.ndarray]


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One field, scored as `field_masks` and `field_basketball` score theirs."""
    scene, names, codes, teacher, ids = lesson_of(options["scene"], seed, folder)
    majority = scored(scene, by_majority(scene, scene.taught, ids, len(names)), names)
    config = replace(PRESETS[options["preset"]], seed=seed)
    if options["preset"] == "paper":
        config = replace(config, iterations=PAPER_STEPS)
    result, found = trained(scene, teacher, config)
    field, located = result.placed
    asked = scored(scene, classes_of(field, located, codes), names, (field, located, codes))
    return {
        **asked,
        **found,
        "majority_miou": majority["miou_3d"],
        "majority_gaussian_iou": majority.get("gaussian_iou"),
        "query_ms": query_ms(result, codes),
        "gaussians": scene.gaussians.num,
    }


def lesson_of(name: str, seed: int, folder: Path) -> Lesson:
    """Masks with a segmenter's flaws for simulated scenes; the masks of real ones as they are."""
    if name == "panoptic_basketball":
        return real_lesson(folder)
    if name == "articulated_0":
        scene = articulated(folder)
    else:
        scene = first_tracked(name, folder, cameras=(0, 1), mask_camera=1, eval_cameras=(2,))
    names, codes = codebook_of(scene.photographs)
    return Lesson(scene, names, codes, *flawed_teacher(scene, codes, seed, snap=SNAP))


def real_lesson(folder: Path) -> Lesson:
    """The foreground of a dome of cameras, four of which judge."""
    scene = fitted(
        "panoptic_basketball",
        folder,
        eval_cameras=HELD_OUT,
        fit=FIT,
        frames="0:1",
        scale=0.5,
        read=ReadOptions(near=0.5),  # cameras of the dome see each other
    )
    photographs = scene.photographs
    cameras = [int(name.split("/")[0]) for name in photographs.names]
    masked = [i for i in scene.taught if photographs.labels(i) is not None]
    taught = [i for i in masked if cameras[i] not in WITHHELD]
    scene = replace(scene, taught=taught, held_out=[i for i in masked if cameras[i] in WITHHELD])
    names, codes = codebook_of(photographs.select(masked))
    masks = [np.asarray(photographs.labels(i), np.int64) for i in taught]
    return Lesson(scene, names, codes, teacher_of_objects(masks, [codes] * len(masks)), masks)


def trained(
    scene: FieldScene, teacher: Teacher, config: DistillConfig
) -> tuple[DistillResult, dict[str, float]]:
    """A field, and its time from the Gaussians and the teacher on: in all but compiling, and compiling."""
    cameras = [scene.photographs.camera(i) for i in scene.taught]
    clock, method = Clock(), Distill(config)
    problem, first = method.start(scene.gaussians, cameras, teacher, scene.rasterize_mode)
    seconds, compiling = clock.read()
    memory = memory_mb(method, problem, first)
    ticks = drive(method, problem, first)
    for now in ticks:
        seconds, compiling = seconds + now.seconds, compiling + now.compile_seconds
        assert not bool(now.info["skipped"])
    if config.start != "random" and config.iterations:
        memory = max(memory, memory_mb(method, problem, ticks.run.having(step=ticks.run.step - 1)))
    return ticks.result, {"taken_seconds": seconds, "compile_seconds": compiling, "memory_mb": memory}


def memory_mb(method: Distill, problem: Any, run: Any) -> float:
    """Memory of a compiled step: its arguments and temporaries."""
    advance = jax.jit(method.step.update, compiler_options=host_options(), donate_argnums=(0, 1))
    batch, _ = method.batch(problem, run, 0.0)
    lowered = advance.lower(run.params, run.state, batch, step=jnp.asarray(0), key=jax.random.key(0))
    needed = lowered.compile().memory_analysis()
    assert needed is not None
    return (needed.argument_size_in_bytes + needed.temp_size_in_bytes) / 2**20


def query_ms(result: DistillResult, codes: np.ndarray) -> float:
    """Median time in which all Gaussians are scored for a vector against all others, once warm."""
    times = []
    for i in range(QUERIES + 1):
        vectors, begun = np.roll(codes, i, axis=0), perf_counter()
        jax.block_until_ready(result.scores(vectors))
        times.append(perf_counter() - begun)
    return 1e3 * float(np.median(times[1:]))


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """Quality over seconds: a panel for each scene, a colour for each score, a point for each preset."""
    from matplotlib.figure import Figure

    scores = {"miou_3d": "mIoU of views, 3D query", "miou_2d": "2D query", "gaussian_iou": "IoU of Gaussians"}
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    drawing = Figure(figsize=(4 * len(scenes), 4), dpi=110, layout="constrained")
    panels = np.atleast_1d(drawing.subplots(1, len(scenes)))
    for axes, scene in zip(panels, scenes, strict=True):
        mine = [row for row in rows if row["scene"] == scene]
        presets = list(dict.fromkeys(row["preset"] for row in mine))
        groups = [[row for row in mine if row["preset"] == preset] for preset in presets]
        seconds = [np.mean([row["taken_seconds"] for row in group]) for group in groups]
        for key, words in scores.items():
            values = [[row[key] for row in group if row.get(key) is not None] for group in groups]
            if not all(values):
                continue
            means = np.array([np.mean(each) for each in values])
            spread = [means - [min(each) for each in values], [max(each) for each in values] - means]
            axes.errorbar(seconds, means, np.maximum(spread, 0), marker="o", ms=4, capsize=2, label=words)
        for preset, x in zip(presets, seconds, strict=True):
            axes.axvline(x, color="0.9", lw=0.8, zorder=0)
            axes.annotate(preset, (x, 1.0), xycoords=("data", "axes fraction"), fontsize=8, rotation=45)
        axes.set(xscale="log", xlabel="seconds")
        axes.xaxis.set_minor_formatter("")
        axes.set_title(scene, fontsize=9, pad=28)
        axes.grid(alpha=0.3, axis="y")
    panels[0].legend(fontsize=8)
    drawing.savefig(path, format=path.suffix.removeprefix(".") or "png")
