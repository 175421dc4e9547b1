"""Pictures of a query of a deforming scene: masks, the scene beside its edits, and a film."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from rich.console import Console
from rich.progress import track

from gsjax.engine.pictures import frame_rate
from gsjax.engine.query import Changes, Selection, write_mask
from gsjax.geometry.cameras import Camera
from gsjax.io.pictures import write_png
from gsjax.io.video import VideoWriter
from gsjax.methods.deform import DeformResult
from gsjax.methods.deform.query import most_likely, prompt_probabilities
from gsjax.rasterize.plan import Plan
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import render_with_room
from gsjax.scene.selection import hidden
from gsjax.viz.colors import in_rows, overlay_labels, to_uint8

_PANEL_HEIGHT = 240  # pixels, at least
_OPAQUE = 0.5  # a pixel in which less of the scene shows is of nothing
_WORDS = {"recolored": "recoloured", "moved": "moved"}

probabilities_of = jax.jit(prompt_probabilities)
"""`prompt_probabilities` of Gaussians or of a picture, compiled."""


class _Seen(NamedTuple):
    """A frame of the scene.

    Attributes:
        t: its index.
        number: the recording's own number of it.
        gaussians: there and then.
        camera: that saw it.
        plan: that held it.
        colors: 0 to 1.
        features: rendered, on the device.
        there: where something of the scene is drawn.
    """

    t: int
    number: int
    gaussians: Gaussians
    camera: Camera
    plan: Plan
    colors: Float[np.ndarray, "h w 3"]
    features: Float[Array, "h w c"]
    there: Bool[np.ndarray, "h w"]


def draw(
    folder: Path,
    result: DeformResult,
    pictured: Sequence[int],
    found: Selection,
    changes: Changes,
    console: Console,
) -> dict[str, int]:
    """Writes masks/FRAME.png (255 where a pixel's own features match) and frames/FRAME.png of some frames,
    and video.mp4 of all: the scene beside the scene without what was found.

    Args:
        folder: for the pictures.
        result: the scene.
        pictured: indices of the frames.
        found: the result of the query; its threshold holds for Gaussians and for pixels.
        changes: changes to what was found.
        console: shows the progress.

    Returns:
        The number of pixels of each mask.
    """
    pixels: dict[str, int] = {}
    wanted, threshold = found.wanted, found.threshold.value
    with VideoWriter(folder / "video.mp4", _frame_rate(result)) as video:
        for seen in _frames(result, console):
            assert seen.gaussians.features is not None
            selected = wanted.scores(seen.gaussians.features) > threshold
            both = {f"frame {seen.number}": to_uint8(seen.colors)}
            both["without it"] = _picture(hidden(seen.gaussians, selected), seen)
            video.write(in_rows(both, 2, _PANEL_HEIGHT))
            if seen.t in pictured:
                name = f"{seen.number:06d}"
                mask = (np.asarray(wanted.scores(seen.features)) > threshold) & seen.there
                pixels[name] = write_mask(folder, name, mask)
                scenes = {"it alone": hidden(seen.gaussians, ~selected)}
                changed = changes.of(seen.gaussians, np.asarray(selected))
                scenes |= {_WORDS[edit]: scene for edit, scene in changed.items()}
                panels = both | {words: _picture(scene, seen) for words, scene in scenes.items()}
                write_png(folder / "frames" / f"{name}.png", in_rows(panels, 2, _PANEL_HEIGHT))
    return pixels


def draw_labels(
    folder: Path, result: DeformResult, pictured: Sequence[int], console: Console
) -> dict[str, dict[str, float]]:
    """Writes label maps masks/FRAME.png and frames/FRAME.png of some frames, and video.mp4 of all: the scene
    beside what each pixel most likely is.

    Args:
        folder: for the pictures.
        result: of a run.
        pictured: indices of the frames.
        console: shows the progress.

    Returns:
        By frame, the share of the picture that each name has.
    """
    assert result.meaning is not None
    codebook = jnp.asarray(result.meaning.codebook, jnp.float32)
    shares: dict[str, dict[str, float]] = {}
    with VideoWriter(folder / "video.mp4", _frame_rate(result)) as video:
        for seen in _frames(result, console):
            likely = np.asarray(probabilities_of(seen.features, codebook))
            labels = np.where(seen.there, 1 + most_likely(likely), 0)
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
    """Pictures a second of a film of all frames."""
    return frame_rate(result.timeline.times * result.timeline.seconds)


def _frames(result: DeformResult, console: Console) -> Iterator[_Seen]:
    """All frames, one after the other."""
    plan = None
    for t in track(range(len(result.timeline.times)), "drawing", console=console, transient=True):
        gaussians, camera = result.at(result.timeline.times[t]), result.camera(t)
        drawn, plan = render_with_room(gaussians, camera, plan)
        assert drawn.features is not None
        there = np.asarray(drawn.alphas[0]) > _OPAQUE
        scene, number = (gaussians, camera, plan), int(result.timeline.frame_ids[t])
        yield _Seen(t, number, *scene, np.asarray(drawn.colors[0]), drawn.features[0], there)


def _picture(gaussians: Gaussians, seen: _Seen) -> np.ndarray:
    """Colours of a scene that stands as another does; drawn as that was, with features, for compiling takes
    longer than drawing these."""
    return to_uint8(np.asarray(render_with_room(gaussians, seen.camera, seen.plan)[0].colors[0]))
