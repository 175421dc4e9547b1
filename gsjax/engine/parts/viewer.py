"""A run of `gsjax parts` in the viewer, as a film that can be edited as with `gsjax edit`."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Int
from rich.console import Console

from gsjax.engine.messages import Notes
from gsjax.engine.parts.films import Shot, edited, frames_of, new_folder, write_film
from gsjax.engine.parts.saved import PartsRun
from gsjax.engine.recording import Recording
from gsjax.methods.parts.entries import ALL
from gsjax.methods.parts.film import Film, Layer
from gsjax.methods.parts.operations import OPERATIONS, describe_operation, example_line
from gsjax.methods.parts.timeline import Names, Script, parse_op
from gsjax.methods.parts.trajectory import BACKGROUND
from gsjax.scene.handles import Blend
from gsjax.viz.viewer import Editing, Motion, Preview, Shots, Viewable


@dataclass(frozen=True, eq=False)
class Filmed:
    """What all films of a run have in common.

    Attributes:
        title: title of the run.
        names: names of its parts.
        blend: how rotations are blended.
        times: times of the recording, seconds from its start.
        shots: its photographs at these times; None if they are not available.
        origin: the point that positions are relative to; None if it is 0.
    """

    title: str
    names: Names
    blend: Blend
    times: np.ndarray
    shots: Shots | None
    origin: np.ndarray | None

    def viewable(self, film: Film, editing: Editing | None = None) -> Viewable:
        """A film to view. Gaussians that change come first; each frame is computed when it is shown."""
        times = np.asarray(film[0].trajectory.times)
        moves = np.concatenate([_moves(layer) for layer in film])
        order = np.argsort(~moves, kind="stable")
        labels, names = _labels(film, self.names)
        at = frames_of(film, self.blend, order)
        return Viewable(
            self.title,
            at(0),
            labels[order],
            names,
            motion=Motion(len(times), int(moves.sum()), at),
            times=times,
            shots=None if self.shots is None else _at_times(self.shots, self.times, times - times[0]),
            unit="m",
            origin=self.origin,
            editing=editing,
        )


def editing_of(saved: PartsRun, filmed: Filmed) -> Editing:
    """What the viewer needs for editing a run: the operations, parts and cameras, a preview, and saving."""
    cameras = camera_names(saved.recording)
    first = saved.camera(None)
    known = {"background": BACKGROUND, **saved.names}
    called = {BACKGROUND: "background"} | {part: name for name, part in saved.names.items()}
    ordered = sorted(called, key=lambda part: (part == BACKGROUND, part))
    parts = {f"{called[part]} ({part})": _word_for(part, called[part], known) for part in ordered}

    def preview(lines: Sequence[str]) -> Preview:
        film, doubts = edited(script_of(lines), saved)
        return Preview(filmed.viewable(film), doubts)

    def save(lines: Sequence[str], name: str, camera: str, goes_on: Callable[[int, int], bool]) -> Path:
        script = script_of(lines)
        film, doubts = edited(script, saved)
        folder, notes = new_folder(saved.path / "edit", name), Notes(Console(quiet=True))
        for doubt in doubts:
            notes.warn(doubt)

        def watch(frames: Iterable[Shot], asked: int) -> Iterator[Shot]:
            for done, frame in enumerate(frames, 1):
                yield frame
                if not goes_on(done, asked):
                    raise KeyboardInterrupt

        write_film(folder, script, film, saved, cameras[camera], notes, watch=watch)
        return folder

    return Editing(
        operations={operation: describe_operation(operation) for operation in OPERATIONS},
        parts=parts | {ALL: ALL},
        cameras=tuple(sorted(cameras, key=lambda name: cameras[name] != first)),
        begin=example_line,
        preview=preview,
        save=save,
    )


def script_of(lines: Sequence[str]) -> Script:
    """The edits that lines describe.

    Raises:
        ValueError: a line is invalid; the message gives its number.
    """
    return Script(edits=tuple(parse_op(line, number) for number, line in enumerate(lines, 1)))


def camera_names(recording: Recording) -> dict[str, int]:
    """Ids of the cameras of a recording, by name."""
    held_out = recording.held_out
    return {f"camera {c}" + (" (held out)" if c in held_out else ""): c for c in recording.judged.camera_ids}


def _word_for(part: int, name: str, known: Names) -> str:
    """The name of a part in a line of edits; its number, if a line would read the name as something else."""
    if name == ALL or known[name] != part:
        return str(part)
    try:
        return name if parse_op(f"freeze:parts={name}").parts == (name,) else str(part)
    except ValueError:
        return str(part)


def _moves(layer: Layer) -> Bool[np.ndarray, "n"]:
    """The Gaussians of a layer that change over time."""
    trajectory, parts = layer.trajectory, layer.scene.num_parts
    changes = np.zeros(parts, bool)
    for leaf in map(np.asarray, jax.tree.leaves((trajectory.poses, trajectory.opacities, trajectory.scales))):
        changes |= (leaf != leaf[:1]).reshape(len(leaf), parts, -1).any(axis=(0, 2))
    return np.any(np.asarray(layer.scene.weights)[:, changes], axis=1)


def _labels(film: Film, names: Names) -> tuple[Int[np.ndarray, "n"], dict[int, str]]:
    """Labels of all Gaussians of a film, and their names; parts of other runs follow those of this run."""
    known: dict[int, Any] = {part: name for name, part in names.items()}  # true names come last
    labels, behind = [], film[0].scene.num_parts
    for layer in film:
        own, first = layer.scene.num_parts, 0
        if not np.array_equal(layer.scene.centers, film[0].scene.centers):  # a layer of another run
            first, behind = behind, behind + own
            known |= {first + part: f"part {part} of another run" for part in range(own)}
        labels.append(first + np.asarray(layer.scene.labels))
    return np.concatenate(labels), known


def _at_times(shots: Shots, recorded: np.ndarray, times: np.ndarray) -> Shots:
    """The photographs nearest in time to `times`."""
    rows = np.interp(times, recorded, np.arange(len(recorded))).round().astype(int)
    load = shots.load_image
    return Shots(
        shots.names,
        shots.viewmats[rows],
        shots.Ks[rows],
        shots.sizes,
        None if load is None else lambda t, v: load(int(rows[t]), v),
        shots.near,
    )
