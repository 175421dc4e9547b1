"""What `gsjax deform` learns from: frames of one camera, what counts in them, and what masks call things."""

import hashlib
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from rich.console import Console
from rich.progress import track

from gsjax.cli.messages import Notes
from gsjax.data import Sequence
from gsjax.data.tool_masks import TISSUE, is_tool, tools_in
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
    """

    sequence: Sequence
    train: list[int]
    test: list[int]
    looks: list[Look]
    names: dict[int, str]
    codebook: Float[np.ndarray, "k channels"] | None

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

    def classes(self, t: int) -> Int[np.ndarray, "h w"] | None:
        """Which row of the codebook each pixel of the camera that is learned from has by its mask, -1 for
        none; None without a teacher."""
        rows = {value: row for row, value in enumerate(self.names)}
        return _ids(self.sequence.mask(t, 0), rows) if rows else None

    def look(self, t: int, camera: int, tools: Tools) -> Look:
        """What a camera saw at a frame, without a teacher."""
        return _look(self.sequence, t, camera, tools, None)


def deform_data(
    sequence: Sequence,
    every: int,
    tools: Tools,
    features: Features,
    channels: int,
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
        notes: told what is odd.
        console: that shows how it goes on.

    Raises:
        ValueError: there are too many classes, or too few that classes are asked for.
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
    shown = track(train, "reading", console=console, transient=True, disable=not console.is_terminal)
    seen = [(t, sequence.mask(t, 0)) for t in shown] if learns else [(t, None) for t in train]
    values = sorted({int(v) for _, mask in seen if mask is not None for v in np.unique(mask)})
    names = sequence.names_of_labels
    counted = [v for v in values if v >= TISSUE and (tools == "draw" or not is_tool(v, names))]
    if learns and len(counted) < 2:
        if features == "classes":
            raise ValueError(
                "--features classes: expected two classes or more among pixels that count, found "
                f"{len(counted)}; --tools draw counts tools too"
            )
        learns = False
    called = {TISSUE: "tissue"} | names
    names = {value: called.get(value, f"object {value}") for value in counted}
    codebook = None
    rows: dict[int, int] = {}
    if learns:
        codebook = _codebook(names, channels)
        rows = {value: row for row, value in enumerate(names)}
    taught = ((t, _ids(mask, rows) if learns and mask is not None else None) for t, mask in seen)
    looks = [_look(sequence, t, 0, tools, ids) for t, ids in taught]
    return DeformData(sequence, train, test, looks, names if learns else {}, codebook)


def unit_times(sequence: Sequence) -> Float[np.ndarray, "t"]:
    """Times of frames, 0 to 1 over the recording."""
    since = sequence.times - sequence.times[0]
    return since / max(since[-1], 1e-12)


def _look(sequence: Sequence, t: int, camera: int, tools: Tools, ids: np.ndarray | None) -> Look:
    mask = sequence.mask(t, camera) if tools == "leave-out" and sequence.has_masks else None
    return Look(
        sequence.image(t, camera),
        None if mask is None else ~tools_in(mask, sequence.names_of_labels),
        sequence.depth(t, camera),
        sequence.viewmats[t, camera],
        sequence.Ks[t, camera],
        float(unit_times(sequence)[t]),
        ids,
        sequence.near,
    )


def _ids(mask: Int[np.ndarray, "h w"], rows: dict[int, int]) -> Int[np.ndarray, "h w"]:
    ids = np.full(mask.shape, -1, np.int32)
    for value, row in rows.items():
        ids[mask == value] = row
    return ids


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
