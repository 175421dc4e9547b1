"""Target features of pixels: masks with an embedding each (FD-3DGS, section 3.2), or dense feature maps. On
the host.
"""

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Shapes are in the docstrings: the functions check them, with clearer messages than annotations give.

UNKNOWN_ID = -1


class Teacher(NamedTuple):
    """Target features of the pixels of V views.

    Attributes:
        ids: row of the codebook of each pixel, [H,W] per view; -1 where unknown. Pixels with the same id show
            the same object; without a codebook, ids serve the contrastive loss alone.
        codebook: the distinct embeddings, [K, D]; None for a teacher of maps only.
        maps: feature maps of any resolution, [h,w,D] per view, stretched over the view; None without.
        filled: for a codebook of L levels, whose channels are concatenated: the levels on which a pixel has
            no mask and was given that of another level, [H,W,L] per view. None without levels.

    Embeddings and maps are scaled to a mean length of 1: cosines do not depend on their length, but the speed
    of training would.
    """

    ids: list[np.ndarray]
    codebook: Float[np.ndarray, "k d"] | None
    maps: list[np.ndarray] | None = None
    filled: list[np.ndarray] | None = None

    @property
    def dimension(self) -> int:
        """Number of channels of a feature, D."""
        if self.codebook is not None:
            return self.codebook.shape[1]
        assert self.maps is not None
        return self.maps[0].shape[-1]


def teacher_of_objects(
    masks: Sequence[np.ndarray],
    embeddings: Sequence[np.ndarray],
    filled: Sequence[np.ndarray] | None = None,
) -> Teacher:
    """A teacher of masks: each pixel has the embedding of the object whose mask contains it.

    Objects with equal embeddings are one object, within a view and across views.

    Args:
        masks: labels of each view, integers [H,W], 0 to n; negative where unknown.
        embeddings: embeddings of the labels 0 to n of each view, [n+1, D]; a row of zeros for an unknown
            label.
        filled: as in `Teacher`.

    Raises:
        ValueError: there is no view, a label has no embedding, dimensions differ, numbers are not finite, or
            no label of any view is known.
    """
    if len(masks) != len(embeddings):
        raise ValueError(f"embeddings: expected those of {len(masks)} views, found {len(embeddings)}")
    if not len(masks):
        raise ValueError("masks: expected those of at least one view, found none")
    dimension = np.shape(embeddings[0])[-1] if np.ndim(embeddings[0]) else 0
    for v, (mask, rows) in enumerate(zip(masks, embeddings, strict=True)):
        if np.ndim(mask) != 2 or not np.issubdtype(np.asarray(mask).dtype, np.integer):
            raise ValueError(f"masks of view {v}: expected integers [H,W], found {_kind(mask)}")
        if np.ndim(rows) != 2 or np.shape(rows)[1] != dimension or dimension < 1:
            raise ValueError(
                f"embeddings of view {v}: expected [labels, {dimension}] as of view 0, found {_kind(rows)}; "
                "features of all views must come from one encoder"
            )
        if not np.isfinite(rows).all():
            bad = sorted(set(np.nonzero(~np.isfinite(rows))[0].tolist()))
            raise ValueError(
                f"embeddings of view {v}: expected finite numbers, found NaN or infinity in rows {bad}"
            )
        if np.max(mask, initial=-1) >= len(rows):
            raise ValueError(
                f"embeddings of view {v}: expected a row for each of the labels 0 to {np.max(mask)}, found "
                f"{len(rows)} rows"
            )
    codebook, place = np.unique(np.concatenate(embeddings).astype(np.float32), axis=0, return_inverse=True)
    known = np.abs(codebook).max(axis=1, initial=0) > 0
    rows = np.where(known, np.cumsum(known) - 1, UNKNOWN_ID)[place.reshape(-1)]
    starts = np.cumsum([0, *(len(e) for e in embeddings)])
    ids = [
        np.append(rows, UNKNOWN_ID)[np.where(mask >= 0, start + mask, len(rows))].astype(np.int32)
        for mask, start in zip(masks, starts[:-1], strict=True)
    ]
    _warn_of_empty_views(ids)
    book = codebook[known] / _mean_length([codebook[known]])
    return Teacher(ids, book, None, None if filled is None else list(filled))


def teacher_of_maps(
    maps: Sequence[np.ndarray],
    sizes: Sequence[tuple[int, int]],
    ids: Sequence[np.ndarray] | None = None,
) -> Teacher:
    """A teacher of dense feature maps.

    Args:
        maps: feature map of each view, [h,w,D], of any resolution.
        sizes: (height, width) of each view.
        ids: object of each pixel, [H,W] per view (default: no contrastive loss).

    Raises:
        ValueError: dimensions differ, numbers are not finite, or the aspect ratio of a map is not that of its
            view.
    """
    if len(maps) != len(sizes) or not len(maps):
        raise ValueError(f"maps: expected those of {len(sizes)} views, found {len(maps)}")
    dimension = np.shape(maps[0])[-1]
    for v, (one, (height, width)) in enumerate(zip(maps, sizes, strict=True)):
        if np.ndim(one) != 3 or np.shape(one)[-1] != dimension:
            raise ValueError(f"maps of view {v}: expected [h, w, {dimension}], found {_kind(one)}")
        if not np.isfinite(one).all():
            raise ValueError(f"maps of view {v}: expected finite numbers, found NaN or infinity")
        stretch = (one.shape[1] / one.shape[0]) / (width / height)
        # A grid of square patches may omit up to one of them at the end of each axis.
        if abs(np.log(stretch)) > np.log(1 + 1.5 / min(one.shape[:2])):
            raise ValueError(
                f"maps of view {v}: expected the aspect ratio of its view, {width}x{height}, found "
                f"{one.shape[1]}x{one.shape[0]}"
            )
    if ids is None:
        ids = [np.full(size, UNKNOWN_ID, np.int32) for size in sizes]
    length = _mean_length(maps)
    scaled = [(np.asarray(one, np.float32) / length).astype(np.float32) for one in maps]
    return Teacher([np.asarray(one, np.int32) for one in ids], None, scaled)


def with_maps(objects: Teacher, dense: Teacher) -> Teacher:
    """A teacher with masks and maps.

    The maps also cover pixels outside of the masks. Their weight relative to the masks is
    `DistillWeightsConfig.map`.

    Args:
        objects: a teacher of masks.
        dense: a teacher of maps, of the same views, by the same encoder.

    Raises:
        ValueError: views or dimensions differ, or a teacher is of the wrong kind.
    """
    if objects.codebook is None or dense.maps is None:
        raise ValueError("teachers: expected one with masks and one with maps, found other kinds")
    if len(objects.ids) != len(dense.maps):
        raise ValueError(f"dense: expected maps of {len(objects.ids)} views, found {len(dense.maps)}")
    if objects.dimension != dense.dimension:
        raise ValueError(
            f"dense: expected features of dimension {objects.dimension} as the objects have, found "
            f"{dense.dimension}; both must come from the same encoder"
        )
    return objects._replace(maps=dense.maps)


def view_codebook(teacher: Teacher, v: int, rows: int) -> tuple[np.ndarray, np.ndarray | None]:
    """The ids [H,W] of a view as rows of its own codebook, and this codebook, [rows, D], padded with zeros;
    for a teacher of maps only, its ids unchanged, and None.

    Args:
        teacher: teacher of all views.
        v: index of the view.
        rows: number of rows to pad to.
    """
    ids = np.asarray(teacher.ids[v], np.int32)
    if teacher.codebook is None:
        return ids, None
    there, place = np.unique(ids, return_inverse=True)
    unknown = int(there[0] < 0) if len(there) else 0
    book = np.zeros((rows, teacher.dimension), np.float32)
    book[: len(there) - unknown] = teacher.codebook[there[unknown:]]
    return (place.reshape(ids.shape) - unknown).astype(np.int32), book


def max_rows(teacher: Teacher) -> int:
    """The largest number of rows of the codebook in any view, at least 1."""
    return max(1, *(len(np.unique(ids[ids >= 0])) for ids in teacher.ids))


def _mean_length(features: Sequence[np.ndarray]) -> np.float32:
    """Mean length of all features; 1 where all are zeros."""
    lengths = [np.linalg.norm(np.asarray(one, np.float64), axis=-1).ravel() for one in features]
    return np.float32(np.concatenate(lengths).mean() or 1.0)


def _warn_of_empty_views(ids: list[np.ndarray]) -> None:
    empty = [v for v, one in enumerate(ids) if not (one >= 0).any()]
    if len(empty) == len(ids):
        raise ValueError("masks: expected some in at least one view, found none that has an embedding")
    if empty:
        some = ", ".join(map(str, empty[:8])) + (", ..." if len(empty) > 8 else "")
        warnings.warn(f"views without any mask are not used: {some} of {len(ids)}", stacklevel=3)


def _kind(array) -> str:
    return f"{np.asarray(array).dtype} {list(np.shape(array))}"
