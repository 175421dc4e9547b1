"""Queries of Gaussians, for `gsjax query` and for the viewer: the question, the Gaussians that match it, and
the files written about them. Each kind of run, a field or a deforming scene, is a `Queryable`, which defines
how it is queried and drawn."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from rich.console import Console

from gsjax.engine.files import write_scene
from gsjax.engine.folder import OF_QUERY, replaced_folder
from gsjax.engine.messages import Notes
from gsjax.io.atomic import write_json, write_npz
from gsjax.io.pictures import write_png
from gsjax.methods.query import Prompt, Threshold
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.origin import in_world
from gsjax.scene.selection import only, shifted, tinted

SCENE_CAPTIONS = {"recolored": "recoloured", "moved": "moved"}
"""Captions of the scenes of `Question.changed`, by the names of their files."""
_HIGHEST = 1.0  # highest score: a cosine is from -1 to 1, a share against others from 0 to 1


@dataclass(frozen=True)
class Question:
    """A query: a text, image, point or box, how it is scored, and how the matches are changed. Without any of
    the four, everything is labelled if the features have names.

    Attributes:
        text: "red can".
        image: a picture of the thing; with an alpha channel, only its opaque part.
        point: x, y in pixels of a photograph or frame, at the size used in training.
        box: x0, y0, x1, y1, likewise.
        camera: short name of the photograph of the point, and of the only mask to draw.
        frame: frame number, in the recording, of point and box; its Gaussians are written (default: the
            first).
        frames: frames to draw, as a Python slice (default: the held-out ones).
        level: level of a field's features (default: that which fits best; for a point, the smallest).
        within: a text that restricts the search to what it finds: "handle" within "drawer".
        threshold: score above which a Gaussian is selected (default: by a rule).
        top: number of Gaussians to select, those with the best scores, instead of a threshold.
        negatives: texts to compare with (default: the encoder's own).
        color: RGB, 0 to 1, of the matches in recolored.ply.
        move: shift of the matches in moved.ply, in the scene's unit; None writes no such file.
        pictures: whether the matches are drawn.

    Raises:
        ValueError: no score can be above the threshold, or every score is; `top` is less than 1, or given
            together with a threshold; a colour or a shift is out of range.
    """

    text: str | None = None
    image: Path | None = None
    point: tuple[float, float] | None = None
    box: tuple[float, float, float, float] | None = None
    camera: str | None = None
    frame: int | None = None
    frames: str | None = None
    level: str | None = None
    within: str | None = None
    threshold: float | None = None
    top: int | None = None
    negatives: tuple[str, ...] | None = None
    color: tuple[float, float, float] = (1.0, 0.25, 0.6)
    move: tuple[float, float, float] | None = None
    pictures: bool = True

    def __post_init__(self):
        if self.threshold is not None and not -math.inf < self.threshold < _HIGHEST:
            raise ValueError(
                f"--threshold: expected a finite number below {_HIGHEST:g}, the highest possible score, "
                f"found {self.threshold:g}"
            )
        if self.top is not None and (self.top < 1 or self.threshold is not None):
            found = "--threshold too" if self.top >= 1 else self.top
            raise ValueError(f"--top: expected 1 Gaussian or more, and no --threshold, found {found}")
        if any(not 0 <= value <= 1 for value in self.color):
            raise ValueError(f"--color: expected three numbers from 0 to 1, found {_spaced(self.color)}")
        if self.move is not None and not all(map(math.isfinite, self.move)):
            raise ValueError(f"--move: expected three finite numbers, found {_spaced(self.move)}")

    @property
    def words(self) -> str:
        """A short description of the query, for messages."""
        return self._what if self.within is None else f"{self._what} within {self.within!r}"

    @property
    def _what(self) -> str:
        if self.point is not None:
            camera = "" if self.camera is None else f" of {self.camera}"
            return f"what is at {self.point[0]:g},{self.point[1]:g}{camera}"
        if self.box is not None:
            return "what is in {:g},{:g} to {:g},{:g}".format(*self.box)
        return repr(self.text) if self.image is None else f"what {self.image.name} shows"

    def changed(self, gaussians: Gaussians, selected: Bool[np.ndarray, "n"]) -> dict[str, Gaussians]:
        """Scenes with the selected Gaussians changed, by the names of their files."""
        there = jnp.asarray(selected)
        scenes = {"recolored": jax.jit(tinted)(gaussians, there, jnp.asarray(self.color))}
        if self.move is not None:
            scenes["moved"] = jax.jit(shifted)(gaussians, there, jnp.asarray(self.move))
        return scenes


@dataclass(frozen=True, eq=False)
class Selection:
    """The result of a query.

    Attributes:
        question: the query.
        frame: index of the frame whose Gaussians were scored.
        prompt: of the query.
        scores: of all Gaussians.
        threshold: score above which they are selected, within `place`.
        selected: whether each Gaussian is.
        best: the highest score, within `place`.
        seconds: time that it took to score all Gaussians.
        place: the selection that they must lie within; None for anywhere.
    """

    question: Question
    frame: int
    prompt: Prompt
    scores: Float[np.ndarray, "n"]
    threshold: Threshold
    selected: Bool[np.ndarray, "n"]
    best: float
    seconds: float
    place: "Selection | None" = None


@dataclass(eq=False)
class Queryable(ABC):
    """A run whose Gaussians can be queried.

    Attributes:
        path: folder of the run, or of the field.
        kind: the encoder of its features.
        hint: what can be asked for, in words.
        rows: row of each Gaussian in the scene's file.
        num_rows: number of rows in that file, including Gaussians that cannot be drawn.
        labels: label of each Gaussian; None without.
        origin: the origin of positions, if the scene lies far from 0.
        antialiased: whether the scene is drawn antialiased.
        frame_ids: numbers of the frames; None for a static scene.
        levels: levels of its features; empty if there is only one.
    """

    path: Path
    kind: str
    hint: str
    rows: Int[np.ndarray, "n"]
    num_rows: int
    labels: Int[np.ndarray, "n"] | None = None
    origin: Float[np.ndarray, "3"] | None = None
    antialiased: bool = False
    frame_ids: tuple[int, ...] | None = None
    levels: tuple[str, ...] = ()

    @abstractmethod
    def frame_of(self, question: Question) -> int:
        """The index of the frame in question, after checking that all the question names exists.

        Raises:
            ValueError: something does not exist.
        """

    @abstractmethod
    def at(self, frame: int) -> Gaussians:
        """The scene in a frame."""

    def refresh(self) -> None:  # noqa: B027
        """Read the features again if they may have improved meanwhile, as while a field is being trained.
        Does nothing by default."""

    @abstractmethod
    def prompt(self, question: Question, frame: int) -> Prompt:
        """The prompt of a question.

        Raises:
            ValueError: the question cannot be answered.
            FileNotFoundError: weights of the encoder do not exist.
        """

    @abstractmethod
    def like(self, row: int, frame: int, level: str | None) -> Prompt:
        """The prompt for what is similar to a Gaussian.

        Args:
            row: index of the Gaussian.
            frame: index of the frame.
            level: of its features (default: the smallest).
        """

    @abstractmethod
    def scorer(self, prompt: Prompt, frame: int) -> Callable[[], Float[Array, "n"]]:
        """A function that scores all Gaussians."""

    @abstractmethod
    def about(self, question: Question, frame: int) -> dict[str, Any]:
        """Entries of query.json that this kind of run adds to those of `answer`."""

    @abstractmethod
    def draw(self, folder: Path, found: Selection, notes: Notes, console: Console) -> dict[str, int] | None:
        """Write pictures of a selection, if wanted; returns the number of pixels in each mask, if any.

        Args:
            folder: for the pictures.
            found: the result of a query.
            notes: receives warnings.
            console: shows the progress.
        """


def select(run: Queryable, question: Question, frame: int, prompt: Prompt | None = None) -> Selection:
    """Score all Gaussians of a run.

    Args:
        run: the run.
        question: the query.
        frame: index of the frame.
        prompt: of the query (default: that of the question).

    Raises:
        ValueError, FileNotFoundError: as for `Queryable.prompt`; or nothing is found to search within.
    """
    prompt = run.prompt(question, frame) if prompt is None else prompt
    score = run.scorer(prompt, frame)
    jax.block_until_ready(score())  # compiles
    begun = perf_counter()
    scores, seconds = np.asarray(score()), perf_counter() - begun
    inside = np.isfinite(scores)
    place = None if question.within is None else _place(run, question, frame)
    if place is not None:
        inside &= place.selected
    if question.top is None:
        threshold = prompt.threshold(scores[inside], question.threshold)
        selected = inside & (scores > threshold.value)
    else:
        best = np.argsort(np.where(inside, -scores, np.inf), kind="stable")[: min(question.top, inside.sum())]
        selected = np.zeros(len(scores), bool)
        selected[best] = True
        threshold = Threshold(float(scores[best].min(initial=np.inf)), f"the {question.top} best")
    highest = float(scores[inside].max(initial=-np.inf))
    return Selection(question, frame, prompt, scores, threshold, selected, highest, seconds, place)


def _place(run: Queryable, question: Question, frame: int) -> Selection:
    """The selection to answer a question within, on the level that fits it best."""
    place = select(run, Question(text=question.within, negatives=question.negatives), frame)
    if not place.selected.any():
        raise ValueError(f"--within {question.within!r}: expected something to look within, found none of it")
    return place


def answer(
    run: Queryable, question: Question, folder: Path, notes: Notes, console: Console
) -> dict[str, Any]:
    """Query a run, and write the result into a folder; returns the content of query.json.

        query/
          query.json          the query, the rule of its threshold, how many Gaussians, where and how large
          selection.npz       indices [n], rows of the scene's PLY file; their scores [n] and means [n,3]; and
                              all_scores, one for each row of the file, NaN for one that cannot be drawn
          object.ply          what was found; without.ply the scene without it, recolored.ply with it in
                              another colour, moved.ply with it elsewhere
          masks/, ...         pictures (`Queryable.draw`)

    Args:
        run: the run or field.
        question: the query.
        folder: for the result, which replaces an earlier one once it is complete.
        notes: receives warnings.
        console: shows the progress.

    Raises:
        ValueError: the query cannot be answered, or selects nothing of the scene.
        FileExistsError: the folder holds something other than the result of a query.
    """
    frame = run.frame_of(question)
    gaussians = run.at(frame)
    found = select(run, question, frame)
    selected = found.selected
    _check_count(run, found, notes)
    with replaced_folder(folder, OF_QUERY) as new:
        _write_selection(new / "selection.npz", run, gaussians, found)
        for name, kept in (("object", selected), ("without", ~selected)):
            if kept.any():
                write_part(new / f"{name}.ply", run, gaussians, kept)
        for name, scene in question.changed(gaussians, selected).items():
            write_part(new / f"{name}.ply", run, scene)
        pixels = run.draw(new, found, notes, console)
        means = in_world(np.asarray(gaussians.means)[selected], run.origin)
        info = {
            "text": question.text,
            "point": question.point,
            "within": question.within,
            "top": question.top,
            "features": run.kind,
            **run.about(question, frame),
            "level": found.prompt.level,
            "within_level": None if found.place is None else found.place.prompt.level,
            "meant": found.prompt.name,
            "against": found.prompt.negatives,
            "threshold": found.threshold.value,
            "rule": found.threshold.rule,
            "gaussians": len(means),
            "of": len(selected),
            "best_score": found.best,
            "center": means.mean(axis=0),
            "frame": None if run.frame_ids is None else int(run.frame_ids[frame]),
            "at_last": None if run.frame_ids is None else _at_last(run, selected),
            "size": np.ptp(means, axis=0),
            "query_seconds": found.seconds,
            "pixels": pixels,
            "notes": notes.all,
        }
        write_json(new / "query.json", info)
    return info


def _at_last(run: Queryable, selected: Bool[np.ndarray, "n"]) -> dict[str, Any]:
    """The number of the last frame, and the middle of the selected Gaussians in it."""
    assert run.frame_ids is not None
    means = np.asarray(run.at(len(run.frame_ids) - 1).means)[selected]
    return {"frame": int(run.frame_ids[-1]), "center": in_world(means, run.origin).mean(axis=0)}


def write_mask(folder: Path, name: str, mask: Bool[np.ndarray, "h w"]) -> int:
    """Writes masks/NAME.png, 255 where something shows; returns the number of these pixels.

    Args:
        folder: of the query.
        name: of the camera or the frame.
        mask: where it shows.
    """
    write_png(folder / "masks" / f"{name}.png", np.where(mask, 255, 0).astype(np.uint8))
    return int(mask.sum())


def _check_count(run: Queryable, found: Selection, notes: Notes) -> None:
    """Raises ValueError if nothing is selected, and warns if everything is."""
    selected, threshold, words = found.selected, found.threshold, found.question.words
    if not selected.any() and not math.isfinite(threshold.value):
        raise ValueError(
            f"{words} fits all Gaussians alike, with a score of {found.best:.3f}, so none can be "
            "told from the others; take --threshold, --top or --negatives"
        )
    if not selected.any():
        where = "" if run.frame_ids is None else f" in frame {run.frame_ids[found.frame]}"
        within = "" if found.place is None else "there "
        raise ValueError(
            f"{words} matches nothing in this scene{where}: the best score {within}is {found.best:.3f}, and "
            f"more than {threshold.value:.5g} is required ({threshold.rule}); try a lower --threshold"
        )
    if selected.all():
        notes.warn(
            f"{words} means all {len(selected)} Gaussians; a higher --threshold would select some of them"
        )


def _write_selection(path: Path, run: Queryable, gaussians: Gaussians, found: Selection) -> None:
    """Writes selection.npz, by rows of the scene's file."""
    selected, scores = found.selected, found.scores.astype(np.float32)
    all_scores = np.full(run.num_rows, np.nan, np.float32)
    all_scores[run.rows] = scores
    means = in_world(np.asarray(gaussians.means)[selected], run.origin)
    arrays = {"indices": run.rows[selected], "scores": scores[selected], "means": means}
    write_npz(path, arrays | {"all_scores": all_scores})


def write_part(
    path: Path, run: Queryable, gaussians: Gaussians, kept: Bool[np.ndarray, "n"] | None = None
) -> None:
    """Writes Gaussians as a PLY file, with their labels where there are any.

    Args:
        path: the file.
        run: of the Gaussians.
        gaussians: all of them.
        kept: which are written (default: all).
    """
    labels = run.labels
    if kept is not None:
        gaussians, labels = only(gaussians, kept), None if labels is None else labels[kept]
    write_scene(path, gaussians, labels, origin=run.origin, antialiased=run.antialiased)


def _spaced(numbers: tuple[float, ...]) -> str:
    return " ".join(f"{number:g}" for number in numbers)
