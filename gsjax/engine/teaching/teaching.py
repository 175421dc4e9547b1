"""Teachers of photographs, or of the frames of one camera: their masks, and features of masks or pixels."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int
from rich.console import Console
from rich.progress import track

from gsjax.data.errors import DataWarning
from gsjax.data.photographs import Photographs
from gsjax.engine.teaching.cache import FeatureCache, content_digest, folder_digest
from gsjax.engine.teaching.choice import TeacherChoice
from gsjax.engine.teaching.source import ABOUT, Source
from gsjax.methods.distill import Teacher, teacher_of_maps, teacher_of_objects, with_maps
from gsjax.methods.distill.teacher import UNKNOWN_ID
from gsjax.methods.protocols import LanguageEncoder
from gsjax.perception.codebook import distinct_names
from gsjax.perception.feature_files import EACH, PictureFeatures, read_feature_folder
from gsjax.perception.levels import joined_levels, labels_on_level
from gsjax.perception.outlines import snap_outlines
from gsjax.perception.segmenters import PieceSegmenter, PlaneOrRegionSegmenter

_OF_OBJECTS = ("classes", "closed", "clip")
_STRETCH = 0.02  # tolerance of the log aspect ratio of the masks in a feature file
_IN_FILES = "in the feature files"
_VERSION = 2  # of cached outputs; outputs of other versions are computed again


class _View(NamedTuple):
    """Masks of a photograph, on one level.

    Attributes:
        ids: index in `labels` of each pixel's label; -1 where unknown.
        labels: the labels that occur, in ascending order; 0 is the background, which is a label like others.
    """

    ids: Int[np.ndarray, "h w"]
    labels: Int[np.ndarray, "n"]


_Objects = tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray] | None]
"""For each photograph: the row of each pixel's vector, -1 where unknown; the vectors; and, with levels, which
levels of a pixel are filled from others (`Teacher.filled`)."""


class Teaching:
    """The teacher of a scene's photographs. The training photographs determine the encoder and the names, so
    that the features of held-out photographs are comparable.

    Attributes:
        teacher: features of the training photographs, in their order.
        source: the source of these features.
        masks: source of the masks: "files", "segment", "sam", "in the feature files", or "none".
        about: a description of the features.
    """

    def __init__(
        self,
        photographs: Photographs,
        indices: Sequence[int],
        choice: TeacherChoice,
        cache: FeatureCache,
        console: Console,
    ):
        """Segments and encodes photographs.

        Args:
            photographs: of the scene.
            indices: indices of the training photographs.
            choice: the masks and features; checked.
            cache: earlier outputs.
            console: shows the progress.

        Raises:
            ValueError: there are no masks, feature files do not fit, or a package is missing.
            FileNotFoundError: files of features or weights do not exist.
        """
        self._photographs, self._indices = photographs, list(indices)
        self._choice, self._cache = choice, cache
        self._dimension: int | None = None  # of the features that teach, once they are known
        # What may be missing is checked first; what takes long comes last.
        clip, weights = (None, "") if choice.weights is None else _clip(choice.weights)
        self._patches = _patches(clip) if "maskclip" in (choice.features, choice.second) else None
        reads = choice.masks != "segment" and choice.sam is None
        reads &= choice.masks == "files" or choice.features in ("auto", *_OF_OBJECTS)
        files = reads and any(photographs.labels(i) is not None for i in indices)
        kind, self.masks = _resolved(choice, files, photographs.name)
        self._segmenter, self._segmenter_key = _segmenter(choice, self.masks)
        views, names = self._views(indices, console), {}
        if views is not None and self.masks == "files" and kind in _OF_OBJECTS:
            names = _names([view for (view,) in views], photographs.label_names)
        where = Path(choice.features) if kind == "files" else choice.weights
        self.source = Source(
            kind,
            {label + 1: name for label, name in names.items()},
            None if where is None else str(where.resolve()),
            choice.levels,
        )
        self.about = ABOUT[kind] + (", and its vectors of patches" if choice.second == "maskclip" else "")
        # Encoders are given labels renumbered from 1 to n; CLIP needs no names.
        self._named = () if kind == "clip" else tuple(names)
        named = {n: names[label] for n, label in enumerate(self._named, start=1)}
        self._encoder: Any = Source(kind, named).encoder() if kind in ("classes", "closed") else clip
        self._encoder_key = f"{kind} {named} {weights} {_VERSION}"
        self._patches_key = f"maskclip {weights} {_VERSION}"
        self.teacher = self._taught(views, console)
        self._dimension = self.teacher.dimension

    def of(self, i: int) -> Teacher | None:
        """The teacher of one photograph, from its masks or its feature map; None if it has no features.

        Raises:
            ValueError, OSError: it cannot be read, or its file of features does not fit.
        """
        quiet = Console(quiet=True)
        found = self._features([i], self._views([i], quiet), quiet)
        if isinstance(found, Teacher):
            return found
        (ids,), (rows,), _ = found
        known = np.asarray(rows)[np.unique(ids[ids >= 0])].any()
        return teacher_of_objects([ids], [rows]) if known else None

    def digest(self) -> str:
        """SHA-256 over the teacher and the cameras: equal if two distillations learn from the same data."""
        teacher, photographs = self.teacher, self._photographs
        arrays = {f"ids {v}": ids for v, ids in enumerate(teacher.ids)}
        arrays |= {f"map {v}": one for v, one in enumerate(teacher.maps or ())}
        arrays |= {} if teacher.codebook is None else {"codebook": teacher.codebook}
        arrays |= {name: getattr(photographs, name)[self._indices] for name in ("sizes", "Ks", "viewmats")}
        return content_digest("lesson", arrays)

    def _taught(self, views: list[list[_View]] | None, console: Console) -> Teacher:
        """The teacher of the training photographs."""
        found = self._features(self._indices, views, console)
        if isinstance(found, Teacher):
            return found
        if self.source.kind == "files":
            self.masks = _IN_FILES
        with warnings.catch_warnings():  # the warning below names the views
            warnings.filterwarnings("ignore", "views without any mask")
            teacher = teacher_of_objects(*found)
        if self._choice.second != "none":
            return with_maps(teacher, self._of_patches(self._indices, views, console))
        silent = [i for i, one in zip(self._indices, teacher.ids, strict=True) if not (one >= 0).any()]
        if silent:
            some = ", ".join(self._photographs.names[i] for i in silent[:8])
            more = f" and {len(silent) - 8} more" if len(silent) > 8 else ""
            message = f"photographs of which no mask says anything teach nothing: {some}{more}"
            warnings.warn(message, DataWarning, stacklevel=2)
        return teacher

    def _features(
        self, indices: Sequence[int], views: list[list[_View]] | None, console: Console
    ) -> Teacher | _Objects:
        """Features of photographs: a teacher with maps, or vectors of objects."""
        if self.source.kind == "maskclip":
            return self._of_patches(indices, views, console)
        if self.source.kind == "files":
            found = self._files(indices)
            maps = [one.map for one in found if one.map is not None]
            if len(maps) == len(found):
                return teacher_of_maps(maps, self._sizes(indices), _ids(views))
            if maps:
                raise ValueError(
                    f"{self._choice.features}: expected files of one kind, found a feature a pixel in "
                    f"{len(maps)} and masks with embeddings in {len(found) - len(maps)}"
                )
            photographs, pairs = self._photographs, list(zip(found, indices, strict=True))
            ids = [_resized(one.ids, photographs, i) for one, i in pairs]
            filled = [_resized(one.filled, photographs, i) for one, i in pairs if one.filled is not None]
            rows = [one.codebook for one in found if one.codebook is not None]  # all, without maps
            return ids, rows, filled or None
        assert views is not None
        shown = track(indices, "features", console=console, transient=True)
        objects = []
        for i, levels in zip(shown, views, strict=True):
            ids, rows = [view.ids for view in levels], [self._embedded(i, view) for view in levels]
            objects.append((ids[0], rows[0], None) if len(levels) == 1 else joined_levels(ids, rows))
        ids, rows, filled = (list(each) for each in zip(*objects, strict=True))
        return ids, rows, filled if self.source.levels else None

    def _views(self, indices: Sequence[int], console: Console) -> list[list[_View]] | None:
        """Masks of photographs on each level; None if the features do not need them."""
        if self.masks in ("none", _IN_FILES):
            return None
        return [self._levels(i) for i in track(indices, "masks", console=console, transient=True)]

    def _levels(self, i: int) -> list[_View]:
        """Masks of a photograph on each level: from its file, or from a segmenter, of which only SAM has
        several levels."""
        photographs = self._photographs
        file = photographs.labels(i) if self.masks == "files" else None
        labels = np.full(photographs.sizes[i][::-1], UNKNOWN_ID) if file is None else file.astype(np.int64)
        if (segmenter := self._segmenter) is not None:
            image, depth, K = photographs.image(i), photographs.depth(i), photographs.Ks[i]
            shown = {"image": image, "K": K} | ({} if depth is None else {"depth": depth})
            found = self._cache(self._segmenter_key, shown, lambda: {"labels": segmenter(image, depth, K)})
            labels = found["labels"].astype(np.int64)
            if labels.ndim == 3 and (level := self._choice.level) not in ("default", EACH):
                labels = labels_on_level(labels, level)
            if self.masks == "sam" or depth is None:  # 0 is not the background, but what lies in no mask
                labels = np.where(labels == 0, UNKNOWN_ID, labels)
        return [self._view(i, level) for level in labels.reshape(-1, *labels.shape[-2:])]

    def _view(self, i: int, labels: Int[np.ndarray, "h w"]) -> _View:
        """The masks of a label map, restricted to the pixels that count."""
        if self._choice.snap:
            labels = snap_outlines(labels, self._photographs.image(i), self._choice.snap)
        if (counted := self._photographs.mask(i)) is not None:
            labels = np.where(counted, labels, UNKNOWN_ID)
        there, place = np.unique(np.maximum(labels, UNKNOWN_ID), return_inverse=True)
        unknown = int((there < 0).sum())
        return _View((place.reshape(labels.shape) - unknown).astype(np.int32), there[unknown:])

    def _embedded(self, i: int, view: _View) -> Float[np.ndarray, "n d"]:
        """The vectors of a photograph's labels; zeros for a label that the encoder does not know."""
        numbers = {label: n for n, label in enumerate(self._named, start=1)}
        of_labels = [numbers.setdefault(label, len(numbers) + 1) for label in view.labels.tolist()]
        image = self._photographs.image(i)

        def embed() -> dict[str, np.ndarray]:
            shown = np.array([0, *of_labels])[view.ids + 1]
            rows = np.asarray(self._encoder.embed_objects(image, shown, max(1, len(numbers))), np.float32)
            return {"rows": rows[np.array(of_labels or [1]) - 1]}  # one row of zeros without any label

        return self._cache(self._encoder_key, {"image": image, **view._asdict()}, embed)["rows"]

    def _of_patches(
        self, indices: Sequence[int], views: list[list[_View]] | None, console: Console
    ) -> Teacher:
        """A teacher of MaskCLIP's maps; masks, if any, define which pixels form one object."""
        encoder, maps = self._patches, []
        assert encoder is not None
        for i in track(indices, "patches", console=console, transient=True):
            image = self._photographs.image(i)
            output = self._cache(
                self._patches_key, {"image": image}, lambda image=image: {"map": encoder(image[None])[0]}
            )
            maps.append(output["map"])
        return teacher_of_maps(maps, self._sizes(indices), _ids(views))

    def _files(self, indices: Sequence[int]) -> list[PictureFeatures]:
        """Features of photographs from a folder."""
        folder, photographs = Path(self._choice.features), self._photographs
        found = read_feature_folder(folder, photographs.names, which=indices, level=self._choice.level)
        for one, i in zip(found, indices, strict=True):
            _expect_shape(one, photographs, i)
            if self._dimension not in (None, one.dimension):
                raise ValueError(
                    f"{one.path}: expected features of {self._dimension} numbers as in the files that "
                    f"taught, found {one.dimension}; take files of one encoder"
                )
        return found

    def _sizes(self, indices: Sequence[int]) -> list[tuple[int, int]]:
        """(height, width) of each photograph."""
        return [tuple(self._photographs.sizes[i][::-1].tolist()) for i in indices]


def teacher_for(photographs: Photographs, wanted: Teacher | TeacherChoice | str) -> tuple[Teacher, Source]:
    """A teacher of all photographs, and the source of its features.

    Args:
        photographs: of the scene.
        wanted: the teacher itself, a choice of one, or its features as `TeacherChoice.features` has them.

    Raises:
        ValueError, FileNotFoundError: as for `TeacherChoice.check` and `Teaching`.
    """
    if isinstance(wanted, Teacher):
        return wanted, Source("files")
    choice = TeacherChoice(wanted) if isinstance(wanted, str) else wanted
    choice.check()
    every, quiet = range(photographs.num), Console(quiet=True)
    teaching = Teaching(photographs, every, choice, FeatureCache(), quiet)
    return teaching.teacher, teaching.source


def _resolved(choice: TeacherChoice, files: bool, name: str) -> tuple[Any, str]:
    """The kind of features and the source of masks; "auto" is resolved by whether there are mask files."""
    if choice.masks == "files" and not files:
        raise ValueError(f"--masks files: {name} has none of these photographs; use --masks segment")
    masks = "sam" if choice.sam is not None else "files" if files else "segment"
    kind = "files" if choice.of_files else choice.features
    if kind == "auto":
        kind = "classes" if masks == "files" else "closed"
    if kind == "classes" and masks != "files":
        raise ValueError(
            "--features classes: expected mask files, whose classes are learned, found a segmenter's masks; "
            "use closed, or clip with its --weights"
        )
    if kind not in _OF_OBJECTS and choice.masks == "auto" and choice.sam is None:
        masks = "none"
    return kind, masks


def _clip(weights: Path) -> tuple[LanguageEncoder, str]:
    """CLIP, and what identifies it in the cache."""
    from gsjax.perception.clip import load_clip

    try:
        return load_clip(weights), folder_digest(weights)
    except OSError as error:
        raise ValueError(f"--weights: {error}") from error


def _patches(clip: Any) -> Callable[[np.ndarray], np.ndarray]:
    """MaskCLIP, with CLIP's weights."""
    from gsjax.perception.maskclip import MaskClipEncoder

    try:
        return MaskClipEncoder(clip)
    except ValueError as error:
        raise ValueError(f"--weights: {error}; take --features clip, without --second") from error


def _segmenter(choice: TeacherChoice, masks: str) -> tuple[Callable[..., np.ndarray] | None, str]:
    """The segmenter, if one is needed, and what identifies it in the cache. Its labels are [H,W], or [L,H,W]
    with levels."""
    if masks in ("files", "none"):
        return None, ""
    if choice.sam is None:
        segmenter = PlaneOrRegionSegmenter(region=PieceSegmenter().region)
        return segmenter, repr(segmenter)
    from gsjax.perception.sam import load_sam

    try:
        sam, key = load_sam(choice.sam), f"sam {folder_digest(choice.sam)}"
    except OSError as error:
        raise ValueError(f"--sam: {error}") from error
    if choice.level == "default":
        return sam, key
    return (lambda image, depth, K: sam.levels(image)), f"{key} levels"


def _names(views: list[_View], known: Mapping[int, str]) -> dict[int, str]:
    """The name of each label that occurs."""
    there = sorted({label for view in views for label in view.labels.tolist() if label > 0})
    if there == [1] and not known:
        return {0: "background", 1: "foreground"}
    names = {label: known.get(label, f"object {label}") for label in there}
    return distinct_names(names, ("background", "unlabelled"))


def _ids(views: list[list[_View]] | None) -> list[np.ndarray] | None:
    return None if views is None else [levels[0].ids for levels in views]


def _expect_shape(one: PictureFeatures, photographs: Photographs, i: int) -> None:
    """Raises ValueError if the aspect ratio of a file is not that of its photograph."""
    width, height = (int(side) for side in photographs.sizes[i])
    rows, columns = np.shape(one.ids if one.map is None else one.map)[:2]
    # A grid of square patches may leave up to one patch uncovered at the far end of each axis.
    stretch = _STRETCH if one.map is None else np.log(1 + 1.5 / min(rows, columns))
    if abs(np.log((columns / rows) / (width / height))) > stretch:
        what, axes = ("masks", "[H,W]") if one.map is None else ("features", "[h,w,C]")
        raise ValueError(
            f"{one.path}: expected {what} {axes} with the aspect ratio of {photographs.names[i]}, "
            f"{width}x{height}, found {columns}x{rows}; are axes swapped?"
        )


def _resized(masks: np.ndarray | None, photographs: Photographs, i: int) -> np.ndarray:
    """The masks of a feature file, resized to its photograph."""
    assert masks is not None
    width, height = (int(side) for side in photographs.sizes[i])
    if masks.shape[:2] == (height, width):
        return masks
    kind = np.uint8 if masks.dtype == bool else masks.dtype
    large = cv2.resize(masks.astype(kind), (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    return large.astype(masks.dtype)
