"""Queries of a run of `gsjax deform` at any time: the Gaussians that match a text, a point or a box, or the
labels of all Gaussians."""

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from rich.console import Console
from rich.progress import track

from gsjax.engine.files import write_scene
from gsjax.engine.folder import OF_QUERY, replaced_folder
from gsjax.engine.messages import Notes
from gsjax.engine.pictures import frame_rate
from gsjax.engine.query import SCENE_CAPTIONS, Queryable, Question, Selection, write_mask
from gsjax.engine.recording import parse_frames
from gsjax.geometry.cameras import Camera
from gsjax.io.atomic import write_json, write_npz
from gsjax.io.pictures import write_png
from gsjax.io.video import VideoWriter
from gsjax.methods.deform import DeformResult, feature_prompt, text_prompt
from gsjax.methods.deform.query import most_likely, prompt_probabilities, region_feature
from gsjax.methods.protocols import LanguageEncoder
from gsjax.methods.query import Prompt
from gsjax.rasterize.plan import Plan
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import render_with_room
from gsjax.scene.selection import hidden
from gsjax.viz.colors import INVALID, in_rows, label_color, overlay_labels, to_uint8
from gsjax.viz.viewer.drawing import recolored

_PANEL_HEIGHT = 240  # pixels, at least
_OPAQUE = 0.5  # alpha up to which a pixel counts as empty

probabilities_of = jax.jit(prompt_probabilities)
"""`prompt_probabilities` of Gaussians or of a picture, compiled."""


class _Seen(NamedTuple):
    """A rendered frame of the scene.

    Attributes:
        t: its index.
        number: its number in the recording.
        gaussians: the scene in this frame.
        camera: its camera.
        plan: the plan that it was rendered with.
        background: RGB behind the scene; None is black.
        colors: rendered, 0 to 1.
        features: rendered, on the device.
        there: the pixels that show the scene.
    """

    t: int
    number: int
    gaussians: Gaussians
    camera: Camera
    plan: Plan
    background: Float[Array, "1 3"] | None
    colors: Float[np.ndarray, "h w 3"]
    features: Float[Array, "h w c"]
    there: Bool[np.ndarray, "h w"]


class QueryableScene(Queryable):
    """A deforming scene."""

    def __init__(
        self,
        path: Path,
        result: DeformResult,
        weights: Path | None = None,
        origin: Float[np.ndarray, "3"] | None = None,
        background: tuple[float, float, float] | None = None,
    ):
        """
        Args:
            path: of the run.
            result: its scene.
            weights: folder of CLIP's weights (default: where they were).
            origin: what the scene is relative to.
            background: RGB, 0 to 1, behind it in pictures (default: black).

        Raises:
            ValueError: the scene has no features with a meaning.
        """
        meaning, gaussians = result.meaning, result.scene.gaussians
        if meaning is None or gaussians.features is None:
            raise ValueError(
                f"{path}: expected a scene with features, found none: there "
                "was one class among the pixels that counted; reconstruct it with --tools draw, or with "
                "--features"
            )
        self.result, self.meaning, self._weights = result, meaning, weights
        self.background = None if background is None else jnp.array([background], jnp.float32)
        super().__init__(
            path,
            meaning.source.kind,
            meaning.hint(weights),
            np.arange(gaussians.num),
            gaussians.num,
            origin=origin,
            frame_ids=tuple(result.timeline.frame_ids.tolist()),
        )

    def frame_of(self, question: Question) -> int:
        self.pictured(question, 0)
        if question.frame is None:
            return 0
        known = self.result.timeline.frame_ids.tolist()
        if question.frame not in known:
            raise ValueError(f"--frame: expected one of {known[0]} to {known[-1]}, found {question.frame}")
        return known.index(question.frame)

    def pictured(self, question: Question, frame: int) -> list[int]:
        """Indices of the frames to draw: the one in question, and those that the question names.

        Raises:
            ValueError: it names none.
        """
        if question.frames is None:
            return sorted({frame, *self.result.timeline.held_out.tolist()})
        count = len(self.result.timeline.times)
        chosen = range(count)[parse_frames(question.frames)]
        if not chosen:
            raise ValueError(f"--frames: {question.frames} selects no frame of the run, which has {count}")
        return sorted({frame, *chosen})

    def at(self, frame: int) -> Gaussians:
        return self.result.at(self.result.timeline.times[frame])

    def prompt(self, question: Question, frame: int) -> Prompt:
        if question.text is not None:
            return text_prompt(self.meaning, question.text, question.negatives, lambda: self._encoder)
        region = question.point * 2 if question.point is not None else question.box
        assert region is not None
        drawn, _ = render_with_room(self.at(frame), self.result.camera(frame))
        assert drawn.features is not None
        try:
            feature = region_feature(np.asarray(drawn.features[0]), np.asarray(drawn.alphas[0]), region)
        except ValueError as error:
            option = "--box" if question.point is None else "--point"
            raise ValueError(f"{option}: {error} (frame {self.result.timeline.frame_ids[frame]})") from None
        return feature_prompt(self.meaning, feature.astype(np.float64))

    def like(self, row: int, frame: int, level: str | None) -> Prompt:
        return feature_prompt(self.meaning, np.asarray(self._features(frame)[row], np.float64))

    def scorer(self, prompt: Prompt, frame: int) -> Callable[[], Float[Array, "n"]]:
        return partial(prompt.scores, self._features(frame))

    def about(self, question: Question, frame: int) -> dict[str, Any]:
        number = int(self.result.timeline.frame_ids[frame])
        return {"box": question.box, "names": self.result.names, "frame": number}

    def draw(self, folder: Path, found: Selection, notes: Notes, console: Console) -> dict[str, int] | None:
        """Writes masks/FRAME.png (255 where a pixel's own features score above the threshold) and
        frames/FRAME.png (the scene; without what was found; what was found alone, recoloured, moved) of some
        frames, and video.mp4 of all: the scene beside the scene without what was found."""
        if not found.question.pictures:
            return None
        result, pictured = self.result, self.pictured(found.question, found.frame)
        pixels: dict[str, int] = {}
        prompt, threshold = found.prompt, found.threshold.value
        with VideoWriter(folder / "video.mp4", _frame_rate(result)) as video:
            for seen in _frames(result, self.background, console):
                assert seen.gaussians.features is not None
                selected = prompt.scores(seen.gaussians.features) > threshold
                both = {f"frame {seen.number}": to_uint8(seen.colors)}
                both["without it"] = _picture(hidden(seen.gaussians, selected), seen)
                video.write(in_rows(both, 2, _PANEL_HEIGHT))
                if seen.t in pictured:
                    name = f"{seen.number:06d}"
                    mask = (np.asarray(prompt.scores(seen.features)) > threshold) & seen.there
                    pixels[name] = write_mask(folder, name, mask)
                    scenes = {"it alone": hidden(seen.gaussians, ~selected)}
                    changed = found.question.changed(seen.gaussians, np.asarray(selected))
                    scenes |= {SCENE_CAPTIONS[edit]: scene for edit, scene in changed.items()}
                    panels = both | {words: _picture(scene, seen) for words, scene in scenes.items()}
                    write_png(folder / "frames" / f"{name}.png", in_rows(panels, 2, _PANEL_HEIGHT))
        return pixels

    def _features(self, frame: int) -> Float[Array, "n c"]:
        """Features of all Gaussians in a frame; if they do not change, always those of the first frame."""
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
          masks/FRAME.png     label maps; frames/FRAME.png and video.mp4 overlay them on the scene

    Args:
        scene: the scene.
        question: names the frame of recolored.ply, and the frames to draw, if any.
        folder: for the result, which replaces an earlier one once it is complete.
        notes: for query.json.
        console: shows the progress.

    Raises:
        ValueError: a frame does not exist.
        FileExistsError: the folder holds something other than the result of a query.
    """
    frame, result, shares = scene.frame_of(question), scene.result, None
    there, codebook = scene.at(frame), jnp.asarray(scene.meaning.codebook, jnp.float32)
    jax.block_until_ready(probabilities_of(there.features, codebook))  # compiles
    begun = perf_counter()
    likely = jax.block_until_ready(probabilities_of(there.features, codebook))
    seconds = perf_counter() - begun
    labels = 1 + np.asarray(most_likely(likely))
    colors = {name: label_color(label) for label, name in enumerate(result.names, 1)}
    shades = np.array([INVALID, *colors.values()], np.float32) / 255
    with replaced_folder(folder, OF_QUERY) as new:
        arrays = {"labels": labels, "probabilities": np.asarray(likely), "names": result.names}
        write_npz(new / "selection.npz", arrays)
        write_scene(new / "recolored.ply", recolored(there, shades[labels]), labels, origin=scene.origin)
        if question.pictures:
            shares = _draw_labels(new, scene, scene.pictured(question, frame), console)
        info = {
            "text": None,
            "point": None,
            "features": scene.kind,
            **scene.about(question, frame),
            "of": there.num,
            "query_seconds": seconds,
            "classes": {name: int((labels == label).sum()) for label, name in enumerate(result.names, 1)},
            "colors": colors,
            "shares": shares,
            "notes": notes.all,
        }
        write_json(new / "query.json", info)
    return info


def _draw_labels(
    folder: Path, scene: QueryableScene, pictured: Sequence[int], console: Console
) -> dict[str, dict[str, float]]:
    """Writes label maps masks/FRAME.png and frames/FRAME.png of some frames, and video.mp4 of all: the scene
    beside the most likely label of each pixel. Returns, by frame, the share of the picture of each name."""
    result, codebook = scene.result, jnp.asarray(scene.meaning.codebook, jnp.float32)
    shares: dict[str, dict[str, float]] = {}
    with VideoWriter(folder / "video.mp4", _frame_rate(result)) as video:
        for seen in _frames(result, scene.background, console):
            likely = probabilities_of(seen.features, codebook)
            labels = np.where(seen.there, 1 + np.asarray(most_likely(likely)), 0)
            colors = to_uint8(seen.colors)
            over = overlay_labels(colors, labels)
            panel = in_rows({f"frame {seen.number}": colors, "what is what": over}, 2, _PANEL_HEIGHT)
            video.write(panel)
            if seen.t in pictured:
                name = f"{seen.number:06d}"
                write_png(folder / "masks" / f"{name}.png", labels.astype(np.uint8))
                write_png(folder / "frames" / f"{name}.png", panel)
                shares[name] = {
                    word: float((labels == label).mean()) for label, word in enumerate(result.names, 1)
                }
    return shares


def _frame_rate(result: DeformResult) -> float:
    """Frames per second of a video of all frames."""
    return frame_rate(result.timeline.times * result.timeline.seconds)


def _frames(
    result: DeformResult, background: Float[Array, "1 3"] | None, console: Console
) -> Iterator[_Seen]:
    """Renders all frames, one after the other."""
    plan = None
    for t in track(range(len(result.timeline.times)), "drawing", console=console, transient=True):
        gaussians, camera = result.at(result.timeline.times[t]), result.camera(t)
        drawn, plan = render_with_room(gaussians, camera, plan, backgrounds=background)
        assert drawn.features is not None
        there = np.asarray(drawn.alphas[0]) > _OPAQUE
        scene, number = (gaussians, camera, plan, background), int(result.timeline.frame_ids[t])
        yield _Seen(t, number, *scene, np.asarray(drawn.colors[0]), drawn.features[0], there)


def _picture(gaussians: Gaussians, seen: _Seen) -> np.ndarray:
    """Renders a scene with the camera and plan of `seen`. Features are rendered too, which reuses the
    compiled program: compiling another takes longer."""
    drawn, _ = render_with_room(gaussians, seen.camera, seen.plan, backgrounds=seen.background)
    return to_uint8(np.asarray(drawn.colors[0]))
