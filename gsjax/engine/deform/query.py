"""Queries of a run of `gsjax deform`: the Gaussians that a text, a point or a box means, or what all of them
are, at every time."""

from collections.abc import Callable
from functools import cached_property, partial
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from rich.console import Console

from gsjax.engine.deform.pictures import draw, draw_labels, probabilities_of
from gsjax.engine.folder import OF_QUERY, replaced_folder
from gsjax.engine.messages import Notes
from gsjax.engine.query import Changes, Queryable, Question, Selection
from gsjax.engine.recording import parse_frames
from gsjax.io.atomic import write_json, write_npz
from gsjax.io.ply import write_ply
from gsjax.methods.deform import DeformResult, wanted_like, wanted_text
from gsjax.methods.deform.query import most_likely, region_feature
from gsjax.methods.protocols import LanguageEncoder
from gsjax.methods.query import Wanted
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import render_with_room
from gsjax.viz.colors import INVALID, label_color
from gsjax.viz.viewer.drawing import recolored


class QueryableScene(Queryable):
    """A scene that deforms."""

    def __init__(self, path: Path, result: DeformResult, weights: Path | None = None):
        """
        Args:
            path: of the run.
            result: its scene.
            weights: folder of CLIP's weights (default: where they were).

        Raises:
            ValueError: the scene has no features with a meaning.
        """
        meaning, gaussians = result.meaning, result.scene.gaussians
        if meaning is None or gaussians.features is None:
            raise ValueError(
                f"{path}: expected a scene that knows what is what in it, found none with features: there "
                "was one class among the pixels that counted; reconstruct it with --tools draw, or with "
                "--features"
            )
        self.result, self.meaning, self._weights = result, meaning, weights
        super().__init__(
            path,
            meaning.source.kind,
            meaning.hint(weights),
            np.arange(gaussians.num),
            gaussians.num,
            frame_ids=tuple(result.timeline.frame_ids.tolist()),
        )

    def frame_of(self, question: Question) -> int:
        self.pictured(question, 0)
        if question.frame is None:
            return 0
        if question.frame not in self.frame_ids:
            known = f"{self.frame_ids[0]} to {self.frame_ids[-1]}"
            raise ValueError(f"--frame: expected one of {known}, found {question.frame}")
        return self.frame_ids.index(question.frame)

    def pictured(self, question: Question, frame: int) -> list[int]:
        """Indices of the frames to draw: the one in question, and those that the question names.

        Raises:
            ValueError: it names none.
        """
        if question.frames is None:
            return sorted({frame, *self.result.timeline.held_out.tolist()})
        chosen = range(len(self.frame_ids))[parse_frames(question.frames)]
        if not chosen:
            raise ValueError(
                f"--frames: {question.frames} holds no frame of the run, which has {len(self.frame_ids)}"
            )
        return sorted({frame, *chosen})

    def at(self, frame: int) -> Gaussians:
        return self.result.at(self.result.timeline.times[frame])

    def wanted(self, question: Question, frame: int) -> Wanted:
        if question.text is not None:
            return wanted_text(self.meaning, question.text, question.negatives, lambda: self._encoder)
        region = question.point * 2 if question.point is not None else question.box
        assert region is not None
        drawn, _ = render_with_room(self.at(frame), self.result.camera(frame))
        assert drawn.features is not None
        try:
            feature = region_feature(np.asarray(drawn.features[0]), np.asarray(drawn.alphas[0]), region)
        except ValueError as error:
            option = "--box" if question.point is None else "--point"
            raise ValueError(f"{option}: {error} (frame {self.frame_ids[frame]})") from None
        return wanted_like(self.meaning, feature.astype(np.float64))

    def like(self, row: int, frame: int) -> Wanted:
        return wanted_like(self.meaning, np.asarray(self._features(frame)[row], np.float64))

    def scorer(self, wanted: Wanted, frame: int) -> Callable[[], Float[Array, "n"]]:
        return partial(wanted.scores, self._features(frame))

    def about(self, question: Question, frame: int) -> dict[str, Any]:
        return {"box": question.box, "names": self.result.names, "frame": self.frame_ids[frame]}

    def draw(
        self,
        folder: Path,
        question: Question,
        found: Selection,
        changes: Changes,
        notes: Notes,
        console: Console,
    ) -> dict[str, int]:
        pictured = self.pictured(question, self.frame_of(question))
        return draw(folder, self.result, pictured, found, changes, console)

    def _features(self, frame: int) -> Float[Array, "n c"]:
        """Features of all Gaussians; those that do not change are the same in all frames."""
        features = self.at(frame if self.result.meaning_changes else 0).features
        assert features is not None
        return features

    @cached_property
    def _encoder(self) -> LanguageEncoder:
        return self.meaning.source.encoder(self._weights)


def label_everything(
    scene: QueryableScene, question: Question, folder: Path, notes: Notes, console: Console
) -> dict[str, Any]:
    """Label all Gaussians, and write the result into a folder; returns the content of query.json.

        query/
          query.json          the number of Gaussians of each name, and its share of each picture
          selection.npz       labels [N], 1 for the first of the names, 0 for none; probabilities [N,k]
          recolored.ply       the Gaussians in the colours of their labels
          masks/FRAME.png     label maps; frames/FRAME.png and video.mp4 have them over the scene

    Args:
        scene: the scene.
        question: the frame of recolored.ply, and those to draw.
        folder: for the result, which replaces an earlier one once it is complete.
        notes: for query.json.
        console: shows the progress.

    Raises:
        ValueError: a frame is not there.
        FileExistsError: the folder holds something else than a result of a query.
    """
    frame, result = scene.frame_of(question), scene.result
    there, codebook = scene.at(frame), jnp.asarray(scene.meaning.codebook, jnp.float32)
    jax.block_until_ready(probabilities_of(there.features, codebook))  # compiles
    begun = perf_counter()
    likely = np.asarray(probabilities_of(there.features, codebook))
    seconds = perf_counter() - begun
    labels = 1 + most_likely(likely)
    colors = {name: label_color(label) for label, name in enumerate(result.names, 1)}
    shades = np.array([INVALID, *colors.values()], np.float32) / 255
    with replaced_folder(folder, OF_QUERY) as new:
        arrays = {"labels": labels, "probabilities": likely, "names": result.names}
        write_npz(new / "selection.npz", arrays)
        write_ply(new / "recolored.ply", recolored(there, shades[labels]), labels=labels)
        told = {
            "text": None,
            "point": None,
            "features": scene.kind,
            **scene.about(question, frame),
            "of": there.num,
            "query_seconds": seconds,
            "classes": {name: int((labels == label).sum()) for label, name in enumerate(result.names, 1)},
            "colors": colors,
            "shares": draw_labels(new, result, scene.pictured(question, frame), console),
            "notes": notes.all,
        }
        write_json(new / "query.json", told)
    return told
