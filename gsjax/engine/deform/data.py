"""What `gsjax deform` learns from: frames of one camera, what counts in them, and what masks call things."""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from rich.console import Console
from rich.progress import track

from gsjax.data import Sequence
from gsjax.data.tool_masks import TISSUE, is_tool
from gsjax.engine.deform.teacher import ClassTeacher, EncodedTeacher, Meaning, Said, said_of, teaching_of
from gsjax.engine.distill.choice import TeacherChoice
from gsjax.engine.messages import Notes
from gsjax.methods.deform import Look, begins, counted_ids

Tools = Literal["leave-out", "draw"]
_OF_CLASSES = ("auto", "classes")
_SHOWN = 0.005  # of a picture: a class that has less of it hardly shows


@dataclass(frozen=True, eq=False)
class DeformData:
    """A recording with its frames parted.

    Attributes:
        sequence: camera 0 is the one that is learned from; others are only judged.
        train: positions of frames to learn from.
        test: positions of frames that are held out.
        looks: what the camera saw in the former.
        meaning: what features are to say; None without a teacher.
        codes: what ids of looks name, in the scene's channels; None without.
        held_out: what the teacher says of frames in `test`.
        taught: digest of what the teacher says, in hexadecimal.
        tool_values: what masks call tools; told by names where there is none.
    """

    sequence: Sequence
    train: list[int]
    test: list[int]
    looks: list[Look]
    meaning: Meaning | None
    codes: Float[np.ndarray, "n channels"] | None
    held_out: Mapping[int, Said]
    taught: str = ""
    tool_values: tuple[int, ...] = ()

    @property
    def times(self) -> Float[np.ndarray, "t"]:
        """Of all frames, 0 to 1."""
        return unit_times(self.sequence)

    @property
    def names(self) -> tuple[str, ...]:
        """Of what features tell apart; none without a teacher."""
        return () if self.meaning is None else self.meaning.names

    @property
    def first(self) -> int | None:
        """Which of the looks the canonical scene is to be like: the earliest that shows most of the classes,
        for what it does not show has no Gaussians of its own. None where there are none, or no depth."""
        if self.meaning is None or self.meaning.source.kind != "classes":
            return None
        shown = np.zeros(len(self.looks), int)
        for i, look in enumerate(self.looks):
            ids = counted_ids(look)
            if begins(look, self.looks):
                counts = np.bincount(ids[ids >= 0], minlength=len(self.names))
                shown[i] = (counts > _SHOWN * ids.size).sum()
        return int(shown.argmax()) if shown.any() else None

    def digest(self) -> str:
        """Of all that is learned from, in hexadecimal."""
        found = hashlib.sha256(self.taught.encode())
        for value in (value for look in self.looks for value in look):
            if value is not None:
                found.update(np.ascontiguousarray(value).tobytes())
        return found.hexdigest()

    def said(self, t: int) -> Said | None:
        """What the teacher says of a frame; None where that is nothing."""
        if self.codes is None or t not in self.train:
            return self.held_out.get(t)
        ids = self.looks[self.train.index(t)].ids
        return None if ids is None else Said(ids, self.codes)

    def look(self, t: int, camera: int, tools: Tools, mask: Int[np.ndarray, "h w"] | None = None) -> Look:
        """What a camera saw at a frame, without a teacher; its mask is read unless given."""
        seen, counts = self.sequence, None
        if tools == "leave-out" and seen.has_masks:
            mask = seen.mask(t, camera) if mask is None else mask
            if mask is not None:
                gone = [v for v in np.unique(mask).tolist() if _is_tool(v, seen, self.tool_values)]
                counts = ~np.isin(mask, gone)
        pose = (seen.viewmats[t, camera], seen.Ks[t, camera], float(unit_times(seen)[t]))
        return Look(seen.image(t, camera), counts, seen.depth(t, camera), *pose, near=seen.near)


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
        tools: whether what masks call a thing is left out.
        asked: whose features are learned; checked. "auto": the masks' classes, if there are two or more among
            pixels that count. None: nobody's.
        channels: of a Gaussian's feature.
        tool_values: what masks call tools; told by names where there is none.
        notes: told what is odd.
        console: that shows how it goes on.

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
    frames = range(count) if sequence.has_masks else range(0)
    shown = track(frames, "reading", console=console, transient=True, disable=not console.is_terminal)
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
    data = DeformData(sequence, train, test, [], None, None, {}, tool_values=tool_values)
    encoded = asked is not None and asked.features not in _OF_CLASSES
    teaching = teaching_of(sequence, train, asked, console) if encoded else None
    looks = [data.look(t, 0, tools, masks.get(t)) for t in train]
    if teaching is not None:
        teacher = EncodedTeacher(teaching, looks, channels)
        ids, codes = teacher.ids, teacher.codes
        notes.add(teacher.note())
        console.print(f"[bold]features[/]  {teacher.note()}", soft_wrap=True)
    else:
        teacher = None if asked is None else _of_classes(sequence, counted, asked.features, channels)
        if teacher is None:
            return replace(data, looks=looks)
        ids, codes = [teacher.of_mask(masks.get(t)).ids for t in train], teacher.meaning.codebook
    looks = [look._replace(ids=one) for look, one in zip(looks, ids, strict=True)]
    held_out = said_of(teacher, test, sequence, notes)
    said = {"meaning": teacher.meaning, "codes": codes, "held_out": held_out, "taught": teacher.digest()}
    return replace(data, looks=looks, **said)


def _counted_names(
    sequence: Sequence,
    masks: Iterable[Int[np.ndarray, "h w"] | None],
    tools: Tools,
    tool_values: tuple[int, ...],
    notes: Notes,
) -> dict[int, str]:
    """What masks call things that count, by their value; what is left out is noted."""
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
