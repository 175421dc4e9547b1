"""7-Scenes (Shotton et al. 2013): one moving Kinect with depth and poses from KinectFusion.

frame-NUMBER.color.png     640x480, or .jpg
frame-NUMBER.depth.png     uint16 millimetres, 0 and 65535 = invalid
frame-NUMBER.pose.txt      4x4, camera to world, OpenCV axes, of the depth camera
camera-intrinsics.txt      3x3, in some copies: intrinsics of the depth camera

The two cameras are not registered: the same point appears up to 40 pixels apart in colour and depth. The
release has intrinsics for the depth camera only (focal length 585 pixels, centred principal point). For the
colour camera the Kinect's factory values are used here: 525 pixels, centred, and 25 mm beside the depth
camera. With them, depth edges of the kitchen coincide with colour edges to within a pixel or two.
"""

import re
import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gsjax.data.errors import COMPLETE, DataError, DataWarning
from gsjax.data.files import image_size, read_depth, read_image, read_text
from gsjax.data.lens import intrinsics_matrix
from gsjax.data.names import find_file
from gsjax.data.origin import near_origin
from gsjax.data.pictures import SUFFIXES
from gsjax.data.registration import register_depth
from gsjax.data.sequence import Sequence
from gsjax.data.text import fields
from gsjax.data.validation import check_poses
from gsjax.geometry.cameras import intrinsics
from gsjax.io.brief import shortened

RATE_HZ = 30.0
WIDTH, HEIGHT = 640, 480
DEPTH_FOCAL, COLOR_FOCAL = 585.0, 525.0
BASELINE_M = 0.025
"""Distance of the colour camera to the right of the depth camera."""

DEPTH_UNIT_M = 0.001
_MICROSOFT_NAN = re.compile(r"-?\d\.#(?:IND|QNAN|SNAN|INF)\w*(?:[+-]\d+)?")
_FRAME = re.compile(r"frame-(\d+)\.pose\.txt")


@near_origin
def read_seven_scenes(
    path: str | Path,
    *,
    register: bool = True,
    K: Float[np.ndarray, "3 3"] | tuple[float, float, float, float] | None = None,
    depth_unit_m: float = DEPTH_UNIT_M,
) -> Sequence:
    """The sequence in a folder of this layout (such as seq-01 of a scene): one camera, 0; times are frame
    numbers at 30 Hz.

    Frames whose pose is not finite (tracking was lost) or whose images are missing are left out, with a
    DataWarning that counts them.

    Args:
        path: the folder that holds frame-000000.pose.txt.
        register: return the colour camera with depth warped into its view: reprojected point by point with a
            z-buffer, and invalid where the depth camera has no data. False returns the depth camera with the
            files unchanged, for use with depth alone or with colour that is already registered.
        K: intrinsics of one's own camera, or (fx, fy, cx, cy), with pixel centres at +0.5. Then pictures may
            have any common size, and depth is taken as registered to colour; default: the Kinect of 7-Scenes.
        depth_unit_m: metres per depth step.

    Raises:
        DataError: the folder has no frame or holds several sequences, a pose is malformed, or its intrinsics
            belong to another camera.
        ValueError: a pose is not a rigid motion.
    """
    root = Path(path)
    if K is None:
        _check_intrinsics(root / "camera-intrinsics.txt")
    numbers, poses, images, depths = _read_frames(root)
    frames, (width, height) = len(numbers), (WIDTH, HEIGHT) if K is None else image_size(images[0])
    register = register and K is None
    depth_K = intrinsics(DEPTH_FOCAL, WIDTH, HEIGHT)
    if K is None:
        K = intrinsics(COLOR_FOCAL, WIDTH, HEIGHT) if register else depth_K
    matrix = intrinsics_matrix(K)
    from_depth = np.eye(4)
    from_depth[0, 3] = -BASELINE_M if register else 0.0

    def load_depth(t: int, c: int) -> Float[np.ndarray, "height width"]:
        depth = read_depth(depths[t], depth_unit_m, width, height)
        if not register:
            return depth
        return register_depth(depth, depth_K, matrix, from_depth, width, height)

    files = {"image": images, "depth": depths}
    return Sequence(
        name=_name(root.resolve()),
        camera_ids=(0,),
        width=width,
        height=height,
        times=np.array(numbers) / RATE_HZ,
        frame_ids=tuple(numbers),
        Ks=np.broadcast_to(matrix, (frames, 1, 3, 3)),
        viewmats=(from_depth @ np.linalg.inv(poses))[:, None],
        load_image=lambda t, c: read_image(images[t], width, height),
        load_depth=load_depth,
        locate=lambda kind, t, c: str(files[kind][t]),
    )


def _name(root: Path) -> str:
    """The folder's name, preceded by that of the scene if the folder is one of its sequences."""
    return f"{root.parent.name}_{root.name}" if root.name.startswith("seq-") else root.name


def _read_frames(root: Path) -> tuple[list[int], Float[np.ndarray, "t 4 4"], list[Path], list[Path]]:
    """Numbers, camera-to-world poses, colour and depth files of the usable frames, sorted by number."""
    names = [match for file in root.iterdir() if (match := _FRAME.fullmatch(file.name))]
    if not names:
        parts = sorted(part.name for part in root.glob("seq-*"))
        found = f"the sequences {', '.join(parts)}" if parts else "no frame-NUMBER.pose.txt"
        advice = f"Pass one of them, such as {root / parts[0]}, unpacked." if parts else "Pass its folder."
        raise DataError(root, "the frames of one sequence", found, advice)
    numbers, poses, images, depths = [], [], [], []
    lost: list[str] = []
    missing: list[str] = []
    for match in sorted(names, key=lambda match: int(match[1])):
        pose, stem = _read_matrix(root / match[0], 4), match[0].removesuffix(".pose.txt")
        image = find_file(root, f"{stem}.color", SUFFIXES)
        depth = root / f"{stem}.depth.png"
        if not np.isfinite(pose).all():
            lost.append(stem)
        elif image is None or not depth.is_file():
            missing.append(stem)
        else:
            numbers.append(int(match[1]))
            poses.append(pose)
            images.append(image)
            depths.append(depth)
    left_out = [
        f"{len(stems)} {what} ({shortened(stems)})"
        for stems, what in ((lost, "without a finite pose"), (missing, "without colour or depth"))
        if stems
    ]
    if not numbers:
        found = f"none of {len(names)}: {', '.join(left_out)}"
        raise DataError(root, "a frame with pose, colour and depth", found, COMPLETE)
    if left_out:
        count = len(lost) + len(missing)
        message = f"{root}: {count} of {len(names)} frames are left out: {', '.join(left_out)}"
        warnings.warn(message, DataWarning, stacklevel=3)
    to_world, advice = np.stack(poses), "Poses are camera to world; correct that frame, or remove it."
    files = [root / f"frame-{number:06d}.pose.txt" for number in numbers]
    check_poses("pose", to_world[:, None], lambda i, _: str(files[i]), advice)
    return numbers, to_world, images, depths


def _read_matrix(path: Path, side: int) -> Float[np.ndarray, "side side"]:
    """A square matrix of numbers in a text file; Microsoft's spellings of NaN and infinity become NaN."""
    expected, advice = f"{side} lines of {side} numbers", "Fetch the file again, or remove that frame."
    lines = _MICROSOFT_NAN.sub("nan", read_text(path, expected)).split("\n")
    try:
        matrix = np.array([row for line in lines if (row := fields(line))], np.float64)
    except ValueError as error:
        raise DataError(path, expected, f"something else ({error})", advice) from None
    if matrix.shape != (side, side):
        raise DataError(path, expected, f"shape {matrix.shape}", advice)
    return matrix


def _check_intrinsics(path: Path) -> None:
    """Reject recordings of other cameras in this layout, which come with their own intrinsics."""
    if not path.exists():
        return
    K = _read_matrix(path, 3)
    known = intrinsics(DEPTH_FOCAL, WIDTH, HEIGHT)
    if not np.allclose(K, known, atol=0.5):
        expected = f"the depth camera of 7-Scenes, {known.tolist()}"
        advice = "If its depth is registered to colour, give K (--read.K), fx fy cx cy, centres at +0.5."
        raise DataError(path, expected, f"{K.tolist()}", advice)
