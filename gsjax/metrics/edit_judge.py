"""A scripted judge of edited videos: is the rest unchanged, did the part move as requested, and is the place
that it left clean?

It uses only the pixels and the requested edit. It is not GPT-EE, which is GPT-4o's opinion (MotionSplicer,
section 4.1), and its scores never bear that name. Each finding comes with a reason in words.

Videos are [T, H, W, 3], RGB, uint8 or floats 0 to 1; regions [T, H, W]. On the host.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Num

from gsjax.geometry.cameras import pixel_grid, project, unproject
from gsjax.geometry.flow import warp
from gsjax.metrics.temporal import unit_frames


class Finding(NamedTuple):
    """The verdict on one aspect of an edit.

    Attributes:
        score: 0 to 1, higher is better; NaN if there was nothing to judge.
        reason: the reason for the score, in words.
    """

    score: float
    reason: str


def rest_stays(
    before: Num[np.ndarray, "..."],
    after: Num[np.ndarray, "..."],
    touched: Bool[np.ndarray, "..."],
    tolerance: float = 1 / 255,
) -> Finding:
    """The fraction of the pixels outside `touched` that are unchanged.

    Args:
        before, after: the video before and after the edit.
        touched: pixels that may change: those that show an edited part, before or after, or its shadow.
        tolerance: largest difference of a channel that counts as unchanged, colours from 0 to 1.

    Raises:
        ValueError: the shapes do not agree.
    """
    _check_shapes(before, after=after, touched=touched)
    changed = _differ(before, after, tolerance)[~touched]
    return _finding(~changed, "pixels outside the edit are unchanged")


def requested_motion_is_seen(
    before: Num[np.ndarray, "..."],
    after: Num[np.ndarray, "..."],
    requested: Float[np.ndarray, "..."],
    tolerance: float = 0.1,
) -> Finding:
    """The fraction of the part's informative pixels that moved as requested.

    A pixel is informative only if the colour at its destination, in the video before the edit, differs from
    its own by more than twice the tolerance; other pixels cannot tell a moved part from an unmoved one. So an
    edit that did nothing scores 0, and one that did exactly what was requested scores 1.

    Args:
        before, after: the video before and after the edit.
        requested: [T, H, W, 2], pixels (x, y) by which the part seen at each pixel of `before` should be
            displaced in `after` (`requested_displacement`); NaN where there is no part, and where it should
            no longer be visible.
        tolerance: largest difference of a channel, colours from 0 to 1. It allows for antialiased edges and
            for lighting that changes along the way.

    Raises:
        ValueError: the shapes do not agree.
    """
    _check_shapes(before, after=after, requested=requested[..., 0])
    hits, lengths = [], []
    for now, edited, displaced in zip(unit_frames(before), unit_frames(after), requested, strict=True):
        found, unmoved = warp(edited, displaced), warp(now, displaced)
        informative = np.abs(unmoved - now).max(-1) > 2 * tolerance  # False for NaN, outside the image
        hits.append((np.abs(found - now).max(-1) <= tolerance)[informative])
        lengths.append(np.linalg.norm(displaced[informative], axis=-1))
    far = np.concatenate(lengths)
    way = f" ({far.mean():.1f} pixels away on average)" if len(far) else ""
    return _finding(np.concatenate(hits), f"informative pixels moved as requested{way}")


def requested_displacement(
    depth: Float[np.ndarray, "H W"],
    depth_after: Float[np.ndarray, "H W"],
    part: Bool[np.ndarray, "H W"],
    motion: Float[np.ndarray, "4 4"],
    viewmat: Float[np.ndarray, "4 4"],
    K: Float[np.ndarray, "3 3"],
    *,
    max_depth_gap: float = 0.015,
) -> Float[np.ndarray, "H W 2"]:
    """Displacement (x, y), in pixels, of the visible part under a rigid motion. NaN off the part, where depth
    is unknown, and where a pixel ends outside the image or is occluded.

    Args:
        depth, depth_after: depth before and after the edit, metres, 0 where unknown.
        part: pixels that show the part before the edit.
        motion: rigid motion in the world, from the part's pose to the requested one.
        viewmat, K: the camera; world to camera.
        max_depth_gap: a point farther than this behind `depth_after` counts as occluded, metres. A point in
            front of it should be visible, and is scored.
    """
    camera = jnp.asarray(viewmat, float), jnp.asarray(K, float)
    pixels = np.asarray(pixel_grid(depth.shape[1], depth.shape[0]))
    points = np.asarray(unproject(jnp.asarray(pixels), jnp.asarray(depth, float), *camera))
    places, z = map(
        np.asarray, project(jnp.asarray(points @ motion[:3, :3].T + motion[:3, 3], float), *camera)
    )
    inside = part & (depth > 0) & (z > 0) & ((places >= 0) & (places < depth.shape[::-1])).all(-1)
    columns, rows = np.where(inside, places.transpose(2, 0, 1), 0).astype(int)
    there = depth_after[rows, columns]
    seen = inside & ~((there > 0) & (z - there > max_depth_gap))
    return np.where(seen[..., None], places - pixels, np.nan).astype(np.float64)


def place_is_clean(
    after: Num[np.ndarray, "..."],
    alphas: Float[np.ndarray, "..."],
    background: Num[np.ndarray, "..."],
    vacated: Bool[np.ndarray, "..."],
    *,
    tolerance: float = 0.1,
    least_alpha: float = 0.5,
) -> Finding:
    """The fraction of the pixels vacated by a part that show what is behind it, with no hole and no ghost.

    Args:
        after: the edited video.
        alphas: [T, H, W], opacity of the rendering. Below `least_alpha` a pixel is a hole.
        background: what should be visible there: the truth, or the scene rendered without the part. A pixel
            that differs by more than `tolerance` in a channel, and is not a hole, is a ghost.
        vacated: pixels that showed the part before, and should show none after.

    Raises:
        ValueError: the shapes do not agree.
    """
    _check_shapes(after, alphas=alphas, background=background, vacated=vacated)
    hole = alphas[vacated] < least_alpha
    ghost = _differ(after, background, tolerance)[vacated] & ~hole
    words = f"vacated pixels show what is behind ({hole.sum()} holes, {ghost.sum()} ghosts)"
    return _finding(~(hole | ghost), words)


def _finding(good: Bool[np.ndarray, "judged"], words: str) -> Finding:
    if len(good) == 0:
        return Finding(float("nan"), f"no pixel to judge whether {words}")
    return Finding(float(good.mean()), f"{good.sum():,} of {len(good):,} {words}")


def _differ(video: np.ndarray, other: np.ndarray, tolerance: float) -> Bool[np.ndarray, "T H W"]:
    """Pixels at which a channel differs by more than the tolerance, up to rounding; NaN always differs."""
    pairs = zip(unit_frames(video), unit_frames(other), strict=True)
    return np.stack([~(np.abs(a - b).max(-1) <= tolerance + 1e-9) for a, b in pairs])


def _check_shapes(video: np.ndarray, **others: np.ndarray) -> None:
    """Check that each has the shape of the video, or one value per pixel."""
    for name, other in others.items():
        wanted = video.shape if other.ndim == 4 else video.shape[:3]
        if other.shape != wanted:
            raise ValueError(f"{name}: expected shape {wanted}, found {other.shape}")
