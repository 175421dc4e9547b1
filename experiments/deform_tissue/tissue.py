"""How well are held-out frames of deforming tissue rendered, and its points tracked?"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.shared.deforming import (
    copies,
    dataset,
    frames_per_second,
    learned,
    scores,
    summary,
    track_errors,
)
from gsjax.methods.deform import DeformConfig, GraphConfig, Lesson

BASE = DeformConfig(warmup=200, iterations=800, start_pixels=1.8)
CHANNELS = BASE.channels


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One variant on tissue_0, with every eighth frame held out and tools masked."""
    data, variant = dataset(), options["variant"]
    config, semantic = replace(BASE, seed=seed), variant not in ("deformation alone", "static")
    if variant == "static":
        config = replace(config, warmup=config.warmup + config.iterations, iterations=0, warmup_frames="all")
    elif variant == "no graph":
        config = replace(config, graph=GraphConfig(kind="none"))
    lesson = Lesson([data.classes(t) for t in data.train], np.eye(2, CHANNELS)) if semantic else None
    found = learned([data.frame(t) for t in data.train], config, lesson)
    return {
        **scores(found, data),
        **copies(data),
        **track_errors(found, data),
        **summary(found),
        "fps": frames_per_second(found, data.frame(0)),
    }
