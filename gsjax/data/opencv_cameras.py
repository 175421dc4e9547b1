"""RGB-D cameras read through OpenCV's OpenNI 2 backend (Kinect, Xtion, Astra), as a stream of snapshots."""

import time
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gsjax.data.errors import DataError
from gsjax.data.stream import Snapshot
from gsjax.geometry.cameras import Camera, intrinsics
from gsjax.scene.frame import Frame

_MILLIMETRE = 1e-3


@runtime_checkable
class Capture(Protocol):
    """The part of `cv2.VideoCapture` that is used here."""

    def isOpened(self) -> bool:
        """Whether the camera is open."""
        ...

    def get(self, propId: int) -> float:
        """The value of an OpenCV property; 0 if the camera does not have it."""
        ...

    def grab(self) -> bool:
        """Grab the next frame; False if there is none."""
        ...

    def retrieve(self, *, flag: int = 0) -> tuple[bool, np.ndarray]:
        """Whether the grabbed frame has a picture of this kind, and the picture, [H,W] or [H,W,3]."""
        ...


class RgbdCamera(NamedTuple):
    """An open camera with its calibration.

    Attributes:
        capture: the OpenCV capture.
        K: intrinsics in pixels, pixel centres at +0.5.
        viewmat: world to camera, OpenCV axes.
    """

    capture: Capture
    K: Float[np.ndarray, "3 3"]
    viewmat: Float[np.ndarray, "4 4"]


def open_camera(index: int, viewmat: Float[np.ndarray, "4 4"] | None = None) -> RgbdCamera:
    """Open the RGB-D camera with OpenCV's number `index`, with depth registered to colour by its driver.

    Args:
        viewmat: world to camera, [4,4]; default: the world frame is the camera's own.

    Raises:
        DataError: there is no such camera, or it has no depth.
    """
    capture = cv2.VideoCapture(index, cv2.CAP_OPENNI2)
    capture.set(cv2.CAP_PROP_OPENNI_REGISTRATION, 1)
    return calibrated_camera(index, capture, np.eye(4) if viewmat is None else viewmat)


def calibrated_camera(index: int, capture: Capture, viewmat: Float[np.ndarray, "4 4"]) -> RgbdCamera:
    """An open RGB-D camera with the intrinsics that its driver reports.

    Args:
        index: OpenCV's number of the camera, for messages.
        capture: the open camera.
        viewmat: world to camera, OpenCV axes.

    Raises:
        DataError: as for `open_camera`.
    """
    what, expected = f"camera {index}", "an RGB-D camera of OpenCV's OpenNI 2 backend"
    if not capture.isOpened():
        found = "none that can be opened"
        raise DataError(what, expected, found, "Connect it, install its OpenNI 2 driver, or replay a folder.")
    focal = capture.get(cv2.CAP_OPENNI_DEPTH_GENERATOR + cv2.CAP_PROP_OPENNI_FOCAL_LENGTH)
    if not focal > 0:
        raise DataError(what, expected, "a camera without depth", "Tracking needs depth: use another.")
    width, height = (int(capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    return RgbdCamera(capture, intrinsics(focal, width, height), viewmat)


def snapshots(cameras: Sequence[RgbdCamera]) -> Iterator[Snapshot]:
    """Snapshots from all cameras until one of them ends. All frames are grabbed first, then decoded, to keep
    them close in time.

    Raises:
        DataError: a camera returns a frame without depth, or of another size than the first one.
    """
    viewmats = jnp.asarray(np.stack([camera.viewmat for camera in cameras]), jnp.float32)
    Ks = jnp.asarray(np.stack([camera.K for camera in cameras]), jnp.float32)
    while True:
        stamps = []
        for camera in cameras:
            if not camera.capture.grab():
                return
            stamps.append(time.monotonic())
        images, depths = zip(
            *(_retrieved(c, camera.capture) for c, camera in enumerate(cameras)), strict=True
        )
        sizes = {image.shape[:2] for image in (*images, *depths)}
        if len(sizes) > 1:
            raise DataError(
                "cameras", "pictures of the same size", f"{sorted(sizes)}", "Set the same video mode on all."
            )
        height, width = images[0].shape[:2]
        colors = jnp.asarray(np.stack(images)[..., ::-1], jnp.float32) / 255
        frame = Frame(colors, jnp.asarray(np.stack(depths)), Camera(viewmats, Ks, width, height))
        yield Snapshot(frame, stamps[0], stamps[-1] - stamps[0])


def _retrieved(c: int, capture: Capture) -> tuple[np.ndarray, np.ndarray]:
    """BGR bytes and depth in metres."""
    has_color, image = capture.retrieve(flag=cv2.CAP_OPENNI_BGR_IMAGE)
    has_depth, depth = capture.retrieve(flag=cv2.CAP_OPENNI_DEPTH_MAP)
    if not (has_color and has_depth):
        what = "colour" if not has_color else "depth"
        raise DataError(f"camera {c}", "colour and depth", f"a frame without {what}", "Check its connection.")
    return image, (_MILLIMETRE * depth).astype(np.float32)
