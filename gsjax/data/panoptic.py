"""The Panoptic layout of Dynamic 3D Gaussians (Luiten et al. 2024), with depth, times and truth added.

train_meta.json        w, h, k[t][c] 3x3, w2c[t][c] 4x4 (OpenCV axes), fn[t][c], cam_id[t][c];
                       gsjax adds time[t] in seconds, depth_unit_m, label_names {"3": "cup"}, and absent:
                       files of seg/ and depth/ that some frames never had
test_meta.json         the same for held-out cameras, optional; both are merged
ims/CAM/FRAME.jpg      named in fn
seg/CAM/FRAME.png      labels, optional, possibly for some cameras only, or only for the first frame
depth/CAM/FRAME.png    uint16 in steps of depth_unit_m, 0 and 65535 = invalid, optional
truth.npz, meta.json   of simulated scenes: T_wo [T,K,4,4] of meta's objects (labels 2.., robot 1), or
                       T_wp [T,K,4,4] of meta's parts (labels 1..) and joints, with joint values q [T,joints]
"""

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from gsjax.data.errors import COMPLETE, DataError, DataWarning
from gsjax.data.files import SATURATED_DEPTH, as_numbers, read_arrays, read_depth, read_image, read_json
from gsjax.data.frame_folders import DEFAULT_RATE_HZ
from gsjax.data.masks import read_mask
from gsjax.data.names import portable
from gsjax.data.objects import Truth
from gsjax.data.origin import near_origin, relative_to_origin
from gsjax.data.pictures import is_picture
from gsjax.data.sequence import Sequence
from gsjax.data.validation import check_intrinsics, check_poses
from gsjax.geometry.joints import Joint
from gsjax.io.atomic import write_json, write_npz
from gsjax.io.brief import brief
from gsjax.io.pictures import write_png

DEFAULT_DEPTH_UNIT_M = 0.001
_JOINTS = {"slide": "prismatic", "hinge": "revolute"}
_JOINT_KEYS = ("axis_world", "point_world")
META_NAMES = ("train_meta.json", "test_meta.json")
_ADVICE_META = "Correct the file, or remove that frame or camera from it."


@near_origin
def read_panoptic(path: str | Path, *, depth_unit_m: float | None = None) -> Sequence:
    """The sequence in a folder of this layout, with the cameras of both metas in the order in which they are
    listed.

    Without `time`, frames are 1/30 s apart; without `depth_unit_m`, depth is in millimetres. Frames without
    any image are left out, with a DataWarning that counts them.

    Args:
        path: the folder.
        depth_unit_m: metres per depth step; None: as train_meta.json states, else 0.001.

    Raises:
        DataError: a meta is missing, inconsistent or in conflict with the other, only some images of a frame
            are missing, or the truth does not match.
        ValueError: a pose is not a rigid motion, or times do not increase.
    """
    root = Path(path)
    meta = _read_metas(root)
    present = _present_frames(root, meta["fn"])
    names = [meta["fn"][t] for t in present]
    ids = tuple(_frame_number(meta["fn"][t][0], t) for t in present)
    if len(set(ids)) < len(ids):  # such as the number of the camera
        ids = tuple(present)
    _check_cameras(meta, present, ids)
    frames, width, height = len(meta["fn"]), meta["w"], meta["h"]
    times = np.asarray(meta.get("time", np.arange(frames) / DEFAULT_RATE_HZ), np.float64)
    if times.shape != (frames,):
        raise DataError(
            root / META_NAMES[0], f"time to be {frames} numbers", f"shape {times.shape}", _ADVICE_META
        )
    unit = depth_unit_m or float(meta.get("depth_unit_m", DEFAULT_DEPTH_UNIT_M))
    first_mask_only = [_has_first_mask_only(root, name) for name in names[0]]

    def locate(kind: str, t: int, c: int) -> str:
        return str(_FINDERS.get(kind, _image_path)(root, names[t][c]))

    def load_depth(t: int, c: int) -> np.ndarray | None:
        name = names[t][c]
        absent = not _has(root, "depth", name) or _file("depth", name) in meta["absent"]
        return None if absent else read_depth(_depth_path(root, name), unit, width, height)

    def load_mask(t: int, c: int) -> np.ndarray | None:
        name = names[t][c]
        absent = not _has(root, "seg", name) or _file("seg", name) in meta["absent"]
        absent |= first_mask_only[c] and name != names[0][c]
        return None if absent else read_mask(_mask_path(root, name), width, height)

    return Sequence(
        name=root.resolve().name,
        camera_ids=tuple(meta["cam_id"]),
        width=width,
        height=height,
        times=times[present],
        frame_ids=ids,
        Ks=meta["k"][present],
        viewmats=meta["w2c"][present],
        load_image=lambda t, c: read_image(_image_path(root, names[t][c]), width, height),
        load_depth=load_depth if any(_has(root, "depth", name) for name in names[0]) else None,
        load_mask=load_mask if any(_has(root, "seg", name) for name in names[0]) else None,
        truth=_read_truth(root, frames, present),
        label_names=_names_of_labels(root / META_NAMES[0], meta.get("label_names", {})),
        locate=locate,
    )


def write_panoptic(sequence: Sequence, path: str | Path, depth_unit_m: float = 0.0001) -> None:
    """Save a sequence in this layout, with a single train_meta.json and lossless PNG images.

    Poses are saved in the coordinates of the data, also far from 0. Names of labels are saved too, and truth,
    whose labels must be those of a tabletop: 2, 3, ... for objects, 1 for a robot.

    Args:
        sequence: the sequence; all its frames are loaded.
        path: the folder; created if missing. Existing files of the same names are overwritten.
        depth_unit_m: metres per depth step; depth beyond 65534 steps becomes invalid, with a DataWarning that
            counts the pixels.

    Raises:
        ValueError: the truth has other labels, frames share a time, or a mask has labels outside 0 to 65535.
    """
    root = Path(path)
    sequence = relative_to_origin(sequence, None)  # the layout has no place for an origin
    if len(shared := np.flatnonzero(np.diff(sequence.times) == 0)):
        found = f"{sequence.times[shared[0]]} s in frames {shared[0]} and {shared[0] + 1}"
        raise ValueError(f"write_panoptic requires a time of its own for each frame, got {found}")
    truth = sequence.truth
    if truth is not None and truth.label_ids.tolist() != list(range(2, 2 + len(truth.names))):
        found = truth.label_ids.tolist()
        raise ValueError(f"write_panoptic requires objects labelled 2, 3, ..., got {found}")
    names = [[f"{cam}/{frame:06d}.png" for cam in sequence.camera_ids] for frame in sequence.frame_ids]
    too_far, absent = 0, []
    for t, frame in enumerate(names):
        for c, name in enumerate(frame):
            write_png(root / "ims" / name, sequence.image(t, c))
            depth, mask = sequence.depth(t, c), sequence.mask(t, c)
            loaded = {"depth": depth, "seg": mask}
            absent += [_file(kind, name) for kind, found in loaded.items() if found is None]
            if depth is not None:
                steps = np.round(depth / depth_unit_m)
                fits = steps < SATURATED_DEPTH
                too_far += np.sum(~fits)
                write_png(root / "depth" / name, np.where(fits, steps, 0).astype(np.uint16))
            if mask is not None:
                if mask.min() < 0 or mask.max() > 65535:
                    found = f"{mask.min()} to {mask.max()} in frame {t}"
                    raise ValueError(f"write_panoptic requires labels from 0 to 65535, got {found}")
                write_png(root / "seg" / name, mask.astype(np.uint8 if mask.max() < 256 else np.uint16))
    if too_far:
        farthest = (SATURATED_DEPTH - 1) * depth_unit_m
        message = f"{root}: the depth of {too_far} pixels farther than {farthest:.4g} m is lost"
        warnings.warn(f"{message}; set a larger depth_unit_m to keep it", DataWarning, stacklevel=2)
    meta = {
        "w": sequence.width,
        "h": sequence.height,
        "k": sequence.Ks.tolist(),
        "w2c": sequence.viewmats.tolist(),
        "fn": names,
        "cam_id": [list(sequence.camera_ids)] * sequence.num_frames,
        "time": sequence.times.tolist(),
        "depth_unit_m": depth_unit_m,
    }
    if absent := [file for file in absent if (root / file).parent.is_dir()]:  # other frames have it
        meta["absent"] = absent
    if sequence.names_of_labels:
        meta["label_names"] = {str(label): name for label, name in sequence.names_of_labels.items()}
    if truth is not None:
        write_npz(root / "truth.npz", {"T_wo": truth.poses})
        write_json(root / "meta.json", {"objects": truth.names, "seg": "0 scene, 1 robot, 2+i objects[i]"})
    write_json(root / META_NAMES[0], meta)  # last, so that a folder that has it is complete


def _read_metas(root: Path) -> dict[str, Any]:
    """Both metas merged: k and w2c as arrays [T,C,...], fn [T][C], cam_id [C], and each camera's file."""
    merged = _read_meta(root / META_NAMES[0])
    extra_path = root / META_NAMES[1]
    if not extra_path.exists():
        return merged
    extra = _read_meta(extra_path)
    for key, count in (("w", int), ("h", int), ("fn", len)):
        if count(extra[key]) != count(merged[key]):
            expected, found = f"{key} as in {META_NAMES[0]} ({count(merged[key])})", str(count(extra[key]))
            raise DataError(extra_path, expected, found, "Both metas describe the same frames.")
    shared = set(merged["cam_id"]) & set(extra["cam_id"])
    if shared:
        found = f"cameras {sorted(shared)} in both"
        expected = f"cameras other than those in {META_NAMES[0]}"
        raise DataError(extra_path, expected, found, "Remove them from one of the two.")
    merged["fn"] = [a + b for a, b in zip(merged["fn"], extra["fn"], strict=True)]
    for key in ("cam_id", "file"):
        merged[key] = merged[key] + extra[key]
    merged["absent"] |= extra["absent"]
    for key in ("k", "w2c"):
        merged[key] = np.concatenate([merged[key], extra[key]], axis=1)
    return merged


def _read_meta(path: Path) -> dict[str, Any]:
    try:
        return _checked(path, read_json(path))
    except (AttributeError, TypeError, KeyError, OverflowError) as error:  # such as a number for a list
        found = f"something else ({error})"
        raise DataError(path, "the lists and numbers of this layout", found, _ADVICE_META) from None


def _checked(path: Path, meta: dict[str, Any]) -> dict[str, Any]:
    missing = [key for key in ("w", "h", "k", "w2c", "fn", "cam_id") if key not in meta]
    if missing:
        raise DataError(path, "the keys w, h, k, w2c, fn, cam_id", f"no {', '.join(missing)}", _ADVICE_META)
    for key in ("w", "h"):
        if not isinstance(meta[key], int) or meta[key] < 1:
            raise DataError(path, f"{key} to be a whole number of pixels", repr(meta[key]), _ADVICE_META)
    unit = meta.get("depth_unit_m", DEFAULT_DEPTH_UNIT_M)
    if not isinstance(unit, (int, float)) or not 0 < unit < np.inf:
        raise DataError(path, "depth_unit_m to be metres above 0", repr(unit), _ADVICE_META)
    frames, cameras = len(meta["fn"]), len(meta["cam_id"][0]) if meta["cam_id"] else 0
    if frames == 0 or cameras == 0:
        raise DataError(path, "at least one frame and one camera", f"{frames} and {cameras}", _ADVICE_META)
    for key in ("k", "w2c", "fn", "cam_id"):
        if len(meta[key]) != frames:
            raise DataError(path, f"{frames} frames in {key}, as in fn", str(len(meta[key])), _ADVICE_META)
        for t, values in enumerate(meta[key]):
            if len(values) != cameras:
                found = f"{len(values)} in frame {t} ({meta['fn'][t][:1]})"
                raise DataError(path, f"{cameras} cameras in {key}, as in frame 0", found, _ADVICE_META)
    for t, ids in enumerate(meta["cam_id"]):
        if ids != meta["cam_id"][0]:
            expected = f"cameras {meta['cam_id'][0]} as in frame 0"
            raise DataError(path, expected, f"{ids} in frame {t}", _ADVICE_META)
    arrays = {key: _stack(path, key, meta[key], side) for key, side in (("k", 3), ("w2c", 4))}
    if not isinstance(absent := meta.get("absent", []), list):
        raise DataError(path, "absent to be a list of files", brief(repr(absent)), _ADVICE_META)
    names = {"fn": [[portable(name) for name in frame] for frame in meta["fn"]]}
    own = {"cam_id": [int(i) for i in meta["cam_id"][0]], "file": [path] * cameras}
    return meta | arrays | names | own | {"absent": {portable(file) for file in absent}}


def _check_cameras(meta: dict[str, Any], present: list[int], ids: tuple[int, ...]) -> None:
    """Raises ValueError if a camera is invalid in a frame that has images; the message names its file."""
    for c, (path, camera) in enumerate(zip(meta["file"], meta["cam_id"], strict=True)):

        def where(t: int, _: int, camera: int = camera) -> str:
            return f"camera {camera} in frame {ids[t]}"

        try:
            check_intrinsics(meta["k"][present, c, None], where)
            check_poses("viewmat", meta["w2c"][present, c, None], where, _ADVICE_META)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None


def _stack(path: Path, key: str, values: list, side: int) -> np.ndarray:
    for t, frame in enumerate(values):
        for c, matrix in enumerate(frame):
            as_numbers(path, f"{key} in frame {t}, camera position {c},", matrix, (side, side))
    return np.asarray(values, np.float64)


def _present_frames(root: Path, names: list[list[str]]) -> list[int]:
    """Indices of the frames whose images exist."""
    exists = np.array([[_image_path(root, name).exists() for name in frame] for frame in names])
    some, every = exists.any(1), exists.all(1)
    if not some.any():
        found = f"none of {exists.size} ({names[0][0]} is missing, for example)"
        raise DataError(root / "ims", "the images listed in the metadata", found, COMPLETE)
    if (some & ~every).any():
        t = int(np.argmax(some & ~every))
        missing = [name for name, present in zip(names[t], exists[t], strict=True) if not present]
        expected = f"images of all {exists.shape[1]} cameras in frame {t}"
        found = f"{len(missing)} of them missing"
        raise DataError(_image_path(root, missing[0]), expected, found, "Restore it.")
    if not every.all():
        message = f"{root}: {np.sum(~every)} of {len(every)} frames have no image and are left out"
        warnings.warn(message, DataWarning, stacklevel=3)
    return [int(t) for t in np.flatnonzero(every)]


def _names_of_labels(path: Path, names: Any) -> dict[int, str]:
    """Names of mask values, which are text in JSON."""
    if not isinstance(names, dict) or not all(
        label.isascii() and label.isdigit() and isinstance(name, str) for label, name in names.items()
    ):
        expected = 'label_names to be names of mask values, as in {"3": "cup"}'
        raise DataError(path, expected, brief(repr(names)), _ADVICE_META)
    return {int(label): name for label, name in names.items()}


def _read_truth(root: Path, frames: int, present: list[int]) -> Truth | None:
    path = root / "truth.npz"
    if not (path.exists() and (root / "meta.json").exists()):
        return None
    described = read_json(root / "meta.json")
    arrays = read_arrays(path)
    for key, names_key, first_label, robot in (("T_wo", "objects", 2, 1), ("T_wp", "parts", 1, None)):
        if key in arrays and names_key in described:
            names, poses = described[names_key], np.asarray(arrays[key], np.float64)
            if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
                expected = f"a list of names as {names_key}"
                raise DataError(root / "meta.json", expected, repr(names), _ADVICE_META)
            names = tuple(names)
            if poses.shape != (frames, len(names), 4, 4):
                expected = f"{key} of shape {(frames, len(names), 4, 4)}: frames, {names_key} of meta.json"
                raise DataError(path, expected, f"{poses.shape}", "Regenerate the file.")
            labels = np.arange(first_label, first_label + len(names))
            joints = _read_joints(path, described.get("joints", {}), arrays.get("q"), names, frames)
            try:
                truth = Truth(names=names, label_ids=labels, poses=poses, robot=robot, joints=joints)
            except ValueError as error:
                raise ValueError(f"{path}: {error}") from None
            return truth.select(present)
    return None


def _read_joints(
    path: Path, described: Any, values: np.ndarray | None, names: tuple[str, ...], frames: int
) -> tuple[Joint | None, ...]:
    """The joint of each part, None for parts without one: meta.json describes the joints, and q has a column
    for each."""
    if not described or values is None:
        return ()
    if values.shape != (frames, len(described)):
        expected = f"q of shape {(frames, len(described))}: frames, joints of meta.json"
        raise DataError(path, expected, f"{values.shape}", "Regenerate the file.")
    columns = dict(zip(described, np.asarray(values, np.float64).T, strict=True))
    try:
        joints = {
            name: Joint(_JOINTS[how["type"]], *(np.array(how[k], float) for k in _JOINT_KEYS), columns[name])
            for name, how in described.items()
        }
    except (KeyError, TypeError, ValueError) as error:
        expected = "joints with type (slide or hinge), axis_world and point_world"
        raise DataError(path.parent / "meta.json", expected, f"{error}", "Regenerate the file.") from None
    return tuple(joints.get(name) for name in names)


def _image_path(root: Path, name: str) -> Path:
    return root / "ims" / name


def _mask_path(root: Path, name: str) -> Path:
    return root / _file("seg", name)


def _depth_path(root: Path, name: str) -> Path:
    return root / _file("depth", name)


def _file(kind: str, name: str) -> str:
    """The file of image `name` in seg/ or depth/, relative to the folder of the recording."""
    return Path(kind, name).with_suffix(".png").as_posix()


_FINDERS = {"image": _image_path, "mask": _mask_path, "depth": _depth_path}


def _has(root: Path, kind: str, name: str) -> bool:
    """Whether the camera of image `name` has a folder of this kind."""
    return (root / kind / name).parent.is_dir()


def _has_first_mask_only(root: Path, first: str) -> bool:
    """Whether the camera of image `first` has only the mask of that image, all that the tracker needs."""
    mask = _mask_path(root, first)
    return _has(root, "seg", first) and [file for file in mask.parent.iterdir() if is_picture(file)] == [mask]


def _frame_number(name: str, fallback: int) -> int:
    digits = re.search(r"(\d+)$", Path(name).stem)
    return int(digits.group()) if digits else fallback
