"""`gsjax query` on a field: the Gaussians that a text, a picture or a point means, and what is done with
them."""

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from rich.console import Console
from rich.progress import track

from gsjax.cli.field_pictures import draw_overview, telling_view
from gsjax.cli.field_run import FieldRun, camera_names
from gsjax.cli.messages import Notes
from gsjax.cli.outputs import write_png
from gsjax.cli.run_folder import fresh_folder
from gsjax.io.atomic import write_npz
from gsjax.io.ply import write_ply
from gsjax.methods.feature_field import (
    Threshold,
    frozen_views,
    gaussian_cosines,
    pixel_features,
    relevancy,
    selection_mask,
    threshold_for,
)
from gsjax.scene.gaussians import take
from gsjax.scene.selection import shifted, tinted, without

_LITTLE = 0.5  # of a pixel's light that the scene must send


@dataclass(frozen=True)
class Question:
    """What is asked of a field: one of text, image and point, and how it is understood.

    Attributes:
        text: "red can".
        image: a picture of the thing; where it has an alpha channel, only what is opaque.
        point: x, y in pixels of the photographs as the field learned from them.
        camera: short name of the photograph that the point is in, and of the only mask to draw.
        negatives: texts that it is held against; the source's own unless given.
        threshold: of the score; by a rule unless given.
        weights: of CLIP, where they are now.
    """

    text: str | None = None
    image: Path | None = None
    point: tuple[float, float] | None = None
    camera: str | None = None
    negatives: tuple[str, ...] | None = None
    threshold: float | None = None
    weights: Path | None = None

    @property
    def words(self) -> str:
        """What was asked, in short."""
        if self.point is not None:
            return f"what is at {self.point[0]:g},{self.point[1]:g} of {self.camera}"
        return repr(self.text) if self.image is None else f"what {self.image.name} shows"


@dataclass(frozen=True, eq=False)
class Selection:
    """The answer.

    Attributes:
        scores: of all Gaussians.
        threshold: from which on they are meant.
        against: what the question was held against.
        seconds: that it took to score all Gaussians.
    """

    scores: Float[np.ndarray, "n"]
    threshold: Threshold
    against: tuple[str, ...]
    seconds: float

    @property
    def selected(self) -> Bool[np.ndarray, "n"]:
        return self.scores > self.threshold.value


def answer(
    run: FieldRun, question: Question, folder: Path, color: Any, move: Any, notes: Notes, console: Console
) -> dict[str, Any]:
    """Ask, and write what is found into a folder; returns what query.json says.

    Args:
        run: the field.
        question: what is asked.
        folder: for it; what an earlier question left there is removed.
        color: RGB, 0 to 1, of the recoloured object.
        move: metres by which it is moved, or None.
        notes: told of what is odd.
        console: shows how far it is.

    Raises:
        ValueError: the question cannot be understood, or means nothing of the scene.
    """
    found = select(run, question)
    selected, count = found.selected, int(found.selected.sum())
    if count == 0:
        best = float(found.scores.max())
        raise ValueError(
            f"{question.words} means nothing of this scene: the best score is {best:.3f}, and "
            f"{found.threshold.value:.3f} is asked for ({found.threshold.rule}); --threshold names another"
        )
    if count == len(selected):
        notes.warn(
            f"{question.words} means all {count} Gaussians; a higher --threshold would tell them apart"
        )
    fresh_folder(folder)  # from here on an earlier answer is gone
    gaussians, there = run.gaussians, jnp.asarray(selected)
    means = np.asarray(gaussians.means)[selected]
    write_npz(
        folder / "selection.npz",
        {
            "indices": np.flatnonzero(selected),
            "scores": found.scores[selected].astype(np.float32),
            "means": means,
            "all_scores": found.scores.astype(np.float32),
        },
    )
    write_ply(folder / "object.ply", take(gaussians, there))
    if count < len(selected):
        write_ply(folder / "without.ply", without(gaussians, there))
    write_ply(folder / "recolored.ply", tinted(gaussians, there, jnp.asarray(color)))
    if move is not None:
        write_ply(folder / "moved.ply", shifted(gaussians, there, jnp.asarray(move)))
    told = {
        "text": question.text,
        "image": None if question.image is None else str(question.image),
        "point": question.point,
        "camera": question.camera,
        "against": found.against,
        "threshold": found.threshold.value,
        "rule": found.threshold.rule,
        "gaussians": count,
        "of": len(selected),
        "best_score": float(found.scores.max()),
        "center": means.mean(axis=0),
        "size": np.ptp(means, axis=0),
        "query_seconds": found.seconds,
        "pixels": _draw(run, question, found, folder, color, move, console),
    }
    return told


def select(run: FieldRun, question: Question) -> Selection:
    """Score all Gaussians.

    Raises:
        ValueError: the question cannot be understood.
    """
    queries, against, least = _queries(run, question)
    field, located = run.stored.at(run.gaussians.means)
    queries = jnp.asarray(queries, field.lift.dtype)
    if queries.shape[1] != field.dimension:
        raise ValueError(
            f"expected a query of {field.dimension} numbers like this field's features, found "
            f"{queries.shape[1]}: --weights are those of another encoder"
        )
    jax.block_until_ready(_scores(field, located, queries))  # what compiles is no answer's time
    begun = perf_counter()
    scores = np.asarray(_scores(field, located, queries))
    seconds = perf_counter() - begun
    given = question.threshold
    if given is None and least is not None and len(queries) == 1:
        threshold = Threshold(float(least), "the encoder's own")
    else:
        threshold = threshold_for(scores, len(queries) > 1, given)
    return Selection(scores, threshold, against, seconds)


@jax.jit
def _scores(field, located, queries):
    return relevancy(gaussian_cosines(field, located, queries))


def _queries(run: FieldRun, question: Question) -> tuple[np.ndarray, tuple[str, ...], float | None]:
    """The vector that is asked for and those of negatives, their texts, and the encoder's own threshold."""
    source = run.stored.source
    if question.point is not None:
        vector, encoder = _at_point(run, question), None
        if source.kind != "classes":
            return vector[None], (), None
        encoder = source.encoder()
        codes = np.stack([encoder.embed_text(name) for name in encoder.names])
        name = encoder.names[int((codes @ vector).argmax())]
        against = encoder.others(name) if question.negatives is None else question.negatives
        return np.stack([encoder.embed_text(text) for text in (name, *against)]), against, None
    encoder = source.encoder(question.weights)
    if question.image is not None:
        if source.kind == "classes":
            raise ValueError("--image: classes are known by name, not by sight; ask by text or --point")
        vector, text = _of_image(encoder, question.image), None
    else:
        assert question.text is not None
        vector, text = encoder.embed_text(question.text), question.text
    against = question.negatives
    if against is None:
        against = () if text is None else source.negatives(text)
    closed = source.kind == "closed" and text is not None
    vectors = np.stack([vector, *(encoder.embed_text(negative) for negative in against)])
    return vectors, tuple(against), encoder.min_score if closed else None


def _of_image(encoder: Any, path: Path) -> np.ndarray:
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
    image = np.ascontiguousarray(picture[..., 2::-1])
    return np.asarray(encoder.embed_objects(image, opaque.astype(np.int32), 1))[0]


def _at_point(run: FieldRun, question: Question) -> np.ndarray:
    """What the field says of a pixel, in the teacher's channels."""
    assert question.point is not None
    if run.views is None:
        raise ValueError("--point: expected the photographs that it is in, found none; see the warning above")
    photographs, v = run.views.photographs, view_number(run, question.camera)
    width, height = (int(side) for side in photographs.sizes[v])
    x, y = question.point
    if not (0 <= x < width and 0 <= y < height):
        raise ValueError(f"--point: expected one in {width}x{height} pixels, found {x:g},{y:g}")
    field, located = run.stored.at(run.gaussians.means)
    view, plan = frozen_views(run.gaussians, [photographs.camera(v)], run.rasterize_mode)[0]
    features, alphas = pixel_features(field, located, view, plan, jnp.array([[int(x), int(y)]]))
    if float(alphas[0]) < _LITTLE:
        raise ValueError(f"--point {x:g},{y:g}: expected something of the scene, found nothing there")
    return np.asarray(features[0])


def view_number(run: FieldRun, camera: str | None) -> int:
    """Which photograph a short name means; the first that is held out, else the first, unless given.

    Raises:
        ValueError: there is none of that name.
    """
    assert run.views is not None
    names = camera_names(run.views.photographs.names)
    if camera is None:
        return int([*run.views.held_out, *run.views.taught][0])
    for known in (names, run.views.photographs.names):
        if camera in known:
            return known.index(camera)
    listed = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
    raise ValueError(f"--camera: expected one of {listed}, found {camera}")


def _draw(
    run: FieldRun, question: Question, found: Selection, folder: Path, color: Any, move: Any, console: Console
) -> dict[str, int]:
    """Writes a mask for each camera and overview.png; returns how many pixels each mask has."""
    if run.views is None:
        return {}
    photographs, names = run.views.photographs, camera_names(run.views.photographs.names)
    which = range(photographs.num)
    if question.camera is not None and question.point is None:
        which = [view_number(run, question.camera)]
    cameras = [photographs.camera(v) for v in which]
    views = frozen_views(run.gaussians, cameras, run.rasterize_mode)
    draw = jax.jit(selection_mask, static_argnums=1)
    selected, pixels = jnp.asarray(found.selected), {}
    masks = []
    for v, (view, plan) in zip(track(which, "drawing", console=console, transient=True), views, strict=True):
        mask = np.asarray(draw(view, plan, selected))
        path = folder / "masks" / f"{names[v]}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, np.where(mask, 255, 0).astype(np.uint8))
        pixels[names[v]] = int(mask.sum())
        masks.append(mask)
    best = telling_view(masks)
    draw_overview(folder / "overview.png", run, list(which)[best], masks[best], found, color, move)
    return pixels
