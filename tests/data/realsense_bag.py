"""A short recording of a RealSense camera: a box in front of a wall, seen by a turned colour camera."""

from types import SimpleNamespace

import numpy as np

COLOR, DEPTH = (48, 36), (40, 30)
COLOR_K, DEPTH_K = (40.0, 41.0, 23.5, 17.5), (40.0, 40.0, 19.5, 14.5)  # pixel centres at integers
BASELINE_M, WALL_M, BOX_M, UNIT_M = 0.2, 2.0, 1.0, 0.0005
ANGLE = 0.1  # by which the colour camera is turned about its axis


def image(number):
    pixels = np.full((*COLOR[::-1], 3), (200, 100, number), np.uint8)
    pixels[20:] += 9
    return pixels


def depth():
    """A wall, and a box of four by four pixels about the axis."""
    steps = np.full(DEPTH[::-1], WALL_M / UNIT_M, np.uint16)
    steps[13:17, 18:22] = BOX_M / UNIT_M
    steps[0, 0] = 65535
    return steps


def write(path, drop=(), **changes):
    """A recording of three frames, of which the last has its depth too late.

    Args:
        path: the file.
        drop: parts of the names of topics to leave out.
        changes: of the values below, such as the seconds by which the depth of each frame is late, or the
            factor on a quaternion's real part.
    """
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    of = {name.split("/")[-1]: kind for name, kind in store.types.items() if name != "std_msgs/msg/Time"}
    given = SimpleNamespace(
        encoding="rgb8",
        step=COLOR[0] * 3,
        distortion=[0.0] * 5,
        turn=1,
        info_size=COLOR,
        lates=(0.001, 0.001, 0.025),
    )
    given.__dict__.update(changes)

    def header(seconds):
        return of["Header"](0, of["Time"](int(seconds), round(seconds % 1 * 1e9)), "0")

    def info(size, K, distortion):
        matrix = np.array([K[0], 0, K[2], 0, K[1], K[3], 0, 0, 1.0])
        roi = of["RegionOfInterest"](0, 0, 0, 0, False)
        D, R, P = np.array(distortion), np.zeros(9), np.zeros(12)
        return of["CameraInfo"](header(0), size[1], size[0], "Brown Conrady", D, matrix, R, P, 0, 0, roi)

    def picture(seconds, pixels, encoding, step):
        rows, columns = pixels.shape[:2]
        data = np.frombuffer(pixels.tobytes(), np.uint8)
        return of["Image"](header(seconds), rows, columns, encoding, 0, step, data)

    def place(x, angle):
        quat = of["Quaternion"](0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2) * given.turn)
        return of["Transform"](of["Vector3"](x, 0.0, 0.0), quat)

    root = "/device_0/sensor_{}/".format
    messages = [
        (root(0) + "option/Depth_Units/value", 0, of["Float32"](UNIT_M)),
        (root(0) + "Depth_0/info/camera_info", 0, info(DEPTH, DEPTH_K, [0.0] * 5)),
        (root(1) + "Color_0/info/camera_info", 0, info(given.info_size, COLOR_K, given.distortion)),
        (root(0) + "Depth_0/tf/0", 0, place(0.0, 0.0)),
        (root(1) + "Color_0/tf/0", 0, place(BASELINE_M, ANGLE)),
    ]
    for n, late in enumerate(given.lates):
        seconds = 1 + n / 30
        colors = picture(seconds, image(n), given.encoding, given.step)
        messages.append((root(1) + "Color_0/image/data", seconds, colors))
        steps = picture(seconds + late, depth(), "mono16", 80)
        messages.append((root(0) + "Depth_0/image/data", seconds + late, steps))
    path.unlink(missing_ok=True)
    bag = Writer(path)
    bag.set_compression(Writer.CompressionFormat.LZ4)
    with bag:
        connections = {}
        for topic, seconds, message in messages:
            if any(part in topic for part in drop):
                continue
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, kind, typestore=store)
            bag.write(connections[topic], round(seconds * 1e9), store.serialize_ros1(message, kind))
    return path
