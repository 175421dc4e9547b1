"""Features that others have computed, as their tools leave them: one picture's, or those of a folder.

layout          files of a picture NAME                       what they hold
langsplat       NAME_s.npy, NAME_f.npy                        [4,H,W] rows (-1: none), at four sizes of
                                                              objects, of [n,512]
feature-3dgs    NAME_fmap_CxHxW.npy, or .pt                   [C,H,W]: LSeg's, SAM's
lerf            level_0.npy, level_1.npy, ... (CLIP), or      [pictures,h,w,C], in the order of the pictures
                any one .npy of that shape (DINO)
plain           NAME.npy, or .npz with `features`             [h,w,C]
plain           NAME.npz with `ids` and `codebook`            [H,W] rows (-1: none) of [n,C]

Pickles are never loaded; of .pt files only the one tensor is read (`gsjax.perception.torch_arrays`).
"""

import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float, Int

from gsjax.perception.torch_arrays import read_torch_array

LANGSPLAT_LEVELS = ("default", "small", "medium", "large")
_LAYOUTS = (
    "NAME_s.npy with NAME_f.npy (LangSplat), NAME_fmap_CxHxW.npy or .pt (Feature-3DGS), level_0.npy (LERF), "
    "NAME.npy, or NAME.npz with features, or with ids and codebook"
)


@dataclass(frozen=True, eq=False)
class PictureFeatures:
    """What a file says of a picture: masks with an embedding each, or a feature a pixel.

    Attributes:
        path: the file.
        ids: rows of the codebook, [H,W]; -1 where it says nothing. None for maps.
        codebook: [n,C]. None for maps.
        map: [h,w,C]. None for masks.
    """

    path: Path
    ids: Int[np.ndarray, "..."] | None = None
    codebook: Float[np.ndarray, "..."] | None = None
    map: Float[np.ndarray, "..."] | None = None

    @property
    def dimension(self) -> int:
        numbers = self.codebook if self.map is None else self.map
        assert numbers is not None
        return numbers.shape[-1]


def read_feature_folder(
    folder: Path, names: Sequence[str], *, level: str = "default"
) -> list[PictureFeatures]:
    """The features of pictures by their names, whatever the layout.

    Args:
        folder: has the files.
        names: of the pictures; folders before them and what follows the last dot do not count.
        level: of LangSplat's files, which size of objects: default, small, medium, large.

    Raises:
        FileNotFoundError: there is no such folder, or nothing in it for a picture.
        ValueError: a file is not what its name says, is not finite, or has another dimension than the others.
    """
    if not folder.is_dir():
        found = "a file" if folder.exists() else "nothing"
        raise FileNotFoundError(f"{folder}: expected a folder of features ({_LAYOUTS}), found {found}")
    if level not in LANGSPLAT_LEVELS:
        raise ValueError(f"level: expected one of {', '.join(LANGSPLAT_LEVELS)}, found {level!r}")
    stacked, found = _stacked(folder, len(names)), []
    for i, name in enumerate(names):
        one = _of_picture(folder, PurePosixPath(name), level) if stacked is None else stacked[i]
        _check(one)
        found.append(one)
        if one.dimension != found[0].dimension:
            raise ValueError(
                f"{one.path}: expected features of {found[0].dimension} numbers as in {found[0].path.name}, "
                f"found {one.dimension}; take files of one encoder"
            )
    return found


def _of_picture(folder: Path, name: PurePosixPath, level: str) -> PictureFeatures:
    for stem in dict.fromkeys((str(name.with_suffix("")), name.stem, str(name), name.name)):
        base = folder / stem
        rows, table = Path(f"{base}_s.npy"), Path(f"{base}_f.npy")
        if rows.is_file() and table.is_file():
            return _langsplat(rows, table, level)
        for suffix in ("_fmap_CxHxW.npy", "_fmap_CxHxW.pt"):
            if (path := Path(f"{base}{suffix}")).is_file():
                array = _load(path)
                _expect(path, array, 3, "[C,H,W]")
                return PictureFeatures(path, map=np.moveaxis(array, 0, -1).astype(np.float32))
        for suffix in (".npy", ".pt", ".pth"):
            if (path := Path(f"{base}{suffix}")).is_file():
                array = _load(path)
                _expect(path, array, 3, "[h,w,C]")
                return PictureFeatures(path, map=array.astype(np.float32))
        if (path := Path(f"{base}.npz")).is_file():
            return _archive(path)
    listed = ", ".join(sorted(entry.name for entry in folder.iterdir())[:6]) or "nothing"
    raise FileNotFoundError(f"{folder}: expected features of the picture {name} ({_LAYOUTS}), found {listed}")


def _langsplat(rows: Path, table: Path, level: str) -> PictureFeatures:
    ids, codebook = _load(rows), _load(table)
    _expect(rows, ids, 3, "[4,H,W]")
    _expect(table, codebook, 2, "[n,C]")
    place = LANGSPLAT_LEVELS.index(level)
    if len(ids) <= place:
        raise ValueError(f"{rows}: expected {len(LANGSPLAT_LEVELS)} sizes of objects, found {len(ids)}")
    if not np.array_equal(ids, np.rint(ids)):
        raise ValueError(f"{rows}: expected rows of {table.name}, whole numbers, found others")
    return PictureFeatures(rows, ids[place].astype(np.int32), codebook.astype(np.float32))


def _archive(path: Path) -> PictureFeatures:
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = dict(stored)
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(
            f"{path}: expected plain arrays, found a file that cannot be read ({error})"
        ) from error
    if "features" in arrays:
        _expect(path, arrays["features"], 3, "features of shape [h,w,C]")
        return PictureFeatures(path, map=arrays["features"].astype(np.float32))
    if {"ids", "codebook"} <= arrays.keys():
        _expect(path, arrays["ids"], 2, "ids of shape [H,W]")
        _expect(path, arrays["codebook"], 2, "a codebook of shape [n,C]")
        return PictureFeatures(path, arrays["ids"].astype(np.int32), arrays["codebook"].astype(np.float32))
    listed = ", ".join(arrays) or "nothing"
    raise ValueError(f"{path}: expected features, or ids and codebook, found {listed}")


def _stacked(folder: Path, count: int) -> list[PictureFeatures] | None:
    """LERF's: all pictures in one file. Of several levels the finest, whose crops are the smallest."""
    path = folder / "level_0.npy"
    if not path.is_file():
        return None
    maps = _load(path)
    _expect(path, maps, 4, "[pictures,h,w,C]")
    if len(maps) != count:
        raise ValueError(
            f"{path}: expected features of {count} pictures, found {len(maps)}; it goes by order"
        )
    return [PictureFeatures(path, map=one.astype(np.float32)) for one in maps]


def _load(path: Path) -> np.ndarray:
    if path.suffix in (".pt", ".pth"):
        return read_torch_array(path)
    try:
        return np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise ValueError(
            f"{path}: expected a plain array, found a file that cannot be read ({error})"
        ) from error


def _expect(path: Path, array: np.ndarray, axes: int, shape: str) -> None:
    if array.ndim != axes or array.dtype.kind not in "iuf" or 0 in array.shape:
        raise ValueError(f"{path}: expected numbers {shape}, found {array.dtype} {list(array.shape)}")


def _check(features: PictureFeatures) -> None:
    numbers = features.codebook if features.map is None else features.map
    if not np.isfinite(numbers).all():
        wrong = int((~np.isfinite(numbers)).sum())
        raise ValueError(f"{features.path}: expected numbers, found {wrong} that are NaN or infinite")
    if features.ids is not None and not -1 <= features.ids.min() <= features.ids.max() < len(numbers):
        found = f"{features.ids.min()} to {features.ids.max()}"
        raise ValueError(f"{features.path}: expected rows -1 to {len(numbers) - 1}, found {found}")
