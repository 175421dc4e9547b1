"""The start of a discovery of parts: the anchor frame, motion, and the fit of the canonical scene."""

import numpy as np
from jaxtyping import Bool

from gsjax.data.sequence import Sequence
from gsjax.methods.fit import FitConfig, StartConfig
from gsjax.methods.parts import Anchor, PartsConfig, choose_anchor, moved_pixels

FIT = FitConfig(
    steps=3_000, cap=15_000, sh_degree=0, depth_weight=0.5, exposure=True, start=StartConfig(count=10_000)
)
"""Default settings of the fit of the canonical scene."""


def detect_motion(
    tracked: Sequence, config: PartsConfig, anchor: int | None
) -> tuple[Anchor, Bool[np.ndarray, "C F H W"]]:
    """The anchor frame, and the pixels of its pictures that change in each of F other frames.

    Args:
        tracked: the tracked cameras.
        config: settings of the discovery.
        anchor: index of the frame (default: the one that differs most from the others).
    """
    cameras, discover = tracked.num_cameras, config.discover
    chosen = choose_anchor(tracked.image, tracked.num_frames, cameras, anchor)
    depth = tracked.depth if tracked.has_depth else None
    return chosen, moved_pixels(
        tracked.image, chosen, cameras, frames=discover.frames, threshold=discover.threshold, depth=depth
    )
