"""EndoVis challenges 2017 (Allan et al. 2019) and 2018 (Allan et al. 2020): labelled 2 Hz endoscope video.

A folder is one sequence, instrument_dataset_N of 2017 or seq_N of 2018:

left_frames/frame000.png     in order of their numbers; those of 2017 have black borders, which are kept
right_frames/frame000.png    the right eye, optional
camera_calibration.txt       "KEY: numbers // comment" lines for both eyes, in millimetres, optional
ground_truth/*_labels/       2017, optional: a folder per instrument with files named like the frames; 0 is
                             tissue; 10, 20, 30 and 40 are shaft, wrist, claspers and probe of that instrument
labels/frame000.png          2018, optional: colours, named by labels.json in this folder or its parent
"""

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from gsjax.data.errors import DataError, DataWarning
from gsjax.data.files import read_image, read_json, read_text
from gsjax.data.frame_folders import (
    check_one_size,
    frame_numbers,
    pictures,
    pictures_beside,
    warn_about_single_frame,
)
from gsjax.data.lens import intrinsics_matrix, scaled_intrinsics
from gsjax.data.masks import read_mask
from gsjax.data.sequence import Sequence
from gsjax.data.text import fields
from gsjax.io.brief import shortened

RATE_HZ = 2.0
LEFT, RIGHT = "left_frames", "right_frames"
CALIBRATION, COLORS = "camera_calibration.txt", "labels.json"

INSTRUMENTS = {
    1: "bipolar forceps",
    2: "prograsp forceps",
    3: "large needle driver",
    4: "vessel sealer",
    5: "grasping retractor",
    6: "monopolar curved scissors",
    7: "other",
}
"""Instrument labels of EndoVis 2017, by the challenge's numbers."""

PARTS = {10: "shaft", 20: "wrist", 30: "claspers", 40: "probe"}
"""Part labels of an instrument in EndoVis 2017."""

_KEYS = {"F": 2, "C": 2, "K": 5}  # per camera: focal lengths, principal point, distortion
_HALF_PIXEL = 0.5  # the calibration counts pixel centres at integers
_DISTORTION_PX = 1.0
_CODE = np.array([65536, 256, 1])  # packs RGB into one integer

Labels = Literal["instruments", "parts"]
_Load = Callable[[int], Int[np.ndarray, "height width"] | None]


def read_endovis(
    path: str | Path,
    *,
    K: Float[np.ndarray, "3 3"] | tuple[float, float, float, float] | None = None,
    baseline_m: float | None = None,
    labels: Labels = "instruments",
) -> Sequence:
    """One sequence of EndoVis 2017 or 2018. It has no poses: the left eye, camera 0, stays at the origin.

    The right eye is camera 1, if the calibration gives its pose; in 2017 it is not quite synchronised, and
    some calibrations are rough. Frames are used as stored, without cropping: those of 2017, 1920x1080, hold
    the calibrated 1280x1024 picture centred in black borders, so K's principal point is shifted. Times are
    frame numbers at 2 Hz. `label_names` has the classes.

    Args:
        path: the folder.
        K: intrinsics of the left eye, or (fx, fy, cx, cy), if there is no calibration; pixel centres at +0.5.
        baseline_m: metres from the left eye to the right, if there is no calibration; both then share K.
        labels: which of 2017's labels to read: "instruments", see `INSTRUMENTS`, or "parts", see `PARTS`.

    Raises:
        DataError: a file is missing or unreadable, frames differ in size, or an instrument is unknown.
        ValueError: there is neither a calibration nor `K`, or both, or an option is invalid.

    Warns with DataWarning if there is only one frame, frames lack labels, the pose of the right eye is
    unknown (it is left out), or the lens distorts by more than a pixel, which is not corrected.
    """
    root = Path(path)
    frames = pictures(root / LEFT)
    if not frames:
        inside = sorted(folder.parent.name for folder in root.glob(f"*/{LEFT}"))
        found = f"{len(inside)} sequences ({', '.join(inside[:3])}, ...)" if inside else "none"
        raise DataError(root / LEFT, "frames", found, "Give the folder of one sequence.")
    size = width, height = check_one_size(frames)
    others = pictures_beside(root / RIGHT, len(frames), LEFT) if (root / RIGHT).is_dir() else []
    check_one_size([frames[0], *others])
    numbers = frame_numbers(frames)
    eyes = _eyes_from_calibration(root, size, bool(others))
    if eyes and (K is not None or baseline_m is not None):
        advice = "leave out K (--read.K) and baseline_m (--read.baseline-m), or remove the file"
        raise ValueError(f"{root / CALIBRATION}: it states what the options give; {advice}")
    eyes = eyes or _eyes_from_options(root, K, baseline_m, bool(others))
    files = [frames, others][: len(eyes)]
    warn_about_single_frame(frames)
    load_labels, names = _find_labels(root, frames, size, labels)
    return Sequence(
        name=root.resolve().name,
        camera_ids=tuple(range(len(eyes))),
        width=width,
        height=height,
        times=np.array(numbers) / RATE_HZ,
        frame_ids=numbers,
        Ks=np.broadcast_to([eye.K for eye in eyes], (len(frames), len(eyes), 3, 3)),
        viewmats=np.broadcast_to([eye.viewmat for eye in eyes], (len(frames), len(eyes), 4, 4)),
        load_image=lambda t, c: read_image(files[c][t], width, height),
        load_mask=load_labels and (lambda t, c: load_labels(t) if c == 0 else None),
        label_names=names,
        locate=lambda kind, t, c: str(files[c][t]) if kind == "image" else f"{files[c][t]}, {kind}",
    )


def is_endovis(root: Path) -> bool:
    """Whether a folder has this layout, or contains sequences that have it."""
    return (root / LEFT).is_dir() or next(root.glob(f"*/{LEFT}"), None) is not None


class _Eye(NamedTuple):
    K: Float[np.ndarray, "3 3"]
    viewmat: Float[np.ndarray, "4 4"]


def _eyes_from_options(
    root: Path, K: Float[np.ndarray, "3 3"] | tuple | None, baseline_m: float | None, right: bool
) -> list[_Eye]:
    """The eyes as the options describe them."""
    if K is None:
        raise ValueError(
            f"{root}: there is no {CALIBRATION}. Give K (--read.K): fx fy cx cy in pixels, centres at +0.5"
        )
    left = _Eye(intrinsics_matrix(K), np.eye(4))
    if not right:
        return [left]
    if baseline_m is None:
        _warn_left_out(root, "give baseline_m (--read.baseline-m)")
        return [left]
    if not 0 < baseline_m < np.inf:
        raise ValueError(f"baseline_m: expected metres above 0, found {baseline_m}")
    viewmat = np.eye(4)
    viewmat[0, 3] = -baseline_m
    return [left, left._replace(viewmat=viewmat)]


def _eyes_from_calibration(root: Path, size: tuple[int, int], right: bool) -> list[_Eye]:
    """The eyes as the calibration file describes them; none without one."""
    path = root / CALIBRATION
    if not path.is_file():
        return []
    values = _read_calibration(path)
    calibrated = (_numbers(path, values, "Width", 1)[0], _numbers(path, values, "Height", 1)[0])
    left = _Eye(_read_K(path, values, 0, calibrated, size), np.eye(4))
    if not right:
        return [left]
    if not any(key.startswith("Extrinsic") for key in values):
        _warn_left_out(root, f"add Extrinsic-T and Extrinsic-Omega to {CALIBRATION} to give its pose")
        return [left]
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.from_rotvec(_numbers(path, values, "Extrinsic-Omega", 3)).as_matrix()
    viewmat[:3, 3] = 0.001 * np.array(_numbers(path, values, "Extrinsic-T", 3))
    return [left, _Eye(_read_K(path, values, 1, calibrated, size), viewmat)]


def _warn_left_out(root: Path, advice: str) -> None:
    message = f"{root / RIGHT}: the right eye is left out: its pose is unknown; {advice}"
    warnings.warn(message, DataWarning, stacklevel=4)


def _read_calibration(path: Path) -> dict[str, list[str]]:
    """The words that follow each key."""
    lines = read_text(path, "lines of text").split("\n")
    parts = (line.split("//")[0].partition(":") for line in lines)
    return {key.strip(): fields(words) for key, colon, words in parts if colon}


def _numbers(path: Path, values: dict[str, list[str]], key: str, count: int) -> list[float]:
    words = values.get(key)
    try:
        numbers = [float(word) for word in words or []]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        found = "no such line" if words is None else repr(" ".join(words))
        noun = "number" if count == 1 else "numbers"
        raise DataError(path, f"{count} {noun} after {key}:", found, "Fetch the file again, or give K.")
    return numbers


def _read_K(
    path: Path,
    values: dict[str, list[str]],
    eye: int,
    calibrated: tuple[float, float],
    size: tuple[int, int],
) -> Float[np.ndarray, "3 3"]:
    """K of one eye, for frames of `size` that were calibrated at the size `calibrated`."""
    F, C, coeffs = (_numbers(path, values, f"Camera-{eye}-{key}", count) for key, count in _KEYS.items())
    if min(F) <= 0:
        raise DataError(
            path, f"focal lengths above 0 after Camera-{eye}-F:", f"{F}", "Correct them, or give K."
        )
    K, (width, height) = intrinsics_matrix((F[0], F[1], C[0], C[1])), calibrated
    corners = np.array([[x, y, 1.0] for x in (0, width) for y in (0, height)]) @ np.linalg.inv(K).T
    distorted, _ = cv2.projectPoints(corners, np.zeros(3), np.zeros(3), K, np.array(coeffs))
    farthest = np.abs(distorted[:, 0] - (corners @ K.T)[:, :2]).max()
    if farthest > _DISTORTION_PX:
        message = (
            f"{path}: lens distortion of {farthest:.1f} pixels at the corners is not corrected; undistort "
            f"the frames and set Camera-{eye}-K to zeros"
        )
        warnings.warn(message, DataWarning, stacklevel=4)
    K[:2, 2] += _HALF_PIXEL
    if size[0] > width and size[1] > height:  # black borders all around
        K[0, 2] += (size[0] - width) / 2
        K[1, 2] += (size[1] - height) / 2
        return K
    return scaled_intrinsics(K, calibrated, size, path)


def _find_labels(
    root: Path, frames: list[Path], size: tuple[int, int], labels: str
) -> tuple[_Load | None, Mapping[int, str]]:
    """A loader of a frame's labels, None if there are none, and the names of the labels."""
    if labels not in ("instruments", "parts"):
        raise ValueError(f"labels: expected 'instruments' or 'parts', found {labels!r}")
    if (root / "ground_truth").is_dir():
        load = _labels_of_instruments(root / "ground_truth", frames, size, labels)
        return load, INSTRUMENTS if labels == "instruments" else PARTS
    if (root / "labels").is_dir():
        return _labels_of_colors(root, frames, size)
    return None, {}


def _labels_of_instruments(
    root: Path, frames: list[Path], size: tuple[int, int], labels: str
) -> _Load | None:
    """2017: a mask per instrument."""
    folders = sorted(folder for folder in root.iterdir() if folder.is_dir())
    masks = [(_instrument_of(folder), _by_frame(folder, frames)) for folder in folders]

    def load(t: int) -> np.ndarray | None:
        found = [(number, read_mask(files[t], *size)) for number, files in masks if t in files]
        if not found:
            return None
        total = np.zeros_like(found[0][1])
        for number, mask in found:
            total = np.where(mask > 0, number if labels == "instruments" else mask, total)
        return total.astype(np.int32)

    return load if masks else None


def _instrument_of(folder: Path) -> int:
    """The number of the instrument in a folder's name, such as Left_Prograsp_Forceps_labels."""
    words = folder.name.lower().replace("_", " ")
    for number, name in INSTRUMENTS.items():
        if name in words:
            return number
    expected = f"a name that contains one of {', '.join(INSTRUMENTS.values())}"
    raise DataError(folder, expected, folder.name, "Rename the folder, or remove it.")


def _by_frame(folder: Path, frames: list[Path]) -> dict[int, Path]:
    """The label files by frame, matched by name. Warns if frames have none."""
    named = {path.stem: path for path in pictures(folder)}
    files = {t: named[frame.stem] for t, frame in enumerate(frames) if frame.stem in named}
    missing = [frame.name for t, frame in enumerate(frames) if t not in files]
    if missing:
        what = f"{len(missing)} of {len(frames)} frames are left out of the labels"
        message = f"{folder}: {what}: no file for {shortened(missing)}"
        warnings.warn(message, DataWarning, stacklevel=5)
    return files


def _labels_of_colors(
    root: Path, frames: list[Path], size: tuple[int, int]
) -> tuple[_Load, Mapping[int, str]]:
    """2018: label pictures whose colours are named in labels.json."""
    path = next((p for p in (root / COLORS, root.parent / COLORS) if p.is_file()), root / COLORS)
    numbers, names = _read_classes(path)
    files = _by_frame(root / "labels", frames)

    def load(t: int) -> np.ndarray | None:
        if t not in files:
            return None
        codes = read_image(files[t], *size).astype(np.int32) @ _CODE
        found, inverse = np.unique(codes, return_inverse=True)
        unknown = ~np.isin(found, list(numbers))[inverse]
        if unknown.any():
            message = f"{files[t]}: {unknown.sum()} pixels in colours not listed in {path.name} are left out"
            warnings.warn(f"{message}, as label 0", DataWarning, stacklevel=4)
        labels = np.array([numbers.get(int(code), 0) for code in found], np.int32)
        return labels[inverse].reshape(codes.shape)

    return load, names


def _read_classes(path: Path) -> tuple[dict[int, int], dict[int, str]]:
    """From labels.json: the class number of each colour, packed into one integer, and the class names."""
    meta = read_json(path)
    classes = (
        meta.get("classes") if isinstance(meta, dict) else meta
    )  # a list of them, or an object around it
    try:
        listed = [
            (int(each.get("classid", i)), int(np.dot(each["color"][:3], _CODE)), str(each["name"]))
            for i, each in enumerate(classes)
        ]
    except (TypeError, KeyError, ValueError, AttributeError, OverflowError) as error:
        expected = "a list of classes, each with name, color and classid"
        raise DataError(path, expected, f"something else ({error})", "Fetch the file again.") from None
    return {code: number for number, code, _ in listed}, {
        number: name for number, _, name in listed if number
    }
