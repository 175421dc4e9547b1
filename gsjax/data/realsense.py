"""Recordings of RealSense cameras, as librealsense and its viewer write them: a rosbag with these topics.

/device_0/sensor_0/Depth_0/image/data         sensor_msgs/Image: mono16, in steps of a depth unit, 0 = invalid
/device_0/sensor_1/Color_0/image/data         the same: rgb8, bgr8, rgba8, bgra8, YUYV or UYVY
.../Depth_0/info/camera_info                  sensor_msgs/CameraInfo: K, pixel centres at integers, and D
.../Color_0/tf/0                              geometry_msgs/Transform: from stream 0, which is depth, to it
/device_0/sensor_0/option/Depth_Units/value   std_msgs/Float32: metres per step

Newer versions write images with frame_id "1" in their header. These end with four bytes that the message type
does not define: the depth unit, float32; 0 for colour.
"""

import re
import struct
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from gsjax.data.association import associate
from gsjax.data.errors import DataError, DataWarning
from gsjax.data.files import SATURATED_DEPTH
from gsjax.data.lens import Lens, intrinsics_matrix, undistort
from gsjax.data.registration import register_depth
from gsjax.data.rosbag import Bag, Message
from gsjax.data.sequence import Sequence
from gsjax.data.validation import check_quaternions
from gsjax.io.brief import shortened

MAX_SKEW_S = 0.02
"""Largest time between colour and depth of a frame: at 30 Hz, the nearest is at most 0.017 s away."""

DEPTH_UNIT_M = 0.001
"""Metres per depth step of D4xx cameras, unless they are set otherwise."""

_RECORD = "Record depth and colour by the RealSense viewer or librealsense."
_IMAGES = re.compile(r"(?P<stream>/device_\d+/sensor_\d+/(?P<kind>Depth|Color)_\d+)/image/data")
_IMAGE, _INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
_TRANSFORM, _FLOAT = "geometry_msgs/msg/Transform", "std_msgs/msg/Float32"
_STAMP_AT, _FRAME_ID_AT = 4, 12  # bytes into a message with a header
_ENDS_WITH_UNIT = struct.pack("<I", 1) + b"1"  # the frame_id
_DISTORTIONS = ("brown conrady", "inverse brown conrady", "modified brown conrady")
_COEFFICIENTS = 5  # k1 k2 p1 p2 k3, as OpenCV's

# Encoding in lower case -> bytes per pixel, and OpenCV's conversion to RGB.
_DEPTHS: dict[str, tuple[int, int | None]] = dict.fromkeys(("mono16", "16uc1", "z16"), (2, None))
_COLORS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
}


def read_realsense(
    path: str | Path, *, depth_unit_m: float | None = None, max_skew: float = MAX_SKEW_S
) -> Sequence:
    """The colour camera of a recording: camera 0, static at the origin, with depth registered to it.

    Frames are its pictures, each with the depth nearest in time; those with none within `max_skew` are left
    out, with a DataWarning that counts them, as are images that repeat a time. Times are the camera's. If a
    lens has distortion, the pictures are resampled to a pinhole camera whose view lies within them.

    Args:
        path: the file.
        depth_unit_m: metres per depth step; None: as recorded, else 0.001 with a DataWarning.
        max_skew: largest time between colour and depth of a frame, seconds.

    Raises:
        DataError: the file is not such a recording or is damaged, it lacks depth or colour, or an encoding or
            a lens model is not supported.
        MissingExtra: rosbags is not installed.
    """
    bag = Bag(Path(path))
    color, depth = _streams(bag)
    pairs = associate(bag.path, {"colour": color.stamps, "depth": depth.stamps}, max_skew)
    numbers, of_depth = pairs.T.tolist()
    K, as_pinhole = undistort(color.lens, color.width, color.height)
    depth_K, depth_as_pinhole = undistort(depth.lens, depth.width, depth.height)
    to_color = _from_reference(bag, color) @ np.linalg.inv(_from_reference(bag, depth))
    for stream, encodings in ((color, _COLORS), (depth, _DEPTHS)):
        _pixels(bag, stream, 0, encodings)  # before anything of the stated size is allocated
    unit = _recorded_unit(bag, depth) if depth_unit_m is None else depth_unit_m

    def load_image(t: int, c: int) -> UInt8[np.ndarray, "height width 3"]:
        return as_pinhole(_read_color(bag, color, numbers[t]), cv2.INTER_LINEAR)

    def load_depth(t: int, c: int) -> Float[np.ndarray, "height width"]:
        measured = depth_as_pinhole(_read_depth(bag, depth, of_depth[t], unit), cv2.INTER_NEAREST)
        return register_depth(measured, depth_K, K, to_color, color.width, color.height)

    def locate(kind: str, t: int, c: int) -> str:
        return _where(bag, *((depth, of_depth[t]) if kind == "depth" else (color, numbers[t])))

    frames = len(numbers)
    return Sequence(
        name=bag.path.stem,
        camera_ids=(0,),
        width=color.width,
        height=color.height,
        times=color.stamps[numbers],
        frame_ids=tuple(numbers),
        Ks=np.broadcast_to(K, (frames, 1, 3, 3)),
        viewmats=np.broadcast_to(np.eye(4), (frames, 1, 4, 4)),
        load_image=load_image,
        load_depth=load_depth,
        locate=locate,
    )


class _Stream(NamedTuple):
    """The images of one camera in order of their stamps, seconds; `recorded` finds them in the file."""

    name: str
    stamps: Float[np.ndarray, "n"]
    recorded: list[int]
    width: int
    height: int
    lens: Lens

    @property
    def topic(self) -> str:
        return f"{self.name}/image/data"


def _streams(bag: Bag) -> tuple[_Stream, _Stream]:
    """The first colour stream and the first depth stream."""
    found = [match for topic in bag.topics if (match := _IMAGES.fullmatch(topic))]
    names = [next((m["stream"] for m in found if m["kind"] == kind), None) for kind in ("Color", "Depth")]
    if None in names:
        lacking, stream = ("depth", "Depth") if names[0] else ("colour", "Color")
        expected = f"{lacking} of a RealSense camera, /device_0/sensor_N/{stream}_0/image/data"
        raise DataError(bag.path, expected, shortened(bag.topics) or "no topic", _RECORD)
    stamps: dict[str, dict[int, float]] = {f"{name}/image/data": {} for name in names}
    for message in bag.messages([*stamps], _IMAGE):
        seconds, nanoseconds = _unpacked(bag, "<II", message.content, _STAMP_AT)
        stamps[message.topic].setdefault(message.recorded, seconds + 1e-9 * nanoseconds)
    color, depth = (_stream(bag, name, stamps[f"{name}/image/data"]) for name in names)
    return color, depth


def _stream(bag: Bag, name: str, stamped: dict[int, float]) -> _Stream:
    """A stream, from the stamps of its images by the times at which they were recorded."""
    if not stamped:
        raise DataError(bag.path, "images", f"none in {name}/image/data", _RECORD)
    stamps, first = np.unique([*stamped.values()], return_index=True)
    if repeated := len(stamped) - len(stamps):
        message = f"{bag.path}: {repeated} of {len(stamped)} images of {name} repeat a time and are left out"
        warnings.warn(message, DataWarning, stacklevel=5)
    info = bag.first(f"{name}/info/camera_info", _INFO)
    if info is None:
        raise DataError(bag.path, f"intrinsics in {name}/info/camera_info", "none", _RECORD)
    K, D = np.reshape(info.K, (3, 3)), tuple(map(float, info.D))
    if not (np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0):
        expected = f"focal lengths above 0 in {name}/info/camera_info"
        raise DataError(bag.path, expected, f"K {K.ravel().tolist()}", _RECORD)
    distorted = any(D)
    if distorted and not (info.distortion_model.lower() in _DISTORTIONS and len(D) == _COEFFICIENTS):
        expected = f"a lens of {shortened(_DISTORTIONS)} in {name}/info/camera_info"
        found = f"{info.distortion_model}, {len(D)} coefficients"
        raise DataError(bag.path, expected, found, "Record rectified pictures.")
    lens = Lens(intrinsics_matrix((K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5)), D if distorted else ())
    recorded = [*stamped]
    return _Stream(name, stamps, [recorded[i] for i in first], info.width, info.height, lens)


def _from_reference(bag: Bag, stream: _Stream) -> Float[np.ndarray, "4 4"]:
    """Transform from the coordinates of the reference stream to those of a stream."""
    topic = f"{stream.name}/tf/0"
    if (found := bag.first(topic, _TRANSFORM)) is None:
        raise DataError(bag.path, f"the place of a camera in {topic}", "none", _RECORD)
    q, t = found.rotation, found.translation
    quat, transform = np.array([q.x, q.y, q.z, q.w]), np.eye(4)
    transform[:3, 3] = t.x, t.y, t.z
    if not np.isfinite(transform).all():
        raise DataError(bag.path, f"a finite translation in {topic}", f"{transform[:3, 3].tolist()}", _RECORD)
    check_quaternions(quat[None], lambda _: f"{bag.path}, {topic}", _RECORD)
    transform[:3, :3] = Rotation.from_quat(quat).as_matrix()
    return transform


def _recorded_unit(bag: Bag, depth: _Stream) -> float:
    """Metres per depth step."""
    stated = _appended_unit(bag, _message(bag, depth, 0)) or 0.0
    option = bag.first(f"{depth.name.rpartition('/')[0]}/option/Depth_Units/value", _FLOAT)
    for unit in (stated, 0.0 if option is None else float(option.data)):
        if 0 < unit < np.inf:
            return unit
    message = f"{bag.path}: no depth unit; assuming {DEPTH_UNIT_M} m; give depth_unit_m (--read.depth-unit-m)"
    warnings.warn(message, DataWarning, stacklevel=4)
    return DEPTH_UNIT_M


def _message(bag: Bag, stream: _Stream, number: int) -> Message:
    """An image of a stream as it is stored."""
    at = stream.recorded[number]
    return next(bag.messages([stream.topic], _IMAGE, at, at + 1))


def _appended_unit(bag: Bag, message: Message) -> float | None:
    """The depth unit appended to an image, metres; None if there is none."""
    marked = message.content[_FRAME_ID_AT : _FRAME_ID_AT + len(_ENDS_WITH_UNIT)] == _ENDS_WITH_UNIT
    return _unpacked(bag, "<f", message.content[-4:], 0)[0] if marked else None


def _unpacked(bag: Bag, form: str, content: bytes, at: int) -> tuple[Any, ...]:
    try:
        return struct.unpack_from(form, content, at)
    except struct.error:
        raise DataError(bag.path, "images", f"a message of {len(content)} bytes", _RECORD) from None


def _read_color(bag: Bag, stream: _Stream, number: int) -> UInt8[np.ndarray, "height width 3"]:
    pixels, encoding, _ = _pixels(bag, stream, number, _COLORS)
    conversion = _COLORS[encoding][1]
    return np.ascontiguousarray(pixels) if conversion is None else cv2.cvtColor(pixels, conversion)


def _read_depth(bag: Bag, stream: _Stream, number: int, unit: float) -> Float[np.ndarray, "height width"]:
    """Metres, 0 = invalid."""
    pixels, _, big_endian = _pixels(bag, stream, number, _DEPTHS)
    steps = np.ascontiguousarray(pixels).view(">u2" if big_endian else "<u2")[..., 0]
    return np.where(steps == SATURATED_DEPTH, 0, steps * unit).astype(np.float32)


def _pixels(
    bag: Bag, stream: _Stream, number: int, encodings: dict[str, tuple[int, int | None]]
) -> tuple[UInt8[np.ndarray, "height width bytes"], str, bool]:
    """The bytes of each pixel, the encoding in lower case, and whether values are big-endian."""
    message, where = _message(bag, stream, number), _where(bag, stream, number)
    end = None if _appended_unit(bag, message) is None else -4
    image = bag.decoded(message.content[:end], _IMAGE)
    if (encoding := image.encoding.lower()) not in encodings:
        raise DataError(where, f"one of {', '.join(encodings)}", image.encoding, _RECORD)
    row, size = image.width * encodings[encoding][0], (image.width, image.height)
    if size != (stream.width, stream.height) or image.step < row or len(image.data) != image.step * size[1]:
        found = f"{size[0]}x{size[1]} in {len(image.data)} bytes"
        raise DataError(where, f"{stream.width}x{stream.height} pixels of {encoding}", found, _RECORD)
    rows = image.data.reshape(size[1], image.step)[:, :row]
    return rows.reshape(size[1], size[0], -1), encoding, bool(image.is_bigendian)


def _where(bag: Bag, stream: _Stream, number: int) -> str:
    return f"{bag.path}, image {number} of {stream.name}"
