"""The points from which a fit starts: those of the data or, if it has neither points nor depth, points
triangulated from matches between its photographs."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
from rich.console import Console

from gsjax.data.photographs import Photographs
from gsjax.engine.messages import stage
from gsjax.methods.fit import FitConfig
from gsjax.perception.matching import filled_up, match_points
from gsjax.scene.frame import Frame

_MOST_MATCHED = 150  # photographs; of more, this many are matched, evenly spread
LEAST_MATCHED = 100
"""Fewest matched points from which a fit starts."""


def start_from(
    photographs: Photographs, frames: list[Frame], config: FitConfig, console: Console | None = None
) -> tuple[FitConfig, tuple[np.ndarray, np.ndarray] | None]:
    """The settings of the fit, and the initial points and their colours; None if they come from elsewhere.

    Args:
        photographs: perhaps with points.
        frames: the photographs to fit.
        config: names the source of the start.
        console: announces the matching (default: no message).

    Raises:
        ValueError: matches are required, and the photographs share too few points.
    """
    source, cloud = config.start.source, photographs.cloud
    has_points = cloud is not None and len(cloud.points) > 0
    has_depth = any(frame.depths is not None for frame in frames)
    if photographs.fisheye is not None and source == "matches":
        raise ValueError(
            f"--fit.start.source matches: expected photographs by pinholes, found {photographs.name} by "
            "fisheyes; leave out --read.fisheye, or use random"
        )
    pinholes = photographs.fisheye is None
    if source != "matches" and (source != "auto" or has_points or has_depth or not pinholes):
        return config, (cloud.points, cloud.colors) if cloud is not None else None
    spread = np.unique(np.linspace(0, len(frames) - 1, _MOST_MATCHED).round().astype(int))
    frames = [frames[i] for i in spread]
    pictures = [frame.images[0] for frame in frames]
    masks = [None if frame.masks is None else frame.masks[0] for frame in frames]
    viewmats = np.concatenate([frame.cameras.viewmat for frame in frames])
    Ks = np.concatenate([frame.cameras.K for frame in frames])
    with nullcontext() if console is None else stage(console, "matching photographs"):
        matched = match_points(pictures, viewmats, Ks, masks)
    if len(matched.points) < LEAST_MATCHED:
        if source == "matches":
            raise ValueError(
                f"--fit.start.source matches: expected photographs to share {LEAST_MATCHED} points or more, "
                f"found {len(matched.points)}; use random"
            )
        return config, None
    points = filled_up(matched, pictures, viewmats, Ks, config.start.count, config.seed)
    return replace(config, start=replace(config.start, source="matches")), points
