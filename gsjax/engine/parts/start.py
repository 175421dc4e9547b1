"""The start of a discovery of parts: the anchor frame, what moves, and the candidate parts."""

import jax
import numpy as np
from jaxtyping import Bool, Int

from gsjax.data.sequence import Sequence
from gsjax.methods.fit import FitConfig, StartConfig
from gsjax.methods.parts import Anchor, PartsConfig, Start, begin, choose_anchor, moved_pixels
from gsjax.methods.parts.anchor import check_anchor
from gsjax.methods.parts.states import begin_with_states
from gsjax.methods.protocols import Segmenter
from gsjax.scene.gaussians import Gaussians

FIT = FitConfig(
    steps=3_000, cap=15_000, sh_degree=0, depth_weight=0.5, exposure=True, start=StartConfig(count=10_000)
)
"""Default settings of the fit of the canonical scene."""
_POSE_TOL = 1e-3  # largest change of an entry of a static camera's pose: metres, or of the rotation matrix


def has_two_states(tracked: Sequence) -> bool:
    """Whether a recording shows two states with depth, each seen by its own cameras, without the motion
    between them."""
    return tracked.has_depth and _cameras_moved(tracked)


def _cameras_moved(tracked: Sequence) -> bool:
    """Whether there are exactly two frames, and most cameras have another pose in the second."""
    if tracked.num_frames != 2:
        return False
    apart = np.abs(tracked.viewmats[0] - tracked.viewmats[1]).max((-1, -2))
    return float(np.mean(apart > _POSE_TOL)) > 0.5


def detect_motion(
    tracked: Sequence, config: PartsConfig, anchor: int | None
) -> tuple[Anchor, Bool[np.ndarray, "C F H W"] | None]:
    """The anchor frame, and the pixels of its pictures that change in each of F other frames; for two states
    None in place of the pixels, as they are compared in 3D.

    Args:
        tracked: the tracked cameras.
        config: settings of the discovery.
        anchor: index of the frame (default: the one that differs most from the others; for two states, the
            first).

    Raises:
        ValueError: there is no such frame, nothing moves, or two states have no depth.
    """
    if has_two_states(tracked):
        check_anchor(anchor, tracked.num_frames)
        chosen = anchor or 0
        return Anchor(chosen, 1 - chosen, np.zeros(2)), None
    cameras, discover = tracked.num_cameras, config.discover
    if discover.difference and _cameras_moved(tracked):
        raise ValueError(
            f"{tracked.name}: expected depth of two frames by cameras that stand elsewhere in each, found "
            "none; what moved between two states is searched for in space. Add depth of both, measured or by "
            "a network (docs/data.md), record more frames by cameras that stand still, or give "
            "--parts.discover.no-difference, by which all segments may move"
        )
    chosen = choose_anchor(tracked.image, tracked.num_frames, cameras, anchor)
    depth = tracked.depth if tracked.has_depth and discover.depth else None
    return chosen, moved_pixels(
        tracked.image, chosen, cameras, frames=discover.frames, threshold=discover.threshold, depth=depth
    )


def discover(
    tracked: Sequence,
    gaussians: Gaussians,
    anchor: Anchor,
    moved: Bool[np.ndarray, "C F H W"] | None,
    config: PartsConfig,
    segmenter: Segmenter | None,
    masks: Int[np.ndarray, "C H W"] | None = None,
) -> Start:
    """Candidate parts; for two states, the parts themselves and their motions.

    Args:
        tracked: the tracked cameras.
        gaussians: the scene at the anchor frame.
        anchor, moved: from `detect_motion`.
        config: settings of the discovery.
        segmenter: finds the segments of a picture; not used if masks are given, or for two states.
        masks: labels of the candidate parts in every view, if known; not used for two states.

    Raises:
        ValueError: as `begin` and `begin_with_states` do.
    """
    key = jax.random.key(config.seed)
    if moved is None:
        return begin_with_states(tracked, gaussians, anchor, config, key)
    return begin(tracked, gaussians, anchor, moved, config, segmenter, key, masks)
