"""The canonical frame, and the pixels that differ from it by the difference image I_d (MotionSplicer,
section 3.2)."""

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
_NEARER = 0.02  # by which an occluder is nearer, at least, relative to the depth behind it
_AS_FAR = 0.01  # by which the depth of the same surface may differ, relative to it
_LEAST_CONTRAST = 0.01  # least contrast of a pattern, relative to the brightness around it
_SAME_PATTERN, _OF_CONTRAST = 0.03, 0.7  # by which a pattern may differ: always, and per its contrast
_SAME_HUE = 0.03  # by which the shares of red, green and blue may differ
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
        frames, cameras: number of frames, and of cameras.
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
    """Raises ValueError for an anchor that is not one of the frames."""
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
        depth: loads depths, if cameras measure them: where something nearer is seen, it occludes what is
            there, which has not moved; where the same surface is lighter or darker, only the light changed.

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
    deep: LoadDepth = depth or (lambda t, c: None)
    limit, moved = max(threshold, _NOISE_FACTOR * float(np.median(steps))), []
    for c, here in enumerate(heres):
        before = deep(anchor.frame, c)
        surface = None if before is None else _Surface.of(here, before)
        changed = []
        for t in sorted(others):
            now = _blurred(load(t, c))
            different = difference_image(now, here) > limit
            if surface is not None and (after := deep(t, c)) is not None:
                different &= ~_is_covered(surface.depth, after)
                different &= ~_is_relit(surface, _Surface.of(now, after))
            changed.append(different)
        moved.append(np.array(changed))
    share = np.mean(np.any(moved, axis=1))
    if share < _LEAST_MOVED:
        raise ValueError(
            f"frames: expected something that moves, found {share:.3%} of the pixels of frame {anchor.frame} "
            f"changing by {limit:.2g} of the range or more; choose other frames or a lower threshold"
        )
    return np.array(moved)


class _Surface(NamedTuple):
    """What a camera sees, irrespective of the lighting.

    Attributes:
        depth: metres, 0 where unknown.
        pattern: colours relative to the brightness around each pixel.
        hue: the shares of red, green and blue.
        contrast: how strong the pattern around each pixel is.
    """

    depth: Float[np.ndarray, "H W"]
    pattern: Float[np.ndarray, "H W 3"]
    hue: Float[np.ndarray, "H W 3"]
    contrast: Float[np.ndarray, "H W"]

    @classmethod
    def of(cls, picture: Float[np.ndarray, "H W 3"], depth: Float[np.ndarray, "H W"]) -> "_Surface":
        """The surface that a picture and its depth show."""
        level = cv2.blur(picture, (_WINDOW, _WINDOW)).mean(-1, keepdims=True)
        pattern = cv2.blur(picture, (3, 3)) / np.maximum(level, _DARK)
        mean = cv2.blur(picture, (_AROUND, _AROUND))
        hue = mean / np.maximum(mean.sum(-1, keepdims=True), 3 * _DARK)
        gray = pattern.mean(-1)
        contrast = cv2.blur(np.abs(gray - cv2.blur(gray, (_WINDOW, _WINDOW))), (_WINDOW, _WINDOW))
        return cls(depth, pattern, hue, contrast)


def _is_covered(before: Float[np.ndarray, "H W"], now: Float[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Where something nearer than before is seen."""
    return (now > 0) & (now < (1 - _NEARER) * before)


def _is_relit(here: _Surface, now: _Surface) -> Bool[np.ndarray, "H W"]:
    """Where the same surface is seen in other light: as far away, of the same hue, and with the same pattern.
    Surfaces without a pattern are left out, because two of them cannot be told apart."""
    same = (here.depth > 0) & (now.depth > 0) & (np.abs(now.depth - here.depth) < _AS_FAR * here.depth)
    unlike = cv2.blur(np.abs(here.pattern - now.pattern).mean(-1), (_AROUND, _AROUND))
    contrast = np.minimum(here.contrast, now.contrast)
    alike = (contrast > _LEAST_CONTRAST) & (unlike < _SAME_PATTERN + _OF_CONTRAST * contrast)
    return same & alike & (np.abs(here.hue - now.hue).max(-1) < _SAME_HUE)


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
