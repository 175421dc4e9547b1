"""Masks of what moves in every view of the anchor frame, by the same numbers in all of them.

In each view a segmenter finds what belongs together, and of its segments those that changed count (I_d).
Views are taken in an order in which neighbours look from near; what earlier ones found is drawn into the
next, and a segment that shows mostly one part takes its number. So numbers pass from view to view over the
scene's own geometry, where SAM2 passes them over its memory of pictures (MotionSplicer, section 3.2).
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from gsjax.methods.protocols import Segmenter

_LEAST_CHANGED = 0.3  # share of a segment's pixels that must have changed
_LEAST_KNOWN = 0.5  # share of its pixels that must show one part for it to be that part


def moving_segments(
    segments: Int[np.ndarray, "H W"], moved: Bool[np.ndarray, "H W"], least: float = _LEAST_CHANGED
) -> Int[np.ndarray, "H W"]:
    """The segments of which at least such a share of pixels changed; the others become 0.

    By segments rather than by pixels, because the inside of a plain surface looks the same after it moved.
    """
    count = segments.max() + 1
    sizes = np.bincount(segments.ravel(), minlength=count)
    shares = np.bincount(segments.ravel(), moved.ravel(), count) / np.maximum(sizes, 1)
    kept = (shares >= least) & (np.arange(count) > 0)
    return np.where(kept[segments], segments, 0)


def order_of_views(
    viewmats: Float[np.ndarray, "C 4 4"], first: int, focus: Float[np.ndarray, "3"]
) -> list[int]:
    """Views in an order in which each looks from nearest to those before it, by the angle at `focus`.

    Args:
        viewmats: world to camera.
        first: where to begin.
        focus: what they look at, metres.
    """
    centers = -np.einsum("cji,cj->ci", viewmats[:, :3, :3], viewmats[:, :3, 3])
    ways = centers - focus
    ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-12)
    order, left = [first], set(range(len(viewmats))) - {first}
    while left:
        order.append(max(sorted(left), key=lambda c: (ways[c] @ ways[order].T).max()))
        left.remove(order[-1])
    return order


def propagated_masks(
    pictures: Sequence[np.ndarray],
    depths: Float[np.ndarray, "C H W"],
    Ks: Float[np.ndarray, "C 3 3"],
    moved: Bool[np.ndarray, "C H W"],
    order: Sequence[int],
    segmenter: Segmenter,
    known: Callable[[int, int, np.ndarray], np.ndarray],
    most: int,
    room: int,
) -> Int[np.ndarray, "C H W"]:
    """Masks of all views: 0 what stands still, then numbers from the largest part to the smallest.

    Args:
        pictures: of the anchor frame, RGB.
        depths: as the canonical scene draws them, metres, 0 where nothing is.
        Ks: intrinsics.
        moved: from `moved_pixels`.
        order: of views, from `order_of_views`.
        segmenter: what belongs together.
        known: (view, the view before it, its mask) -> mask of the view as far as earlier ones tell, [H, W];
            -1 where they do not.
        most: how many numbers there may be in the end; those of fewest pixels are dropped.
        room: how many there may be before that.
    """
    masks: dict[int, np.ndarray] = {}
    count, last = 0, None
    for c in order:
        segments = moving_segments(segmenter(pictures[c], depths[c], Ks[c]), moved[c])
        labels = np.full(segments.shape, -1) if last is None else known(c, last, masks[last])
        mask = np.zeros(segments.shape, np.int32)
        for segment in np.unique(segments[segments > 0]):
            inside = segments == segment
            seen = labels[inside]
            names, pixels = np.unique(seen[seen > 0], return_counts=True)
            if len(names) and pixels.max() >= _LEAST_KNOWN * len(seen):
                mask[inside] = names[pixels.argmax()]
            elif count < room:
                count += 1
                mask[inside] = count
        masks[c], last = mask, c
    return _by_size(np.stack([masks[c] for c in range(len(pictures))]), most)


def masks_of_labels(
    labels: Int[np.ndarray, "C H W"], moved: Bool[np.ndarray, "C H W"], most: int
) -> Int[np.ndarray, "C H W"]:
    """Masks from labels that mean the same in all views: those of which enough changed, over all views, by
    numbers from the largest to the smallest.

    Args:
        labels: 0 and below is nothing.
        moved: from `moved_pixels`.
        most: how many numbers there may be; those of fewest pixels are dropped.
    """
    flat = np.maximum(labels, 0).reshape(-1, labels.shape[-1])
    return _by_size(moving_segments(flat, moved.reshape(flat.shape)).reshape(labels.shape), most)


def _by_size(masks: Int[np.ndarray, "C H W"], most: int) -> Int[np.ndarray, "C H W"]:
    sizes = np.bincount(masks.ravel())
    sizes[0] = 0
    kept = np.argsort(-sizes, kind="stable")[: min(most, np.count_nonzero(sizes))]
    renamed = np.zeros(len(sizes), np.int32)
    renamed[kept] = np.arange(1, len(kept) + 1)
    return renamed[masks]
