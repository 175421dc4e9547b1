"""poses_bounds.npy (LLFF, Mildenhall et al. 2019), also used by DyNeRF and EndoNeRF.

[N,17], one row per camera: 3x5 [R | t | (height, width, focal length)] in row-major order, and the nearest
and farthest depth. R and t are camera to world. The file does not state the meaning of R's columns: LLFF and
DyNeRF write [down, right, back], EndoNeRF [right, up, back]. So the caller has to choose.
"""

import warnings
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from gsjax.data.errors import COMPLETE, DataError, DataWarning
from gsjax.data.files import BLACK, find_background, picture_size, read_arrays, read_image
from gsjax.data.frame_folders import pictures
from gsjax.data.lens import scaled_intrinsics
from gsjax.data.origin import near_origin
from gsjax.data.photographs import Photographs
from gsjax.data.sequence import Sequence
from gsjax.data.validation import check_poses
from gsjax.data.video import Video, describe_video
from gsjax.geometry.cameras import intrinsics

Axes = Literal["llff", "endonerf"]
NAMES = ("poses_bounds.npy", "pose_bounds.npy")
"""Names of the file; some releases leave out an s."""

# Columns of R that are right, down and forward, up to sign.
_TO_OPENCV = {
    "llff": np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]),
    "endonerf": np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]),
}


@near_origin
def read_llff(path: str | Path, axes: Axes, images: str = "images") -> Photographs:
    """Photographs sorted by name, one per row of poses_bounds.npy; transparent ones are composited on white.

    Args:
        path: the folder.
        axes: meaning of the columns of R: "llff" down, right, back; "endonerf" right, up, back.
        images: name of the folder of photographs inside `path`; the photographs may be downscaled copies.

    Raises:
        DataError: a file is missing or malformed, or the numbers of photographs and rows differ.
        ValueError: `axes` is invalid, or a pose is not a rigid motion.
    """
    root = Path(path)
    file, viewmats, sizes, focals = _read_rows(root, axes)
    folder = root / images
    paths = pictures(folder)
    if len(paths) != len(viewmats):
        expected, found = f"{len(viewmats)} photographs in {folder}, one per row", f"{len(paths)}"
        raise DataError(file, expected, found, "Give the name of their folder, or fetch them again.")
    actual = np.array([picture_size(photograph) for photograph in paths])
    background = find_background(paths)
    return Photographs(
        name=root.resolve().name,
        names=tuple(photograph.name for photograph in paths),
        sizes=actual,
        Ks=_intrinsics(paths, focals, sizes, actual),
        viewmats=viewmats,
        load_image=lambda i: read_image(paths[i], *actual[i].tolist(), background or BLACK),
        background=background,
        locate=lambda kind, i: str(paths[i]),
    )


@near_origin
def read_dynerf(path: str | Path, axes: Axes = "llff") -> Sequence:
    """A DyNeRF scene (Li et al. 2022): cam00.mp4, cam01.mp4, ..., one per row of poses.

    The sequence is as long as the shortest video, and its times are those of the first.

    Warns with DataWarning if frames with the same number are more than half a frame interval apart in time.

    Raises:
        DataError: as for `read_llff`, or the videos differ in size.
    """
    root = Path(path)
    file, viewmats, sizes, focals = _read_rows(root, axes)
    paths = sorted(root.glob("cam*.mp4"))
    if len(paths) != len(viewmats):
        expected, found = f"{len(viewmats)} videos cam*.mp4, one per row", f"{len(paths)}"
        raise DataError(file, expected, found, f"{COMPLETE} Remove the rows of missing videos.")
    described = [describe_video(video) for video in paths]
    shapes = [(video.width, video.height) for video in described]
    if len(set(shapes)) > 1:
        odd = next(i for i, shape in enumerate(shapes) if shape != shapes[0])
        expected, found = (
            f"{shapes[0][0]}x{shapes[0][1]} as in {paths[0].name}",
            f"{shapes[odd][0]}x{shapes[odd][1]}",
        )
        raise DataError(paths[odd], expected, found, "Resize all videos to one size.")
    frames = min(video.frames for video in described)
    videos = [Video(p, *shapes[0], video.frames, video) for p, video in zip(paths, described, strict=True)]
    _warn_of_clocks(paths, [video.times[:frames] for video in described])
    Ks = _intrinsics(paths, focals, sizes, np.array(shapes))
    return Sequence(
        name=root.resolve().name,
        camera_ids=tuple(
            int(digits) if (digits := p.stem[3:]).isdecimal() else i for i, p in enumerate(paths)
        ),
        width=shapes[0][0],
        height=shapes[0][1],
        times=described[0].times[:frames],
        frame_ids=tuple(range(frames)),
        Ks=np.broadcast_to(Ks, (frames, *Ks.shape)),
        viewmats=np.broadcast_to(viewmats, (frames, *viewmats.shape)),
        load_image=lambda t, c: videos[c].frame(t),
        locate=lambda kind, t, c: f"{paths[c]}, {kind} {t}",
    )


def _warn_of_clocks(paths: list[Path], times: list[Float[np.ndarray, "t"]]) -> None:
    """Warns if frames with the same number, which count as simultaneous, are apart in time."""
    apart = np.abs(np.stack(times) - times[0])
    step = np.median(np.diff(times[0])) if apart.shape[1] > 1 else np.inf
    if apart.max() > 0.5 * step:
        c, t = (int(i) for i in np.unravel_index(apart.argmax(), apart.shape))
        message = f"{paths[c]}: frame {t} is {apart[c, t]:.3g} s apart from that of {paths[0].name}"
        advice = "frames of one number count as simultaneous; give videos with the same times"
        warnings.warn(f"{message}; {advice}", DataWarning, stacklevel=3)


def find(root: Path) -> Path | None:
    """The pose file in a folder, or None."""
    return next((root / name for name in NAMES if (root / name).is_file()), None)


def _read_rows(root: Path, axes: str) -> tuple[Path, np.ndarray, np.ndarray, np.ndarray]:
    """The file, and the view matrix, (width, height) and focal length of each row."""
    if axes not in _TO_OPENCV:
        raise ValueError(
            "axes must be the meaning of the columns of poses_bounds.npy: 'llff' (down, right, back; "
            f"DyNeRF too) or 'endonerf' (right, up, back); got {axes!r}"
        )
    file = find(root)
    if file is None:
        raise DataError(root, NAMES[0], "no such file", "Give the folder that holds it.")
    rows = read_arrays(file).get("")
    if rows is None or rows.ndim != 2 or rows.shape[1] != 17 or not len(rows) or rows.dtype.kind not in "fiu":
        found = "several arrays" if rows is None else f"shape {rows.shape} of {rows.dtype}"
        raise DataError(file, "one array [N,17] of numbers", found, "Is it an LLFF file?")
    if not np.isfinite(rows).all():
        row = int(np.argmax(~np.isfinite(rows).all(-1)))
        raise DataError(
            file, "finite numbers", f"NaN or infinity in row {row}", "Remove that row and its photograph."
        )
    matrices = rows[:, :15].reshape(-1, 3, 5).astype(np.float64)
    if (matrices[:, :, 4] <= 0).any():
        row = int(np.argmax((matrices[:, :, 4] <= 0).any(-1)))
        found = f"{matrices[row, :, 4].tolist()} in row {row}"
        raise DataError(file, "height, width and focal length above 0", found, "Correct that row.")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = matrices[:, :, :3] @ _TO_OPENCV[axes]
    poses[:, :3, 3] = matrices[:, :, 3]
    check_poses("pose", poses[:, None], lambda row, _: f"row {row} of {file}", "Is axes set correctly?")
    return file, np.linalg.inv(poses), matrices[:, 1::-1, 4], matrices[:, 2, 4]


def _intrinsics(
    paths: list[Path],
    focals: Float[np.ndarray, "n"],
    stated: Float[np.ndarray, "n 2"],
    actual: Int[np.ndarray, "n 2"],
) -> Float[np.ndarray, "n 3 3"]:
    """K of pictures that may be smaller than the file states, with the principal point at the centre."""
    centers = (stated / 2).tolist()
    columns = (focals.tolist(), centers, stated.tolist(), actual.tolist())
    return np.stack(
        [
            scaled_intrinsics(intrinsics(focal, 0, 0, tuple(center)), tuple(size), tuple(now), path)
            for path, focal, center, size, now in zip(paths, *columns, strict=True)
        ]
    )
