"""The tracker, judged as the optimisations are: it has no loss to end at, but poses that are right or said to
be lost."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np

from experiments.shared.recordings import start_of, tracked
from gsjax.data import Sequence
from gsjax.engine.recording import Recording, remembered
from gsjax.engine.track.loop import Tracking
from gsjax.engine.track.scoring import first_labels, score_motion
from gsjax.methods.track import PRESETS, TrackConfig

TRACKER = PRESETS["fast"]
EXTENT = 100.0  # pixels a Gaussian, so that an object has hardly more than two


def track(sequence: Sequence, config: TrackConfig, gaussians: int | None) -> dict[str, Any]:
    """One recording tracked from its first frame.

    Args:
        sequence: the recording, with true poses and masks.
        config: settings.
        gaussians: two, or as many as there can be: one to a pixel; None for the usual number.
    """
    if gaussians is not None:
        spacing = EXTENT if gaussians == 2 else 1.0
        start = replace(config.start, object_pixels=spacing, background_pixels=spacing)
        config = replace(config, start=start)
    start = start_of(Recording(remembered(sequence), sequence, sequence.num_frames, True), config)
    tracking = tracked(start, config)
    errors = {}
    labels = first_labels(tracking, start.recording)
    for label, score in score_motion(tracking, start.recording, labels).items():
        if score.num_scored:
            errors[label] = score.centroid_errors_mm
    worst = max(errors, key=lambda label: errors[label][-1])
    poses = jax.tree.leaves(tracking.poses)
    return {
        "finite": all(bool(np.isfinite(leaf).all()) for leaf in poses),
        "skipped": tracking.skipped,
        "error_mm": float(errors[worst][-1]),
        "median_mm": float(np.median([np.median(of) for of in errors.values()])),
        "said": _said(tracking),
    }


def _said(tracking: Tracking) -> list[str]:
    """How many updates reported an object as lost, or its turn as unknown."""
    lost = int(np.stack(tracking.lost).any(axis=1).sum())
    unknown = int((~np.stack(tracking.turn_known)).any(axis=1).sum())
    counts = {"an object lost": lost, "a turn unknown": unknown}
    return [f"{words} in {count} frames" for words, count in counts.items() if count]


def longer(config: TrackConfig) -> TrackConfig:
    """Ten times the iterations of the alignment and of the refinement."""
    align, refine = config.align, config.refine
    return replace(
        config,
        align=replace(align, iterations=10 * align.iterations),
        refine=replace(refine, iterations=10 * refine.iterations),
    )


def faster(config: TrackConfig, factor: float) -> TrackConfig:
    """The paper's stages instead, which alone have rates, all times a factor."""
    paper = replace(PRESETS["paper"], seed=config.seed)
    names = ("translation_rate", "rotation_rate", "delta_rate", "background_rate")
    rates = {name: factor * getattr(paper.refine, name) for name in names}
    return replace(paper, refine=replace(paper.refine, **rates))
