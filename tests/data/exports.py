"""Recordings written as apps export them."""

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from gsjax.data import Sequence
from gsjax.geometry.cameras import OPENGL_TO_OPENCV
from tests.data import dots


def write_exr(path: Path, **channels: np.ndarray) -> None:
    """Writes a compressed OpenEXR picture with the named channels."""
    import OpenEXR

    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, channels).write(str(path))


def write_record3d(root: Path, sequence: Sequence, depth_size: tuple[int, int], fps: float = 10.0) -> None:
    """Writes what all cameras of a sequence see in its first frame, as the frames of one moving camera.

    Args:
        root: the folder.
        sequence: a recording by many cameras, with depth.
        depth_size: width and height of the depth in pixels; the pictures' size must be a multiple of it.
        fps: frames per second.
    """
    across, down = sequence.width // depth_size[0], sequence.height // depth_size[1]
    poses = np.linalg.inv(sequence.viewmats[0]) @ OPENGL_TO_OPENCV
    for n in range(sequence.num_cameras):
        dots.save(root / f"rgb/{n}.png", sequence.image(0, n))
        depth = sequence.depth(0, n)[down // 2 :: down, across // 2 :: across]
        write_exr(root / f"depth/{n}.exr", R=np.ascontiguousarray(depth, np.float32))
    Ks = sequence.Ks[0]
    meta = {
        "w": sequence.width,
        "h": sequence.height,
        "fps": fps,
        "K": Ks[0].T.ravel().tolist(),
        "poses": np.hstack([Rotation.from_matrix(poses[:, :3, :3]).as_quat(), poses[:, :3, 3]]).tolist(),
        "initPose": [0, 0, 0, 1, 0, 0, 0],
        "perFrameIntrinsicCoeffs": Ks[:, [0, 1, 0, 1], [0, 1, 2, 2]].tolist(),
        "frameTimestamps": (np.arange(len(Ks)) / fps).tolist(),
    }
    (root / "metadata.json").write_text(json.dumps(meta))
