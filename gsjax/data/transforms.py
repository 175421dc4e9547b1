"""transforms.json of nerfstudio, instant-ngp and Blender (NeRF, D-NeRF): camera to world, OpenGL axes.

fl_x, fl_y, cx, cy, w, h       pixels, centres at +0.5; for all frames, or per frame
camera_angle_x, camera_angle_y radians, instead of focal lengths
k1 .. k4, p1, p2               OpenCV's lens distortion; camera_model (or is_fisheye) selects the model
frames[]                       file_path (Blender omits the extension), transform_matrix [4,4], optionally
                               mask_path (0 = ignored), depth_file_path or instant-ngp's depth_path (16 bits),
                               time
integer_depth_scale            instant-ngp's length of a depth step; depth_unit_scale_factor in nerfstudio;
                               enable_depth_loading false leaves depth out
train_filenames, ...           nerfstudio's splits: files in none of the lists are left out, as nerfstudio
                               does; Blender has a file per split: transforms_train.json, ...
ply_file_path                  nerfstudio's sparse points; default: sparse_pc.ply or points3D.ply, if there

Poses and points share one frame, so nerfstudio's applied_transform, which records how that frame was chosen,
and instant-ngp's scale, offset and aabb_scale, which place its grid, have no effect here.
"""

import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gsjax.data.clouds import find_cloud, read_cloud
from gsjax.data.errors import DataError, DataWarning
from gsjax.data.files import (
    BLACK,
    WHITE,
    Color,
    find_background,
    picture_size,
    read_depth,
    read_image,
    read_json,
)
from gsjax.data.lens import Lens, scaled_intrinsics
from gsjax.data.masks import read_shades
from gsjax.data.names import find_file, portable
from gsjax.data.origin import near_origin
from gsjax.data.photographs import Photographs
from gsjax.data.pictures import SUFFIXES, reject_unread
from gsjax.data.through_lenses import Fisheye, through_lenses
from gsjax.data.transforms_keys import (
    DEPTH_UNIT_M,
    DEPTHS,
    MODEL_KEYS,
    SPLITS,
    UNITS,
    warn_of_unknown_unit,
    warn_of_unread,
)
from gsjax.data.validation import check_poses
from gsjax.geometry.cameras import intrinsics, viewmat_from_opengl
from gsjax.io.brief import brief, shortened

_MODELS = dict.fromkeys(("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"), False)
_MODELS["OPENCV_FISHEYE"] = True


class _Frame(NamedTuple):
    name: str
    split: str | None
    viewmat: Float[np.ndarray, "4 4"]
    lens: Lens
    size: tuple[int, int]
    image: Path
    mask: Path | None
    depth: Path | None
    depth_unit: float
    time: float | None


@near_origin
def read_transforms(
    path: str | Path,
    *,
    background: Color = WHITE,
    depth_unit_m: float | None = None,
    fisheye: Fisheye = "undistort",
) -> Photographs:
    """The photographs listed in a transforms.json, or in a transforms_train.json and its siblings.

    Listed files that do not exist are left out with a DataWarning that counts them, as are frames without a
    finite pose and, if the file lists splits, frames in none of them. A file in two lists belongs to the
    later of train, val and test, so held-out photographs are never fitted. Distorted photographs are
    undistorted (see `gsjax.data.lens`). A photograph whose size differs from the stated one is treated as a
    downscaled copy.

    Args:
        path: the folder, or one such file.
        background: RGB, 0 to 1, behind transparent photographs; default: white, as is usual.
        depth_unit_m: length of one depth step; None: as the file states, else 0.001, as in nerfstudio.
        fisheye: whether fisheye photographs are undistorted or kept.

    Warns with DataWarning if the file has keys that look like data but are not read, or instant-ngp's depth
    without its unit.

    Raises:
        DataError: a file is missing or malformed, no frame is left, a camera model is unknown, or fisheyes
            are to be kept and not all lenses are fisheyes.
        ValueError: a pose is not a rigid motion.
    """
    root, files = _files(Path(path))
    frames: list[_Frame] = []
    missing: list[str] = []
    lost: list[str] = []
    listed, unnamed, cloud = 0, 0, None
    for file, split in files.items():
        meta = read_json(file)
        if not isinstance(meta, dict) or not isinstance(meta.get("frames"), list) or not meta["frames"]:
            raise DataError(file, "frames, a non-empty list", "none", "Is it a transforms.json?")
        named = _named_splits(file, meta)
        warn_of_unread(root, file, meta)
        if depth_unit_m is None:
            warn_of_unknown_unit(file, meta)
        listed += len(meta["frames"])
        for number, entry in enumerate(meta["frames"]):
            frame = _Entry(file, number, meta, entry)
            image = frame.image(root)
            own_split = split or named.get(_listed(entry["file_path"]))
            if named and own_split is None:
                unnamed += 1
                continue
            if image is None:
                missing.append(str(entry["file_path"]))
                continue
            pose = frame.pose()
            if pose is None:
                lost.append(str(entry["file_path"]))
                continue
            frames.append(frame.read(root, image, pose, own_split, depth_unit_m))
        points = meta.get("ply_file_path")
        if not isinstance(points, str | None):
            expected, advice = "ply_file_path, the name of a file", "Correct it, or leave it out."
            raise DataError(file, expected, brief(repr(points)), advice)
        points = find_cloud(root) if points is None else _beside(root, points)
        if cloud is None and points is not None:
            cloud = read_cloud(points)
    _report_left_out(root, listed, missing, lost, unnamed, len(frames))
    return _photographs(root, frames, cloud, background, fisheye)


def _files(path: Path) -> tuple[Path, dict[Path, str | None]]:
    """The folder, and the files to read, each with its split."""
    if path.suffix == ".json":
        return path.parent, {path: None}
    if (path / "transforms.json").is_file():
        return path, {path / "transforms.json": None}
    files: dict[Path, str | None] = {}
    for split in SPLITS:
        if (file := path / f"transforms_{split}.json").is_file():
            files[file] = split
    if not files:
        found = (
            ", ".join(sorted(entry.name for entry in path.iterdir())[:8])
            if path.is_dir()
            else "nothing there"
        )
        raise DataError(
            path, "transforms.json or transforms_train.json", found or "an empty folder", "Pass its folder."
        )
    return path, files


def _listed(name: Any) -> Path:
    """A normalised form of a name, the same for its different spellings."""
    return Path(portable(str(name)))


def _beside(root: Path, name: str) -> Path:
    """Path of a file that a name refers to, whether it exists or not."""
    return find_file(root, name) or root / name


def _named_splits(file: Path, meta: dict[str, Any]) -> dict[Path, str]:
    """The split of each photograph to which the file assigns one."""
    named = {}
    for split in SPLITS:
        names = meta.get(f"{split}_filenames") or []
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            expected = f"{split}_filenames, a list of names"
            raise DataError(file, expected, repr(names)[:80], "Correct or remove it.")
        named |= {_listed(name): split for name in names}
    if named and not meta.get("train_filenames"):
        found = (
            f"only {' and '.join(key for key in (f'{split}_filenames' for split in SPLITS) if meta.get(key))}"
        )
        advice = "Add it, or remove the other lists."
        raise DataError(file, "train_filenames as well as the other lists", found, advice)
    known = {_listed(entry.get("file_path")) for entry in meta["frames"] if isinstance(entry, dict)}
    if unknown := [str(name) for name in named if name not in known]:
        expected = "names of frames in train_filenames, val_filenames and test_filenames"
        found = f"{len(unknown)} that no frame has, for example {unknown[0]}"
        raise DataError(file, expected, found, "Correct or remove them.")
    return named


class _Entry(NamedTuple):
    """One frame of a file, together with the values that the file gives for all frames."""

    file: Path
    number: int
    meta: dict[str, Any]
    entry: dict[str, Any]

    def error(self, expected: str, found: Any, advice: str) -> DataError:
        return DataError(f"{self.file}, frame {self.number}", expected, str(found), advice)

    def value(self, *names: str) -> Any:
        """The value of the first of these keys that the frame, or else the file, has; None if none has."""
        for name in names:
            for place in (self.entry, self.meta):
                if place.get(name) is not None:
                    return place[name]
        return None

    def numeral(self, name: str) -> float | None:
        value = self.value(name)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise self.error(f"{name}, a number", repr(value), "Correct the file.")
        return float(value)

    def image(self, root: Path) -> Path | None:
        """Path of its photograph, whose name may lack the extension; None if there is no such file."""
        if not isinstance(self.entry, dict) or not isinstance(self.entry.get("file_path"), str):
            raise self.error("file_path and transform_matrix", repr(self.entry)[:80], "Correct the file.")
        return find_file(root, self.entry["file_path"], SUFFIXES)

    def pose(self) -> Float[np.ndarray, "4 4"] | None:
        """World to camera, OpenCV axes; None if it is not finite."""
        try:
            matrix = np.array(self.entry.get("transform_matrix"), np.float64)
        except (TypeError, ValueError):
            matrix = np.zeros(0)
        if matrix.shape == (3, 4):
            matrix = np.concatenate([matrix, [[0.0, 0.0, 0.0, 1.0]]])
        if matrix.shape != (4, 4):
            raise self.error(
                "transform_matrix, 4 rows of 4 numbers", f"shape {matrix.shape}", "Correct the file."
            )
        if not np.isfinite(matrix).all():
            return None
        where = f"{self.file}, frame {self.number} ({self.entry['file_path']})"
        advice = "It must be a rotation and a translation; correct or remove that frame."
        check_poses("transform_matrix", matrix[None, None], lambda i, _: where, advice)
        return viewmat_from_opengl(matrix)

    def read(
        self, root: Path, image: Path, pose: np.ndarray, split: str | None, depth_unit: float | None
    ) -> _Frame:
        width, height = picture_size(image)
        stated = next((unit for name in UNITS if (unit := self.numeral(name)) is not None), DEPTH_UNIT_M)
        if stated <= 0:
            raise self.error(f"{' or '.join(UNITS)} above 0", f"{stated:g}", "Correct the file.")
        has_depth = self.value("enable_depth_loading") is not False
        return _Frame(
            portable(self.entry["file_path"]),
            split,
            pose,
            self.lens(width, height),
            (width, height),
            image,
            self.beside(root, "mask_path"),
            self.beside(root, *DEPTHS) if has_depth else None,
            stated if depth_unit is None else depth_unit,
            self.numeral("time"),
        )

    def beside(self, root: Path, *keys: str) -> Path | None:
        """Path of the mask or depth image of its photograph, if it has one."""
        key = next((key for key in keys if self.value(key) is not None), keys[0])
        name = self.value(key)
        if name is not None and not isinstance(name, str):
            raise self.error(f"{key}, a name", repr(name), "Correct the file.")
        return _beside(root, name) if name else None

    def lens(self, width: int, height: int) -> Lens:
        """The camera, for a photograph of this size."""
        stated_width, stated_height = self.numeral("w") or width, self.numeral("h") or height
        fx, angle = self.numeral("fl_x"), self.numeral("camera_angle_x")
        for name in ("camera_angle_x", "camera_angle_y"):
            if (field_of_view := self.numeral(name)) is not None and not 0 < field_of_view < np.pi:
                raise self.error(
                    f"{name} between 0 and pi", f"{field_of_view:g}", "It is in radians; correct it."
                )
        if fx is None:
            if angle is None:
                raise self.error("fl_x or camera_angle_x", "neither", "Add one, per frame or for all.")
            fx = stated_width / (2 * np.tan(angle / 2))
        fy, angle_y = self.numeral("fl_y"), self.numeral("camera_angle_y")
        if fy is None:
            fy = fx if angle_y is None else stated_height / (2 * np.tan(angle_y / 2))
        if not (0 < fx < np.inf and 0 < fy < np.inf):
            raise self.error("focal lengths above 0", f"{fx:g} and {fy:g}", "Correct the file.")
        cx, cy = self.numeral("cx"), self.numeral("cy")
        center = (stated_width / 2 if cx is None else cx, stated_height / 2 if cy is None else cy)
        K = intrinsics(fx, 0, 0, center)
        K[1, 1] = fy
        chosen = (model for key, model in MODEL_KEYS.items() if self.value(key) not in (None, False))
        model = self.value("camera_model") or next(chosen, "OPENCV")
        if str(model) not in _MODELS:
            raise self.error(
                f"camera_model to be one of {', '.join(_MODELS)}", model, "Undistort the photographs first."
            )
        fisheye = _MODELS[model]
        names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
        coeffs = tuple(self.numeral(name) or 0.0 for name in names)
        if not fisheye and self.numeral("k4"):  # nerfstudio's is the r^8 term, which OpenCV's model lacks
            raise self.error(
                "k4 to be 0 except for a fisheye", self.value("k4"), "Undistort the photographs first."
            )
        where = f"{self.file}, frame {self.number}"
        K = scaled_intrinsics(K, (stated_width, stated_height), (width, height), where)
        return Lens(K, coeffs, fisheye)


def _report_left_out(
    root: Path, listed: int, missing: list[str], lost: list[str], unnamed: int, kept: int
) -> None:
    left_out = []
    for names, what in ((missing, "with no file"), (lost, "without a finite pose")):
        if names:
            left_out.append(f"{len(names)} {what} ({shortened(names)})")
    if unnamed:
        left_out.append(f"{unnamed} in none of the train, val and test lists")
    if not kept:
        folder = (root / portable(missing[0])).parent if missing else root
        reject_unread(folder, "photographs", folder.iterdir() if folder.is_dir() else ())
        found = f"{listed} listed, {' and '.join(left_out)}"
        raise DataError(root, "a photograph with a pose", found, "Check the folder.")
    if left_out:
        message = f"{root}: of {listed} listed photographs, {' and '.join(left_out)} are left out"
        warnings.warn(message, DataWarning, stacklevel=4)


def _photographs(root, frames, cloud, background, fisheye: Fisheye) -> Photographs:
    seen = through_lenses([frame.lens for frame in frames], [frame.size for frame in frames], root, fisheye)
    shown_before = find_background([frame.image for frame in frames], background)
    behind = shown_before or BLACK

    def load_image(i: int) -> np.ndarray:
        return seen.image(i, read_image(frames[i].image, *frames[i].size, behind))

    def load_mask(i: int) -> np.ndarray | None:
        mask = frames[i].mask
        return seen.mask(i, None if mask is None else read_shades(mask, *frames[i].size))

    def load_depth(i: int) -> np.ndarray | None:
        if frames[i].depth is None:
            return None
        return seen.depth(i, read_depth(frames[i].depth, frames[i].depth_unit, *frames[i].size))

    has = {
        key: any(getattr(frame, key) is not None for frame in frames) for key in ("mask", "depth", "split")
    }
    times = np.array([np.nan if frame.time is None else frame.time for frame in frames])
    known = np.isfinite(times)
    if known.any() and not known.all():
        without = shortened([frame.name for frame in frames if frame.time is None])
        message = f"{root}: expected a time of each photograph or of none, found none of {without}"
        warnings.warn(f"{message}; the times of the others are ignored", DataWarning, stacklevel=3)
    return Photographs(
        name=root.resolve().name,
        names=tuple(frame.name for frame in frames),
        sizes=np.array([frame.size for frame in frames]),
        Ks=seen.Ks,
        viewmats=np.stack([frame.viewmat for frame in frames]),
        load_image=load_image,
        load_mask=load_mask if has["mask"] or seen.has_edges else None,
        load_depth=load_depth if has["depth"] else None,
        times=times if known.all() and np.ptp(times) > 0 else None,
        splits=tuple(frame.split or "train" for frame in frames) if has["split"] else None,
        cloud=cloud,
        background=shown_before,
        fisheye=seen.fisheye,
        locate=lambda kind, i: str(getattr(frames[i], kind)),
    )
