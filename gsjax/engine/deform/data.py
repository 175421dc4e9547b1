"""What `gsjax deform` learns from: frames of one camera, the pixels that count, and names of mask values."""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import jax
import numpy as np
from jaxtyping import Float, Int
from rich.console import Console
from rich.progress import track

from gsjax.data import Sequence
from gsjax.data.tool_masks import TISSUE, is_tool
from gsjax.engine.deform.teacher import ClassTeacher, EncodedTeacher, Labels, labels_of, teaching_of
from gsjax.engine.distill.choice import TeacherChoice
from gsjax.engine.messages import Notes
from gsjax.geometry.cameras import Camera
from gsjax.methods.deform import Lesson, Meaning, Timeline, can_start_from, counted_ids
from gsjax.scene.frame import Frame

Tools = Literal["leave-out", "draw"]
_OF_CLASSES = ("auto", "classes")
_SHOWN = 0.005  # of a picture: a class that has less of it hardly shows


@dataclass(frozen=True, eq=False)
class DeformData:
    """A recording with its frames split.

    Attributes:
        sequence: camera 0 is the one that is learned from; others are only judged.
        train: indices of frames to learn from.
        test: indices of frames that are held out.
        frames: what the camera saw in the former.
        lesson: a teacher's labels of these; None without a teacher.
        held_out: the teacher's labels of frames in `test`.
        taught: digest of what the teacher teaches, in hexadecimal.
        tool_values: mask values that are tools; those with names of tools where there is none.
    """

    sequence: Sequence
    train: list[int]
    test: list[int]
    frames: list[Frame]
    lesson: Lesson | None = None
    held_out: Mapping[int, Labels] = field(default_factory=dict)
    taught: str = ""
    tool_values: tuple[int, ...] = ()

    @property
    def times(self) -> Float[np.ndarray, "t"]:
        """Of all frames, 0 to 1."""
        return unit_times(self.sequence)

    @property
    def meaning(self) -> Meaning | None:
        """What features are to mean; None without a teacher."""
        return None if self.lesson is None else self.lesson.meaning

    @property
    def names(self) -> tuple[str, ...]:
        """Names of what features tell apart; none without a teacher."""
        return () if self.meaning is None else self.meaning.names

    @property
    def first(self) -> int | None:
        """Index in `frames` of the one that the canonical scene is to be like: the earliest that shows most
        of the classes, for what it does not show has no Gaussians of its own. None without classes, or where
        the scene can start from none of them."""
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
        """Digest of all that is learned from, in hexadecimal."""
        found = hashlib.sha256(self.taught.encode())
        ids = () if self.lesson is None else self.lesson.ids
        for value in jax.tree.leaves((self.frames, list(ids))):
            found.update(np.ascontiguousarray(value).tobytes())
        return found.hexdigest()

    def labels(self, t: int) -> Labels | None:
        """The teacher's labels of a frame; None where it has none."""
        if self.lesson is None or t not in self.train:
            return self.held_out.get(t)
        return Labels(self.lesson.ids[self.train.index(t)], self.lesson.codebook)

    def frame(self, t: int, camera: int, tools: Tools, mask: Int[np.ndarray, "h w"] | None = None) -> Frame:
        """What one camera saw in a frame, on the host.

        Args:
            t: index of the frame.
            camera: index of the camera.
            tools: whether pixels of tools count.
            mask: the frame's own, where it was read before.
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
        """All frames of the recording, those that are held out too.

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
    asked: TeacherChoice | None,
    channels: int,
    tool_values: tuple[int, ...],
    notes: Notes,
    console: Console,
) -> DeformData:
    """Read the frames to learn from.

    Args:
        sequence: camera 0 is learned from.
        every: hold out frame i where (i - 1) mod `every` is 0, as is done with EndoNeRF; 0: none.
        tools: whether tools are left out, by the names of mask values.
        asked: whose features are learned; checked. "auto": the masks' classes, if there are two or more among
            pixels that count. None: nobody's.
        channels: of a Gaussian's feature.
        tool_values: mask values that are tools; those with names of tools where there is none.
        notes: receives what is odd.
        console: shows progress.

    Raises:
        ValueError: there are too many classes, or too few that classes are asked for; features do not fit; or
            no frame has a mask.
        DataError, FileNotFoundError: a file is bad, or not there.
    """
    count = sequence.num_frames
    test = [i for i in range(count) if every and (i - 1) % every == 0] if count > 1 else []
    train = [i for i in range(count) if i not in test]
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
            notes.warn(f"frames {numbers} have no mask to tell where tools are, and are left out")
        if not train:
            raise ValueError(
                f"{sequence.name}: expected masks of frames to learn from, found none (--tools draw)"
            )
    counted = _counted_names(sequence, [masks.get(t) for t in train], tools, tool_values, notes)
    encoded = asked is not None and asked.features not in _OF_CLASSES
    teaching = teaching_of(sequence, train, asked, console) if encoded else None
    data = DeformData(sequence, train, test, [], tool_values=tool_values)
    data = replace(data, frames=[data.frame(t, 0, tools, masks.get(t)) for t in train])
    if teaching is not None:
        teacher = EncodedTeacher(teaching, data.frames, channels)
        lesson = Lesson(teacher.ids, teacher.codes, teacher.meaning)
        notes.add(teacher.note())
        console.print(f"[bold]features[/]  {teacher.note()}", soft_wrap=True)
    else:
        teacher = None if asked is None else _of_classes(sequence, counted, asked.features, channels)
        if teacher is None:
            return data
        ids = [teacher.of_mask(masks.get(t)).ids for t in train]
        lesson = Lesson(ids, teacher.meaning.codebook, teacher.meaning)
    held_out = labels_of(teacher, test, sequence, notes)
    return replace(data, lesson=lesson, held_out=held_out, taught=teacher.digest())


def _counted_names(
    sequence: Sequence,
    masks: Iterable[Int[np.ndarray, "h w"] | None],
    tools: Tools,
    tool_values: tuple[int, ...],
    notes: Notes,
) -> dict[int, str]:
    """Names of mask values that count; what is left out is noted."""
    values = sorted({int(v) for mask in masks if mask is not None for v in np.unique(mask)})
    names = {TISSUE: "tissue"} | sequence.names_of_labels
    called = {value: names.get(value, f"object {value}") for value in values if value >= TISSUE}
    gone = [v for v in called if tools == "leave-out" and _is_tool(v, sequence, tool_values)]
    if gone:
        kept = ", ".join(name for value, name in called.items() if value not in gone) or "nothing"
        notes.add(f"Left out as tools: {', '.join(called[v] for v in gone)}; kept: {kept} (--tool-values).")
    return {value: name for value, name in called.items() if value not in gone}


def _of_classes(
    sequence: Sequence, counted: dict[int, str], features: str, channels: int
) -> ClassTeacher | None:
    """A teacher of the masks' classes; None where there is nothing to tell apart, unless it is asked for.

    Raises:
        ValueError: it is asked for.
    """
    if features == "classes" and not sequence.has_masks:
        raise ValueError(f"--features classes: {sequence.name} has no masks; leave it at auto, or give masks")
    if len(counted) >= 2:
        return ClassTeacher(sequence, counted, channels)
    if features == "classes":
        raise ValueError(
            "--features classes: expected two classes or more among pixels that count, found "
            f"{len(counted)}; --tools draw counts tools too"
        )
    return None


def unit_times(sequence: Sequence) -> Float[np.ndarray, "t"]:
    """Times of frames, 0 to 1 over the recording."""
    since = sequence.times - sequence.times[0]
    return since / max(since[-1], 1e-12)


def _is_tool(value: int, sequence: Sequence, given: tuple[int, ...]) -> bool:
    return value in given if given else is_tool(value, sequence.names_of_labels)
