"""RealSense cameras, read through pyrealsense2 with the interface of `gsjax.data.opencv_cameras`."""

from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from gsjax import extras
from gsjax.data.errors import DataError
from gsjax.data.lens import intrinsics_matrix
from gsjax.data.opencv_cameras import RgbdCamera

_MILLIMETRES = 1e3
_LONGEST_WAIT = 1.0  # seconds; Python sees Ctrl-C only between two waits


class RealSenseCapture:
    """An open RealSense camera as `opencv_cameras.Capture` describes one: colour, and depth registered to it.

    Lenses are treated as pinholes, which those of D4xx cameras nearly are.

    Args:
        rs: the module pyrealsense2.
        serial: the camera's serial number.
        patience: longest wait for a frame, seconds.

    Raises:
        RuntimeError: the camera does not start.
    """

    def __init__(self, rs: Any, serial: str, patience: float = 5.0):
        self._patience = patience
        config, self._pipeline = rs.config(), rs.pipeline()
        config.enable_device(serial)
        config.enable_stream(rs.stream.depth, rs.format.z16)
        config.enable_stream(rs.stream.color, rs.format.bgr8)
        profile = self._pipeline.start(config)
        self._to_millimetres = _MILLIMETRES * profile.get_device().first_depth_sensor().get_depth_scale()
        self._align, self._frames = rs.align(rs.stream.color), None
        seen = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
        self.K = intrinsics_matrix((seen.fx, seen.fy, seen.ppx + 0.5, seen.ppy + 0.5))
        self._size = {cv2.CAP_PROP_FRAME_WIDTH: seen.width, cv2.CAP_PROP_FRAME_HEIGHT: seen.height}

    def isOpened(self) -> bool:
        """Whether the camera is open: always, since the constructor opens it."""
        return True

    def get(self, propId: int) -> float:
        """The width or height in pixels, by OpenCV's property; 0 for other properties."""
        return self._size.get(propId, 0)

    def grab(self) -> bool:
        """Wait for the next frame; False if none comes."""
        arrived, frames, left = False, None, self._patience
        while not arrived and left > 0:
            wait = min(left, _LONGEST_WAIT)
            arrived, frames = self._pipeline.try_wait_for_frames(round(1e3 * wait))
            left -= wait
        self._frames = self._align.process(frames) if arrived else None
        return bool(arrived)

    def retrieve(self, *, flag: int = 0) -> tuple[bool, np.ndarray]:
        """Whether the grabbed frame has a picture of this kind, and the picture: BGR bytes [H,W,3], or depth
        in millimetres, [H,W], 0 = invalid."""
        is_depth = flag == cv2.CAP_OPENNI_DEPTH_MAP
        if self._frames is None:
            return False, np.zeros(0)
        picture = self._frames.get_depth_frame() if is_depth else self._frames.get_color_frame()
        if not picture:
            return False, np.zeros(0)
        pixels = np.array(picture.get_data())  # a copy: the driver reuses its own
        return True, self._to_millimetres * pixels if is_depth else pixels


def open_realsense(
    index: int, viewmat: Float[np.ndarray, "4 4"] | None = None, patience: float = 5.0
) -> RgbdCamera:
    """Open a RealSense camera, with depth registered to colour.

    Args:
        index: its number among the connected cameras, from 0.
        viewmat: world to camera, [4,4]; default: the world frame is the camera's own.
        patience: longest wait for a frame, seconds.

    Raises:
        DataError: there is no such camera, or it does not start.
        MissingExtra: pyrealsense2 is not installed.
    """
    rs = extras.load("pyrealsense2", "realsense", f"realsense:{index}")
    what, advice = (
        f"realsense:{index}",
        "Connect it, close other programs that use it, or replay a recording.",
    )
    try:
        devices = list(rs.context().query_devices())
        if index >= len(devices):
            raise DataError(what, "a RealSense camera", f"{len(devices)} that are connected", advice)
        serial = devices[index].get_info(rs.camera_info.serial_number)
        capture = RealSenseCapture(rs, serial, patience)
    except RuntimeError as error:
        raise DataError(what, "a RealSense camera", f"one that does not start ({error})", advice) from None
    return RgbdCamera(capture, capture.K, np.eye(4) if viewmat is None else viewmat)
