"""Teachers of a deforming scene's features: classes of masks, or features of files or of an encoder, brought
into the scene's few channels."""

from collections import Counter
from collections.abc import Sequence as Many
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from rich.console import Console
from scipy.cluster.hierarchy import fcluster, ward

from gsjax.data import Photographs, Sequence
from gsjax.data.photographs import photographs_of
from gsjax.engine.distill.cache import FeatureCache, content_digest
from gsjax.engine.distill.choice import TeacherChoice
from gsjax.engine.distill.source import Source
from gsjax.engine.distill.teacher import Teaching
from gsjax.engine.messages import Notes, describe
from gsjax.methods.deform import Meaning, counted_ids
from gsjax.methods.distill import Teacher
from gsjax.perception.codebook import ClassCodebook
from gsjax.scene.frame import Frame

GROUPS = 8
"""The most kinds into which features without names are split."""
_SAMPLE = 2000  # of the vectors that are split into kinds, for all pairs are compared
_ALIKE = 0.98  # cosine of directions that are of one kind


class Labels(NamedTuple):
    """A teacher's labels of a frame.

    Attributes:
        ids: row of the codes of each of the teacher's pixels, -1 for none; a grid of any size.
        codes: in the scene's channels.
    """

    ids: Int[np.ndarray, "h w"]
    codes: Float[np.ndarray, "n channels"]


class ClassTeacher:
    """A code for each class of the masks: a stand-in for a model, which knows the labels' names."""

    def __init__(self, sequence: Sequence, names: dict[int, str], channels: int):
        """
        Args:
            sequence: the recording.
            names: of mask values.
            channels: of a Gaussian's feature.

        Raises:
            ValueError: there are more classes than channels.
        """
        if len(names) > channels:
            raise ValueError(
                f"--deform.channels {channels}: expected at least {len(names)}, one for each class; give more"
            )
        self._sequence, self._values = sequence, tuple(names)
        source = Source("classes", {value + 1: name for value, name in names.items()})
        encoder = ClassCodebook(source.names)
        codes = np.stack([encoder.embed_text(name) for name in names.values()])
        basis, _ = basis_of([codes], channels)
        self.meaning = Meaning(source, tuple(names.values()), codes @ basis, basis)

    def labels(self, t: int) -> Labels:
        """Labels of frame t, by its mask; -1 everywhere where it has none."""
        return self.of_mask(self._sequence.mask(t, 0))

    def of_mask(self, mask: Int[np.ndarray, "h w"] | None) -> Labels:
        """Labels by a mask that was read."""
        ids = np.full((self._sequence.height, self._sequence.width), -1, np.int32)
        if mask is not None:
            for row, value in enumerate(self._values):
                ids[mask == value] = row
        return Labels(ids, self.meaning.codebook)

    def digest(self) -> str:
        """Digest of what is taught beside the frames' ids, in hexadecimal."""
        return content_digest(f"classes {self.meaning.names}", {})


class EncodedTeacher:
    """Features of files, or of an encoder, brought into the scene's channels."""

    def __init__(self, teaching: Teaching, frames: Many[Frame], channels: int):
        """
        Args:
            teaching: has frames segmented and encoded, or their features read.
            frames: those that teach, of one camera each.
            channels: of a Gaussian's feature.

        Raises:
            ValueError: grids differ, or no pixel that counts has features.
        """
        self._teaching, teacher = teaching, teaching.teacher
        self.ids = _ids(teacher)
        weights = _counts(teacher, self.ids, frames)
        blocks = _vectors(teacher)
        counted = np.split(weights > 0, np.cumsum([len(block) for block in blocks])[:-1])
        vectors = [block[some] for block, some in zip(blocks, counted, strict=True)]
        basis, self.kept = basis_of(vectors, channels)
        self.codes = _codes(teacher, basis)
        groups = groups_of(self.codes[weights > 0], weights[weights > 0])
        names = tuple(f"group {n}" for n in range(1, len(groups) + 1))
        self.meaning = Meaning(teaching.source, names, groups, basis)

    def labels(self, t: int) -> Labels | None:
        """Labels of frame t, whether it teaches or not; None where there are none.

        Raises:
            ValueError, OSError: it cannot be read, or its file does not fit.
        """
        teacher = self._teaching.of(t)
        if teacher is None:
            return None
        (ids,) = _ids(teacher)
        return Labels(ids, _codes(teacher, self.meaning.basis))

    def digest(self) -> str:
        """Digest of what is taught, in hexadecimal."""
        return self._teaching.digest()

    def note(self) -> str:
        """The note that a run has of it."""
        (dimension, channels), count = self.meaning.basis.shape, len(self.meaning.names)
        parted = f"they are parted into {count} groups"
        if count == 1:
            parted = "all of it is alike, one group"
            parted += " (--masks segment finds more pieces)" if self.meaning.source.kind == "closed" else ""
        return (
            f"Learned beside colours: {self._teaching.about}; {channels} channels keep {self.kept:.1%} of "
            f"its {dimension} numbers (--deform.channels); {parted}."
        )


def teaching_of(sequence: Sequence, train: Many[int], asked: TeacherChoice, console: Console) -> Teaching:
    """Have frames of camera 0 segmented and encoded, or their features read.

    Args:
        sequence: the recording.
        train: frames to learn from.
        asked: whose masks and features; checked, not of classes.
        console: shows how far it is.

    Raises:
        ValueError: there are no masks, files do not fit, or a package is missing.
        FileNotFoundError: files of features or weights are not there.
    """
    return Teaching(_as_photographs(sequence), train, asked, FeatureCache(), console)


def labels_of(
    teacher: ClassTeacher | EncodedTeacher, frames: Many[int], sequence: Sequence, notes: Notes
) -> dict[int, Labels]:
    """Labels of frames that are only judged; those that cannot be read are noted and left out.

    Args:
        teacher: of the frames that are learned from.
        frames: indices of the others.
        sequence: the recording.
        notes: receives what could not be read.
    """
    found: dict[int, Labels] = {}
    failed: dict[int, str] = {}
    for t in frames:
        try:
            if (labels := teacher.labels(t)) is not None:
                found[t] = labels
        except FileNotFoundError:
            failed[int(sequence.frame_ids[t])] = "they have no file"
        except (ValueError, OSError) as error:
            failed[int(sequence.frame_ids[t])] = describe(error)
    if failed:
        which = ", ".join(map(str, failed))
        notes.warn(f"not compared with the teacher: frames {which} ({next(iter(failed.values()))})")
    return found


def basis_of(
    vectors: Many[Float[np.ndarray, "_ D"]], channels: int
) -> tuple[Float[np.ndarray, "D channels"], float]:
    """The orthonormal columns that keep most of some vectors, their lengths and angles, and which share of
    their squares that is; zeros fill it up where there are fewer than `channels`."""
    products = sum(np.asarray(some, np.float64).T @ np.asarray(some, np.float64) for some in vectors)
    squares, axes = np.linalg.eigh(products)
    squares, axes = np.maximum(squares[::-1], 0), axes[:, ::-1]
    held = min(channels, int((squares > 1e-12 * squares[0]).sum()))
    basis = np.zeros((len(axes), channels))
    basis[:, :held] = axes[:, :held]
    return basis, float(squares[:held].sum() / max(squares.sum(), 1e-30))


def groups_of(
    codes: Float[np.ndarray, "n channels"], weights: Float[np.ndarray, "n"], most: int = GROUPS
) -> Float[np.ndarray, "k channels"]:
    """Means of codes that point the same way, the heaviest group first.

    Ward's method joins directions; it stops where to join two more costs most beside what it cost before, and
    goes on while two groups are alike.

    Args:
        codes: not all zeros.
        weights: of each code, the number of its pixels.
        most: number of groups, at most.
    """
    chosen = np.unique(np.linspace(0, len(codes) - 1, _SAMPLE).astype(int))
    codes, weights = codes[chosen], weights[chosen]
    lengths = np.linalg.norm(codes, axis=1)
    codes, weights, lengths = (one[lengths > 0] for one in (codes, weights, lengths))
    directions = codes / lengths[:, None]
    group = np.ones(len(codes), int)
    if len(codes) > 1:
        tree = ward(directions)
        alike = np.sqrt(2 - 2 * _ALIKE)  # what it costs to join two directions of one kind
        costs = np.maximum(np.append(tree[: -most - 1 : -1, 2][: most - 1], alike), alike)  # the last first
        count = 2 + int(np.argmax(costs[:-1] / costs[1:])) if len(costs) > 1 else 1
        group = fcluster(tree, count, "maxclust")
        while count > 1 and _closest(_means(directions, weights, group)) > _ALIKE:
            count -= 1
            group = fcluster(tree, count, "maxclust")
    heavy = [weights[group == kind].sum() for kind in np.unique(group)]
    return _means(codes, weights, group)[np.argsort(-np.array(heavy), kind="stable")]


def _means(
    vectors: Float[np.ndarray, "n c"], weights: Float[np.ndarray, "n"], group: Int[np.ndarray, "n"]
) -> Float[np.ndarray, "k c"]:
    kinds = [group == kind for kind in np.unique(group)]
    return np.stack([np.average(vectors[some], axis=0, weights=weights[some]) for some in kinds])


def _closest(vectors: Float[np.ndarray, "k c"]) -> float:
    """The largest cosine of two of some vectors."""
    directions = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    return float((directions @ directions.T - 2 * np.eye(len(vectors))).max())


def _as_photographs(sequence: Sequence) -> Photographs:
    """The frames of camera 0, named as their pictures' files are, or by their number where they have none.
    Without depth: what a segmenter would find by it are planes, which do not deform."""
    alone = photographs_of(sequence.select(cameras=[sequence.camera_ids[0]]))
    files = [Path(alone.where("image", i)) for i in range(alone.num)]
    names = [file.name for file in files if file.is_file()]
    if len(set(names)) < alone.num:
        names = [f"{number:06d}" for number in sequence.frame_ids]
    return replace(alone, names=tuple(names), load_depth=None)


def _counts(
    teacher: Teacher, ids: Many[Int[np.ndarray, "h w"]], frames: Many[Frame]
) -> Float[np.ndarray, "n"]:
    """The number of pixels that count which have each vector.

    Raises:
        ValueError: grids differ, or no pixel has any.
    """
    grids = Counter(one.shape for one in ids)
    if len(grids) > 1:
        found = ", ".join(f"{width}x{height} ({n})" for (height, width), n in grids.most_common())
        raise ValueError(f"--features: expected one grid in all frames, found (frames) {found}")
    counts = np.zeros(1 + sum(map(len, _vectors(teacher))))
    for frame, one in zip(frames, ids, strict=True):
        counted = counted_ids(one, None if frame.masks is None else frame.masks[0])
        counts += np.bincount(1 + counted.ravel(), minlength=len(counts))
    if not counts[1:].any():
        silent = all((one < 0).all() for one in ids)
        found = "zeros alone" if silent else "none; do masks hide all?"
        raise ValueError(f"--features: expected some of pixels that count, found {found}")
    return counts[1:]


def _vectors(teacher: Teacher) -> list[Float[np.ndarray, "_ D"]]:
    """Its vectors: rows of its codebook, or a block of them for each map, whose pixels have one each."""
    if teacher.codebook is not None:
        return [teacher.codebook]
    assert teacher.maps is not None
    return [one.reshape(-1, one.shape[2]) for one in teacher.maps]


def _codes(teacher: Teacher, basis: Float[np.ndarray, "D channels"]) -> Float[np.ndarray, "n channels"]:
    """All of that, in the scene's channels."""
    return np.concatenate([block @ basis for block in _vectors(teacher)])


def _ids(teacher: Teacher) -> list[Int[np.ndarray, "h w"]]:
    """The row of these of each pixel of each view; -1 where there is none, as where a map is zero."""
    if teacher.maps is None:
        return teacher.ids
    ids, begin = [], 0
    for one in teacher.maps:
        places = begin + np.arange(one.shape[0] * one.shape[1], dtype=np.int32).reshape(one.shape[:2])
        ids.append(np.where(np.any(one, axis=2), places, -1))
        begin += places.size
    return ids
