"""Recordings of RealSense cameras (.bag, ROS 1) by Intel's viewer or SDK: one camera with depth, no poses.

/device_0/sensor_N/Color_0/image/data           sensor_msgs/Image, rgb8 or bgr8
/device_0/sensor_N/Depth_0/image/data           sensor_msgs/Image, 16 bits, in steps of Depth_Units
.../Color_0 and Depth_0/info/camera_info        sensor_msgs/CameraInfo: K, pixel centres at integers
.../Color_0 and Depth_0/tf/0                    geometry_msgs/Transform: from the group's reference to the
                                                stream, as `rs2_extrinsics` have it
/device_0/sensor_N/option/Depth_Units/value     std_msgs/Float32: metres per step

Names and conventions are those of librealsense (src/media/ros), which writes these files.
"""

import re
import struct
import warnings
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gsjax import extras
from gsjax.data.association import associate
from gsjax.data.errors import DataError, DataWarning, shortened
from gsjax.data.files import SATURATED_DEPTH
from gsjax.data.lens import intrinsics_matrix
from gsjax.data.registration import registered
from gsjax.data.sequence import Sequence
from gsjax.data.validation import check_intrinsics

SUFFIX = ".bag"
MAX_SKEW_S = 0.02
"""Largest time between colour and depth of a frame: more than half of one at 30 Hz."""

DEPTH_UNIT_M = 0.001
"""Metres per depth step where the file has none."""

_TOPIC = re.compile(r"/device_\d+/sensor_\d+/(Color|Depth)_0/(image/data|info/camera_info|tf/0)")
_UNITS = re.compile(r"/device_\d+/sensor_\d+/option/Depth[_ ]Units/value")
_COLORS = {"rgb8": (3, slice(None)), "bgr8": (3, slice(None, None, -1))}
_COLORS |= {"rgba8": (4, slice(0, 3)), "bgra8": (4, slice(2, None, -1))}
_DEPTHS = ("mono16", "16UC1")
_KIND = "a recording of a RealSense camera, a ROS 1 bag"
_DAMAGED = (
    struct.error,
    ValueError,
    LookupError,
    AssertionError,
    EOFError,
    OSError,
    RuntimeError,
    MemoryError,
)


def read_realsense(path: str | Path, *, depth_unit_m: float | None = None) -> Sequence:
    """The colour images of a recording with the depth nearest in time, moved to the colour camera: one
    camera, 0, which stands still. Frames without depth within 20 ms are left out, with a DataWarning that
    counts them; lens distortion is not corrected, and one that is recorded gives a DataWarning.

    Args:
        path: the .bag file.
        depth_unit_m: metres per depth step; default: the file's, else 0.001.

    Raises:
        DataError: the file is damaged, or lacks colour, depth, their intrinsics or their places.
        MissingExtra: the package rosbags is not installed.
    """
    bag = _Bag(Path(path))
    (color_K, size), (depth_K, depth_size) = bag.intrinsics("Color"), bag.intrinsics("Depth")
    width, height = size
    check_intrinsics(depth_K[None, None], lambda *_: f"Depth in {bag.path}")
    to_color = bag.place("Color") @ np.linalg.inv(bag.place("Depth"))
    clocks = {stream: bag.stamps(stream, "image/data") for stream in ("Color", "Depth")}
    seconds = {"colour": clocks["Color"] / 1e9, "depth": clocks["Depth"] / 1e9}
    matched = associate(bag.path, seconds, MAX_SKEW_S)
    unit = depth_unit_m or bag.depth_unit() or DEPTH_UNIT_M
    frames = len(matched)
    bag.color(int(clocks["Color"][matched[0, 0]]), size)  # a size that the file has the pixels of

    def load_depth(t: int, c: int) -> Float[np.ndarray, "height width"]:
        raw = bag.depth(int(clocks["Depth"][matched[t, 1]]), depth_size)
        depth = np.where(raw == SATURATED_DEPTH, 0, raw * unit).astype(np.float32)
        return registered(depth, depth_K, color_K, to_color, width, height)

    return Sequence(
        name=bag.path.stem,
        camera_ids=(0,),
        width=width,
        height=height,
        times=seconds["colour"][matched[:, 0]],
        frame_ids=tuple(matched[:, 0].tolist()),
        Ks=np.broadcast_to(color_K, (frames, 1, 3, 3)),
        viewmats=np.broadcast_to(np.eye(4), (frames, 1, 4, 4)),
        load_image=lambda t, c: bag.color(int(clocks["Color"][matched[t, 0]]), size),
        load_depth=load_depth,
        locate=lambda kind, t, c: f"{bag.path} at {seconds['colour'][matched[t, 0]]:.3f} s",
    )


class _Bag:
    """The messages of a file, read when they are needed: recordings are larger than memory."""

    def __init__(self, path: Path):
        self.path = path
        self.reader = extras.load("rosbags.rosbag1", "rosbag", "a .bag file")
        typesys = extras.load("rosbags.typesys", "rosbag", "a .bag file")
        self.types = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
        self.topics: dict[tuple[str, str], str] = {}
        self.times: dict[str, np.ndarray] = {}
        self.units: str | None = None
        try:
            with self.reader.Reader(path) as reader:
                for connection in reader.connections:
                    self.times[connection.topic] = np.unique([i.time for i in reader.indexes[connection.id]])
        except (self.reader.ReaderError, *_DAMAGED) as error:
            raise self._damaged(error) from None
        for topic in self.times:
            if match := _TOPIC.fullmatch(topic):
                self.topics.setdefault((match[1], match[2]), topic)
            elif _UNITS.fullmatch(topic):
                self.units = topic

    def stamps(self, stream: str, part: str) -> np.ndarray:
        """Times of a stream's messages, nanoseconds, increasing."""
        return self.times[self._topic(stream, part)]

    def intrinsics(self, stream: str) -> tuple[Float[np.ndarray, "3 3"], tuple[int, int]]:
        """K with pixel centres at +0.5, and width and height, of a stream."""
        info = self._message(self._topic(stream, "info/camera_info"), "sensor_msgs/msg/CameraInfo")
        if np.any(info.D):
            message = (
                f"{self.path}: the lens distortion of {stream} ({info.distortion_model}) is not corrected"
            )
            advice = "straight lines stay bent; give undistorted pictures where that matters"
            warnings.warn(f"{message}; {advice}", DataWarning, stacklevel=3)
        fx, fy, cx, cy = np.asarray(info.K, np.float64)[[0, 4, 2, 5]]
        return intrinsics_matrix((fx, fy, cx + 0.5, cy + 0.5)), (info.width, info.height)

    def place(self, stream: str) -> Float[np.ndarray, "4 4"]:
        """From coordinates of the camera's reference to those of a stream."""
        tf = self._message(self._topic(stream, "tf/0"), "geometry_msgs/msg/Transform")
        q, t, matrix = tf.rotation, tf.translation, np.eye(4)
        quat = np.array([q.x, q.y, q.z, q.w])
        if not abs(np.linalg.norm(quat) - 1) < 0.01:
            found = f"the quaternion {quat.tolist()} for {stream}"
            raise DataError(self.path, "rotations between its cameras", found, "Record it again.")
        matrix[:3, :3], matrix[:3, 3] = Rotation.from_quat(quat).as_matrix(), (t.x, t.y, t.z)
        return matrix

    def depth_unit(self) -> float | None:
        """Metres per depth step, if the file has them."""
        return None if self.units is None else self._message(self.units, "std_msgs/msg/Float32").data

    def color(self, stamp: int, size: tuple[int, int]) -> np.ndarray:
        """The colour image of a time, RGB; `size` is its expected width and height."""
        image = self._image("Color", stamp, size, _COLORS)
        channels, order = _COLORS[image.encoding]
        pixels = self._pixels(image, channels).reshape(image.height, image.width, channels)
        return np.ascontiguousarray(pixels[..., order])

    def depth(self, stamp: int, size: tuple[int, int]) -> np.ndarray:
        """The depth image of a time, in steps; `size` is its expected width and height."""
        image = self._image("Depth", stamp, size, _DEPTHS)
        pixels = np.ascontiguousarray(self._pixels(image, 2))
        return pixels.view(">u2" if image.is_bigendian else "<u2")

    def _image(self, stream: str, stamp: int, size: tuple[int, int], encodings: Collection[str]) -> Any:
        image = self._message(self._topic(stream, "image/data"), "sensor_msgs/msg/Image", stamp)
        if image.encoding not in encodings:
            advice = "Record colour as RGB8 or BGR8, and depth as Z16."
            expected = f"images of {stream} encoded as {', '.join(encodings)}"
            raise DataError(self.path, expected, repr(image.encoding), advice)
        if (image.width, image.height) != size:
            expected = f"images of {stream} of {size[0]}x{size[1]} pixels, as its camera_info says"
            raise DataError(self.path, expected, f"{image.width}x{image.height}", "Record it again.")
        return image

    def _pixels(self, image: Any, size: int) -> np.ndarray:
        """The bytes of an image, [height, width * size], without the ends of lines that only fill them."""
        line, data = image.width * size, np.asarray(image.data, np.uint8)
        if image.step < line or len(data) < image.height * image.step:
            found = f"{len(data)} bytes in lines of {image.step}"
            expected = f"an image of {image.width}x{image.height} pixels of {size} bytes"
            raise DataError(self.path, expected, found, "Record it again.")
        return data[: image.height * image.step].reshape(image.height, image.step)[:, :line]

    def _topic(self, stream: str, part: str) -> str:
        if (topic := self.topics.get((stream, part))) is None:
            found = f"none; it has {shortened(sorted(self.times), 4)}" if self.times else "an empty file"
            expected = f"the messages {stream}_0/{part} of a RealSense camera"
            raise DataError(self.path, expected, found, "Record colour and depth with Intel's viewer or SDK.")
        return topic

    def _message(self, topic: str, kind: str, stamp: int | None = None) -> Any:
        """The first message of a topic, or that of a time."""
        try:
            with self.reader.Reader(self.path) as reader:
                sources = [c for c in reader.connections if c.topic == topic and c.msgtype == kind]
                _, _, raw = next(reader.messages(sources, start=stamp)) if sources else (None, 0, b"")
                return self.types.deserialize_ros1(raw, kind)
        except (self.reader.ReaderError, StopIteration, *_DAMAGED) as error:
            raise self._damaged(error) from None

    def _damaged(self, error: BaseException) -> DataError:
        return DataError(self.path, _KIND, f"bad data ({error})", "Fetch the file again.")
