"""The EndoNeRF layout (Wang et al. 2022): deforming tissue seen by an endoscope.

images/NAME.png       frames in order of their names, or .jpg
poses_bounds.npy      or pose_bounds.npy: one row per frame, see `gsjax.data.poses_bounds`
masks/NAME.png        the tool in white, or in black; some releases name the folder gt_masks; optional
depth/NAME.png        uint16, 0 and 65535 = invalid; optional
right/images/ ...     the right eye of a stereo endoscope, held out, with the same subfolders; optional
meta.json, truth.npz  of simulated data: fps, baseline_m; depth_unit_m, verts [T,V,3], T_w_tool [T,4,4]
"""

import inspect
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gsjax.data import poses_bounds
from gsjax.data.errors import DataError, DataWarning
from gsjax.data.files import read_arrays, read_depth, read_image, read_json
from gsjax.data.frame_folders import (
    DEFAULT_RATE_HZ,
    check_one_size,
    frame_numbers,
    pictures,
    pictures_beside,
    warn_about_single_frame,
)
from gsjax.data.masks import read_shades
from gsjax.data.objects import Truth
from gsjax.data.origin import near_origin
from gsjax.data.sequence import Sequence
from gsjax.data.tool_masks import LABEL_NAMES, TOOL, Tool, check_tool, find_masks, tool_labels

DEFAULT_DEPTH_UNIT_M = 0.001
RIGHT = "right"
"""The folder of the right eye."""

_BOUNDS_OFF_BY = 5.0  # a ratio larger than this indicates another unit


@near_origin
def read_endonerf(
    path: str | Path,
    *,
    axes: poses_bounds.Axes = "endonerf",
    images: str = "images",
    tool: Tool = "white",
    depth_unit_m: float | None = None,
    pose_unit_m: float = 1.0,
    depth_percentiles: tuple[float, float] | None = None,
    baseline_m: float | None = None,
) -> Sequence:
    """A recording in the EndoNeRF layout: camera 0 is the left eye; camera 1, if there is a right/ folder,
    the right one.

    Masks are 0 for tissue and 1 for a tool. Times are 1/fps apart, with `fps` from meta.json or else 30 Hz.
    The right eye is displaced by `baseline_m` along the left one's x axis and has the same orientation, as
    in rectified stereo. A truth.npz with `verts` gives `Truth.tracks`.

    The largest errors of depth from stereo matching are at the extremes: EndoGaussian (Liu et al. 2024)
    clips depth outside the 3rd and the 99.8th percentile of a frame. `depth_percentiles` marks such depth as
    invalid instead, since its true value is unknown. It is off by default: exact depth has no such errors,
    and the nearest few per cent are where a tool pulls the tissue towards the camera.

    Args:
        path: the folder.
        axes: meaning of the columns of poses_bounds.npy, see `read_llff`.
        images: name of the folder of the frames.
        tool: colour of the tool in masks: "white", as in EndoNeRF, or "black".
        depth_unit_m: metres per depth step; None: as truth.npz or meta.json state, else 0.001 (EndoNeRF's
            own depth is in millimetres).
        pose_unit_m: metres per unit of the poses, which matters only if the camera moves.
        depth_percentiles: lowest and highest percentile of the valid depth of a frame to keep, for example
            (3, 99.8); None keeps all.
        baseline_m: distance between the eyes, metres; None: `baseline_m` of meta.json.

    Raises:
        DataError: a file is missing or unreadable; the numbers of masks or depth images and frames differ;
            frames differ in size; the tool covers everything, or no depth is valid, in all frames.
        ValueError: an option is invalid, or a pose is not a rigid motion.

    Warns with DataWarning if masks look inverted, there is only one frame, the baseline is unknown (the right
    eye is left out), or the depth unit does not match the poses of a moving camera.
    """
    _expect_options(depth_unit_m, pose_unit_m, baseline_m, depth_percentiles)
    root = Path(path)
    # Without `near_origin`: the unit of the poses is not applied yet.
    rows = inspect.unwrap(poses_bounds.read_llff)(root, axes, images)
    frames = pictures(root / images)
    width, height = check_one_size(frames)
    meta = _read_meta(root)
    truth = read_arrays(root / "truth.npz") if (root / "truth.npz").is_file() else {}
    unit = depth_unit_m or _stored_depth_unit(root, meta, truth)
    left = rows.viewmats.copy()
    left[:, :3, 3] *= pose_unit_m
    eyes = _find_eyes(root, images, frames, baseline_m, meta)

    def load_mask(path: Path) -> np.ndarray:
        return tool_labels(read_shades(path, width, height), tool)

    def load_depth(path: Path) -> np.ndarray:
        return _within_percentiles(read_depth(path, unit, width, height), depth_percentiles)

    warn_about_single_frame(frames)
    if eyes[0].masks:
        check_tool(lambda t: load_mask(eyes[0].masks[t]), len(frames), tool, eyes[0].masks[0].parent)
    if eyes[0].depths:
        depths = _first_depths(map(load_depth, eyes[0].depths), eyes[0].depths[0].parent)
        _check_unit(root, left, depths, pose_unit_m)
    return Sequence(
        name=root.resolve().name,
        camera_ids=tuple(range(len(eyes))),
        width=width,
        height=height,
        times=np.arange(len(frames)) / _positive(root, "fps", meta.get("fps", DEFAULT_RATE_HZ)),
        frame_ids=frame_numbers(frames),
        Ks=np.repeat(rows.Ks[:, None], len(eyes), axis=1),
        viewmats=np.stack([_shifted_right(left, eye.shift_m) for eye in eyes], axis=1),
        load_image=lambda t, c: read_image(eyes[c].images[t], width, height),
        load_depth=_loader([eye.depths for eye in eyes], load_depth),
        load_mask=_loader([eye.masks for eye in eyes], load_mask),
        truth=_read_truth(root, truth, len(frames)),
        label_names=LABEL_NAMES,
        locate=lambda kind, t, c: str(eyes[c].files(kind)[t]),
    )


def is_endonerf(root: Path, images: str = "images") -> bool:
    """Whether a folder has this layout: poses and frames with masks or depth beside them."""
    beside = find_masks(root) is not None or (root / "depth").is_dir()
    return poses_bounds.find(root) is not None and (root / images).is_dir() and beside


def is_unambiguous_endonerf(root: Path, images: str = "images") -> bool:
    """Whether both masks and depth lie beside the frames, which never happens in LLFF's own folders."""
    return is_endonerf(root, images) and find_masks(root) is not None and (root / "depth").is_dir()


class _Eye(NamedTuple):
    """Files of one camera, one per frame, empty where there are none; and its offset from the left eye."""

    images: list[Path]
    masks: list[Path]
    depths: list[Path]
    shift_m: float = 0.0

    def files(self, kind: str) -> list[Path]:
        return {"mask": self.masks, "depth": self.depths}.get(kind) or self.images


def _find_eyes(
    root: Path, images: str, frames: list[Path], baseline_m: float | None, meta: dict[str, Any]
) -> list[_Eye]:
    """The left eye and, if present, the right one. Warns if the baseline is unknown."""
    eyes = [_find_eye(root, frames)]
    if not (root / RIGHT / images).is_dir():
        return eyes
    if baseline_m is None and "baseline_m" not in meta:
        reason = "its distance from the left one is unknown"
        message = f"{root / RIGHT}: the right eye is left out: {reason}; give baseline_m (--read.baseline-m)"
        warnings.warn(message, DataWarning, stacklevel=3)
        return eyes
    others = pictures_beside(root / RIGHT / images, len(frames), images)
    check_one_size([frames[0], *others])
    shift_m = baseline_m or _positive(root, "baseline_m", meta["baseline_m"])
    return [*eyes, _find_eye(root / RIGHT, others)._replace(shift_m=shift_m)]


def _find_eye(root: Path, images: list[Path]) -> _Eye:
    count, name = len(images), images[0].parent.name
    folders = (find_masks(root), root / "depth" if (root / "depth").is_dir() else None)
    return _Eye(images, *(pictures_beside(folder, count, name) if folder else [] for folder in folders))


def _loader(
    files: list[list[Path]], load: Callable[[Path], np.ndarray]
) -> Callable[[int, int], np.ndarray | None] | None:
    """(t, c) -> content of the camera's file, None for a camera without files; None if no camera has any."""
    if not any(files):
        return None
    return lambda t, c: load(files[c][t]) if files[c] else None


def _expect_options(
    depth_unit_m: float | None,
    pose_unit_m: float,
    baseline_m: float | None,
    percentiles: tuple[float, float] | None,
) -> None:
    lengths = {"depth_unit_m": depth_unit_m, "pose_unit_m": pose_unit_m, "baseline_m": baseline_m}
    for name, length in lengths.items():
        if length is not None and not 0 < length < np.inf:
            raise ValueError(f"{name}: expected metres above 0, found {length}")
    if percentiles is not None and not 0 <= percentiles[0] < percentiles[1] <= 100:
        found = f"{percentiles[0]:g} and {percentiles[1]:g}"
        raise ValueError(f"depth_percentiles: expected two in 0 to 100, lower first, found {found}")


def _read_meta(root: Path) -> dict[str, Any]:
    path = root / "meta.json"
    meta = read_json(path) if path.is_file() else {}
    if not isinstance(meta, dict):
        raise DataError(path, "an object", f"a {type(meta).__name__}", "Correct the file, or remove it.")
    return meta


def _positive(root: Path, key: str, value: Any) -> float:
    """A positive number from meta.json."""
    if not isinstance(value, (int, float)) or not 0 < value < np.inf:
        advice = "Correct it, or remove it."
        raise DataError(root / "meta.json", f"{key} to be a number above 0", repr(value), advice)
    return float(value)


def _stored_depth_unit(root: Path, meta: dict[str, Any], truth: dict[str, np.ndarray]) -> float:
    stored = truth.get("depth_unit_m")
    if stored is None:
        return _positive(root, "depth_unit_m", meta.get("depth_unit_m", DEFAULT_DEPTH_UNIT_M))
    if stored.size != 1 or stored.dtype.kind not in "fiu" or not 0 < stored.item() < np.inf:
        expected, advice = "depth_unit_m to be one number above 0", "Regenerate the file."
        raise DataError(root / "truth.npz", expected, f"{stored.tolist()}", advice)
    return float(stored.item())


def _shifted_right(viewmats: Float[np.ndarray, "t 4 4"], baseline: float) -> Float[np.ndarray, "t 4 4"]:
    """View matrices of cameras shifted along their own x axis."""
    moved = viewmats.copy()
    moved[:, 0, 3] -= baseline
    return moved


def _within_percentiles(
    depth: Float[np.ndarray, "height width"], percentiles: tuple[float, float] | None
) -> Float[np.ndarray, "height width"]:
    """The depth with values outside the percentiles of its valid pixels set to 0."""
    valid = depth[depth > 0]
    if percentiles is None or not valid.size:
        return depth
    low, high = np.percentile(valid, percentiles)
    return np.where((depth >= low) & (depth <= high), depth, np.float32(0))


def _read_truth(root: Path, arrays: dict[str, np.ndarray], frames: int) -> Truth | None:
    """The tracks of the tissue's vertices, and the poses of the tool if there are any."""
    if "verts" not in arrays:
        return None
    tracks = np.asarray(arrays["verts"], np.float64)
    tool = "T_w_tool" in arrays
    poses = np.asarray(arrays["T_w_tool"], np.float64) if tool else np.zeros((frames, 0, 4, 4))
    if tracks.ndim != 3 or len(tracks) != frames or tracks.shape[2] != 3:
        expected = f"verts of shape ({frames}, V, 3): frames, vertices"
        raise DataError(root / "truth.npz", expected, f"{tracks.shape}", "Regenerate the file.")
    if tool and poses.shape != (frames, 4, 4):
        expected = f"T_w_tool of shape ({frames}, 4, 4): frames"
        raise DataError(root / "truth.npz", expected, f"{poses.shape}", "Regenerate the file.")
    return Truth(
        names=(LABEL_NAMES[TOOL],) if tool else (),
        label_ids=np.array([TOOL] if tool else [], int),
        poses=poses[:, None] if tool else poses,
        tracks=tracks,
    )


def _first_depths(depths: Iterable[np.ndarray], folder: Path) -> Float[np.ndarray, "n"]:
    """The valid depths of the first image that has any.

    Raises:
        DataError: no image has any.
    """
    first = next((depth[depth > 0] for depth in depths if depth.any()), None)
    if first is None:
        advice = "Export them again, or remove the folder to go without depth."
        raise DataError(folder, "some valid depth", "0 or 65535 everywhere, in all images", advice)
    return first


def _check_unit(
    root: Path, viewmats: Float[np.ndarray, "t 4 4"], depths: Float[np.ndarray, "n"], pose_unit_m: float
) -> None:
    """Warns if the bounds stored with the poses are in another unit than the depth images. For a static
    camera the unit of the poses does not matter."""
    file = poses_bounds.find(root)
    if file is None or np.ptp(viewmats, axis=0).max() == 0:
        return
    nearest, farthest = np.median(read_arrays(file)[""][:, 15:], axis=0) * pose_unit_m
    if not 1 / _BOUNDS_OFF_BY < farthest / depths.max() < _BOUNDS_OFF_BY:
        found = f"depth images reach from {depths.min():.4g} to {depths.max():.4g} m"
        message = f"{file}: its bounds are {nearest:.4g} and {farthest:.4g} m, but {found}"
        advice = "set pose_unit_m (metres per unit of the poses) or depth_unit_m"
        warnings.warn(f"{message}; {advice}", DataWarning, stacklevel=3)
