"""Cost and savings of a coarser field, fewer nodes, a gate or fewer channels."""

from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.shared.deform_regions import CLASSES, meanings, region_map
from experiments.shared.deforming import (
    Dataset,
    Reconstructed,
    dataset,
    frames_per_second,
    learned,
    scores,
    summary,
    track_errors,
)
from gsjax.methods.deform import DeformConfig, GraphConfig, Lesson
from gsjax.scene.deformation import DeformationConfig

BASE = DeformConfig(warmup=100, iterations=300, start_pixels=1.8)
SCALE = 0.4
_FIELD = ("kind", "resolution", "levels", "field_channels")
_TIMED = 32


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One setting changed, on tissue_0 with its regions."""
    data = dataset(scale=options.get("scale", SCALE))
    config = _config(options, seed)
    codes, reference = np.eye(CLASSES, config.channels), _reference_ms(seed)
    found = learned(*_taught(data, codes, config))
    row = {**scores(found, data), **track_errors(found, data), **summary(found)}
    return {
        **row,
        **meanings(found, data, codes),
        "pace": row["step_ms"] / reference,
        "deform_ms": _deform_ms(found),
        "fps": frames_per_second(found, data.frame(0)),
    }


def _config(options: dict[str, Any], seed: int) -> DeformConfig:
    field = {name.removeprefix("field_"): options[name] for name in _FIELD if name in options}
    rest = {name: options[name] for name in options if name not in (*_FIELD, "scale", "graph")}
    config = replace(BASE, seed=seed, deformation=DeformationConfig(**field), **rest)
    return replace(config, graph=GraphConfig(kind="none")) if options.get("graph") == "none" else config


def _taught(data: Dataset, codes: np.ndarray, config: DeformConfig) -> tuple[list, DeformConfig, Lesson]:
    """Arguments of `learned`: frames, settings, and the class of each pixel."""
    lesson = Lesson([region_map(data, t) for t in data.train], codes)
    return [data.frame(t) for t in data.train], config, lesson


def _reference_ms(seed: int) -> float:
    """Milliseconds of a step with the first row's settings on this machine now: a short run with the same
    shares of warmup and iterations."""
    config = replace(BASE, seed=seed, warmup=_TIMED // 4, iterations=3 * _TIMED // 4)
    codes = np.eye(CLASSES, config.channels)
    return summary(learned(*_taught(dataset(scale=SCALE), codes, config)))["step_ms"]


def _deform_ms(found: Reconstructed) -> float:
    """Median milliseconds of deforming all Gaussians and differentiating that."""
    scene, moving = found.run.params, found.run.kept.moving

    def squares(scene, moving, time):
        return sum(jnp.square(leaf).sum() for leaf in jax.tree.leaves(scene.at(time, moving)))

    slope = jax.jit(jax.grad(squares))

    took = []
    for i in range(_TIMED):
        begun = perf_counter()
        jax.block_until_ready(slope(scene, moving, jnp.asarray(i / _TIMED, jnp.float32)))
        took.append(perf_counter() - begun)
    return 1e3 * float(np.median(took[2:]))


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """PSNR and track errors over the time of a step, each setting labelled."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(11, 5), dpi=110, layout="constrained")
    names = (*_FIELD, "nodes", "moving_share", "channels", "graph", "start_pixels", "iterations", "scale")
    for axes, key, words in zip(
        drawing.subplots(1, 2),
        ("psnr", "track_median_mm"),
        ("PSNR of held-out frames, dB", "tracks, median, mm"),
        strict=True,
    ):
        for i, row in enumerate(rows):
            changed = (f"{name} {row[name]}".replace("_", " ") for name in names if row.get(name) is not None)
            axes.plot(row["pace"], row[key], "k*" if i == 0 else "o", ms=10 if i == 0 else 4)
            axes.annotate(", ".join(changed), (row["pace"], row[key]), fontsize=6, va="bottom")
        axes.set(xscale="log", xlabel="a step, times the first row's (star)", ylabel=words)
        axes.grid(alpha=0.3)
    drawing.savefig(path, format=path.suffix.removeprefix(".") or "png")
