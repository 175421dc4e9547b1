"""Masks of the moving parts in every view of the anchor frame, with labels that agree between views.

In each view a segmenter finds segments, and those that changed (I_d) are kept. Views are visited in an order
in which each is close to an earlier one; labels found so far are rendered into the next view, and a segment
that mostly shows one part takes its label. Labels thus propagate from view to view through the scene's own
geometry, where SAM2 uses its memory of pictures (MotionSplicer, section 3.2).
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from gsjax.methods.protocols import Segmenter

_LEAST_CHANGED = 0.3  # share of a segment's pixels that must have changed
_LEAST_KNOWN = 0.5  # share of a segment's pixels that must show one part for it to take its label


def moving_segments(
    segments: Int[np.ndarray, "H W"], moved: Bool[np.ndarray, "H W"], least: float = _LEAST_CHANGED
) -> Int[np.ndarray, "H W"]:
    """The segments in which at least the share `least` of the pixels changed; the others become 0.

    Segments are selected rather than pixels, because the interior of a uniform surface looks the same after
    it has moved.
    """
    count = segments.max() + 1
    sizes = np.bincount(segments.ravel(), minlength=count)
    shares = np.bincount(segments.ravel(), moved.ravel(), count) / np.maximum(sizes, 1)
    kept = (shares >= least) & (np.arange(count) > 0)
    return np.where(kept[segments], segments, 0)


def view_order(viewmats: Float[np.ndarray, "C 4 4"], first: int, focus: Float[np.ndarray, "3"]) -> list[int]:
    """Orders the views: next comes the one that is nearest to any before it, by the angle at `focus`.

    Args:
        viewmats: world to camera.
        first: the first view.
        focus: the point that the cameras look at, metres.
    """
    centers = -np.einsum("cji,cj->ci", viewmats[:, :3, :3], viewmats[:, :3, 3])
    directions = centers - focus
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    order, left = [first], set(range(len(viewmats))) - {first}
    while left:
        order.append(max(sorted(left), key=lambda c: (directions[c] @ directions[order].T).max()))
        left.remove(order[-1])
    return order


def propagate_masks(
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
    """Masks of all views: 0 is the static background, then labels from the largest part to the smallest.

    Args:
        pictures: RGB pictures of the anchor frame.
        depths: rendered from the canonical scene, metres, 0 where it is empty.
        Ks: intrinsics.
        moved: pixels that show something that moves.
        order: indices of the views, from `view_order`.
        segmenter: finds the segments of a picture.
        known: (view, previous view, its mask) -> labels of the view that earlier views imply, [H, W]; -1
            where unknown.
        most: largest number of labels in the result; those with the fewest pixels are dropped.
        room: largest number of labels before any are dropped.
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


def masks_from_labels(
    labels: Int[np.ndarray, "C H W"], moved: Bool[np.ndarray, "C H W"], most: int
) -> Int[np.ndarray, "C H W"]:
    """Masks from labels that agree between views: the labels of which enough pixels changed over all views,
    renumbered from the largest to the smallest.

    Args:
        labels: 0 and below is background.
        moved: pixels that show something that moves.
        most: largest number of labels; those with the fewest pixels are dropped.
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
