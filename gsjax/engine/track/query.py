"""The query of a run of `gsjax track`: the object that a text refers to, and where it is in every frame."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Int
from rich.console import Console
from rich.progress import track
from rich.table import Table
from rich.text import Text

from gsjax.engine.folder import OF_QUERY, replaced_folder
from gsjax.engine.messages import Notes
from gsjax.engine.options import ClipWeights, Common, ObjectText
from gsjax.engine.pictures import frame_rate, spotlight
from gsjax.engine.query import write_mask
from gsjax.engine.recording import Recording
from gsjax.engine.track.saved import SavedRun, open_run
from gsjax.engine.track.views import views
from gsjax.engine.views import View
from gsjax.io.atomic import write_json, write_npz
from gsjax.io.video import VideoWriter
from gsjax.methods.protocols import LanguageEncoder
from gsjax.methods.track import find_object
from gsjax.perception.closed_vocabulary import ClosedVocabulary
from gsjax.scene.origin import in_world
from gsjax.viz.colors import label_color, to_uint8

_CLOSE = 0.02  # a smaller margin is reported as a close call


@dataclass(frozen=True)
class ObjectQuery(Common, ClipWeights, ObjectText):
    """A query of a run for an object, and the encoder that reads it."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder of a run of `gsjax track`."""
    text: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TEXT")]
    """Which object: "red can"."""
    camera: Annotated[int | None, tyro.conf.arg(metavar="ID")] = None
    """Id of the camera to show it from (default: the first held-out one, else the first tracked)."""


class Answer(NamedTuple):
    """The object that a text refers to.

    Attributes:
        group: its label in the run's files, 1 to K.
        name: its name.
        scores: cosine of each object, by name.
        margin: difference between its cosine and the next one.
        min_score: the smallest cosine that counts as a match.
        rows: its Gaussians, as rows of scene.ply.
    """

    group: int
    name: str
    scores: dict[str, float]
    margin: float
    min_score: float
    rows: Int[np.ndarray, "n"]


def answer_query(options: ObjectQuery, console: Console, folder: Path, *, pictures: bool = True) -> None:
    """Answer a query, and write the folder of the answer.

    Args:
        options: the run and the text.
        console: shows the progress.
        folder: for the answer.
        pictures: whether to write the object's masks and a video of it.

    Raises:
        ValueError, OSError: there is no such run or encoder, or no object matches the text.
    """
    with Notes(console) as notes:
        saved, answer = ask(options, console, notes)
        recording = saved.seen_by(options.camera)
        camera = recording.tracked.camera_ids[0]
        means = in_world(saved.tracking.means()[:, answer.rows], saved.recording.tracked.origin)
        with replaced_folder(folder, OF_QUERY) as new:
            write_npz(
                new / "selection.npz",
                {
                    "indices": answer.rows,
                    "scores": np.array(list(answer.scores.values()), np.float32),
                    "names": np.array(list(answer.scores)),
                    "means": means,
                    "times": recording.tracked.times[: saved.tracking.num_frames],
                },
            )
            pixels = _draw(new, saved, recording, answer.group, console) if pictures else None
            found = answer._asdict() | {"label": saved.tracking.scene.label_ids[answer.group]}
            found |= {"text": options.text, "encoder": options.encoder, "camera": camera}
            del found["rows"]  # in selection.npz
            write_json(new / "query.json", found | {"pixels": pixels, "notes": notes.all})
    hidden = sum(count == 0 for count in pixels or ())
    unseen = f"; camera {camera} does not see it in {hidden} of {len(pixels or ())} frames" if hidden else ""
    score = f"cosine {answer.scores[answer.name]:.2f}, and {answer.min_score:.2f} is required"
    print(f"{answer.name}: {len(answer.rows)} Gaussians ({score}){unseen}")
    last = recording.tracked.frame_ids[len(means) - 1]
    for at, frame in ((0, recording.tracked.frame_ids[0]), (-1, last))[: len(means)]:
        print("where   " + ", ".join(f"{x:.3f}" for x in means[at].mean(0)) + f" m in frame {frame}")
    print(f"query   {folder}")


def _draw(folder: Path, saved: SavedRun, recording: Recording, group: int, console: Console) -> list[int]:
    """Write the masks of an object and a video of it; returns the number of pixels of each mask."""
    pixels = []
    with VideoWriter(folder / "video.mp4", frame_rate(recording.tracked.times)) as video:
        for view in progress(views(saved.tracking, recording), saved, console):
            mask = view.groups == group
            frame_id = recording.tracked.frame_ids[view.t]
            pixels.append(write_mask(folder, f"{frame_id:06d}", mask))
            video.write(spotlight(view.image, mask, label_color(group)))
    return pixels


def ask(options: ObjectQuery, console: Console, notes: Notes) -> tuple[SavedRun, Answer]:
    """Open the run and find the object; prints the scores of all.

    Args:
        options: the run and the text.
        console: for the scores.
        notes: for warnings.

    Raises:
        ValueError, OSError: as for `answer_query`.
    """
    _check_encoder(options)
    saved = open_run(options.run)
    saved.seen_by(options.camera)  # these two first, to report a wrong camera or word at once
    encoder = _encoder(options, saved)
    wanted = encoder.embed_text(options.text)
    with console.status("encoding the first frame"):
        view = next(views(saved.tracking, saved.seen_by(saved.mask_camera)))[0]
        objects = encoder.embed_objects(to_uint8(view.image), view.groups, len(saved.names))
    min_score = encoder.min_score if options.min_score is None else options.min_score
    match = find_object(jnp.asarray(wanted, float), jnp.asarray(objects, float), float(min_score))
    scores = dict(zip(saved.names.values(), np.asarray(match.scores).tolist(), strict=True))
    group, margin = int(match.best) + 1, float(match.margin)
    if not match.found:
        listed = ", ".join(f"{name} {score:.2f}" for name, score in _ranked(scores))
        raise ValueError(
            f"{options.text!r} matches none of the objects of {saved.path}: its best cosine is "
            f"{max(scores.values()):.2f}, and {min_score:.2f} is required. The objects are: {listed}"
        )
    if margin < _CLOSE:
        second = _ranked(scores)[1][0]
        notes.warn(f"{second} fits {options.text!r} about as well; say more to distinguish them")
    _print_scores(scores, saved.names[group])
    rows = np.flatnonzero(np.asarray(saved.tracking.scene.labels) == group)
    return saved, Answer(group, saved.names[group], scores, margin, float(min_score), rows)


def progress(frames: Iterator[list[View]], saved: SavedRun, console: Console) -> Iterator[View]:
    """The one view of each frame of a run, with a progress bar on the console.

    Args:
        frames: the views of each frame.
        saved: the run.
        console: shows the bar.
    """
    count = saved.tracking.num_frames
    for frame in track(frames, "rendering", total=count, console=console, transient=True):
        yield frame[0]


def _check_encoder(options: ObjectQuery) -> None:
    if options.encoder == "clip" and options.weights is None:
        raise ValueError(
            "--encoder clip: expected --weights PATH as well, a folder of CLIP's weights, found none"
        )
    if options.encoder == "closed" and options.weights is not None:
        raise ValueError(
            "--weights: expected none with the closed vocabulary; leave it out, or use --encoder clip"
        )


def _encoder(options: ObjectQuery, saved: SavedRun) -> LanguageEncoder:
    if options.encoder == "closed":
        return ClosedVocabulary(saved.names)
    from gsjax.perception.clip import load_clip

    assert options.weights is not None
    return load_clip(options.weights)


def _ranked(scores: dict[str, float]) -> list[tuple[str, float]]:
    return sorted(scores.items(), key=lambda item: -item[1])


def _print_scores(scores: dict[str, float], best: str) -> None:
    table = Table(box=None, padding=(0, 2, 0, 0))
    table.add_column("object")
    table.add_column("cosine", justify="right")
    for name, score in _ranked(scores):
        table.add_row(Text(name), f"{score:.3f}", style="bold green" if name == best else None)
    Console(highlight=False).print(table)
