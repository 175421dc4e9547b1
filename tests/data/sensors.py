"""Recordings of the built-in tabletop as librealsense writes them."""

import numpy as np

from gsjax.data.simulated import tabletop


def scene(width, height, frames=3):
    """One camera's view of the tabletop."""
    return tabletop(frames=frames, width=width, height=height, cameras=1)


COLOR, DEPTH = "/device_0/sensor_1/Color_0", "/device_0/sensor_0/Depth_0"
UNIT = "/device_0/sensor_0/option/Depth Units/value"
START_NS = 1_700_000_000_000_000_000


class Messages:
    """Messages as librealsense writes them, by topic: the type, and (seconds from the start, bytes) of each.

    Args:
        K: intrinsics of both cameras, pixel centres at +0.5.
        width, height: pixels, of both.
        unit: metres per depth step.
    """

    def __init__(self, K, width, height, unit):
        from rosbags.typesys import Stores, get_typestore

        self.topics, self.size = {}, (width, height)
        self.store = get_typestore(Stores.ROS1_NOETIC)
        for name in (COLOR, DEPTH):
            self.info(name, K)
            self.place(name)
        self.add(UNIT, "std_msgs/msg/Float32", unit)

    def make(self, kind, *values):
        return self.store.types[kind](*values)

    def raw(self, kind, *values):
        return bytes(self.store.serialize_ros1(self.make(kind, *values), kind))

    def add(self, topic, kind, *values):
        """Sets the only message of a topic."""
        self.topics[topic] = kind, [(0.0, self.raw(kind, *values))]

    def header(self, seconds, frame_id=""):
        stamp = round(1e9 * seconds) + START_NS
        time = self.make("builtin_interfaces/msg/Time", stamp // 10**9, stamp % 10**9)
        return self.make("std_msgs/msg/Header", 0, time, frame_id)

    def info(self, name, K, model="Inverse Brown Conrady", coeffs=(0.0,) * 5, size=None):
        width, height = size or self.size
        K = np.asarray(K, np.float64) - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        region = self.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        values = (model, np.array(coeffs), K.ravel(), np.zeros(9), np.zeros(12), 0, 0, region)
        topic, kind = f"{name}/info/camera_info", "sensor_msgs/msg/CameraInfo"
        self.add(topic, kind, self.header(0), height, width, *values)

    def place(self, name, translation=(0.0, 0.0, 0.0), quat=(0.0, 0.0, 0.0, 1.0)):
        vector = self.make("geometry_msgs/msg/Vector3", *translation)
        turn = self.make("geometry_msgs/msg/Quaternion", *quat)
        self.add(f"{name}/tf/0", "geometry_msgs/msg/Transform", vector, turn)

    def images(self, name, encoding, stamped, unit=None, big_endian=False):
        """Sets a camera's images, (seconds from the start, pixels) each; `unit`, if any, follows each one."""
        kind, found = "sensor_msgs/msg/Image", []
        for seconds, pixels in stamped:
            rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
            header = self.header(seconds, "" if unit is None else "1")
            values = (*pixels.shape[:2], encoding, int(big_endian), rows.shape[1], rows.ravel())
            behind = b"" if unit is None else np.float32(unit).tobytes()
            found.append((seconds, self.raw(kind, header, *values) + behind))
        self.topics[f"{name}/image/data"] = kind, found

    def write(self, path, compressed=True):
        from rosbags.rosbag1 import Writer

        path.unlink(missing_ok=True)
        writer = Writer(path)
        if compressed:
            writer.set_compression(Writer.CompressionFormat.LZ4)
        with writer:
            connections = {
                topic: writer.add_connection(topic, kind, typestore=self.store)
                for topic, (kind, _) in self.topics.items()
            }
            for seconds, topic, raw in sorted(
                (s, t, raw) for t, (_, m) in self.topics.items() for s, raw in m
            ):
                writer.write(connections[topic], round(1e9 * seconds), raw)
        return path


def realsense(width=32, height=24, frames=3, unit=0.001, marked=True):
    """A recording of the tabletop whose colour and depth cameras coincide."""
    sequence = scene(width, height, frames)
    messages, behind = Messages(sequence.Ks[0, 0], width, height, unit), unit if marked else None
    steps = (np.round(sequence.depth(t, 0) / unit).astype(np.uint16) for t in range(frames))
    messages.images(DEPTH, "mono16", [(0.033 * t + 0.034, depth) for t, depth in enumerate(steps)], behind)
    colors = [(0.033 * t + 0.03, sequence.image(t, 0)) for t in range(frames)]
    messages.images(COLOR, "rgb8", colors, None if behind is None else 0)
    return messages
