"""What teaches the features of a deforming scene: classes of masks, or features from files or an encoder,
projected to the few channels of the scene."""

from collections import Counter
from collections.abc import Mapping
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
from gsjax.engine.messages import Notes, describe
from gsjax.engine.teaching.cache import content_digest
from gsjax.engine.teaching.source import Source
from gsjax.engine.teaching.teaching import Teaching
from gsjax.methods.deform import Lesson, Meaning, counted_ids
from gsjax.methods.distill import Teacher
from gsjax.perception.codebook import ClassCodebook
from gsjax.scene.frame import Frame

GROUPS = 8
"""The largest number of groups into which features without names are clustered."""
_SAMPLE = 2000  # vectors, at most, that are clustered, because all pairs are compared
_SAME_GROUP = 0.98  # cosine above which directions belong to one group


class Labels(NamedTuple):
    """A teacher's labels of a frame.

    Attributes:
        ids: row in `codes` for each of the teacher's pixels, -1 for none; a grid of any size.
        codes: feature vectors, in the scene's channels.
    """

    ids: Int[np.ndarray, "h w"]
    codes: Float[np.ndarray, "n channels"]


class Taught(NamedTuple):
    """A teacher's labels of a recording.

    Attributes:
        lesson: labels of the training frames.
        held_out: labels of held-out frames, by their index; frames without any are left out.
        digest: of everything taught other than the ids of frames, in hexadecimal.
        masks: source of the masks, as `Teaching.masks`.
    """

    lesson: Lesson
    held_out: Mapping[int, Labels]
    digest: str
    masks: str


def taught_by_classes(
    masks: Mapping[int, Int[np.ndarray, "h w"] | None],
    train: Many[int],
    test: Many[int],
    names: Mapping[int, str],
    size: tuple[int, int],
    channels: int,
) -> Taught:
    """Labels with a code for each class of the masks, in place of a foundation model's features.

    Args:
        masks: of frames; pixels of a frame without a mask have no label.
        train, test: indices of the training frames and of the held-out ones.
        names: of mask values.
        size: width and height of the masks, pixels.
        channels: of a Gaussian's feature.

    Raises:
        ValueError: there are more classes than channels.
    """
    if len(names) > channels:
        raise ValueError(
            f"--deform.channels {channels}: expected at least {len(names)}, one for each class; give more"
        )
    source = Source("classes", {value + 1: name for value, name in names.items()})
    encoder = ClassCodebook(source.names)
    codes = np.stack([encoder.embed_text(name) for name in names.values()])
    basis, _ = basis_of([codes], channels)
    meaning = Meaning(source, tuple(names.values()), codes @ basis, basis)

    def ids_of(mask: Int[np.ndarray, "h w"] | None) -> Int[np.ndarray, "h w"]:
        ids = np.full(size[::-1], -1, np.int32)
        for row, value in enumerate(() if mask is None else names):
            ids[mask == value] = row
        return ids

    lesson = Lesson([ids_of(masks[t]) for t in train], meaning.codebook, meaning)
    held_out = {t: Labels(ids_of(masks[t]), meaning.codebook) for t in test}
    return Taught(lesson, held_out, content_digest(f"classes {meaning.names}", {}), "files")


def taught_by_features(
    teaching: Teaching,
    frames: Many[Frame],
    test: Mapping[int, int],
    channels: int,
    notes: Notes,
    console: Console,
) -> Taught:
    """Labels with features from files, or of an encoder, projected to the scene's channels.

    Args:
        teaching: the teacher of the recording, frame by frame.
        frames: training frames, of one camera each.
        test: the held-out frames: their numbers in the recording, by index.
        channels: of a Gaussian's feature.
        notes: receives what is learned, and which held-out frames cannot be read; these are left out.
        console: shows what is learned.

    Raises:
        ValueError: grids differ, or no pixel that counts has features.
    """
    teacher = teaching.teacher
    ids, blocks = _ids(teacher), _vectors(teacher)
    weights = _counts(ids, sum(map(len, blocks)), frames)
    counted = np.split(weights > 0, np.cumsum([len(block) for block in blocks])[:-1])
    vectors = [block[some] for block, some in zip(blocks, counted, strict=True)]
    basis, kept = basis_of(vectors, channels)
    codes = _codes(teacher, basis)
    groups = groups_of(codes[weights > 0], weights[weights > 0])
    names = tuple(f"group {n}" for n in range(1, len(groups) + 1))
    lesson = Lesson(ids, codes, Meaning(teaching.source, names, groups, basis))
    parted = f"they are parted into {len(names)} groups"
    if len(names) == 1:
        parted = "all of it is alike, one group"
        parted += " (--masks segment finds more pieces)" if teaching.source.kind == "closed" else ""
    note = (
        f"Learned beside colours: {teaching.about}; {channels} channels keep {kept:.1%} of "
        f"its {len(basis)} numbers (--deform.channels); {parted}."
    )
    notes.add(note)
    console.print(f"[bold]features[/]  {note}", soft_wrap=True)
    held_out: dict[int, Labels] = {}
    failed: dict[int, str] = {}
    for t, number in test.items():
        try:
            if (found := teaching.of(t)) is not None:
                held_out[t] = Labels(_ids(found)[0], _codes(found, basis))
        except FileNotFoundError:
            failed[number] = "they have no file"
        except (ValueError, OSError) as error:
            failed[number] = describe(error)
    if failed:
        which = ", ".join(map(str, failed))
        notes.warn(f"not compared with the teacher: frames {which} ({next(iter(failed.values()))})")
    return Taught(lesson, held_out, teaching.digest(), teaching.masks)


def basis_of(
    vectors: Many[Float[np.ndarray, "_ D"]], channels: int
) -> tuple[Float[np.ndarray, "D channels"], float]:
    """An orthonormal basis, in columns, of the subspace in which vectors keep most of their squared lengths,
    and the share that they keep. Columns beyond the rank of the vectors are zeros."""
    products = sum(np.asarray(some, np.float64).T @ np.asarray(some, np.float64) for some in vectors)
    squares, axes = np.linalg.eigh(products)
    squares, axes = np.maximum(squares[::-1], 0), axes[:, ::-1]
    held = min(channels, int((squares > 1e-12 * squares[0]).sum()))
    basis = np.zeros((len(axes), channels))
    basis[:, :held] = axes[:, :held]
    return basis, float(squares[:held].sum() / max(squares.sum(), 1e-30))


def groups_of(
    codes: Float[np.ndarray, "n channels"], weights: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "k channels"]:
    """Clusters codes by direction; returns the mean of each group, heaviest first, at most `GROUPS` of them.

    Directions are merged by Ward's method. The number of groups is that before the merge whose cost exceeds
    the previous one's by the largest factor; then groups are merged further while two of them are alike.

    Args:
        codes: not all zeros.
        weights: the number of pixels of each code.
    """
    chosen = np.unique(np.linspace(0, len(codes) - 1, _SAMPLE).astype(int))
    codes, weights = codes[chosen], weights[chosen]
    lengths = np.linalg.norm(codes, axis=1)
    codes, weights, lengths = (one[lengths > 0] for one in (codes, weights, lengths))
    directions = codes / lengths[:, None]
    group = np.ones(len(codes), int)
    if len(codes) > 1:
        tree = ward(directions)
        alike = np.sqrt(2 - 2 * _SAME_GROUP)  # cost of merging two directions that are just alike
        last = tree[: -GROUPS - 1 : -1, 2][: GROUPS - 1]  # costs of the last merges, the last first
        costs = np.maximum(np.append(last, alike), alike)
        count = 2 + int(np.argmax(costs[:-1] / costs[1:])) if len(costs) > 1 else 1
        group = fcluster(tree, count, "maxclust")
        while count > 1 and _max_cosine(_means(directions, weights, group)) > _SAME_GROUP:
            count -= 1
            group = fcluster(tree, count, "maxclust")
    heavy = [weights[group == kind].sum() for kind in np.unique(group)]
    return _means(codes, weights, group)[np.argsort(-np.array(heavy), kind="stable")]


def _means(
    vectors: Float[np.ndarray, "n c"], weights: Float[np.ndarray, "n"], group: Int[np.ndarray, "n"]
) -> Float[np.ndarray, "k c"]:
    kinds = [group == kind for kind in np.unique(group)]
    return np.stack([np.average(vectors[some], axis=0, weights=weights[some]) for some in kinds])


def _max_cosine(vectors: Float[np.ndarray, "k c"]) -> float:
    """The largest cosine between two of the vectors."""
    directions = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    return float((directions @ directions.T - 2 * np.eye(len(vectors))).max())


def as_photographs(sequence: Sequence) -> Photographs:
    """The frames of camera 0, named after their picture files, or by number if they have none. Without
    depth, in which a segmenter would find planes, which do not deform."""
    alone = photographs_of(sequence.select(cameras=[sequence.camera_ids[0]]))
    files = [Path(alone.where("image", i)) for i in range(alone.num)]
    names = [file.name for file in files if file.is_file()]
    if len(set(names)) < alone.num:
        names = [f"{number:06d}" for number in sequence.frame_ids]
    return replace(alone, names=tuple(names), load_depth=None)


def _counts(ids: Many[Int[np.ndarray, "h w"]], rows: int, frames: Many[Frame]) -> Float[np.ndarray, "n"]:
    """The number of pixels that count with each of `rows` vectors.

    Raises:
        ValueError: grids differ, or no pixel has a vector.
    """
    grids = Counter(one.shape for one in ids)
    if len(grids) > 1:
        found = ", ".join(f"{width}x{height} ({n})" for (height, width), n in grids.most_common())
        raise ValueError(f"--features: expected one grid size in all frames, found (frames of each) {found}")
    counts = np.zeros(1 + rows)
    for frame, one in zip(frames, ids, strict=True):
        counted = counted_ids(one, None if frame.masks is None else frame.masks[0])
        counts += np.bincount(1 + counted.ravel(), minlength=len(counts))
    if not counts[1:].any():
        silent = all((one < 0).all() for one in ids)
        found = "zeros alone" if silent else "none; do masks hide all?"
        raise ValueError(f"--features: expected some for the pixels that count, found {found}")
    return counts[1:]


def _vectors(teacher: Teacher) -> list[Float[np.ndarray, "_ D"]]:
    """The vectors of a teacher: its codebook, or a block for each map, with a vector per pixel."""
    if teacher.codebook is not None:
        return [teacher.codebook]
    assert teacher.maps is not None
    return [one.reshape(-1, one.shape[2]) for one in teacher.maps]


def _codes(teacher: Teacher, basis: Float[np.ndarray, "D channels"]) -> Float[np.ndarray, "n channels"]:
    """All vectors of a teacher, projected to the scene's channels."""
    return np.concatenate([block @ basis for block in _vectors(teacher)])


def _ids(teacher: Teacher) -> list[Int[np.ndarray, "h w"]]:
    """The row in `_vectors` of each pixel of each view; -1 where there is none, or where a map is zero."""
    if teacher.maps is None:
        return teacher.ids
    ids, begin = [], 0
    for one in teacher.maps:
        places = begin + np.arange(one.shape[0] * one.shape[1], dtype=np.int32).reshape(one.shape[:2])
        ids.append(np.where(np.any(one, axis=2), places, -1))
        begin += places.size
    return ids
