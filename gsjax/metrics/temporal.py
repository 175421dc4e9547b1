"""Temporal consistency of a video: scores between neighbouring frames, directly and along the optical flow.

A video in which nothing moves is the most consistent of all, so such a score means little on its own: read it
with its gap from the score of the true video and, for scores along the flow, with the fraction of the pixels
compared. The occlusion check may discard exactly those pixels that move implausibly.

Videos are [T, H, W, 3], RGB, uint8 or floats 0 to 1; masks [T, H, W], True where to compare. On the host.
"""

from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Num

from gsjax.geometry.flow import seen_in_both, warp
from gsjax.metrics.image import ssim
from gsjax.metrics.perceptual import LpipsWeights, lpips

Compare = Callable[[np.ndarray, np.ndarray, np.ndarray | None], float]
"""A score of two images [H, W, 3], 0 to 1, under a mask: `psnr`, `ssim`, `ms_ssim`, or `lpips` with its
weights bound."""


def unit_frames(video: Num[np.ndarray, "..."]) -> Iterator[Float[np.ndarray, "H W 3"]]:
    """The frames of a video one by one, in float64, 0 to 1.

    Raises:
        ValueError: its shape is not [T, H, W, 3], or its numbers are neither bytes nor floats.
    """
    if video.ndim != 4 or video.shape[3] != 3:
        raise ValueError(f"video: expected shape [T, H, W, 3], found {video.shape}")
    if video.dtype != np.uint8 and not np.issubdtype(video.dtype, np.floating):
        raise ValueError(f"video: expected uint8 or floats 0 to 1, found {video.dtype}")
    scale = 255.0 if video.dtype == np.uint8 else 1.0
    return (np.asarray(frame, np.float64) / scale for frame in video)


def between_neighbors(
    compare: Compare, video: Num[np.ndarray, "..."], masks: Bool[np.ndarray, "..."] | None = None
) -> float:
    """The mean over t of compare(frame t + 1, frame t) where both masks are True.

    Pairs without a score (under an empty mask) are ignored; NaN if none has one.

    Args:
        compare: a score of two images under a mask.
        video: [T, H, W, 3], at least two frames.
        masks: [T, H, W], True where to compare; default: everywhere.

    Raises:
        ValueError: shapes do not agree, there are fewer than two frames, or `compare` raises it.
    """
    frames = _checked(video, masks)
    inside = [None] * (len(video) - 1) if masks is None else masks[:-1] & masks[1:]
    pairs = zip(pairwise(frames), inside, strict=True)
    return _mean([compare(after, now, both) for (now, after), both in pairs])


def t_ssim(video: Num[np.ndarray, "..."], masks: Bool[np.ndarray, "..."] | None = None) -> float:
    """Mean SSIM of neighbouring frames (SurstSplat, section 3.3); 1 if nothing moves. Like T-LPIPS, with
    windows of 11 pixels instead of a network.

    Args:
        video: [T, H, W, 3], at least two frames.
        masks: [T, H, W], True where to compare; default: everywhere.

    Raises:
        ValueError: as for `between_neighbors`, or a side is below 11 pixels.
    """
    return between_neighbors(ssim, video, masks)


def t_lpips(
    weights: LpipsWeights, video: Num[np.ndarray, "..."], masks: Bool[np.ndarray, "..."] | None = None
) -> float:
    """Mean LPIPS of neighbouring frames (MotionSplicer, section 4.1); 0 if nothing moves.

    Args:
        weights: weights of LPIPS.
        video: [T, H, W, 3], at least two frames.
        masks: [T, H, W], True where to compare; default: everywhere.

    Raises:
        ValueError: as for `between_neighbors`, or the frames are too small for the network.
    """
    return between_neighbors(partial(lpips, weights), video, masks)


class Flows(NamedTuple):
    """Optical flow between neighbouring frames, pixels (x, y); NaN where unknown.

    Attributes:
        forward: from frame t to t + 1.
        backward: from frame t + 1 to t.
    """

    forward: Float[np.ndarray, "pairs H W 2"]
    backward: Float[np.ndarray, "pairs H W 2"]


def video_flows(
    video: Num[np.ndarray, "T H W 3"], optical_flow: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> Flows:
    """The flows of a video, as estimated by a method (`gsjax.methods.protocols.OpticalFlow`).

    Raises:
        ValueError: there are fewer than two frames.
    """
    _checked(video, None)
    return Flows(
        np.stack([optical_flow(now, after) for now, after in pairwise(video)]),
        np.stack([optical_flow(after, now) for now, after in pairwise(video)]),
    )


class FlowWarpError(NamedTuple):
    """Difference between each frame and the next one warped back along the flow.

    Attributes:
        error: mean absolute difference of colours from 0 to 1, over the compared pixels and their channels;
            NaN if no pixel was compared.
        share: fraction of the pixels that was compared; with masks, of the pixels in the masks.
    """

    error: float
    share: float


def flow_warp_error(
    video: Num[np.ndarray, "..."], flows: Flows, masks: Bool[np.ndarray, "..."] | None = None
) -> FlowWarpError:
    """Flow-Warp (MotionSplicer, section 4.1): mean |frame t - frame t + 1 warped to t along the flow|.

    Pixels are compared if they are visible in both frames (`gsjax.geometry.flow.seen_in_both`) and in both
    masks. Lai et al. (2018) square the differences instead.

    Args:
        video: the video to score.
        flows: optical flow of the video: the true flow of a simulated scene, or `video_flows` of the video.
        masks: where to compare; default: everywhere.

    Raises:
        ValueError: the shapes do not agree, or there are fewer than two frames.
    """
    total, compared = 0.0, 0
    for now, warped, inside in _along(video, flows, masks):
        total += float(np.abs(warped - now)[inside].sum())
        compared += int(inside.sum())
    asked = video[:-1, ..., 0].size if masks is None else int(masks[:-1].sum())
    return FlowWarpError(
        total / (3 * compared) if compared else float("nan"), compared / asked if asked else float("nan")
    )


def along_flow(
    compare: Compare,
    video: Num[np.ndarray, "..."],
    flows: Flows,
    masks: Bool[np.ndarray, "..."] | None = None,
) -> float:
    """The mean over t of compare(frame t + 1 warped to t along the flow, frame t), over the pixels of
    `flow_warp_error`: warped LPIPS and warped SSIM (SurstSplat, section 3.3), which discount explained
    motion.

    Elsewhere both images show frame t, so that a window or network that reaches there finds no difference.

    Args:
        compare: a score of two images under a mask.
        video: [T, H, W, 3], at least two frames.
        flows: optical flow of the video.
        masks: [T, H, W], True where to compare; default: everywhere.

    Raises:
        ValueError: the shapes do not agree, there are fewer than two frames, or `compare` raises it.
    """
    scores = []
    for now, warped, inside in _along(video, flows, masks):
        scores.append(compare(np.where(inside[..., None], warped, now), now, inside))
    return _mean(scores)


def temporal_scores(
    video: Num[np.ndarray, "..."],
    truth: Num[np.ndarray, "..."] | None = None,
    *,
    masks: Bool[np.ndarray, "..."] | None = None,
    optical_flow: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
    lpips_weights: LpipsWeights | None = None,
) -> dict[str, float | None]:
    """All scores of this module by name, and under `NAME_gap` how far each is from that of the true video.

    Each video is warped along the flow estimated from itself.

    Args:
        video: the video to score.
        truth: the recording of the same frames; without it, the gaps are left out.
        masks: where to compare, in both.
        optical_flow: estimates flow; without it, there are no scores along the flow.
        lpips_weights: weights of LPIPS; without them, there is no LPIPS.

    Returns:
        Scores by name; None for a score that was not computed.

    Raises:
        ValueError: shapes do not agree, there are fewer than two frames, or a side is below 11 pixels.
    """
    found = _scores(video, masks, optical_flow, lpips_weights)
    if truth is None:
        return found
    if truth.shape != video.shape:
        raise ValueError(f"truth: expected shape {video.shape} to match video, found {truth.shape}")
    true = _scores(truth, masks, optical_flow, lpips_weights)
    gaps = {f"{name}_gap": _gap(found[name], true[name]) for name in found if name != "flow_warp_share"}
    return found | gaps


def _scores(video, masks, optical_flow, lpips_weights) -> dict[str, float | None]:
    names = ("t_ssim", "t_lpips", "flow_warp_error", "flow_warp_share", "warped_ssim", "warped_lpips")
    found: dict[str, float | None] = dict.fromkeys(names)
    found["t_ssim"] = t_ssim(video, masks)
    if lpips_weights is not None:
        found["t_lpips"] = t_lpips(lpips_weights, video, masks)
    if optical_flow is not None:
        flows = video_flows(video, optical_flow)
        found["flow_warp_error"], found["flow_warp_share"] = flow_warp_error(video, flows, masks)
        found["warped_ssim"] = along_flow(ssim, video, flows, masks)
        if lpips_weights is not None:
            found["warped_lpips"] = along_flow(partial(lpips, lpips_weights), video, flows, masks)
    return found


def _gap(found: float | None, true: float | None) -> float | None:
    return None if found is None or true is None else abs(found - true)


def _along(
    video: np.ndarray, flows: Flows, masks: np.ndarray | None
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """For each pair: frame t, frame t + 1 warped to it, and where the two are compared."""
    frames = _checked(video, masks)
    wanted = (len(video) - 1, *video.shape[1:3], 2)
    for name, flow in flows._asdict().items():
        if flow.shape != wanted:
            raise ValueError(f"flows.{name}: expected shape {wanted} to match video, found {flow.shape}")
    for t, (now, after) in enumerate(pairwise(frames)):
        warped = warp(after, flows.forward[t])
        inside = seen_in_both(flows.forward[t], flows.backward[t]) & np.isfinite(warped).all(-1)
        if masks is not None:
            # All four pixels around the end of the flow must be in the mask, up to rounding.
            inside &= masks[t] & (warp(masks[t + 1], flows.forward[t]) > 1 - 1e-6)
        yield now, warped, inside


def _checked(video: np.ndarray, masks: np.ndarray | None) -> Iterator[np.ndarray]:
    """The frames one by one; raises ValueError for fewer than two, or masks of another shape."""
    frames = unit_frames(video)
    if len(video) < 2:
        raise ValueError(f"video: expected at least two frames, found {len(video)}")
    if masks is not None and masks.shape != video.shape[:3]:
        raise ValueError(f"masks: expected shape {video.shape[:3]} to match video, found {masks.shape}")
    return frames


def _mean(values: list[float]) -> float:
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else float("nan")
