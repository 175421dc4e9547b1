"""RGB-D folders of Open3D's reconstruction system (Choi et al. 2015): one moving camera.

image/NUMBER.jpg          or color/, rgb/; .png
depth/NUMBER.png          uint16 millimetres, registered to colour
trajectory.log            (test_)scene/trajectory.log or beside the images: for each frame three integers, the
                          first its number, and a 4x4 matrix in 4 lines, camera to world, OpenCV axes

The folder has no intrinsics (Open3D reads them from a file that the user supplies), so the caller provides
them. A pose belongs to the frame whose file name has its number: folders often hold only every third frame.
"""

import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gsjax.data.errors import DataError, DataWarning
from gsjax.data.files import image_size, read_depth, read_image, read_text
from gsjax.data.frame_folders import DEFAULT_RATE_HZ, numbered
from gsjax.data.lens import intrinsics_matrix
from gsjax.data.origin import near_origin
from gsjax.data.sequence import Sequence
from gsjax.data.text import fields
from gsjax.data.validation import check_poses
from gsjax.io.brief import shortened

DEPTH_UNIT_M = 0.001
_IMAGES = ("image", "color", "rgb")
_TRAJECTORIES = (
    "trajectory.log",
    "scene/trajectory.log",
    "test_scene/trajectory.log",
    "fragments/trajectory.log",
)


def is_open3d(root: Path) -> bool:
    """Whether a folder has this layout."""
    return _has_pictures(root) and _first(root, _TRAJECTORIES) is not None


def without_poses(root: Path) -> DataError | None:
    """The error for a folder that lacks only the poses of this layout; None if it lacks pictures too."""
    if not _has_pictures(root):
        return None
    advice = (
        "Of a camera that stands still all are the same: five lines for each frame, its number three times, "
        "and the rows 1 0 0 0, 0 1 0 0, 0 0 1 0 and 0 0 0 1"
    )
    return DataError(root, "the camera's poses in trajectory.log", "colour and depth without poses", advice)


def _has_pictures(root: Path) -> bool:
    return (root / "depth").is_dir() and _first(root, _IMAGES) is not None


@near_origin
def read_open3d(
    path: str | Path,
    K: Float[np.ndarray, "3 3"] | tuple[float, float, float, float] | None = None,
    *,
    depth_unit_m: float = DEPTH_UNIT_M,
    trajectory: str | None = None,
) -> Sequence:
    """The frames that have colour, depth and a pose; their times are their numbers at 30 Hz.

    Args:
        path: the folder.
        K: intrinsics of the colour camera, or (fx, fy, cx, cy); pixel centres at +0.5 (Open3D and most
            sensors count them at integers: add 0.5 to cx and cy).
        depth_unit_m: metres per depth step.
        trajectory: the pose file, relative to the folder; default: the first of those above that exists.

    Raises:
        DataError: the folder has no images or poses, a file is malformed, or no frame has all three.
        ValueError: `K` is missing or invalid, or a pose is not a rigid motion.
    """
    root = Path(path)
    if K is None:
        raise ValueError(
            f"{root}: an Open3D folder has no intrinsics; give K (--read.K), fx fy cx cy in pixels, centres "
            "at +0.5 (if your calibration counts pixel centres at integers, add 0.5 to cx and cy)"
        )
    matrix = intrinsics_matrix(K)
    folder, log = _first(root, _IMAGES), root / trajectory if trajectory else _first(root, _TRAJECTORIES)
    if folder is None or log is None:
        missing = (
            f"one of the folders {', '.join(_IMAGES)}"
            if folder is None
            else f"one of {', '.join(_TRAJECTORIES)}"
        )
        raise DataError(root, missing, "none of them", "Give the folder of an Open3D recording.")
    poses, images, depths = _read_log(log), numbered(folder), numbered(root / "depth")
    numbers = sorted(images.keys() & depths.keys() & poses.keys())
    if not numbers:
        found = f"{len(images)} images, {len(depths)} depths and {len(poses)} poses with no number in common"
        raise DataError(root, "frames with image, depth and pose", found, "Name files by frame number.")
    if left_out := sorted(images.keys() - set(numbers)):
        some = shortened(images[n].name for n in left_out)
        reason = f"{len(left_out)} of {len(images)} frames without depth or a pose are left out"
        message = f"{root}: {reason} ({some})"
        warnings.warn(message, DataWarning, stacklevel=2)
    to_world = np.stack([poses[n] for n in numbers])[:, None]
    advice = "Poses are camera to world in OpenCV axes."
    check_poses("pose", to_world, lambda i, _: f"frame {numbers[i]} in {log}", advice)
    width, height = image_size(images[numbers[0]])
    files = {"image": images, "depth": depths}
    return Sequence(
        name=root.resolve().name,
        camera_ids=(0,),
        width=width,
        height=height,
        times=np.array(numbers) / DEFAULT_RATE_HZ,
        frame_ids=tuple(numbers),
        Ks=np.broadcast_to(matrix, (len(numbers), 1, 3, 3)),
        viewmats=np.linalg.inv(to_world),
        load_image=lambda t, c: read_image(images[numbers[t]], width, height),
        load_depth=lambda t, c: read_depth(depths[numbers[t]], depth_unit_m, width, height),
        locate=lambda kind, t, c: str(files[kind][numbers[t]]),
    )


def _first(root: Path, names: tuple[str, ...]) -> Path | None:
    return next((root / name for name in names if (root / name).exists()), None)


def _read_log(path: Path) -> dict[int, Float[np.ndarray, "4 4"]]:
    """Poses by frame number; those that are not finite are left out."""
    expected = "blocks of one line of three integers and four lines of four numbers"
    lines = read_text(path, "a trajectory").split("\n")
    try:
        values = np.array([field for line in lines for field in fields(line)], np.float64)
    except ValueError as error:
        raise DataError(path, expected, f"something else ({error})", "Fetch the file again.") from None
    if values.size % 19 or not values.size:
        raise DataError(
            path, expected, f"{values.size} numbers, not one or more blocks of 19", "Is it cut off?"
        )
    blocks = values.reshape(-1, 19)
    return {int(block[0]): block[3:].reshape(4, 4) for block in blocks if np.isfinite(block).all()}
