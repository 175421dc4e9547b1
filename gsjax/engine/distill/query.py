"""Queries of a field: the Gaussians that match a text, a picture or a point, and pictures of them."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from rich.console import Console
from rich.progress import track

from gsjax.data.errors import DataError
from gsjax.data.files import picture_size, read_rgba
from gsjax.data.photographs import Photographs
from gsjax.engine.distill.file import NAME, read_field
from gsjax.engine.distill.saved import FieldRun, short_names
from gsjax.engine.messages import Notes, describe
from gsjax.engine.pictures import MARK, MIN_SHARE
from gsjax.engine.query import SCENE_CAPTIONS, Queryable, Question, Selection, write_mask
from gsjax.geometry.cameras import Camera, camera_centers
from gsjax.geometry.spherical_harmonics import evaluate_sh
from gsjax.io.brief import shortened
from gsjax.io.pictures import write_png
from gsjax.methods.distill import frozen_views, pixel_features
from gsjax.methods.query import Prompt, encoded_prompt
from gsjax.optim.compiler import host_options
from gsjax.rasterize.frozen import strip_of
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.selection import hidden
from gsjax.viz.colors import enlarged, heat, highlight, in_rows, to_uint8, with_heat_scale
from gsjax.viz.viewer.drawing import Drawer, recolored

if TYPE_CHECKING:
    from gsjax.engine.distill.over_time import OverTime
else:
    OverTime = Any  # the module is slow to import, like all tracking modules

_LEAST_LENGTH = 0.05  # of a feature; the teacher's have a mean length of 1
_LEAST_ALPHA = 0.5  # share of a pixel's light that the scene must send
_PANEL_HEIGHT = 240  # pixels, at least


class QueryableField(Queryable):
    """A field and its scene, which is static, with a single frame 0, unless the run that tracked it is given.

    Args:
        run: the field and its scene.
        over_time: the run that tracked the scene.
        films: whether what is found is filmed over time.
    """

    def __init__(self, run: FieldRun, over_time: OverTime | None = None, *, films: bool = True):
        source = run.stored.source
        self.run, self._source, self._over_time = run, source, over_time
        self._films = films
        self._motion = None if over_time is None else over_time.motion(run.gaussians)
        self._read_at = _changed_at(run.path / NAME)
        super().__init__(
            run.path,
            source.kind,
            source.hint(run.weights),
            run.rows,
            run.num_rows,
            run.labels,
            run.origin,
            run.rasterize_mode == "antialiased",
            frame_ids=None if over_time is None else over_time.frame_ids,
            levels=run.stored.levels,
        )

    def frame_of(self, question: Question) -> int:
        if question.level not in (None, *self.levels):
            there = ", ".join(self.levels) or "none, as this field has one level (gsjax distill --level each)"
            raise ValueError(f"--level: expected {there}, found {question.level}")
        if question.camera is not None:
            if self.run.photographs is None:
                raise ValueError(
                    "--camera: expected photographs, found none (see the warning); pass their folder "
                    "as --images"
                )
            _index(self.run.photographs, question.camera)
        return 0

    def at(self, frame: int) -> Gaussians:
        return self.run.gaussians if self._motion is None else self._motion.at(frame)

    def refresh(self) -> None:
        file = self.run.path / NAME
        if (changed_at := _changed_at(file)) in (None, self._read_at):
            return
        stored = replace(read_field(file), means=self.run.gaussians.means)
        if stored.scene.get("sha256") == self.run.stored.scene.get("sha256"):
            self.run, self._read_at = replace(self.run, stored=stored), changed_at

    def prompt(self, question: Question, frame: int) -> Prompt:
        prompt = self._prompt(question)
        level = question.level
        if level is None and question.point is not None:  # a point does not say how large a thing is meant
            level = self.run.stored.smallest
        return prompt._replace(level=level or self.run.stored.best_level(prompt.vectors))

    def _prompt(self, question: Question) -> Prompt:
        """The prompt of a question, for any level."""
        run, source, negatives = self.run, self._source, question.negatives
        if question.text is not None:
            return self._read(question.text, negatives)
        if question.image is not None:
            if source.kind == "classes":
                raise ValueError(
                    "--image: classes are known by name, not by sight; ask by text or --point, or distil "
                    "with --features closed or clip"
                )
            vector = self._of_image(question.image)
        else:
            vector = self._at_point(question)
            if source.kind == "classes":  # a point stands for the class nearest to it
                names = list(source.names.values())
                codes = np.stack([run.encoder.embed_text(name) for name in names])
                name = names[int((codes @ vector).argmax())]
                return self._read(name, negatives)._replace(name=name)
        against = negatives or ()
        return Prompt(np.stack([vector, *(run.encoder.embed_text(text) for text in against)]), against)

    def like(self, row: int, frame: int, level: str | None) -> Prompt:
        level = level or self.run.stored.smallest
        return Prompt(np.asarray(self.run.stored.direction(row, level))[None], level=level)

    def scorer(self, prompt: Prompt, frame: int) -> Callable[[], Float[Array, "n"]]:
        return partial(self.run.stored.scores, prompt.vectors, prompt.level)

    def about(self, question: Question, frame: int) -> dict[str, Any]:
        image = None if question.image is None else str(question.image)
        return {"image": image, "camera": question.camera, "scene": str(self.run.file)}

    def draw(self, folder: Path, found: Selection, notes: Notes, console: Console) -> dict[str, int] | None:
        """Writes masks/CAMERA.png, 255 where more than half of a pixel's light comes from the selected
        Gaussians, and overview.png for the photograph that shows most of them: the photograph, a heat map of
        the scores, and the scene with the selected Gaussians removed, alone, recoloured and moved. For a
        tracked scene, also writes what `OverTime.write` does, even without pictures.

        All are rendered by one compiled program per picture size, with one colour per Gaussian, because
        compiling takes longer than rendering. Gaussians that should not be seen are made invisible rather
        than removed, so that their number stays the same."""
        run, question, photographs = self.run, found.question, self.run.photographs
        if photographs is None or not question.pictures:
            if self._over_time is not None:
                self._over_time.write(folder, found.selected)
            return None
        which = range(photographs.num)
        if question.camera is not None and question.point is None:
            which = [_index(photographs, question.camera)]
        selected, scores = found.selected, found.scores
        drawer = Drawer(antialiased=run.rasterize_mode == "antialiased", compiler_options=host_options())
        names, pixels = short_names(photographs.names), {}
        low, high = _score_range(scores)
        shares = np.clip((np.nan_to_num(scores) - low) / max(high - low, 1e-6), 0, 1)
        values = _with_shares(run.gaussians, selected, shares)
        best: tuple[float, int, np.ndarray] | None = None
        for v in track(which, "drawing", console=console, transient=True):
            drawn = drawer(values, _batched(photographs.camera(v))).colors
            mask = drawn[..., 0] > MIN_SHARE
            pixels[names[v]] = write_mask(folder, names[v], mask)
            if best is None or mask.mean() > best[0]:
                best = (float(mask.mean()), v, drawn)
        assert best is not None
        _, v, drawn = best
        camera, there = _batched(photographs.camera(v)), jnp.asarray(selected)
        shown = {"the object alone": hidden(run.gaussians, ~there)}
        if not selected.all():
            shown["without it"] = hidden(run.gaussians, there)
        changed = question.changed(run.gaussians, selected)
        shown |= {SCENE_CAPTIONS[name]: scene for name, scene in changed.items()}
        behind_is = "photograph"
        try:
            behind = photographs.image(v)
        except (ValueError, OSError) as error:
            notes.warn(f"overview.png shows a render in place of a photograph: {describe(error)}")
            behind_is, behind = "scene", to_uint8(drawer(_seen_from(run.gaussians, camera), camera).colors)
        threshold = found.threshold.value
        scale = enlarged(heat(drawn[..., 1]), _PANEL_HEIGHT)
        panels = {
            f"found in view {names[v]}": highlight(behind, drawn[..., 0] > MIN_SHARE, MARK),
            f"scores; found above {threshold:.2f}": with_heat_scale(scale, low, high, threshold),
        }
        for words, scene in shown.items():
            panels[words] = to_uint8(drawer(_seen_from(scene, camera), camera).colors)
        if len(panels) % 2:  # fill two rows without a gap
            panels = {behind_is: behind, **panels}
        write_png(folder / "overview.png", in_rows(panels, len(panels) // 2, _PANEL_HEIGHT))
        if self._over_time is not None:
            name = None if question.camera is None else question.camera.split("/")[0]
            paint = partial(_with_shares, run.gaussians, shares=shares)
            film = partial(self._over_time.film, folder / "video.mp4", paint, name, drawer, notes, console)
            self._over_time.write(folder, selected, film if self._films else None)
        return pixels

    def _read(self, text: str, negatives: tuple[str, ...] | None) -> Prompt:
        return encoded_prompt(self._source, text, negatives, lambda: self.run.encoder)

    def _of_image(self, path: Path) -> np.ndarray:
        """The vector of a picture."""
        try:
            picture = read_rgba(path, *picture_size(path))
        except DataError as error:
            raise ValueError(f"--image {error}") from error
        opaque = picture[..., 3] > 127 if picture.shape[2] == 4 else np.ones(picture.shape[:2], bool)
        if not opaque.any():
            raise ValueError(f"--image {path}: expected something opaque in it, found nothing")
        label = max(self._source.names, default=0) + 1  # without a name: encoded by its appearance
        image = np.ascontiguousarray(picture[..., :3])
        labels = np.where(opaque, label, 0).astype(np.int32)
        return np.asarray(self.run.encoder.embed_objects(image, labels, label))[-1]

    def _at_point(self, question: Question) -> np.ndarray:
        """The field's feature at a pixel, in the teacher's channels for one level."""
        run, photographs = self.run, self.run.photographs
        assert question.point is not None
        assert question.camera is not None
        assert photographs is not None
        v = _index(photographs, question.camera)
        width, height = (int(side) for side in photographs.sizes[v])
        x, y = question.point
        if not (0 <= x < width and 0 <= y < height):
            raise ValueError(
                f"--point: expected a pixel of the {width}x{height} photograph, found {x:g},{y:g}"
            )
        field, located = run.stored.placed
        view, plan = frozen_views(run.gaussians, [photographs.camera(v)], run.rasterize_mode)[0]
        row, below = divmod(int(y), plan.tile_size)
        strip, strip_plan = strip_of(view, plan, row, 1)  # all that has to be drawn for one pixel
        pixel = jnp.array([[int(x), below]])
        features, alphas = jax.jit(pixel_features)(field, located, strip, strip_plan, pixel)
        if float(alphas[0]) < _LEAST_ALPHA:
            raise ValueError(
                f"--point {x:g},{y:g}: expected a pixel that shows the scene, found an empty one; choose "
                "another"
            )
        vector = np.asarray(features[0])[run.stored.channels(question.level or run.stored.smallest)]
        if np.linalg.norm(vector) < _LEAST_LENGTH:
            raise ValueError(
                f"--point {x:g},{y:g}: expected something that a mask covered when the field was distilled, "
                "found what none did; choose another"
            )
        return vector


def _changed_at(file: Path) -> int | None:
    """When a file was last written; None if it does not exist."""
    return file.stat().st_mtime_ns if file.is_file() else None


def _index(photographs: Photographs, camera: str) -> int:
    """The index of a photograph by its short or full name.

    Raises:
        ValueError: no photograph has that name.
    """
    names = short_names(photographs.names)
    for known in (names, photographs.names):
        if camera in known:
            return known.index(camera)
    raise ValueError(f"--camera: expected one of {shortened(names, 12)}, found {camera}")


def _batched(camera: Camera) -> Camera:
    """A batch of one."""
    return jax.tree.map(lambda a: a[None], camera)


def _score_range(scores: Float[np.ndarray, "n"]) -> tuple[float, float]:
    """The smallest and largest score, without a few outliers at the lower end."""
    scores = np.nan_to_num(scores)
    return float(np.percentile(scores, 1)), float(scores.max())


def _with_shares(
    gaussians: Gaussians, selected: Bool[np.ndarray, "n"], shares: Float[np.ndarray, "n"]
) -> Gaussians:
    """The scene with selected Gaussians' red at 1, and green set to the shares."""
    colors = np.stack([selected, shares, np.zeros(len(shares))], axis=1)
    return _painted(gaussians, colors.astype(np.float32))


def _seen_from(gaussians: Gaussians, camera: Camera) -> Gaussians:
    """The scene with the colours that one camera sees, made independent of the view."""
    return _painted(gaussians, np.asarray(_colors(gaussians, camera)))


@jax.jit
def _colors(gaussians: Gaussians, camera: Camera) -> Float[Array, "n 3"]:
    toward = gaussians.means - camera_centers(camera.viewmat)[0]
    return jnp.maximum(evaluate_sh(gaussians.sh_degree, gaussians.sh, toward), 0)


def _painted(gaussians: Gaussians, colors: Float[np.ndarray, "n 3"]) -> Gaussians:
    """The scene with one colour per Gaussian and no features."""
    return eqx.tree_at(lambda g: g.features, recolored(gaussians, colors), None, is_leaf=lambda x: x is None)
