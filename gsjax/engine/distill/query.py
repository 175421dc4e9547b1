"""Queries of a field: the Gaussians that match a text, a picture or a point, and pictures of them."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from rich.console import Console

from gsjax.data.photographs import Photographs
from gsjax.engine.distill.pictures import draw
from gsjax.engine.distill.saved import FieldRun, short_names
from gsjax.engine.messages import Notes
from gsjax.engine.query import Changes, Queryable, Question, Selection
from gsjax.methods.distill import FeatureField, frozen_views, pixel_features
from gsjax.methods.query import Wanted, read_text
from gsjax.rasterize.frozen import strip_of
from gsjax.scene.gaussians import Gaussians

_LEAST_ALPHA = 0.5  # share of a pixel's light that the scene must send


class QueryableField(Queryable):
    """A field and its scene, which stands still: there is one frame, 0."""

    def __init__(self, run: FieldRun, *, many: bool = False):
        """
        Args:
            run: the field and its scene.
            many: whether many queries follow; features are then computed once.
        """
        if many:
            field = FeatureField(run.stored.features(), run.stored.field.lift)
            run = replace(run, stored=replace(run.stored, field=field, rows=None))
        source = run.stored.source
        self.run, self._source = run, source
        super().__init__(run.path, source.kind, source.hint(run.weights), run.rows, run.num_rows, run.labels)

    def frame_of(self, question: Question) -> int:
        if question.camera is not None:
            if self.run.photographs is None:
                raise ValueError(
                    "--camera: expected photographs, found none (see the warning); --images says where they "
                    "are"
                )
            _index(self.run.photographs, question.camera)
        return 0

    def at(self, frame: int) -> Gaussians:
        return self.run.gaussians

    def wanted(self, question: Question, frame: int) -> Wanted:
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
            if source.kind == "classes":  # the point means the class that it is nearest to
                names = list(source.names.values())
                codes = np.stack([run.encoder.embed_text(name) for name in names])
                name = names[int((codes @ vector).argmax())]
                return self._read(name, negatives)._replace(meant=name)
        against = negatives or ()
        return Wanted(np.stack([vector, *(run.encoder.embed_text(text) for text in against)]), against)

    def like(self, row: int, frame: int) -> Wanted:
        stored = self.run.stored
        vector = jnp.matmul(stored.field.lift, stored.features()[row], precision="highest")
        return Wanted(np.asarray(vector)[None])

    def scorer(self, wanted: Wanted, frame: int) -> Callable[[], Float[Array, "n"]]:
        return partial(self.run.stored.scores, wanted.vectors)

    def about(self, question: Question, frame: int) -> dict[str, Any]:
        image = None if question.image is None else str(question.image)
        return {"image": image, "camera": question.camera, "scene": str(self.run.file)}

    def draw(
        self,
        folder: Path,
        question: Question,
        found: Selection,
        changes: Changes,
        notes: Notes,
        console: Console,
    ) -> dict[str, int]:
        photographs = self.run.photographs
        if photographs is None:
            return {}
        which = range(photographs.num)
        if question.camera is not None and question.point is None:
            which = [_index(photographs, question.camera)]
        return draw(folder, self.run, which, found, changes, notes, console)

    def _read(self, text: str, negatives: tuple[str, ...] | None) -> Wanted:
        return read_text(self._source, text, negatives, lambda: self.run.encoder)

    def _of_image(self, path: Path) -> np.ndarray:
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
        label = max(self._source.names, default=0) + 1  # one without a name, which is known by sight
        image = np.ascontiguousarray(picture[..., 2::-1])
        labels = np.where(opaque, label, 0).astype(np.int32)
        return np.asarray(self.run.encoder.embed_objects(image, labels, label))[-1]

    def _at_point(self, question: Question) -> np.ndarray:
        """The field's feature at a pixel, in the teacher's channels."""
        run, photographs = self.run, self.run.photographs
        assert question.point is not None
        assert question.camera is not None
        assert photographs is not None
        v = _index(photographs, question.camera)
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


def _index(photographs: Photographs, camera: str) -> int:
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
