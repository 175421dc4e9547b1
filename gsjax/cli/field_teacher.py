"""What photographs are to say of a scene: whose masks, whose features, and where they are kept."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Int
from rich.console import Console
from rich.progress import track

from gsjax.cli.feature_cache import FeatureCache, folder_digest
from gsjax.cli.field_source import KINDS, Source
from gsjax.data.photographs import Photographs
from gsjax.methods.feature_field.teacher import UNKNOWN_ID, Teacher, teacher_of_maps, teacher_of_objects
from gsjax.methods.protocols import LanguageEncoder, Segmenter
from gsjax.perception.feature_files import PictureFeatures, read_feature_folder
from gsjax.perception.segmenters import PieceSegmenter, PlaneOrRegionSegmenter

Masks = Literal["auto", "files", "segment"]
_STRETCH = 0.02  # by which the sides of a feature file may be off


@dataclass(frozen=True)
class Asked:
    """Whose masks and features.

    Attributes:
        features: an encoder (`field_source.KINDS`), a folder of files, or "auto".
        masks: those of files, those of a segmenter, or "auto".
        sam: folder of SAM's weights; a segmenter without weights unless given.
        weights: folder of CLIP's.
        level: of LangSplat's files.
    """

    features: str = "auto"
    masks: Masks = "auto"
    sam: Path | None = None
    weights: Path | None = None
    level: str = "default"

    def check(self) -> None:
        """Raises ValueError where these contradict each other, FileNotFoundError for files not there."""
        files = self.features not in ("auto", *KINDS)
        if files and not Path(self.features).is_dir():
            found = "a file" if Path(self.features).exists() else "none of these"
            raise FileNotFoundError(
                f"--features {self.features}: expected {', '.join(KINDS)}, or a folder of feature files, "
                f"found {found}"
            )
        if self.features in ("clip", "maskclip") and self.weights is None:
            raise ValueError(f"--features {self.features}: expected --weights PATH too, a folder of CLIP's")
        if self.features in ("closed", "classes") and self.weights is not None:
            raise ValueError(f"--weights: {self.features} has none; they are for --features clip or maskclip")
        if self.sam is not None and self.masks == "files":
            raise ValueError("--sam: expected --masks segment, for SAM is a segmenter; found --masks files")


@dataclass(frozen=True, eq=False)
class Said:
    """A teacher, and what it is.

    Attributes:
        teacher: of the views that were asked for, in this order.
        source: of its features.
        masks: "files", "segment", "sam", or "none".
        notes: what is odd about it.
    """

    teacher: Teacher
    source: Source
    masks: str
    notes: tuple[str, ...] = field(default=())


def teach(
    photographs: Photographs, indices: Sequence[int], asked: Asked, cache: FeatureCache, console: Console
) -> Said:
    """Has photographs encoded.

    Args:
        photographs: of the scene.
        indices: which of them are to teach.
        asked: whose masks and features.
        cache: what was said before.
        console: shows how far it is.

    Raises:
        ValueError: there are no masks, feature files do not fit, or a package is missing.
        FileNotFoundError: files or weights are not there.
    """
    asked.check()
    named = [photographs.labels(i) is not None for i in indices] if photographs.load_labels else [False]
    masks = "segment" if asked.sam is not None else asked.masks
    if masks == "files" and not any(named):
        raise ValueError(
            f"--masks files: {photographs.name} has none of these photographs; use --masks segment"
        )
    if masks == "auto":
        masks = "files" if any(named) else "segment"
    kind: Any = asked.features
    if kind == "auto":
        kind = "classes" if masks == "files" else "closed"
    if kind == "classes" and masks != "files":
        raise ValueError(
            "--features classes: they are the classes of mask files, and masks here are a segmenter's; use "
            "closed, or clip with its --weights"
        )
    of_objects = kind in ("classes", "closed", "clip")
    labels = None
    if of_objects or asked.masks != "auto" or asked.sam is not None:
        segmenter = None if masks == "files" else _segmenter(asked)
        shown = track(indices, "masks", console=console, transient=True)
        labels = [_labels(photographs, i, segmenter, asked.sam, cache) for i in shown]
    whose = "none" if labels is None else "sam" if asked.sam is not None else masks
    if kind not in KINDS:
        return _of_files(photographs, indices, labels, whose, asked)
    names = _names(labels, photographs.label_names) if labels is not None and masks == "files" else {}
    weights = None if asked.weights is None else str(asked.weights.resolve())
    source = Source(kind, {label + 1: name for label, name in names.items()} if of_objects else {}, weights)
    who = _identity(source, asked)
    images = (photographs.image(i) for i in track(indices, "features", console=console, transient=True))
    if labels is None or not of_objects:
        maps = _of_patches(images, who, asked, cache)
        return Said(teacher_of_maps(maps, _sizes(photographs, indices), labels), source, whose)
    encoder, rows = source.encoder(), []
    for image, one in zip(images, labels, strict=True):

        def embed(image=image, one=one):
            return {"rows": _embedded(encoder, image, one)}

        rows.append(cache(who, {"image": image, "labels": one}, embed)["rows"])
    return Said(teacher_of_objects(labels, rows), source, whose)


def _of_files(
    photographs: Photographs,
    indices: Sequence[int],
    labels: list[np.ndarray] | None,
    whose: str,
    asked: Asked,
) -> Said:
    """A teacher from a folder; masks, where there are any beside it, say what is one thing."""
    folder = Path(asked.features)
    found = read_feature_folder(folder, [photographs.names[i] for i in indices], level=asked.level)
    source = Source("files", {}, str(folder.resolve()))
    maps = [one.map for one in found if one.map is not None]
    if len(maps) == len(found):
        return Said(teacher_of_maps(maps, _sizes(photographs, indices), labels), source, whose)
    if maps:
        raise ValueError(
            f"{folder}: expected files of one kind, found a feature a pixel in {len(maps)} and masks with "
            f"embeddings in {len(found) - len(maps)}"
        )
    ids = [_as_large(one, photographs, i) for one, i in zip(found, indices, strict=True)]
    return Said(teacher_of_objects(ids, [one.codebook for one in found]), source, "in the feature files")


def _of_patches(
    images: Iterable[np.ndarray], who: str, asked: Asked, cache: FeatureCache
) -> list[np.ndarray]:
    """MaskCLIP's maps."""
    from gsjax.perception.maskclip import load_maskclip

    assert asked.weights is not None
    try:
        encoder = load_maskclip(asked.weights)
    except ImportError as error:
        raise ValueError(f"--features maskclip: {error}") from error
    return [
        cache(who, {"image": image}, lambda image=image: {"map": encoder(image[None])[0]})["map"]
        for image in images
    ]


def _labels(
    photographs: Photographs, i: int, segmenter: Segmenter | None, sam: Path | None, cache: FeatureCache
) -> Int[np.ndarray, "h w"]:
    """What each pixel shows, 0 the background as one more thing; -1 where nobody says."""
    if segmenter is None:
        found = photographs.labels(i)
        labels = np.full(photographs.sizes[i][::-1], UNKNOWN_ID) if found is None else found.astype(np.int64)
    else:
        image, depth, K = photographs.image(i), photographs.depth(i), photographs.Ks[i]
        shown = {"image": image, "K": K} | ({} if depth is None else {"depth": depth})
        who = repr(segmenter) if sam is None else f"sam {folder_digest(sam)}"
        labels = cache(who, shown, lambda: {"labels": segmenter(image, depth, K)})["labels"].astype(np.int64)
        if sam is not None or depth is None:  # these have no background: 0 is what lies in no mask
            labels = np.where(labels == 0, UNKNOWN_ID, labels)
    counted = photographs.mask(i)
    return labels if counted is None else np.where(counted, labels, UNKNOWN_ID)


def _segmenter(asked: Asked) -> Segmenter:
    if asked.sam is None:
        return PlaneOrRegionSegmenter(region=PieceSegmenter().region)
    from gsjax.perception.sam import load_sam

    try:
        return load_sam(asked.sam)
    except ImportError as error:
        raise ValueError(f"--sam: {error}") from error


def _names(labels: list[np.ndarray], known: Mapping[int, str]) -> dict[int, str]:
    """Of each label that occurs."""
    there = sorted({int(label) for one in labels for label in np.unique(one) if label > 0})
    if there == [1] and not known:
        return {0: "background", 1: "foreground"}
    return {0: "background"} | {label: known.get(label, f"object {label}") for label in there}


def _embedded(encoder: LanguageEncoder, image: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """The vectors of labels 0 to the largest: to an encoder the background is a thing like others."""
    count = int(labels.max(initial=0)) + 1
    return np.asarray(encoder.embed_objects(image, labels + 1, count), np.float32)


def _identity(source: Source, asked: Asked) -> str:
    """What an answer depends on beside what is shown."""
    weights = "" if asked.weights is None else folder_digest(asked.weights)
    return f"{source.kind} {dict(source.names)} {weights} 1"


def _as_large(one: PictureFeatures, photographs: Photographs, i: int) -> Int[np.ndarray, "h w"]:
    """Rows of a file for each pixel of its photograph."""
    assert one.ids is not None
    width, height = (int(side) for side in photographs.sizes[i])
    rows, columns = one.ids.shape
    if abs(np.log((columns / rows) / (width / height))) > _STRETCH:
        raise ValueError(
            f"{one.path}: expected masks of a picture of the shape of {photographs.names[i]}, "
            f"{width}x{height}, found {columns}x{rows}"
        )
    if (rows, columns) == (height, width):
        return one.ids
    return cv2.resize(one.ids, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)


def _sizes(photographs: Photographs, indices: Sequence[int]) -> list[tuple[int, int]]:
    """(height, width) of each."""
    return [(int(photographs.sizes[i][1]), int(photographs.sizes[i][0])) for i in indices]
