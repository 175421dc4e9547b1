"""Where the first Gaussians of a fit come from: the data, or, where it has neither points nor depth, what its
photographs are found to share."""

from dataclasses import replace

import numpy as np
from rich.console import Console

from gsjax.data.photographs import Photographs
from gsjax.engine.messages import stage
from gsjax.methods.fit import FitConfig, View
from gsjax.perception.matching import filled_up, match_points

_MOST_MATCHED = 150  # photographs; of more, as many that are spread over them
LEAST_MATCHED = 100
"""Points that photographs share, below which they tell too little of where things are."""


def start_from(
    photographs: Photographs, views: list[View], config: FitConfig, console: Console
) -> tuple[FitConfig, tuple[np.ndarray, np.ndarray] | None]:
    """How to fit, and the points to begin with and their colours; None where these come from elsewhere.

    Args:
        photographs: may have points.
        views: those that are fitted.
        config: says which source is asked for.
        console: matching takes a while, which is said there.

    Raises:
        ValueError: matches are asked for, and photographs share next to nothing.
    """
    source, cloud = config.start.source, photographs.cloud
    has_points = cloud is not None and len(cloud.points) > 0
    has_depth = any(view.depth is not None for view in views)
    if source != "matches" and (source != "auto" or has_points or has_depth):
        return config, (cloud.points, cloud.colors) if cloud is not None else None
    views = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, _MOST_MATCHED).round().astype(int))]
    pictures, masks = [view.image for view in views], [view.mask for view in views]
    viewmats, Ks = np.stack([view.viewmat for view in views]), np.stack([view.K for view in views])
    with stage(console, "looking for what photographs share"):
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
