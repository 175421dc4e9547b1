"""The data of `gsjax deform`: the frames of one camera, the pixels that count, and the teacher's labels."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import jax
import numpy as np
from jaxtyping import Float, Int
from rich.console import Console
from rich.progress import track

from gsjax.data import Sequence
from gsjax.data.tool_masks import TISSUE, is_tool
from gsjax.engine.deform.teacher import Labels, Taught, as_photographs, taught_by_classes, taught_by_features
from gsjax.engine.messages import Notes, counted
from gsjax.engine.photographs import data_split
from gsjax.engine.teaching.cache import FeatureCache
from gsjax.engine.teaching.choice import NO_TEACHER, TeacherChoice
from gsjax.engine.teaching.teaching import Teaching
from gsjax.geometry.cameras import Camera
from gsjax.methods.deform import Lesson, Meaning, Timeline, can_start_from, counted_ids
from gsjax.perception.codebook import distinct_names
from gsjax.scene.frame import Frame

Tools = Literal["leave-out", "draw"]
_WITHOUT_ENCODER = ("auto", "classes", NO_TEACHER)
_SHOWN = 0.005  # share of a picture below which a class hardly shows


@dataclass(frozen=True, eq=False)
class DeformData:
    """A recording whose frames are split into training and held-out frames.

    Attributes:
        sequence: the recording; camera 0 is the training camera, the others are only for evaluation.
        train: indices of training frames.
        test: indices of held-out frames.
        frames: the training frames, in memory.
        taught: the teacher's labels of the frames; None without a teacher.
        tool_values: mask values that are tools; if empty, tools are recognised by name (`is_tool`).
    """

    sequence: Sequence
    train: list[int]
    test: list[int]
    frames: list[Frame]
    taught: Taught | None = None
    tool_values: tuple[int, ...] = ()

    @property
    def times(self) -> Float[np.ndarray, "t"]:
        """Times of all frames, 0 to 1."""
        return unit_times(self.sequence)

    @property
    def lesson(self) -> Lesson | None:
        """The teacher's labels of the training frames; None without a teacher."""
        return None if self.taught is None else self.taught.lesson

    @property
    def meaning(self) -> Meaning | None:
        """The meaning of features; None without a teacher."""
        return None if self.lesson is None else self.lesson.meaning

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the classes or groups of features; none without a teacher."""
        return () if self.meaning is None else self.meaning.names

    @property
    def first(self) -> int | None:
        """Index in `frames` of the frame that the canonical scene starts from: the earliest of those that
        show the most classes, because a class it does not show gets no Gaussians of its own. None without
        classes, or if the scene cannot start from any of these frames."""
        if self.lesson is None or self.meaning is None or self.meaning.source.kind != "classes":
            return None
        shown = np.zeros(len(self.frames), int)
        for i, (frame, ids) in enumerate(zip(self.frames, self.lesson.ids, strict=True)):
            counted = counted_ids(ids, None if frame.masks is None else frame.masks[0])
            if can_start_from(frame, self.frames):
                counts = np.bincount(counted[counted >= 0], minlength=len(self.names))
                shown[i] = (counts > _SHOWN * counted.size).sum()
        return int(shown.argmax()) if shown.any() else None

    def digest(self) -> str:
        """Digest of all training data, in hexadecimal."""
        found = hashlib.sha256(b"" if self.taught is None else self.taught.digest.encode())
        ids = () if self.lesson is None else self.lesson.ids
        for value in jax.tree.leaves((self.frames, list(ids))):
            found.update(np.ascontiguousarray(value).tobytes())
        return found.hexdigest()

    def labels(self, t: int) -> Labels | None:
        """The teacher's labels of a frame; None if it has none."""
        if self.taught is None or self.lesson is None:
            return None
        if t not in self.train:
            return self.taught.held_out.get(t)
        return Labels(self.lesson.ids[self.train.index(t)], self.lesson.codebook)

    def frame(self, t: int, camera: int, tools: Tools, mask: Int[np.ndarray, "h w"] | None = None) -> Frame:
        """A frame of one camera, on the host.

        Args:
            t: index of the frame.
            camera: index of the camera.
            tools: whether pixels of tools count.
            mask: labels of the frame, if they were already read.
        """
        seen, counts = self.sequence, None
        if tools == "leave-out" and seen.has_masks:
            mask = seen.mask(t, camera) if mask is None else mask
            if mask is not None:
                gone = [v for v in np.unique(mask).tolist() if _is_tool(v, seen, self.tool_values)]
                counts = ~np.isin(mask, gone)[None]
        only = slice(camera, camera + 1)
        view = Camera(seen.viewmats[t, only], seen.Ks[t, only], seen.width, seen.height, seen.near)
        depth = seen.depth(t, camera)
        return Frame(
            seen.image(t, camera)[None],
            None if depth is None else depth[None],
            view,
            counts,
            np.asarray(unit_times(seen)[t]),
        )

    def timeline(self, metric: bool = True) -> Timeline:
        """All frames of the recording, held-out ones included.

        Args:
            metric: whether depth, and so the scene, is in metres.
        """
        seen = self.sequence
        return Timeline(
            self.times,
            np.asarray(seen.frame_ids),
            float(seen.times[-1] - seen.times[0]),
            seen.viewmats[:, 0],
            seen.Ks[:, 0],
            (seen.width, seen.height),
            seen.near,
            np.array(self.test, int),
            metric,
        )


def deform_data(
    sequence: Sequence,
    every: int,
    tools: Tools,
    choice: TeacherChoice,
    channels: int,
    tool_values: tuple[int, ...],
    notes: Notes,
    console: Console,
) -> DeformData:
    """Read the training frames, and the teacher's labels of all frames.

    Args:
        sequence: the recording; camera 0 is the training camera.
        every: if the data has no split, hold out frame i where (i - 1) mod `every` is 0, as is usual for
            EndoNeRF; 0: none.
        tools: whether tools, recognised by the names of mask values, are left out.
        choice: the teacher; checked. "auto": the masks' classes, if there are two or more among pixels that
            count. "none": no teacher.
        channels: of a Gaussian's feature.
        tool_values: mask values that are tools; if empty, tools are recognised by name (`is_tool`).
        notes: receives oddities of the data.
        console: shows the progress.

    Raises:
        ValueError: there are too many classes, or too few for "classes"; features do not fit; or no training
            frame is left, or has a mask.
        DataError, FileNotFoundError: a file is invalid or missing.
    """
    train, test = _split(sequence, every, notes)
    count = sequence.num_frames
    if count < 2:
        notes.warn(f"{sequence.name} has one frame: nothing deforms, and nothing is held out")
    with_masks = range(count) if sequence.has_masks else range(0)
    shown = track(with_masks, "reading", console=console, transient=True, disable=not console.is_terminal)
    masks = {t: sequence.mask(t, 0) for t in shown}
    if tools == "leave-out":
        unknown = [t for t, mask in masks.items() if mask is None]
        train, test = ([t for t in some if t not in unknown] for some in (train, test))
        if unknown:
            numbers = ", ".join(str(sequence.frame_ids[t]) for t in unknown)
            notes.warn(f"frames {numbers} have no tool mask and are left out")
        if not train:
            raise ValueError(
                f"{sequence.name}: expected masks of training frames, found none; try --tools draw"
            )
    counted = _counted_names(sequence, [masks.get(t) for t in train], tools, tool_values, notes)
    teaching = None
    if choice.features not in _WITHOUT_ENCODER:
        teaching = Teaching(as_photographs(sequence), train, choice, FeatureCache(), console)
    data = DeformData(sequence, train, test, [], tool_values=tool_values)
    data = replace(data, frames=[data.frame(t, 0, tools, masks.get(t)) for t in train])
    if teaching is not None:
        numbers = {t: int(sequence.frame_ids[t]) for t in test}
        taught = taught_by_features(teaching, data.frames, numbers, channels, notes, console)
    elif _has_classes(sequence, len(counted), choice.features):
        size = (sequence.width, sequence.height)
        taught = taught_by_classes(masks, train, test, counted, size, channels)
    else:
        return data
    return replace(data, taught=taught)


def _split(sequence: Sequence, every: int, notes: Notes) -> tuple[list[int], list[int]]:
    """Indices of training and of held-out frames: by the data's split, as in `gsjax fit`, else every n-th is
    held out.

    Raises:
        ValueError: no frame is left to learn from.
    """
    count, found = sequence.num_frames, data_split(sequence.splits)
    if found is None:
        test = [i for i in range(count) if every and (i - 1) % every == 0] if count > 1 else []
        return [i for i in range(count) if i not in test], test
    train, test = (some.tolist() for some in found)
    if not train:
        raise ValueError(
            f"{sequence.name}: expected photographs of its split train, found none; is transforms_train.json "
            "there, with its pictures, and does --frames take any of them?"
        )
    unused = count - len(train) - len(test)
    notes.add(
        f"The data's own split is used: {counted(len(train), 'frame')} of train learned, {len(test)} held out"
        + (f", {unused} of val left out of both." if unused else ".")
    )
    return train, test


def _counted_names(
    sequence: Sequence,
    masks: Iterable[Int[np.ndarray, "h w"] | None],
    tools: Tools,
    tool_values: tuple[int, ...],
    notes: Notes,
) -> dict[int, str]:
    """The mask values that count, with their names; notes which are left out."""
    values = sorted({int(v) for mask in masks if mask is not None for v in np.unique(mask)})
    given = sequence.names_of_labels
    known = {v: given.get(v, f"object {v}") for v in values if v > TISSUE or v in given}
    names = distinct_names(known, ("tissue", "background", "unlabelled"))
    called = {value: names[value] for value in values if value >= TISSUE}
    gone = [v for v in called if tools == "leave-out" and _is_tool(v, sequence, tool_values)]
    if gone:
        kept = ", ".join(name for value, name in called.items() if value not in gone) or "nothing"
        notes.add(f"Left out as tools: {', '.join(called[v] for v in gone)}; kept: {kept} (--tool-values).")
    return {value: name for value, name in called.items() if value not in gone}


def _has_classes(sequence: Sequence, count: int, features: str) -> bool:
    """Whether the classes of masks are the teacher: if there are two or more among the pixels that count.

    Raises:
        ValueError: they are asked for, but there are no masks or fewer than two classes.
    """
    if features == "classes" and not sequence.has_masks:
        raise ValueError(f"--features classes: {sequence.name} has no masks; leave it at auto, or give masks")
    if features == "classes" and count < 2:
        raise ValueError(
            "--features classes: expected two classes or more to learn, found "
            f"{count}; --tools draw makes the tools one of them"
        )
    return count >= 2 and features != NO_TEACHER


def unit_times(sequence: Sequence) -> Float[np.ndarray, "t"]:
    """Times of frames, 0 to 1 over the recording."""
    since = sequence.times - sequence.times[0]
    return since / max(since[-1], 1e-12)


def _is_tool(value: int, sequence: Sequence, given: tuple[int, ...]) -> bool:
    return value in given if given else is_tool(value, sequence.names_of_labels)
