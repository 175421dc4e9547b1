"""The push-T recordings of Embodied Gaussians (Abou-Chakra et al. 2025): three videos, calibrated, no depth.

sample_demos/DEMO/cameras.json          by serial number: X_WC, camera to world in OpenGL axes
sample_demos/DEMO/videos/SERIAL.json    K (pixel centres at integers), resolution, timestamps in seconds
sample_demos/DEMO/videos/SERIAL.mp4     its frame rate is wrong; only the timestamps are used
environment/ground.npy                  points of the ground [N,3], world
environment/ground_plane.json           its plane (n, d), n.x + d = 0
objects/tblock.json                     the T-block as Gaussians in its own frame
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gsjax.data.association import associate
from gsjax.data.errors import DataError
from gsjax.data.files import as_numbers, read_arrays, read_json
from gsjax.data.objects import PointModel
from gsjax.data.origin import near_origin
from gsjax.data.sequence import Sequence
from gsjax.data.video import Video
from gsjax.geometry.cameras import viewmat_from_opengl
from gsjax.geometry.neighbors import neighbor_spacing

MAX_SKEW_S = 0.03
"""Largest time between the images of a frame: an object at 1 m/s moves by 3 cm."""

GROUND_COLOR = 0.5
GROUND_THICKNESS_M = 0.001
BLOCK_LABEL = 1

# RealSense counts pixel centres at integers.
_HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


@near_origin
def read_push_t(path: str | Path, demo: int = 0, *, max_skew: float = MAX_SKEW_S) -> Sequence:
    """Demonstration `demo` of a push-T folder. Cameras are numbered from 0 in the order of cameras.json.

    The frames are those of the first camera, paired with the image of every other camera nearest in time.
    Frames for which a camera has no image within `max_skew` seconds are left out, with a DataWarning that
    counts them. Times are the recording's own, in seconds. `models` holds the ground (static) and the T-block
    (of unknown pose).

    Raises:
        DataError: a file is missing or unreadable, the numbers of frames and timestamps of a video differ,
            timestamps do not increase, or no frame has an image of every camera within `max_skew`.
        ValueError: a pose is not a rigid motion.
    """
    root = Path(path)
    folder = root / "sample_demos" / str(demo)
    described = read_json(folder / "cameras.json")
    if not isinstance(described, dict) or not described:
        raise DataError(folder / "cameras.json", "at least one camera", "none", "Choose another recording.")
    videos, Ks, poses, stamps = [], [], [], []
    for serial, entry in described.items():
        record = folder / "videos" / f"{serial}.json"
        meta = read_json(record)
        stamps.append(_numbers(record, meta, "timestamps", (None,)))
        Ks.append(_numbers(record, meta, "K", (3, 3)) + _HALF_PIXEL)
        poses.append(_numbers(folder / "cameras.json", entry, "X_WC", (4, 4)))
        size = _numbers(record, meta, "resolution", (2,))
        if not (np.isfinite(size).all() and (size >= 1).all()):
            raise DataError(record, "a width and a height above 0", f"{size.tolist()}", "Correct it.")
        videos.append(Video(record.with_suffix(".mp4"), int(size[0]), int(size[1]), len(stamps[-1])))
        if (videos[-1].width, videos[-1].height) != (videos[0].width, videos[0].height):
            found = f"{videos[-1].width}x{videos[-1].height}"
            expected = f"{videos[0].width}x{videos[0].height} as for the first camera"
            raise DataError(record, expected, found, "Resize all videos to one size, and scale K with them.")
    clocks = {video.path.name: own for video, own in zip(videos, stamps, strict=True)}
    pairs = associate(folder / "videos", clocks, max_skew)
    frames = len(pairs)
    return Sequence(
        name=f"{root.resolve().name}_{demo}",
        camera_ids=tuple(range(len(videos))),
        width=videos[0].width,
        height=videos[0].height,
        times=stamps[0][pairs[:, 0]],
        frame_ids=tuple(pairs[:, 0].tolist()),
        Ks=np.broadcast_to(np.stack(Ks), (frames, len(videos), 3, 3)),
        viewmats=np.broadcast_to(viewmat_from_opengl(np.asarray(poses)), (frames, len(videos), 4, 4)),
        load_image=lambda t, c: videos[c].frame(int(pairs[t, c])),
        models=_read_models(root),
        locate=lambda kind, t, c: f"{videos[c].path}, {kind} {pairs[t, c]}",
    )


def _read_models(root: Path) -> tuple[PointModel, ...]:
    """The ground and the block, if their files exist."""
    ground, plane_path = root / "environment" / "ground.npy", root / "environment" / "ground_plane.json"
    block = root / "objects" / "tblock.json"
    plane = _numbers(plane_path, read_json(plane_path), "plane", (4,)) if plane_path.exists() else None
    models = []
    if ground.exists() and plane is not None:
        models.append(
            _ground_model(as_numbers(ground, "points", read_arrays(ground).get(""), (None, 3)), plane)
        )
    if block.exists():
        models.append(_block_model(block, plane))
    return tuple(models)


def _ground_model(points: Float[np.ndarray, "n 3"], plane: Float[np.ndarray, "4"]) -> PointModel:
    """Grey discs in the plane, as wide as the spacing of the points."""
    spacing = neighbor_spacing(points)
    scales = np.stack([spacing, spacing, np.full_like(spacing, GROUND_THICKNESS_M)], axis=1)
    count = len(points)
    to_plane = Rotation.align_vectors(plane[None, :3], [[0.0, 0.0, 1.0]])[0]
    return PointModel(
        name="ground",
        means=points,
        quats=np.tile(to_plane.as_quat(scalar_first=True), (count, 1)),
        scales=scales,
        opacities=np.full(count, 0.9),
        colors=np.full((count, 3), GROUND_COLOR),
        pose=np.eye(4),
        plane=plane,
    )


def _block_model(path: Path, plane: Float[np.ndarray, "4"] | None) -> PointModel:
    """The T-block, without a pose: the file's X_WB is not its pose in the recordings.

    The file's colours are in the order blue, green, red: read as RGB, their mean (0.29, 0.49, 0.87) would be
    sky blue, while the block in the videos is orange.
    """
    gaussians = _get(path, read_json(path), "gaussians")
    shapes = {"means": (None, 3), "quats": (None, 4), "scales": (None, 3), "opacities": (None,)}
    shapes["colors"] = (None, 3)
    fields = {name: _numbers(path, gaussians, name, shape) for name, shape in shapes.items()}
    fields["colors"] = fields["colors"][:, ::-1].copy()
    return PointModel(name="tblock", label=BLOCK_LABEL, plane=plane, **fields)


def _get(path: Path, record: Any, key: str) -> Any:
    if not isinstance(record, dict) or key not in record:
        found = f"only {', '.join(record)}" if isinstance(record, dict) else "something else"
        raise DataError(path, f"the key {key!r}", found, "Fetch the file again.")
    return record[key]


def _numbers(path: Path, record: Any, key: str, shape: tuple[int | None, ...]) -> Float[np.ndarray, "..."]:
    return as_numbers(path, key, _get(path, record, key), shape)
