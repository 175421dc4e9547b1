"""`gsjax query` on a run of `gsjax deform`: the Gaussians that a text, a point or a box means, or what all of
them are, at every time."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from rich.console import Console

from gsjax.engine.deform.pictures import draw, draw_labels, probabilities_of
from gsjax.engine.folder import OF_QUERY, replaced_folder
from gsjax.engine.messages import Notes
from gsjax.engine.recording import parse_frames
from gsjax.engine.selected import Changes, write_scenes, write_selection
from gsjax.io.atomic import write_json, write_npz
from gsjax.io.ply import write_ply
from gsjax.methods.deform import DeformResult, Prompt, feature_prompt, text_prompt
from gsjax.methods.deform.query import most_likely, region_feature
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import render_with_room
from gsjax.viz.colors import INVALID, label_color
from gsjax.viz.viewer.drawing import recolored


@dataclass(frozen=True)
class DeformQuestion:
    """A query of a deforming scene: one of text, point and box; without any, what everything is.

    Attributes:
        text: one of the scene's names, or a text for the encoder of its features.
        point: x, y in pixels of a frame, as the scene was learned.
        box: x0, y0, x1, y1, likewise.
        frame: the recording's number of the frame in which point and box lie, and whose Gaussians are written
            (default: the first).
        frames: those that pictures are made of, as a Python slice (default: the held-out ones).
        threshold: of the score (default: by a rule).
        negatives: texts that a text is held against, where an encoder reads it (default: the encoder's own).
        weights: folder of CLIP's, where they are now.
    """

    text: str | None = None
    point: tuple[float, float] | None = None
    box: tuple[float, float, float, float] | None = None
    frame: int | None = None
    frames: str | None = None
    threshold: float | None = None
    negatives: tuple[str, ...] | None = None
    weights: Path | None = None

    @property
    def region(self) -> tuple[float, float, float, float] | None:
        """The box; a point is one without extent."""
        return self.box if self.point is None else self.point * 2

    @property
    def words(self) -> str:
        """The query in short."""
        if self.point is not None:
            return "what is at {:g},{:g}".format(*self.point)
        if self.box is not None:
            return "what is in {:g},{:g} to {:g},{:g}".format(*self.box)
        return "what is what" if self.text is None else repr(self.text)


def answer_deformation(
    path: Path,
    result: DeformResult,
    question: DeformQuestion,
    changes: Changes,
    folder: Path,
    notes: Notes,
    console: Console,
) -> dict[str, Any]:
    """Answer a query and write what is found into a folder; returns the content of query.json.

        query/
          query.json          the query; the Gaussians that are meant: count, place, size; pixels by frame
          selection.npz       as a field's, of the frame in question (rows of the run's scene.ply)
          object.ply          what was found, in that frame; without.ply the scene without it, recolored.ply
                              with it in another colour, moved.ply with it elsewhere
          masks/FRAME.png     255 where a pixel's own features mean it
          frames/FRAME.png    the scene, what was found alone, the scene without it, recoloured, perhaps moved
          video.mp4           the scene and the scene without it, in all frames

    Without a prompt: selection.npz has labels [N] and probabilities [N,k], recolored.ply the Gaussians in the
    colours of their labels, masks/FRAME.png are label maps, and the film has these over it. Label 1 is the
    first of the names; 0 is nothing.

    Args:
        path: of the run.
        result: its scene.
        question, changes, folder, notes, console: as for a field's `answer`.

    Raises:
        ValueError: the question cannot be understood, or means nothing of the scene.
        FileExistsError: something is in the folder that is no answer.
    """
    t = _frame(result, question.frame)
    shown = sorted({t, *_pictured(result, question)})
    there = result.at(result.timeline.times[t])
    if result.meaning is None or there.features is None:
        raise ValueError(
            f"{path}: expected a scene that knows what is what in it, found none with features: there "
            "was one class among the pixels that counted; reconstruct it with --tools draw, or with "
            "--features"
        )
    about = {
        "text": question.text,
        "point": question.point,
        "box": question.box,
        "features": result.meaning.source.kind,
        "names": result.names,
        "frame": int(result.timeline.frame_ids[t]),
        "of": there.num,
    }
    if question.text is None and question.region is None:
        codebook = jnp.asarray(result.meaning.codebook, jnp.float32)
        likely, about["query_seconds"] = _timed(lambda: probabilities_of(there.features, codebook))
        with replaced_folder(folder, OF_QUERY) as new:
            found = _write_labels(new, result, there, likely)
            answer = about | found | {"shares": draw_labels(new, result, shown, console), "notes": notes.all}
            write_json(new / "query.json", answer)
        return answer
    prompt = prompt_of(result, question, t, there)
    scores, about["query_seconds"] = _timed(lambda: prompt.scores(there.features))
    threshold = prompt.threshold(scores, question.threshold)
    selected = scores > threshold.value
    _check_count(question, selected, scores, threshold.value, about["frame"], notes)
    with replaced_folder(folder, OF_QUERY) as new:
        every, scenes = np.arange(there.num), changes.of(there, selected)
        write_selection(new / "selection.npz", there, selected, scores, every, there.num)
        write_scenes(new, there, selected, scenes)
        pixels = draw(new, result, shown, prompt, threshold.value, changes, console)
        means = np.asarray(there.means)[selected]
        answer = about | {
            "meant": prompt.name,
            "against": prompt.negatives,
            "threshold": threshold.value,
            "rule": threshold.rule,
            "gaussians": int(selected.sum()),
            "best_score": float(scores.max()),
            "center": means.mean(axis=0),
            "size": np.ptp(means, axis=0),
            "pixels": pixels,
            "notes": notes.all,
        }
        write_json(new / "query.json", answer)
    return answer


def _timed(score: Callable[[], Float[jax.Array, "*n"]]) -> tuple[Float[np.ndarray, "*n"], float]:
    """Scores, and the seconds that they took, without compiling."""
    jax.block_until_ready(score())
    begun = perf_counter()
    return np.asarray(score()), perf_counter() - begun


def _check_count(
    question: DeformQuestion,
    selected: Bool[np.ndarray, "n"],
    scores: Float[np.ndarray, "n"],
    threshold: float,
    frame: int,
    notes: Notes,
) -> None:
    """Raises a ValueError where nothing is meant, and warns where everything is."""
    if not selected.any():
        raise ValueError(
            f"{question.words} means nothing of this scene in frame {frame}: the best score is "
            f"{scores.max():.3f}, and more than {threshold:g} is asked for; try a lower --threshold"
        )
    if selected.all():
        words = f"{question.words} means all {len(selected)} Gaussians"
        notes.warn(f"{words}; a higher --threshold would tell them apart")


def _write_labels(
    folder: Path, result: DeformResult, there: Gaussians, likely: Float[np.ndarray, "n k"]
) -> dict[str, Any]:
    """Writes what all Gaussians most likely are; returns the number of each name, and its colour in
    recolored.ply."""
    labels = 1 + most_likely(likely)
    write_npz(folder / "selection.npz", {"labels": labels, "probabilities": likely, "names": result.names})
    colors = {name: label_color(label) for label, name in enumerate(result.names, 1)}
    shades = np.array([INVALID, *colors.values()], np.float32) / 255
    write_ply(folder / "recolored.ply", recolored(there, shades[labels]), labels=labels)
    counts = {name: int((labels == label).sum()) for label, name in enumerate(result.names, 1)}
    return {"classes": counts, "colors": colors}


def prompt_of(result: DeformResult, question: DeformQuestion, t: int, there: Gaussians) -> Prompt:
    """A text, a point or a box in the scene's channels.

    Args:
        result: of a run.
        question: the query.
        t: index of the frame in question.
        there: the scene at that frame.

    Raises:
        ValueError: the text cannot be read, or nothing of the scene lies there.
        FileNotFoundError: weights are not there.
    """
    assert result.meaning is not None
    if question.region is None:
        assert question.text is not None
        source = result.meaning.source
        encoder = partial(source.encoder, question.weights)
        return text_prompt(result.meaning, question.text, question.negatives, encoder)
    drawn, _ = render_with_room(there, result.camera(t))
    assert drawn.features is not None
    try:
        feature = region_feature(np.asarray(drawn.features[0]), np.asarray(drawn.alphas[0]), question.region)
    except ValueError as error:
        option = "--point" if question.box is None else "--box"
        raise ValueError(f"{option}: {error} (frame {result.timeline.frame_ids[t]})") from None
    return feature_prompt(result.meaning, feature.astype(np.float64))


def _frame(result: DeformResult, frame: int | None) -> int:
    """The index of a frame.

    Raises:
        ValueError: the run had none of this number.
    """
    known = result.timeline.frame_ids.tolist()
    if frame is None:
        return 0
    if frame not in known:
        raise ValueError(f"--frame: expected one of {known[0]} to {known[-1]}, found {frame}")
    return known.index(frame)


def _pictured(result: DeformResult, question: DeformQuestion) -> list[int]:
    """Indices of the frames that pictures are made of."""
    if question.frames is None:
        return result.timeline.held_out.tolist()
    chosen = list(range(len(result.timeline.times))[parse_frames(question.frames)])
    if not chosen:
        raise ValueError(
            f"--frames: {question.frames} holds no frame of the run, which has {len(result.timeline.times)}"
        )
    return chosen
