"""What `gsjax deform` learns from: frames of one camera, what counts in them, and what masks call things."""

import hashlib
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from rich.console import Console
from rich.progress import track

from gsjax.cli.messages import Notes
from gsjax.data import Sequence
from gsjax.data.tool_masks import TISSUE, is_tool
from gsjax.methods.surgical import Look
from gsjax.perception.codebook import ClassCodebook

Tools = Literal["leave-out", "draw"]
Features = Literal["auto", "classes", "none"]


@dataclass(frozen=True, eq=False)
class DeformData:
    """A recording with its frames parted.

    Attributes:
        sequence: camera 0 is the one that is learned from; others are only judged.
        train: positions of frames to learn from.
        test: positions of frames that are held out.
        looks: what the camera saw in the former.
        names: what masks call things, by their value.
        codebook: what the teacher says of each, in the scene's channels; None without a teacher.
        tool_values: what masks call tools; told by names where there is none.
    """

    sequence: Sequence
    train: list[int]
    test: list[int]
    looks: list[Look]
    names: dict[int, str]
    codebook: Float[np.ndarray, "k channels"] | None
    tool_values: tuple[int, ...] = ()

    @property
    def times(self) -> Float[np.ndarray, "t"]:
        """Of all frames, 0 to 1."""
        return unit_times(self.sequence)

    def digest(self) -> str:
        """Of all that is learned from, in hexadecimal."""
        found = hashlib.sha256()
        for look in self.looks:
            for value in look:
                if value is not None:
                    found.update(np.ascontiguousarray(value).tobytes())
        return found.hexdigest()

    def classes(self, mask: Int[np.ndarray, "h w"] | None) -> Int[np.ndarray, "h w"] | None:
        """Which row of the codebook each pixel of a mask has, -1 for none; None without a teacher."""
        if self.codebook is None:
            return None
        ids = np.full((self.sequence.height, self.sequence.width), -1, np.int32)
        if mask is not None:
            for row, value in enumerate(self.names):
                ids[mask == value] = row
        return ids

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
    features: Features,
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
        features: whether the masks' classes are learned.
        channels: of a Gaussian's feature.
        tool_values: what masks call tools; told by names where there is none.
        notes: told what is odd.
        console: that shows how it goes on.

    Raises:
        ValueError: there are too many classes, or too few that classes are asked for; or no frame has a mask.
        DataError: a file is bad.
    """
    count = sequence.num_frames
    test = [i for i in range(count) if every and (i - 1) % every == 0] if count > 1 else []
    train = [i for i in range(count) if i not in test]
    if count < 2:
        notes.warn(f"{sequence.name} has one frame: nothing deforms, and nothing is held out")
    learns = features == "classes" or (features == "auto" and sequence.has_masks)
    if learns and not sequence.has_masks:
        raise ValueError(f"--features classes: {sequence.name} has no masks; leave it at auto, or give masks")
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
    values = sorted({int(v) for t in train if masks.get(t) is not None for v in np.unique(masks[t])})
    names = {TISSUE: "tissue"} | sequence.names_of_labels
    called = {value: names.get(value, f"object {value}") for value in values if value >= TISSUE}
    gone = [v for v in called if tools == "leave-out" and _is_tool(v, sequence, tool_values)]
    if gone:
        kept = ", ".join(name for value, name in called.items() if value not in gone) or "nothing"
        notes.add(f"Left out as tools: {', '.join(called[v] for v in gone)}; kept: {kept} (--tool-values).")
    counted = {value: name for value, name in called.items() if value not in gone}
    if learns and len(counted) < 2:
        if features == "classes":
            raise ValueError(
                "--features classes: expected two classes or more among pixels that count, found "
                f"{len(counted)}; --tools draw counts tools too"
            )
        learns = False
    codebook = _codebook(counted, channels) if learns else None
    found = DeformData(sequence, train, test, [], counted if learns else {}, codebook, tool_values)
    looks = [found.look(t, 0, tools, masks.get(t))._replace(ids=found.classes(masks.get(t))) for t in train]
    return replace(found, looks=looks)


def unit_times(sequence: Sequence) -> Float[np.ndarray, "t"]:
    """Times of frames, 0 to 1 over the recording."""
    since = sequence.times - sequence.times[0]
    return since / max(since[-1], 1e-12)


def _is_tool(value: int, sequence: Sequence, given: tuple[int, ...]) -> bool:
    return value in given if given else is_tool(value, sequence.names_of_labels)


def _codebook(names: dict[int, str], channels: int) -> Float[np.ndarray, "k channels"]:
    """Codes of classes in the scene's channels: a projection with orthonormal rows in which they keep their
    lengths and angles (METHODS.md: fixed, for two that learn agree best where both are 0).

    Raises:
        ValueError: there are more classes than channels.
    """
    if len(names) > channels:
        raise ValueError(
            f"--deform.channels {channels}: expected at least {len(names)}, one for each class; give more"
        )
    encoder = ClassCodebook({value + 1: name for value, name in names.items()})
    codes = np.stack([encoder.embed_text(name) for name in names.values()])
    _, _, axes = np.linalg.svd(codes, full_matrices=False)
    basis = np.zeros((channels, codes.shape[1]))
    basis[: len(axes)] = axes
    return codes @ basis.T
