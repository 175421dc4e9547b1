"""A scripted judge of edited videos: did the rest stay, did the part go where it was asked to, is its old
place clean?

It looks at pixels alone, and at what the edit was told to do. It is no GPT-EE, which is GPT-4o's opinion
(MotionSplicer, section 4.1), and no figure of it bears that name. Each finding has a reason in words.

Videos are [T, H, W, 3], RGB, uint8 or floats 0 to 1; regions [T, H, W]. On the host.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Num

from gsjax.geometry.cameras import pixel_grid, project, unproject
from gsjax.geometry.flow import warp
from gsjax.metrics.temporal import unit_frames


class Finding(NamedTuple):
    """What the judge says of one side of an edit.

    Attributes:
        score: 0 to 1, the more the better; NaN where there was nothing to judge.
        reason: why, in words.
    """

    score: float
    reason: str


def rest_stays(
    before: Num[np.ndarray, "..."],
    after: Num[np.ndarray, "..."],
    touched: Bool[np.ndarray, "..."],
    tolerance: float = 1 / 255,
) -> Finding:
    """The share of the pixels outside `touched` that are as they were.

    Args:
        before, after: the video, and the edited one.
        touched: what may change: pixels that show an edited part before or after, its shadow if it has one.
        tolerance: largest difference of a channel, colours from 0 to 1.

    Raises:
        ValueError: the shapes do not agree.
    """
    _check_shapes(before, after=after, touched=touched)
    changed = _differ(before, after, tolerance)[~touched]
    return _finding(~changed, "pixels beside the edit are as they were")


def asked_motion_is_seen(
    before: Num[np.ndarray, "..."],
    after: Num[np.ndarray, "..."],
    asked: Float[np.ndarray, "..."],
    tolerance: float = 0.1,
) -> Finding:
    """The share of the part's pixels that are found again where they were asked to go.

    A pixel tells only if the video before the edit has another colour where it should go, by more than twice
    the tolerance: by the others, a part that was moved looks like one that was not. So the score is 0 for an
    edit that did nothing, and 1 for one that did what was asked.

    Args:
        before, after: the video, and the edited one.
        asked: [T, H, W, 2], pixels (x, y) by which the part seen at each pixel of `before` is to be displaced
            in `after` (`asked_displacement`); NaN where no part is, and where it is not to be seen any more.
        tolerance: largest difference of a channel, colours from 0 to 1. Edges that are drawn between pixels
            and light that changes on the way need some.

    Raises:
        ValueError: the shapes do not agree.
    """
    _check_shapes(before, after=after, asked=asked[..., 0])
    hits, lengths = [], []
    for now, edited, displaced in zip(unit_frames(before), unit_frames(after), asked, strict=True):
        found, unmoved = warp(edited, displaced), warp(now, displaced)
        telling = np.abs(unmoved - now).max(-1) > 2 * tolerance  # NaN, outside the picture, is not
        hits.append((np.abs(found - now).max(-1) <= tolerance)[telling])
        lengths.append(np.linalg.norm(displaced[telling], axis=-1))
    far = np.concatenate(lengths)
    way = f" ({far.mean():.1f} pixels away on average)" if len(far) else ""
    return _finding(np.concatenate(hits), f"pixels that tell are where they were asked to go{way}")


def asked_displacement(
    depth: Float[np.ndarray, "H W"],
    depth_after: Float[np.ndarray, "H W"],
    part: Bool[np.ndarray, "H W"],
    motion: Float[np.ndarray, "4 4"],
    viewmat: Float[np.ndarray, "4 4"],
    K: Float[np.ndarray, "3 3"],
    *,
    max_depth_gap: float = 0.015,
) -> Float[np.ndarray, "H W 2"]:
    """Pixels (x, y) by which a rigid motion displaces what a camera sees of a part; NaN elsewhere, where
    depth is unknown, and where it ends outside the picture or behind something.

    Args:
        depth, depth_after: before and after the edit, metres, 0 where unknown.
        part: where the part is seen before.
        motion: of the world, from where the part is to where it is asked to be.
        viewmat, K: the camera; world to camera.
        max_depth_gap: what ends further behind `depth_after` than this is hidden, metres. In front of it, it
            should be seen: there nothing excuses that it is not.
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
    """The share of the pixels that a part has left which show what is behind it: no hole, and no ghost.

    Args:
        after: the edited video.
        alphas: [T, H, W], how opaque it was drawn. Below `least_alpha` there is a hole.
        background: what should be there: the truth, or the scene drawn without the part. What differs by more
            than `tolerance` in a channel, and is no hole, is a ghost.
        vacated: where the part was before, and where none is to be after.

    Raises:
        ValueError: the shapes do not agree.
    """
    _check_shapes(after, alphas=alphas, background=background, vacated=vacated)
    hole = alphas[vacated] < least_alpha
    ghost = _differ(after, background, tolerance)[vacated] & ~hole
    words = f"vacated pixels show what is behind ({hole.sum()} holes, {ghost.sum()} ghosts)"
    return _finding(~(hole | ghost), words)


def worst(findings: Mapping[str, Finding]) -> Finding:
    """An edit is as good as the worst that is found of it; what was not judged is left out."""
    judged = {name: finding for name, finding in findings.items() if not np.isnan(finding.score)}
    if not judged:
        return Finding(float("nan"), "nothing was judged")
    name = min(judged, key=lambda name: judged[name].score)
    return Finding(judged[name].score, f"{name}: {judged[name].reason}")


def _finding(good: Bool[np.ndarray, "judged"], words: str) -> Finding:
    if len(good) == 0:
        return Finding(float("nan"), f"no pixel to judge whether {words}")
    return Finding(float(good.mean()), f"{good.sum():,} of {len(good):,} {words}")


def _differ(video: np.ndarray, other: np.ndarray, tolerance: float) -> Bool[np.ndarray, "T H W"]:
    """Pixels of which some channel differs by more, rounding apart; NaN differs."""
    pairs = zip(unit_frames(video), unit_frames(other), strict=True)
    return np.stack([~(np.abs(a - b).max(-1) <= tolerance + 1e-9) for a, b in pairs])


def _check_shapes(video: np.ndarray, **others: np.ndarray) -> None:
    """Each is a video of that shape too, or has a number for each of its pixels."""
    for name, other in others.items():
        wanted = video.shape if other.ndim == 4 else video.shape[:3]
        if other.shape != wanted:
            raise ValueError(f"{name}: expected shape {wanted}, found {other.shape}")
