"""Reads features computed by other tools, in the layouts that those tools write.

layout          files for an image NAME                       contents
langsplat       NAME_s.npy, NAME_f.npy                        [4,H,W] rows (-1: none) of [n,512], for four
                                                              sizes of objects
feature-3dgs    NAME_fmap_CxHxW.npy, or .pt                   [C,H,W]: LSeg's, SAM's
lerf            level_0.npy, level_1.npy, ... (CLIP), or      [images,h,w,C], in the order of the images
                the folder's only .npy (DINO)
plain           NAME.npy, or .npz with `features`             [h,w,C]
plain           NAME.npz with `ids` and `codebook`            [H,W] rows (-1: none) of [n,C]

Pickles are never loaded: a .pt file must hold a single tensor (`gsjax.perception.torch_arrays`).
"""

import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.lib import format as npy

from gsjax.perception.levels import LEVELS, joined_levels
from gsjax.perception.torch_arrays import read_torch_array

LANGSPLAT_LEVELS = ("default", *LEVELS)
EACH = "each"
"""The level that stands for small, medium and large together."""
_LAYOUTS = (
    "NAME_s.npy with NAME_f.npy (LangSplat), NAME_fmap_CxHxW.npy or .pt (Feature-3DGS), level_0.npy or "
    "one .npy of all images (LERF), NAME.npy, or NAME.npz with features, or with ids and codebook"
)
_LONGEST = 200  # characters quoted from a file
# Masks compress a thousandfold but are small; features are large but compress far less.
_LARGE, _MOST_PACKED = 2**30, 100  # bytes; largest compression ratio


@dataclass(frozen=True, eq=False)
class PictureFeatures:
    """The features of one image: masks with one embedding each, or a feature per pixel.

    Attributes:
        path: the file.
        ids: row of the codebook for each pixel, [H,W]; -1 where there is none. None for maps.
        codebook: embeddings of the masks, [n,C]. None for maps.
        map: features of the pixels, [h,w,C]. None for masks.
        filled: with all levels, those on which a pixel has the mask of another level, [H,W,levels]. None for
            one level.
    """

    path: Path
    ids: Int[np.ndarray, "..."] | None = None
    codebook: Float[np.ndarray, "..."] | None = None
    map: Float[np.ndarray, "..."] | None = None
    filled: Bool[np.ndarray, "..."] | None = None

    @property
    def dimension(self) -> int:
        """C, the length of a feature."""
        numbers = self.codebook if self.map is None else self.map
        assert numbers is not None
        return numbers.shape[-1]


def read_feature_folder(
    folder: Path, names: Sequence[str], *, which: Sequence[int] | None = None, level: str = "default"
) -> list[PictureFeatures]:
    """Read the features of images by name, in any of the layouts.

    Args:
        folder: the folder of the files.
        names: names of all images. Suffixes are ignored, and leading folders too where that is unambiguous.
        which: indices of the images to read; with one file per image, only these have to exist. Default: all.
        level: size of objects to read from LangSplat's files: default, small, medium or large; or "each" for
            the last three together, with codebooks as from `joined_levels`.

    Raises:
        FileNotFoundError: the folder does not exist, or has no features for an image.
        ValueError: the content of a file does not match its name, is not finite, or has another dimension
            than the others, or a file matches several images.
    """
    if not folder.is_dir():
        found = "a file" if folder.exists() else "nothing"
        raise FileNotFoundError(f"{folder}: expected a folder of features ({_LAYOUTS}), found {found}")
    if level not in (*LANGSPLAT_LEVELS, EACH):
        raise ValueError(f"level: expected one of {', '.join(LANGSPLAT_LEVELS)} and {EACH}, found {level!r}")
    read: list[PictureFeatures] = []
    for features in _pictures(folder, names, range(len(names)) if which is None else which, level):
        _check(features)
        if level == EACH and not features.path.name.endswith("_s.npy"):
            raise ValueError(
                f"{features.path}: expected LangSplat's NAME_s.npy and NAME_f.npy, which have levels, found "
                "features on one level; leave out --level"
            )
        read.append(features)
        if features.dimension != read[0].dimension:
            raise ValueError(
                f"{features.path}: expected features of {read[0].dimension} numbers as in "
                f"{read[0].path.name}, found {features.dimension}; use files of a single encoder"
            )
    return read


def _pictures(
    folder: Path, names: Sequence[str], which: Sequence[int], level: str
) -> Iterator[PictureFeatures]:
    """The features one by one, as stored in the files."""
    stack = folder / "level_0.npy"  # LERF's finest level, with the smallest crops
    files = [] if stack.is_file() else [_file(folder, PurePosixPath(name), level) for name in names]
    alone = list(folder.glob("*.npy"))
    if stack.is_file():
        yield from _stacked(stack, _mapped(stack), len(names), which)
    elif not any(files) and len(alone) == 1 and (maps := _mapped(alone[0])).ndim == 4:
        yield from _stacked(alone[0], maps, len(names), which)
    else:
        _check_unique(files, names)
        for i in which:
            name, file = names[i], files[i]
            if file is None:
                there = sorted(entry.name for entry in folder.iterdir())
                listed = ", ".join(there[:6]) or "nothing"
                listed += f", ... ({len(there)} files)" if len(there) > 6 else ""
                raise FileNotFoundError(
                    f"{folder}: expected features of the image {name}, for example in "
                    f"{PurePosixPath(name).stem}.npy ({_LAYOUTS}), found {listed}"
                )
            yield file.read(file.path)


class _File(NamedTuple):
    """The file of an image, and its reader."""

    path: Path
    read: Callable[[Path], PictureFeatures]


def _file(folder: Path, name: PurePosixPath, level: str) -> _File | None:
    for stem in dict.fromkeys((str(name.with_suffix("")), name.stem, str(name), name.name)):
        base = folder / stem
        if Path(f"{base}_s.npy").is_file() and Path(f"{base}_f.npy").is_file():
            return _File(Path(f"{base}_s.npy"), partial(_langsplat, level=level))
        for suffix, read in _READERS.items():
            if (path := Path(f"{base}{suffix}")).is_file():
                return _File(path, read)
    return None


def _check_unique(files: Sequence[_File | None], names: Sequence[str]) -> None:
    """Leading folders of a name are ignored, so one file could match the images of several cameras."""
    pictures: dict[Path, str] = {}
    for file, name in zip(files, names, strict=True):
        if file is not None and (other := pictures.setdefault(file.path, name)) != name:
            raise ValueError(
                f"{file.path}: expected features of one image, found one that {other} and {name} both "
                "match; give each its own file under its full name, with a folder per camera"
            )


def _langsplat(rows: Path, level: str) -> PictureFeatures:
    table = rows.with_name(f"{rows.name.removesuffix('_s.npy')}_f.npy")
    ids, codebook = _load(rows), _load(table)
    _expect(rows, ids, 3, "[4,H,W]")
    _expect(table, codebook, 2, "[n,C]")
    places = [LANGSPLAT_LEVELS.index(one) for one in (LEVELS if level == EACH else (level,))]
    if len(ids) <= max(places):
        raise ValueError(f"{rows}: expected {len(LANGSPLAT_LEVELS)} levels, found {len(ids)}")
    wanted, codebook = _rows(rows, ids[places], len(codebook)), codebook.astype(np.float32)
    if level == EACH:
        ids, codebook, filled = joined_levels(list(wanted), [codebook] * len(wanted))
        return PictureFeatures(rows, ids, codebook, filled=filled)
    return PictureFeatures(rows, wanted[0], codebook)


def _channels_first(path: Path) -> PictureFeatures:
    array = _load(path)
    _expect(path, array, 3, "[C,H,W]")
    return PictureFeatures(path, map=np.moveaxis(array, 0, -1).astype(np.float32))


def _channels_last(path: Path) -> PictureFeatures:
    array = _load(path)
    _expect(path, array, 3, "[h,w,C]")
    return PictureFeatures(path, map=array.astype(np.float32))


def _archive(path: Path) -> PictureFeatures:
    with _as_value_error(path, "plain arrays"), zipfile.ZipFile(path) as archive:
        entries = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
        wanted = [entries[name] for name in ("features", "ids", "codebook") if name in entries]
        size = sum(entry.file_size for entry in wanted)
        if size > max(_LARGE, _MOST_PACKED * path.stat().st_size):
            raise ValueError(f"{path.stat().st_size} bytes that would unpack to {size}")
        arrays = {}
        for entry in wanted:
            with archive.open(entry) as part:
                arrays[entry.filename.removesuffix(".npy")] = npy.read_array(part, allow_pickle=False)
    if "features" in arrays:
        _expect(path, arrays["features"], 3, "features of shape [h,w,C]")
        return PictureFeatures(path, map=arrays["features"].astype(np.float32))
    if {"ids", "codebook"} <= arrays.keys():
        ids, codebook = arrays["ids"], arrays["codebook"]
        _expect(path, ids, 2, "ids of shape [H,W]")
        _expect(path, codebook, 2, "a codebook of shape [n,C]")
        return PictureFeatures(path, _rows(path, ids, len(codebook)), codebook.astype(np.float32))
    listed = ", ".join(entries)[:_LONGEST] or "nothing"
    raise ValueError(f"{path}: expected features, or ids and codebook, found {listed}")


_READERS = {
    "_fmap_CxHxW.npy": _channels_first,
    "_fmap_CxHxW.pt": _channels_first,
    ".npy": _channels_last,
    ".pt": _channels_last,
    ".pth": _channels_last,
    ".npz": _archive,
}


def _stacked(path: Path, maps: np.ndarray, count: int, which: Sequence[int]) -> Iterator[PictureFeatures]:
    """LERF's layout: one file of all images, or only of those wanted, since LERF stores training images."""
    _expect(path, maps, 4, "[images,h,w,C]")
    if len(maps) not in (count, len(which)):
        some = f", or of the {len(which)} that are selected" if len(which) < count else ""
        raise ValueError(
            f"{path}: expected features of {count} images{some}, found {len(maps)}; images are matched by "
            "order, so the file must hold exactly those that are used"
        )
    for i in which if len(maps) == count else range(len(which)):
        yield PictureFeatures(path, map=np.array(maps[i], np.float32))


def _mapped(path: Path) -> np.ndarray:
    """A memory-mapped stack, so that only the wanted images are read."""
    with _as_value_error(path, "a plain array"):
        return npy.open_memmap(path, mode="r")


def _load(path: Path) -> np.ndarray:
    if path.suffix in (".pt", ".pth"):
        return read_torch_array(path)
    if zipfile.is_zipfile(path):
        raise ValueError(f"{path}: expected a plain array, found an archive; name it {path.stem}.npz")
    with _as_value_error(path, "a plain array"), path.open("rb") as file:
        return npy.read_array(file, allow_pickle=False)


@contextmanager
def _as_value_error(path: Path, expected: str) -> Iterator[None]:
    """Turn every error into a ValueError; numpy, zipfile and the decompressors raise all kinds of them."""
    try:
        yield
    except Exception as error:
        reason = str(error)[:_LONGEST] or type(error).__name__
        raise ValueError(
            f"{path}: expected {expected}, found a file that cannot be read ({reason}); make it again, with "
            f"{'numpy.savez' if path.suffix == '.npz' else 'numpy.save'}"
        ) from error


def _expect(path: Path, array: np.ndarray, axes: int, shape: str) -> None:
    if array.ndim != axes or array.dtype.kind not in "iuf" or 0 in array.shape:
        raise ValueError(
            f"{path}: expected numbers of shape {shape}, found {array.dtype} of shape {list(array.shape)}"
        )


def _rows(path: Path, ids: np.ndarray, count: int) -> Int[np.ndarray, "*levels H W"]:
    """Rows of a codebook of `count` rows, checked before the cast to int32, which would wrap large ones."""
    if not np.array_equal(ids, np.rint(ids)):
        raise ValueError(f"{path}: expected rows of the codebook as whole numbers, found fractions")
    if not -1 <= ids.min() <= ids.max() < count:
        found = f"{ids.min():.0f} to {ids.max():.0f}"
        raise ValueError(f"{path}: expected rows -1 to {count - 1}, found {found}")
    return ids.astype(np.int32)


def _check(features: PictureFeatures) -> None:
    numbers = features.codebook if features.map is None else features.map
    if not np.isfinite(numbers).all():
        wrong = int((~np.isfinite(numbers)).sum())
        raise ValueError(f"{features.path}: expected finite numbers, found {wrong} that are NaN or infinite")
