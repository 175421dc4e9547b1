"""Who says what there is in frames of a deforming scene: classes of masks, or features of files or of an
encoder, brought into the scene's few channels."""

from collections.abc import Sequence as Many
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from rich.console import Console
from scipy.cluster.hierarchy import fcluster, ward

from gsjax.cli.feature_cache import FeatureCache
from gsjax.cli.field_source import Source
from gsjax.cli.field_teacher import Asked, Teaching
from gsjax.cli.messages import Notes, describe
from gsjax.data import Photographs, Sequence
from gsjax.data.photographs import photographs_of
from gsjax.methods.feature_field import Teacher
from gsjax.methods.surgical import Look, counted_ids
from gsjax.perception.codebook import ClassCodebook

GROUPS = 8
"""Into how many kinds, at most, features without names are parted."""
_SAMPLE = 2000  # of the vectors that are parted, for all pairs are compared


@dataclass(frozen=True, eq=False)
class Meaning:
    """What features say, apart from any frame.

    Attributes:
        source: who made what they learn.
        names: of what they tell apart: classes, or groups of features that are alike.
        codebook: the feature of each.
        basis: orthonormal columns that bring the source's vectors of D numbers into the scene's channels.
            Fixed, for two that learn agree best where both are 0 (METHODS.md).
    """

    source: Source
    names: tuple[str, ...]
    codebook: Float[np.ndarray, "k channels"]
    basis: Float[np.ndarray, "D channels"]


class Said(NamedTuple):
    """Of a frame.

    Attributes:
        ids: which of the codes each of the teacher's pixels has, -1 for none; a grid of any size.
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
        basis, _ = basis_of(codes, channels)
        self.meaning = Meaning(source, tuple(names.values()), codes @ basis, basis)

    def said(self, t: int) -> Said:
        """By the mask of frame t; nothing of any pixel where there is none."""
        return self.of_mask(self._sequence.mask(t, 0))

    def of_mask(self, mask: Int[np.ndarray, "h w"] | None) -> Said:
        """By a mask that was read."""
        ids = np.full((self._sequence.height, self._sequence.width), -1, np.int32)
        if mask is not None:
            for row, value in enumerate(self._values):
                ids[mask == value] = row
        return Said(ids, self.meaning.codebook)


class EncodedTeacher:
    """Features of files, or of an encoder."""

    def __init__(self, teaching: Teaching, meaning: Meaning):
        self._teaching, self.meaning = teaching, meaning

    def said(self, t: int) -> Said | None:
        """Of frame t, whether it was learned from or not.

        Raises:
            ValueError, OSError: it cannot be read, or its file does not fit.
        """
        teacher = self._teaching.of(t)
        if teacher is None:
            return None
        (ids,), codes = _in_channels(teacher, self.meaning.basis)
        return Said(ids, codes)


def encoded_teacher(
    sequence: Sequence,
    train: Many[int],
    looks: Many[Look],
    asked: Asked,
    channels: int,
    notes: Notes,
    console: Console,
) -> tuple[EncodedTeacher, list[Look], Float[np.ndarray, "n channels"]]:
    """Have frames segmented and encoded, or their features read.

    Args:
        sequence: camera 0 is the one that is learned from.
        train: frames to learn from.
        looks: of these, without a teacher.
        asked: whose masks and features; checked, of neither classes nor nobody.
        channels: of a Gaussian's feature.
        notes: told how much of the features the channels keep.
        console: shows how far it is.

    Returns:
        The teacher, looks with what it says, and the codes that their ids name.

    Raises:
        ValueError: there are no masks, files do not fit, a package is missing, or nothing is said of pixels
            that count.
        FileNotFoundError: files of features or weights are not there.
    """
    teaching = Teaching(_as_photographs(sequence), train, asked, FeatureCache(), console)
    basis, kept = basis_of(_counted_vectors(teaching.teacher, looks), channels)
    ids, codes = _in_channels(teaching.teacher, basis)
    if len({one.shape for one in ids}) > 1:
        found = ", ".join(sorted({f"{one.shape[1]}x{one.shape[0]}" for one in ids}))
        raise ValueError(f"--features {asked.features}: expected one grid in all frames, found {found}")
    looks = [look._replace(ids=one) for look, one in zip(looks, ids, strict=True)]
    there = np.unique(np.concatenate([counted_ids(look).ravel() for look in looks]))
    groups = groups_of(codes[there[there >= 0]])
    names = tuple(f"group {n}" for n in range(1, len(groups) + 1))
    notes.add(
        f"Learned beside colours: {teaching.about}; {channels} channels keep {kept:.1%} of their "
        f"{teaching.teacher.dimension} numbers (--deform.channels). They have no names, and are parted into "
        f"{len(groups)} groups."
    )
    return EncodedTeacher(teaching, Meaning(teaching.source, names, groups, basis)), looks, codes


def said_of(
    teacher: ClassTeacher | EncodedTeacher, frames: Many[int], sequence: Sequence, notes: Notes
) -> dict[int, Said]:
    """Of frames that are only judged; those that cannot be read are noted and left out."""
    found: dict[int, Said] = {}
    for t in frames:
        try:
            if (said := teacher.said(t)) is not None:
                found[t] = said
        except (ValueError, OSError) as error:
            notes.warn(f"frame {sequence.frame_ids[t]} is not compared with the teacher: {describe(error)}")
    return found


def basis_of(
    vectors: Float[np.ndarray, "n D"], channels: int
) -> tuple[Float[np.ndarray, "D channels"], float]:
    """The orthonormal columns that keep most of some vectors, their lengths and angles, and which share of
    their squares that is; zeros fill it up where there are fewer than `channels`."""
    vectors = np.asarray(vectors, np.float64)
    squares, axes = np.linalg.eigh(vectors.T @ vectors)
    squares, axes = np.maximum(squares[::-1], 0), axes[:, ::-1]
    held = min(channels, axes.shape[1], int(np.linalg.matrix_rank(vectors)))
    basis = np.zeros((vectors.shape[1], channels))
    basis[:, :held] = axes[:, :held]
    return basis, float(squares[:held].sum() / max(squares.sum(), 1e-30))


def groups_of(codes: Float[np.ndarray, "n channels"], most: int = GROUPS) -> Float[np.ndarray, "k channels"]:
    """Means of codes that point the same way, the largest group first: as many as there are different codes,
    or, of more than `most`, so many that to join two more would cost most beside what it cost to join them so
    far (Ward's method, of directions)."""
    codes = np.unique(codes, axis=0)
    codes = codes[np.unique(np.linspace(0, len(codes) - 1, _SAMPLE).astype(int))]
    if len(codes) <= most:
        return codes
    tree = ward(codes / np.maximum(np.linalg.norm(codes, axis=1, keepdims=True), 1e-12))
    to_join = tree[: -most - 1 : -1, 2]  # the last two, the last three, ...
    count = 2 + int(np.argmax(to_join[:-1] / np.maximum(to_join[1:], 1e-12)))
    group = fcluster(tree, count, "maxclust")
    kinds, sizes = np.unique(group, return_counts=True)
    return np.stack([codes[group == kind].mean(axis=0) for kind in kinds[np.argsort(-sizes, kind="stable")]])


def _as_photographs(sequence: Sequence) -> Photographs:
    """The frames of camera 0, named as their pictures' files are, or by their number where they have none."""
    alone = photographs_of(sequence.select(cameras=[sequence.camera_ids[0]]))
    files = [Path(alone.where("image", i)) for i in range(alone.num)]
    names = [file.name for file in files if file.is_file()]
    if len(set(names)) < alone.num:
        names = [f"{number:06d}" for number in sequence.frame_ids]
    return replace(alone, names=tuple(names))


def _counted_vectors(teacher: Teacher, looks: Many[Look]) -> Float[np.ndarray, "n D"]:
    """What is said of pixels that count: rows of its codebook, each once, or a vector a pixel of its maps.

    Raises:
        ValueError: that is nothing.
    """
    if teacher.codebook is not None:
        pairs = zip(looks, teacher.ids, strict=True)
        counted = [counted_ids(look._replace(ids=ids)).ravel() for look, ids in pairs]
        there = np.unique(np.concatenate(counted))
        vectors = teacher.codebook[there[there >= 0]]
    else:
        assert teacher.maps is not None
        every = [np.zeros(one.shape[:2], np.int32) for one in teacher.maps]
        counted = [counted_ids(look._replace(ids=ids)) >= 0 for look, ids in zip(looks, every, strict=True)]
        vectors = np.concatenate([one[some] for one, some in zip(teacher.maps, counted, strict=True)])
    if not np.any(vectors):
        raise ValueError("--features: expected some of pixels that count, found none; do masks hide all?")
    return vectors


def _in_channels(
    teacher: Teacher, basis: Float[np.ndarray, "D channels"]
) -> tuple[list[Int[np.ndarray, "h w"]], Float[np.ndarray, "n channels"]]:
    """Ids of each view, and the codes that they name; a map's pixels have a code each."""
    if teacher.codebook is not None:
        return teacher.ids, teacher.codebook @ basis
    assert teacher.maps is not None
    ids, begin = [], 0
    for one in teacher.maps:
        places = begin + np.arange(one.shape[0] * one.shape[1], dtype=np.int32).reshape(one.shape[:2])
        ids.append(np.where(np.any(one, axis=2), places, -1))
        begin += places.size
    return ids, np.concatenate([one.reshape(-1, one.shape[2]) @ basis for one in teacher.maps])
