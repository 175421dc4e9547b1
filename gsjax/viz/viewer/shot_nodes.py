"""The photographs in a browser's scene: a frustum where each was taken."""

import threading
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8
from scipy.spatial.transform import Rotation

from gsjax.viz.viewer.cameras import vertical_fov
from gsjax.viz.viewer.viewable import Shots

_COLOR = (120, 150, 255)
_THUMB = 96  # longer side in pixels
_PICTURED = 300  # at most this many photographs are shown in their frustums: each is read from disk


class ShotNodes:
    """Frustums of one browser, created when they are first shown.

    Args:
        api: viser's scene handle of that browser.
        shots: the photographs.
        size: size of a frustum, in the scene's unit.
        go: called with the index of the photograph whose frustum is clicked.
    """

    def __init__(self, api: Any, shots: Shots, size: float, go: Callable[[int], None]):
        self._api, self._shots, self._size, self._go = api, shots, size, go
        self._nodes: list[Any] = []
        self._closed = False

    def show(self, visible: bool, frame: int) -> None:
        """Show the frustums of a frame, or hide them."""
        if visible and not self._nodes:
            self._nodes = [self._frustum(v, frame) for v in range(len(self._shots.names))]
            if self._shots.load_image is not None and len(self._shots.viewmats) == 1:
                threading.Thread(target=self._fill, name="gsjax photographs", daemon=True).start()
        for node in self._nodes:
            node.visible = visible

    def move(self, shots: Shots, frame: int) -> None:
        """Move the frustums to their poses in a frame; `shots` has the same cameras, maybe at other times."""
        self._shots = shots
        if len(self._shots.viewmats) > 1:
            for v, node in enumerate(self._nodes):
                node.wxyz, node.position = self._pose(v, frame)

    def close(self) -> None:
        """Stop reading pictures."""
        self._closed = True

    def _pose(self, v: int, frame: int) -> tuple[np.ndarray, np.ndarray]:
        to_world = np.linalg.inv(self._shots.viewmats[self._shots.at(frame), v])
        return Rotation.from_matrix(to_world[:3, :3]).as_quat(scalar_first=True), to_world[:3, 3]

    def _frustum(self, v: int, frame: int) -> Any:
        width, height = (int(size) for size in self._shots.sizes[v])
        wxyz, position = self._pose(v, frame)
        node = self._api.add_camera_frustum(
            f"/photographs/{v}",
            fov=vertical_fov(self._shots.Ks[self._shots.at(frame), v], height),
            aspect=width / height,
            scale=self._size,
            thickness=1.5,
            thickness_units="screen",
            color=_COLOR,
            wxyz=wxyz,
            position=position,
        )
        node.on_click(lambda _: self._go(v))
        return node

    def _fill(self) -> None:
        load = self._shots.load_image
        for v, node in enumerate(self._nodes[:_PICTURED]):
            if self._closed or load is None:
                return
            try:
                node.image = shrunk(load(0, v), _THUMB)
            except (ValueError, OSError):
                continue  # an unreadable one has an empty frustum; visiting it reports why


def shrunk(image: UInt8[np.ndarray, "h w 3"], side: int) -> UInt8[np.ndarray, "rows cols 3"]:
    """A picture whose longer side is `side` pixels at most."""
    height, width = image.shape[:2]
    factor = side / max(height, width)
    if factor >= 1:
        return image
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
