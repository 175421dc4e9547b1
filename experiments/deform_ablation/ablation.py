"""What is each part of SurstSplat and GaussianClin worth, also with a teacher that errs?"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.shared.deform_regions import CLASSES, meanings, region_map, with_errors
from experiments.shared.deforming import dataset, learned, scores, summary, track_errors
from gsjax.methods.deform import PRESETS, DeformConfig, Lesson

SCALE, WARMUP, ITERATIONS, START_PIXELS = 0.4, 100, 300, 1.8
HEAVY_NODES = 2048
_COUNTED = ("node", "structure", "spatial", "temporal")


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """tissue_0 at two fifths of its width, every eighth frame held out, tools masked."""
    data, part = dataset(scale=SCALE), options["without"]
    config = _config(options["method"], part, seed)
    if options.get("features") == "over time":
        config = replace(config, deformation=replace(config.deformation, feature=True))
    if options.get("graph") == "heavy":  # half of the Gaussians are nodes, with ten times the weight
        heavy = {"nodes": HEAVY_NODES} | dict.fromkeys(_COUNTED, 1.0)
        config = replace(config, graph=replace(config.graph, **heavy))
    codes = None if part == "features" else np.eye(CLASSES, config.channels)
    rng = np.random.default_rng(seed)
    lesson = None
    if codes is not None:
        errors = options["errors"]
        lesson = Lesson([with_errors(region_map(data, t), errors, rng) for t in data.train], codes)
    found = learned([data.frame(t) for t in data.train], config, lesson)
    row = {**scores(found, data), **track_errors(found, data), **summary(found)}
    return row if codes is None else row | meanings(found, data, codes)


def _config(method: str, part: str, seed: int) -> DeformConfig:
    """A paper's recipe in fewer steps, without a part of it."""
    config = replace(
        PRESETS[method], warmup=WARMUP, iterations=ITERATIONS, start_pixels=START_PIXELS, seed=seed
    )
    if part == "deformation":
        steps = config.warmup + config.iterations
        return replace(config, warmup=steps, iterations=0, warmup_frames="all")
    if part == "graph":
        return replace(config, graph=replace(config.graph, kind="none"))
    if part == "matching":  # keeps the node loss, drops the pairwise one
        return replace(config, graph=replace(config.graph, structure=0.0))
    return config
