"""What do a coarser field, fewer nodes, a gate or fewer channels cost, and what do they save?"""

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
    """tissue_0 with its regions, one setting changed at a time."""
    data = dataset(scale=options.get("scale", SCALE))
    config = _config(options, seed)
    codes, reference = np.eye(CLASSES, config.channels), _reference_ms(seed)
    found = learned(*_taught(data, codes, config))
    told = {**scores(found, data), **track_errors(found, data), **summary(found)}
    return {
        **told,
        **meanings(found, data, codes),
        "pace": told["step_ms"] / reference,
        "deform_ms": _deform_ms(found),
        "fps": frames_per_second(found, data.frame(0)),
    }


def _config(options: dict[str, Any], seed: int) -> DeformConfig:
    field = {name.removeprefix("field_"): options[name] for name in _FIELD if name in options}
    rest = {name: options[name] for name in options if name not in (*_FIELD, "scale", "graph")}
    config = replace(BASE, seed=seed, deformation=DeformationConfig(**field), **rest)
    return replace(config, graph=GraphConfig(kind="none")) if options.get("graph") == "none" else config


def _taught(data: Dataset, codes: np.ndarray, config: DeformConfig) -> tuple[list, DeformConfig, Lesson]:
    """What `learned` is given: frames, settings, and what each pixel shows."""
    lesson = Lesson([region_map(data, t) for t in data.train], codes)
    return [data.frame(t) for t in data.train], config, lesson


def _reference_ms(seed: int) -> float:
    """A step of the first row's, as fast as this machine is now: the mean of a few, in the same shares."""
    config = replace(BASE, seed=seed, warmup=_TIMED // 4, iterations=3 * _TIMED // 4)
    codes = np.eye(CLASSES, config.channels)
    return summary(learned(*_taught(dataset(scale=SCALE), codes, config)))["step_ms"]


def _deform_ms(found: Reconstructed) -> float:
    """To deform all Gaussians and bring a slope back through that; the median."""
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
    """PSNR and tracks over how long a step takes, each setting by its name."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(11, 5), dpi=110, layout="constrained")
    told = (*_FIELD, "nodes", "moving_share", "channels", "graph", "start_pixels", "iterations", "scale")
    for axes, key, words in zip(
        drawing.subplots(1, 2),
        ("psnr", "track_median_mm"),
        ("PSNR of held-out frames, dB", "tracks, median, mm"),
        strict=True,
    ):
        for i, row in enumerate(rows):
            said = (f"{one} {row[one]}".replace("_", " ") for one in told if row.get(one) is not None)
            axes.plot(row["pace"], row[key], "k*" if i == 0 else "o", ms=10 if i == 0 else 4)
            axes.annotate(", ".join(said), (row["pace"], row[key]), fontsize=6, va="bottom")
        axes.set(xscale="log", xlabel="a step, times the first row's (star)", ylabel=words)
        axes.grid(alpha=0.3)
    drawing.savefig(path, format=path.suffix.removeprefix(".") or "png")
