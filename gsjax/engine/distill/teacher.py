"""Teachers of photographs: whose masks, whose features, and where they are kept."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int
from rich.console import Console
from rich.progress import track

from gsjax.data.errors import DataWarning
from gsjax.data.photographs import Photographs
from gsjax.engine.distill.cache import FeatureCache, content_digest, folder_digest
from gsjax.engine.distill.choice import TeacherChoice
from gsjax.engine.distill.source import ABOUT, Source
from gsjax.methods.distill import Teacher, teacher_of_maps, teacher_of_objects, with_maps
from gsjax.methods.distill.teacher import UNKNOWN_ID
from gsjax.methods.protocols import LanguageEncoder, Segmenter
from gsjax.perception.feature_files import PictureFeatures, read_feature_folder
from gsjax.perception.outlines import snap_outlines
from gsjax.perception.segmenters import PieceSegmenter, PlaneOrRegionSegmenter

_OF_OBJECTS = ("classes", "closed", "clip")
_STRETCH = 0.02  # tolerance of the logarithm of the aspect ratio of a feature file's masks
_IN_FILES = "in the feature files"
_VERSION = 2  # of kept outputs; those of others are computed again


class _View(NamedTuple):
    """Masks of a photograph.

    Attributes:
        ids: index in `labels` of what each pixel shows; -1 where unknown.
        labels: the labels that occur, in order; 0 is the background, which is a thing like others.
    """

    ids: Int[np.ndarray, "h w"]
    labels: Int[np.ndarray, "n"]


class Teaching:
    """The teacher of a scene's photographs. Encoder and names are settled by those to learn from, so that
    held-out photographs have features in the same terms.

    Attributes:
        teacher: of the photographs to learn from, in their order.
        source: of its features.
        masks: source of the masks: "files", "segment", "sam", "in the feature files", or "none".
        about: the features in words.
    """

    def __init__(
        self,
        photographs: Photographs,
        indices: Sequence[int],
        asked: TeacherChoice,
        cache: FeatureCache,
        console: Console,
    ):
        """Segments and encodes photographs.

        Args:
            photographs: of the scene.
            indices: indices of those to learn from.
            asked: the choice of masks and features; checked.
            cache: earlier outputs.
            console: shows the progress.

        Raises:
            ValueError: there are no masks, feature files do not fit, or a package is missing.
            FileNotFoundError: files of features or weights are not there.
        """
        self._photographs, self._indices = photographs, list(indices)
        self._asked, self._cache = asked, cache
        # First what may be missing, then what takes long.
        clip, weights = (None, "") if asked.weights is None else _clip(asked.weights)
        reads = asked.masks != "segment" and asked.sam is None
        reads &= asked.masks == "files" or asked.features in ("auto", *_OF_OBJECTS)
        files = [photographs.labels(i) if reads else None for i in indices]
        kind, self.masks = _settled(asked, any(one is not None for one in files), photographs.name)
        self._segmenter, self._segments = _segmenter(asked, self.masks)
        views, names = None, {}
        if self.masks != "none":
            shown = track(indices, "masks", console=console, transient=True)
            views = [self._view(i, one) for i, one in zip(shown, files, strict=True)]
        if views is not None and self.masks == "files" and kind in _OF_OBJECTS:
            names = _names(views, photographs.label_names)
        where = Path(asked.features) if kind == "files" else asked.weights
        self.source = Source(
            kind,
            {label + 1: name for label, name in names.items()},
            None if where is None else str(where.resolve()),
        )
        self.about = ABOUT[kind] + (", and its vectors of patches" if asked.second == "maskclip" else "")
        # For an encoder labels are 1 to n, whatever their values; CLIP needs no names.
        self._named = () if kind == "clip" else tuple(names)
        named = {n: names[label] for n, label in enumerate(self._named, start=1)}
        self._encoder: Any = Source(kind, named).encoder() if kind in ("classes", "closed") else clip
        self._who = f"{kind} {named} {weights} {_VERSION}"
        self._who_of_patches = f"maskclip {weights} {_VERSION}"
        self.teacher = self._taught(views, console)

    def of(self, i: int) -> Teacher | None:
        """The teacher of one photograph, by its masks or else by its map; None where nothing is known.

        Raises:
            ValueError, OSError: it cannot be read, or its file of features does not fit.
        """
        views = None
        if self.masks not in ("none", _IN_FILES):
            views = [self._view(i, self._photographs.labels(i) if self.masks == "files" else None)]
        if self.source.kind == "files":
            (one,) = self._files([i])
            if one.dimension != self.teacher.dimension:
                raise ValueError(
                    f"{one.path}: expected features of {self.teacher.dimension} numbers as in the files that "
                    f"taught, found {one.dimension}; take files of one encoder"
                )
            if one.map is not None:
                return teacher_of_maps([one.map], self._sizes([i]), _ids(views))
            ids, rows = _as_large(one, self._photographs, i), one.codebook
        elif self.source.kind == "maskclip":
            return self._of_patches([i], views, Console(quiet=True))
        else:
            assert views is not None
            ids, rows = views[0].ids, self._embedded(i, views[0])
        known = np.asarray(rows)[np.unique(ids[ids >= 0])].any()
        return teacher_of_objects([ids], [rows]) if known else None

    def digest(self) -> str:
        """SHA-256 over the teacher and the poses, which tells whether two distillations learn the same."""
        teacher, photographs = self.teacher, self._photographs
        arrays = {f"ids {v}": ids for v, ids in enumerate(teacher.ids)}
        arrays |= {f"map {v}": one for v, one in enumerate(teacher.maps or ())}
        arrays |= {} if teacher.codebook is None else {"codebook": teacher.codebook}
        arrays |= {name: getattr(photographs, name)[self._indices] for name in ("sizes", "Ks", "viewmats")}
        return content_digest("lesson", arrays)

    def _taught(self, views: list[_View] | None, console: Console) -> Teacher:
        indices = self._indices
        if self.source.kind == "maskclip":
            return self._of_patches(indices, views, console)
        if self.source.kind == "files":
            found = self._files(indices)
            maps = [one.map for one in found if one.map is not None]
            if len(maps) == len(found):
                return teacher_of_maps(maps, self._sizes(indices), _ids(views))
            if maps:
                raise ValueError(
                    f"{self._asked.features}: expected files of one kind, found a feature a pixel in "
                    f"{len(maps)} and masks with embeddings in {len(found) - len(maps)}"
                )
            self.masks = _IN_FILES
            ids = [_as_large(one, self._photographs, i) for one, i in zip(found, indices, strict=True)]
            rows = [one.codebook for one in found]
        else:
            assert views is not None
            shown = track(indices, "features", console=console, transient=True)
            rows = [self._embedded(i, view) for i, view in zip(shown, views, strict=True)]
            ids = [view.ids for view in views]
        with warnings.catch_warnings():  # named below
            warnings.filterwarnings("ignore", "views without any mask")
            teacher = teacher_of_objects(ids, rows)
        if self._asked.second != "none":
            return with_maps(teacher, self._of_patches(indices, views, console))
        silent = [i for i, one in zip(indices, teacher.ids, strict=True) if not (one >= 0).any()]
        if silent:
            some = ", ".join(self._photographs.names[i] for i in silent[:8])
            more = f" and {len(silent) - 8} more" if len(silent) > 8 else ""
            message = f"photographs of which no mask says anything teach nothing: {some}{more}"
            warnings.warn(message, DataWarning, stacklevel=2)
        return teacher

    def _view(self, i: int, file: np.ndarray | None) -> _View:
        """Masks of a photograph: those of its file, or a segmenter's."""
        photographs = self._photographs
        labels = np.full(photographs.sizes[i][::-1], UNKNOWN_ID) if file is None else file.astype(np.int64)
        if (segmenter := self._segmenter) is not None:
            image, depth, K = photographs.image(i), photographs.depth(i), photographs.Ks[i]
            shown = {"image": image, "K": K} | ({} if depth is None else {"depth": depth})
            found = self._cache(self._segments, shown, lambda: {"labels": segmenter(image, depth, K)})
            labels = found["labels"].astype(np.int64)
            if self.masks == "sam" or depth is None:  # no background here: 0 is what lies in no mask
                labels = np.where(labels == 0, UNKNOWN_ID, labels)
        if self._asked.snap:
            labels = snap_outlines(labels, photographs.image(i), self._asked.snap)
        if (counted := photographs.mask(i)) is not None:
            labels = np.where(counted, labels, UNKNOWN_ID)
        there, place = np.unique(np.maximum(labels, UNKNOWN_ID), return_inverse=True)
        unknown = int((there < 0).sum())
        return _View((place.reshape(labels.shape) - unknown).astype(np.int32), there[unknown:])

    def _embedded(self, i: int, view: _View) -> Float[np.ndarray, "n d"]:
        """The vectors of a photograph's labels; zeros for one that the encoder does not know."""
        numbers = {label: n for n, label in enumerate(self._named, start=1)}
        of_labels = [numbers.setdefault(label, len(numbers) + 1) for label in view.labels.tolist()]
        image = self._photographs.image(i)

        def embed() -> dict[str, np.ndarray]:
            shown = np.array([0, *of_labels])[view.ids + 1]
            rows = np.asarray(self._encoder.embed_objects(image, shown, max(1, len(numbers))), np.float32)
            return {"rows": rows[np.array(of_labels or [1]) - 1]}  # zeros where there is no label

        return self._cache(self._who, {"image": image, **view._asdict()}, embed)["rows"]

    def _of_patches(self, indices: Sequence[int], views: list[_View] | None, console: Console) -> Teacher:
        """MaskCLIP's maps; masks, where there are any, tell what is one thing."""
        from gsjax.perception.maskclip import MaskClipEncoder

        encoder, maps = MaskClipEncoder(self._encoder), []
        for i in track(indices, "patches", console=console, transient=True):
            image = self._photographs.image(i)
            output = self._cache(
                self._who_of_patches, {"image": image}, lambda image=image: {"map": encoder(image[None])[0]}
            )
            maps.append(output["map"])
        return teacher_of_maps(maps, self._sizes(indices), _ids(views))

    def _files(self, indices: Sequence[int]) -> list[PictureFeatures]:
        """Features of photographs from a folder."""
        folder, photographs = Path(self._asked.features), self._photographs
        found = read_feature_folder(folder, photographs.names, which=indices, level=self._asked.level)
        for one, i in zip(found, indices, strict=True):
            _expect_shape(one, photographs, i)
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
        ValueError, FileNotFoundError: as `TeacherChoice.check` and `Teaching`.
    """
    if isinstance(wanted, Teacher):
        return wanted, Source("files")
    choice = TeacherChoice(wanted) if isinstance(wanted, str) else wanted
    choice.check()
    every, quiet = range(photographs.num), Console(quiet=True)
    teaching = Teaching(photographs, every, choice, FeatureCache(), quiet)
    return teaching.teacher, teaching.source


def _settled(asked: TeacherChoice, files: bool, name: str) -> tuple[Any, str]:
    """The kind of features and the source of masks, with "auto" settled.

    Args:
        asked: the choice.
        files: whether there are mask files.
        name: name of the photographs.
    """
    if asked.masks == "files" and not files:
        raise ValueError(f"--masks files: {name} has none of these photographs; use --masks segment")
    masks = "sam" if asked.sam is not None else "files" if files else "segment"
    kind = "files" if asked.of_files else asked.features
    if kind == "auto":
        kind = "classes" if masks == "files" else "closed"
    if kind == "classes" and masks != "files":
        raise ValueError(
            "--features classes: they are the classes of mask files, and masks here are a segmenter's; use "
            "closed, or clip with its --weights"
        )
    if kind not in _OF_OBJECTS and asked.masks == "auto" and asked.sam is None:
        masks = "none"
    return kind, masks


def _clip(weights: Path) -> tuple[LanguageEncoder, str]:
    """CLIP, and what identifies it in the cache."""
    from gsjax.perception.clip import load_clip

    try:
        return load_clip(weights), folder_digest(weights)
    except OSError as error:
        raise ValueError(f"--weights: {error}") from error


def _segmenter(asked: TeacherChoice, masks: str) -> tuple[Segmenter | None, str]:
    """The segmenter, where one is needed, and what identifies it in the cache."""
    if masks in ("files", "none"):
        return None, ""
    if asked.sam is None:
        segmenter = PlaneOrRegionSegmenter(region=PieceSegmenter().region)
        return segmenter, repr(segmenter)
    from gsjax.perception.sam import load_sam

    try:
        return load_sam(asked.sam), f"sam {folder_digest(asked.sam)}"
    except OSError as error:
        raise ValueError(f"--sam: {error}") from error


def _names(views: list[_View], known: Mapping[int, str]) -> dict[int, str]:
    """The name of each label that occurs."""
    there = sorted({label for view in views for label in view.labels.tolist() if label > 0})
    if there == [1] and not known:
        return {0: "background", 1: "foreground"}
    return {0: "background"} | {label: known.get(label, f"object {label}") for label in there}


def _ids(views: list[_View] | None) -> list[np.ndarray] | None:
    return None if views is None else [view.ids for view in views]


def _expect_shape(one: PictureFeatures, photographs: Photographs, i: int) -> None:
    """Raises a ValueError where a file belongs to a picture of another shape."""
    width, height = (int(side) for side in photographs.sizes[i])
    rows, columns = np.shape(one.ids if one.map is None else one.map)[:2]
    # A grid of square patches leaves up to one of them at the far side of each axis.
    stretch = _STRETCH if one.map is None else np.log(1 + 1.5 / min(rows, columns))
    if abs(np.log((columns / rows) / (width / height))) > stretch:
        what, axes = ("masks", "[H,W]") if one.map is None else ("features", "[h,w,C]")
        raise ValueError(
            f"{one.path}: expected {what} {axes}, as wide for their height as {photographs.names[i]}, "
            f"{width}x{height}, found {columns}x{rows}; are axes swapped?"
        )


def _as_large(one: PictureFeatures, photographs: Photographs, i: int) -> Int[np.ndarray, "h w"]:
    """Row of a file's codebook for each pixel of its photograph."""
    assert one.ids is not None
    width, height = (int(side) for side in photographs.sizes[i])
    if one.ids.shape == (height, width):
        return one.ids
    return cv2.resize(one.ids, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
