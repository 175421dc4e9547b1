"""The canonical frame, and what differs from it: the difference image I_d (MotionSplicer, section 3.2)."""

import warnings
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float

Load = Callable[[int, int], np.ndarray]
"""(frame, camera) -> RGB picture, uint8."""
LoadDepth = Callable[[int, int], np.ndarray | None]
"""(frame, camera) -> depths, metres, 0 where unknown; None for a camera without depth."""

_WIDTH = 96  # pixels of the thumbnails by which frames are compared
_BLUR = 1.0  # pixels; suppresses camera noise and the aliasing of hard edges
_NOISE_FACTOR = 4.0  # differences above this many times the noise level are motion
_MOST_FRAMES = 16  # compared with the anchor at full size
_NEARER = 0.02  # share of its depth by which what comes before something is nearer
_AS_FAR = 0.01  # share of its depth by which the same surface may be nearer or farther
_SAME_PATTERN, _SAME_HUE = 0.15, 0.03  # differences of patterns, relative, and of shares of a colour
_WINDOW, _AROUND = 7, 5  # pixels over which brightness, and differences, are averaged
_DARK = 0.02  # brightness below which neither pattern nor hue is known
_LEAST_MOVED = 1e-3  # share of the pixels that must change for anything to have moved


class Anchor(NamedTuple):
    """The canonical frame.

    Attributes:
        frame: its index.
        farthest: the frame that differs most from it.
        differences: mean difference of each frame from it, 0 to 1, [T].
    """

    frame: int
    farthest: int
    differences: Float[np.ndarray, "T"]


def choose_anchor(load: Load, frames: int, cameras: int, anchor: int | None = None) -> Anchor:
    """Choose the frame with the largest mean I_d to all others.

    Warns with UserWarning if the given frame differs from the others by less than half as much as the best
    one does: its parts are then hard to distinguish from the static background.

    Args:
        load: loads a picture.
        frames, cameras: their numbers.
        anchor: the frame to use; default: the one that differs most.

    Raises:
        ValueError: there is only one frame, or `anchor` is not a frame.
    """
    if frames < 2:
        raise ValueError(f"frames: expected at least 2, between which something moves, found {frames}")
    check_anchor(anchor, frames)
    small = np.stack([[_thumbnail(load(t, c)) for c in range(cameras)] for t in range(frames)])
    flat = small.reshape(frames, -1, 3)
    apart = np.stack([np.linalg.norm(flat - one, axis=-1).mean(-1) for one in flat]) / np.sqrt(3)
    best = int(apart.mean(1).argmax())
    chosen = best if anchor is None else anchor
    if apart[chosen].mean() < 0.5 * apart[best].mean():
        warnings.warn(
            f"anchor: frame {chosen} differs from the others by {apart[chosen].mean():.3f} on average, frame "
            f"{best} by {apart[best].mean():.3f}; parts that hardly move from the anchor are found poorly",
            stacklevel=2,
        )
    return Anchor(chosen, int(apart[chosen].argmax()), apart[chosen])


def check_anchor(anchor: int | None, frames: int) -> None:
    """Raises ValueError for an anchor that is none of the frames."""
    if anchor is not None and not 0 <= anchor < frames:
        raise ValueError(f"anchor: expected a frame from 0 to {frames - 1}, found {anchor}")


def moved_pixels(
    load: Load,
    anchor: Anchor,
    cameras: int,
    *,
    frames: int | None = None,
    threshold: float = 0.06,
    depth: LoadDepth | None = None,
) -> Bool[np.ndarray, "C F H W"]:
    """The pixels of the anchor's pictures that change in each of F other frames: I_d exceeds a threshold, or
    four times the noise level if that is higher.

    Args:
        load: loads a picture.
        anchor: from `choose_anchor`.
        cameras: number of cameras.
        frames: number of other frames to compare, spread over the recording; default: 16. With 1, as in the
            paper, only the frame that differs most is compared, so objects that return to their places are
            missed.
        threshold: least difference of colours, which range from 0 to 1.
        depth: loads depths, if cameras measure them: where something nearer is seen, nothing has moved away,
            something has come before it; and where the same surface is lighter or darker, a shadow has moved.

    Raises:
        ValueError: nothing moves.
    """
    count = len(anchor.differences)
    spread = np.linspace(0, count - 1, min(count, frames or _MOST_FRAMES)).round().astype(int)
    others = {anchor.farthest} if frames == 1 else {*spread.tolist(), anchor.farthest} - {anchor.frame}
    beside = [t for t in (anchor.frame - 1, anchor.frame + 1) if 0 <= t < count]
    heres = [_blurred(load(anchor.frame, c)) for c in range(cameras)]
    # At least half of a picture is static between adjacent frames, so the median difference is noise.
    steps = [
        np.median(difference_image(_blurred(load(t, c)), heres[c])) for c in range(cameras) for t in beside
    ]
    limit, moved = max(threshold, _NOISE_FACTOR * float(np.median(steps))), []
    for c, here in enumerate(heres):
        nows = [_blurred(load(t, c)) for t in sorted(others)]
        changed = np.array([difference_image(now, here) > limit for now in nows])
        if depth is not None and (before := depth(anchor.frame, c)) is not None:
            deep = [depth(t, c) for t in sorted(others)]
            changed &= np.array([~_is_covered(before, after) for after in deep])
            both = zip(nows, deep, strict=True)
            changed &= np.array([~_is_lit_otherwise(here, now, before, after) for now, after in both])
        moved.append(changed)
    share = np.mean(np.any(moved, axis=1))
    if share < _LEAST_MOVED:
        raise ValueError(
            f"frames: expected something that moves, found {share:.3%} of the pixels of frame {anchor.frame} "
            f"changing by {limit:.2g} of the range or more; choose other frames or a lower threshold"
        )
    return np.array(moved)


def _is_covered(
    before: Float[np.ndarray, "H W"], now: Float[np.ndarray, "H W"] | None
) -> Bool[np.ndarray, "H W"]:
    """Where something nearer than before is seen; nowhere without depth."""
    return np.zeros(before.shape, bool) if now is None else (now > 0) & (now < (1 - _NEARER) * before)


def _is_lit_otherwise(
    here: Float[np.ndarray, "H W 3"],
    now: Float[np.ndarray, "H W 3"],
    before: Float[np.ndarray, "H W"],
    after: Float[np.ndarray, "H W"] | None,
) -> Bool[np.ndarray, "H W"]:
    """Where the same surface is seen in other light: as far away, of the same hue, and with the same pattern
    relative to the brightness around it; nowhere without depth."""
    if after is None:
        return np.zeros(before.shape, bool)
    same = (before > 0) & (after > 0) & (np.abs(after - before) < _AS_FAR * before)
    pattern, hue = (f(here) - f(now) for f in (_pattern, _hue))
    unlike = cv2.blur(np.abs(pattern).mean(-1), (_AROUND, _AROUND))
    return same & (unlike < _SAME_PATTERN) & (np.abs(hue).max(-1) < _SAME_HUE)


def _pattern(picture: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    """A picture relative to the mean around each pixel."""
    mean = cv2.blur(picture, (_WINDOW, _WINDOW))
    return cv2.blur(picture, (3, 3)) / np.maximum(mean, _DARK)


def _hue(picture: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    """The shares of red, green and blue."""
    mean = cv2.blur(picture, (_AROUND, _AROUND))
    return mean / np.maximum(mean.sum(-1, keepdims=True), 3 * _DARK)


def difference_image(
    a: Float[np.ndarray, "H W 3"], b: Float[np.ndarray, "H W 3"]
) -> Float[np.ndarray, "H W"]:
    """I_d = ||a - b|| over the channels, 0 to 1."""
    return np.linalg.norm(a - b, axis=-1) / np.sqrt(3)


def _thumbnail(picture: np.ndarray) -> Float[np.ndarray, "h w 3"]:
    height, width = picture.shape[:2]
    size = (_WIDTH, max(1, round(height * _WIDTH / width)))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255


def _blurred(picture: np.ndarray) -> Float[np.ndarray, "H W 3"]:
    return cv2.GaussianBlur(picture.astype(np.float32) / 255, (0, 0), _BLUR)
