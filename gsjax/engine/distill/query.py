"""`gsjax query` on a field: the Gaussians that match a text, a picture or a point, and what is done with
them. `select` is the one query, of the command as of the viewer."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from rich.console import Console

from gsjax.data.photographs import Photographs
from gsjax.engine.distill.pictures import draw
from gsjax.engine.distill.saved import FieldRun, short_names
from gsjax.engine.folder import OF_QUERY, replaced_folder
from gsjax.engine.messages import Notes
from gsjax.engine.selected import Changes, write_scenes, write_selection
from gsjax.io.atomic import write_json
from gsjax.methods.distill import (
    Threshold,
    frozen_views,
    pixel_features,
    threshold_for,
)
from gsjax.rasterize.frozen import strip_of

_LEAST_ALPHA = 0.5  # share of a pixel's light that the scene must send


@dataclass(frozen=True)
class Question:
    """A query of a field: one of text, image and point, and how it is scored.

    Attributes:
        text: "red can".
        image: a picture of the thing; where it has an alpha channel, only what is opaque.
        point: x, y in pixels of the photographs as the field learned from them.
        camera: short name of the photograph that the point is in, and of the only mask to draw.
        negatives: texts to compare with (default: those of the source).
        threshold: score above which a Gaussian is selected (default: by a rule).
    """

    text: str | None = None
    image: Path | None = None
    point: tuple[float, float] | None = None
    camera: str | None = None
    negatives: tuple[str, ...] | None = None
    threshold: float | None = None

    @property
    def words(self) -> str:
        """The query in short."""
        if self.point is not None:
            return f"what is at {self.point[0]:g},{self.point[1]:g} of {self.camera}"
        return repr(self.text) if self.image is None else f"what {self.image.name} shows"


@dataclass(frozen=True, eq=False)
class Selection:
    """The result of a query.

    Attributes:
        scores: of all Gaussians.
        threshold: score above which they are selected.
        against: the negatives.
        seconds: time that it took to score all Gaussians.
        meant: the class that a point shows; None for other queries, and without classes.
    """

    scores: Float[np.ndarray, "n"]
    threshold: Threshold
    against: tuple[str, ...]
    seconds: float
    meant: str | None = None

    @property
    def selected(self) -> Bool[np.ndarray, "n"]:
        """The Gaussians that score above the threshold."""
        return self.scores > self.threshold.value


def answer(
    run: FieldRun, question: Question, changes: Changes, folder: Path, notes: Notes, console: Console
) -> dict[str, Any]:
    """Query a field, and write the result into a folder; returns the content of query.json.

        query/
          query.json          the query, the rule of its threshold, how many Gaussians, where and how large
          selection.npz       indices [n], rows of the scene's PLY file; their scores [n] and means [n,3]; and
                              all_scores, one for each row of the file, NaN for one that cannot be drawn
          object.ply          what was found; without.ply the scene without it, recolored.ply with it in
                              another colour, moved.ply with it elsewhere
          masks/CAMERA.png    255 where it shows
          overview.png        it in a photograph, the scores with their scale, and these scenes

    Args:
        run: the field and its scene.
        question: the query.
        changes: what is done with the selected Gaussians.
        folder: for the result, which replaces an earlier one once it is complete.
        notes: receives warnings.
        console: shows the progress.

    Raises:
        ValueError: the query cannot be answered, or selects nothing of the scene.
        FileExistsError: the folder holds something else than a result of a query.
    """
    chosen = _chosen(run, question)
    found = select(run, question)
    selected, count = found.selected, int(found.selected.sum())
    if count == 0:
        best = float(found.scores.max())
        raise ValueError(
            f"{question.words} means nothing of this scene: the best score is {best:.3f}, and "
            f"{found.threshold.value:.3f} is asked for ({found.threshold.rule}); try a lower --threshold"
        )
    if count == len(selected):
        notes.warn(
            f"{question.words} means all {count} Gaussians; a higher --threshold would select some of them"
        )
    scenes = changes.of(run.gaussians, selected)
    with replaced_folder(folder, OF_QUERY) as new:
        rows = (run.rows, run.num_rows)
        write_selection(new / "selection.npz", run.gaussians, selected, found.scores, *rows)
        write_scenes(new, run.gaussians, selected, scenes, run.labels)
        pixels: dict[str, int] = {}
        if chosen:
            at = found.threshold.value
            pixels = draw(new, run, chosen, selected, found.scores, at, scenes, notes, console)
        means = np.asarray(run.gaussians.means)[selected]
        told = {
            "text": question.text,
            "image": None if question.image is None else str(question.image),
            "point": question.point,
            "camera": question.camera,
            "meant": found.meant,
            "features": run.stored.source.kind,
            "scene": str(run.file),
            "against": found.against,
            "threshold": found.threshold.value,
            "rule": found.threshold.rule,
            "gaussians": count,
            "of": len(selected),
            "best_score": float(found.scores.max()),
            "center": means.mean(axis=0),
            "size": np.ptp(means, axis=0),
            "query_seconds": found.seconds,
            "pixels": pixels,
            "notes": notes.all,
        }
        write_json(new / "query.json", told)
    return told


def select(run: FieldRun, question: Question) -> Selection:
    """Score all Gaussians.

    Raises:
        ValueError: the query cannot be answered.
    """
    vectors, against, least, meant = _vectors(run, question)
    scores, seconds = timed_scores(lambda: run.stored.scores(vectors))
    given = question.threshold
    if given is None and least is not None and len(vectors) == 1:
        threshold = Threshold(float(least), "the encoder's own")
    else:
        threshold = threshold_for(scores, len(vectors) > 1, given)
    return Selection(scores, threshold, against, seconds, meant)


def timed_scores(score: Callable[[], Float[Array, "n"]]) -> tuple[Float[np.ndarray, "n"], float]:
    """Scores, and the seconds that they took without compiling.

    Args:
        score: computes them.
    """
    jax.block_until_ready(score())  # compiles
    begun = perf_counter()
    return np.asarray(score()), perf_counter() - begun


def _vectors(
    run: FieldRun, question: Question
) -> tuple[np.ndarray, tuple[str, ...], float | None, str | None]:
    """The vector of the query and those of negatives, the negatives, the encoder's own threshold, and the
    class that a point shows."""
    stored, source, text, least = run.stored, run.stored.source, question.text, None
    if text is not None:
        least = run.encoder.min_score if source.kind == "closed" else None
        return *stored.text_vectors(text, question.negatives, run.encoder), least, None
    if question.image is not None:
        if source.kind == "classes":
            raise ValueError(
                "--image: classes are known by name, not by sight; ask by text or --point, or distil "
                "with --features closed or clip"
            )
        vector = _of_image(run, question.image)
    else:
        vector = _at_point(run, question)
        if source.kind == "classes":  # the point means the class that it is nearest to
            names = list(source.names.values())
            codes = np.stack([run.encoder.embed_text(name) for name in names])
            name = names[int((codes @ vector).argmax())]
            return *stored.text_vectors(name, question.negatives, run.encoder), None, name
    against = question.negatives or ()
    return np.stack([vector, *(run.encoder.embed_text(text) for text in against)]), against, None, None


def _of_image(run: FieldRun, path: Path) -> np.ndarray:
    """The vector of a picture."""
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise ValueError(
            f"--image {path}: expected a picture, found {'another file' if path.exists() else 'nothing'}"
        )
    if picture.ndim == 2:
        picture = np.repeat(picture[..., None], 3, axis=2)
    opaque = picture[..., 3] > 127 if picture.shape[2] == 4 else np.ones(picture.shape[:2], bool)
    if not opaque.any():
        raise ValueError(f"--image {path}: expected something opaque in it, found nothing")
    label = max(run.stored.source.names, default=0) + 1  # one without a name, which is known by sight
    image, labels = np.ascontiguousarray(picture[..., 2::-1]), np.where(opaque, label, 0).astype(np.int32)
    return np.asarray(run.encoder.embed_objects(image, labels, label))[-1]


def _at_point(run: FieldRun, question: Question) -> np.ndarray:
    """The field's feature at a pixel, in the teacher's channels."""
    photographs = run.photographs
    assert question.point is not None
    assert question.camera is not None
    assert photographs is not None
    v = _number(photographs, question.camera)
    width, height = (int(side) for side in photographs.sizes[v])
    x, y = question.point
    if not (0 <= x < width and 0 <= y < height):
        raise ValueError(f"--point: expected one in {width}x{height} pixels, found {x:g},{y:g}")
    field, located = run.stored.placed
    view, plan = frozen_views(run.gaussians, [photographs.camera(v)], run.rasterize_mode)[0]
    row, below = divmod(int(y), plan.tile_size)
    strip, strip_plan = strip_of(view, plan, row, 1)  # all that has to be drawn for one pixel
    pixel = jnp.array([[int(x), below]])
    features, alphas = jax.jit(pixel_features)(field, located, strip, strip_plan, pixel)
    if float(alphas[0]) < _LEAST_ALPHA:
        raise ValueError(f"--point {x:g},{y:g}: expected something of the scene, found nothing there")
    return np.asarray(features[0])


def _chosen(run: FieldRun, question: Question) -> list[int]:
    """Indices of the photographs to draw a mask for.

    Raises:
        ValueError: the query names one that is not there.
    """
    if run.photographs is None:
        if question.camera is not None:
            raise ValueError(
                "--camera: expected photographs, found none (see the warning); --images says where they are"
            )
        return []
    number = None if question.camera is None else _number(run.photographs, question.camera)
    everywhere = number is None or question.point is not None
    return list(range(run.photographs.num)) if everywhere else [number]


def _number(photographs: Photographs, camera: str) -> int:
    """The index of a photograph by its name, in short or in full.

    Raises:
        ValueError: there is none of that name.
    """
    names = short_names(photographs.names)
    for known in (names, photographs.names):
        if camera in known:
            return known.index(camera)
    listed = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
    raise ValueError(f"--camera: expected one of {listed}, found {camera}")
