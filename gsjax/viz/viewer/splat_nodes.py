"""The Gaussians in a browser's scene: static ones, and ones that are sent again every frame."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gsjax.scene.gaussians import Gaussians
from gsjax.viz.viewer.splats import Palette, browser_scale, splats
from gsjax.viz.viewer.viewable import Coloring, Viewable, most_opaque, rows_of


class Appearance(NamedTuple):
    """How Gaussians are coloured.

    Attributes:
        coloring: one of the scene's colorings.
        viewmat: world to camera, for depth; None before there is a camera.
        depths: the ends of the depth scale, or None.
    """

    coloring: Coloring
    viewmat: Float[np.ndarray, "4 4"] | None = None
    depths: tuple[float, float] | None = None

    def same_as(self, other: "Appearance | None") -> bool:
        """Whether Gaussians that do not move keep their colours; only depth depends on the camera."""
        if other is None or self.coloring != other.coloring:
            return False
        return self.coloring != "depth" or (
            self.depths == other.depths and np.array_equal(self.viewmat, other.viewmat)
        )


class Displayed(NamedTuple):
    """What a page currently displays.

    Attributes:
        scene: the original scene, or an edited or filtered one.
        palette: the colours of the scene.
        frame: index of the frame.
        gaussians: all Gaussians of the scene in that frame.
    """

    scene: Viewable
    palette: Palette
    frame: int
    gaussians: Gaussians


class SplatNodes:
    """Splats of one browser; not thread-safe.

    Args:
        api: viser's scene handle of that browser.
        scene: the scene shown at first.
        max_gaussians: only the most opaque Gaussians are sent, at most this many.
    """

    def __init__(self, api: Any, scene: Viewable, max_gaussians: int):
        self._api, self._most = api, max_gaussians
        self._scale = browser_scale(scene.gaussians)
        self._nodes: dict[str, Any] = {}
        self._begin(scene)

    def show(self, now: Displayed, look: Appearance) -> None:
        """Send what differs from what the browser has.

        Args:
            now: what to display; a new scene replaces the previous one.
            look: how to colour it.
        """
        if now.scene is not self._scene:
            self._begin(now.scene)
        for name, rows in self._rows.items():
            if len(rows) == 0 and name in self._nodes:
                self._nodes.pop(name).remove()
            elif len(rows) and not self._has(name, now.frame, look):
                centers, covariances, opacities = splats(rows_of(now.gaussians, rows), self._scale)
                means = np.asarray(now.gaussians.means)
                colors = now.palette(look.coloring, means, rows, look.viewmat, look.depths)
                arrays = (centers, covariances, colors, opacities)
                if name in self._nodes:
                    self._nodes[name].set_gaussians(*arrays)
                else:
                    add = self._api.add_gaussian_splats
                    self._nodes[name] = add(f"/splats/{name}", *arrays, scale=self._scale)
                self._sent[name] = (now.frame, look)

    def _begin(self, scene: Viewable) -> None:
        rows = most_opaque(scene.gaussians, self._most)
        self._scene = scene
        self._rows = {
            "moving": rows[rows < scene.num_moving],
            "still": rows[rows >= scene.num_moving],
        }
        self._sent: dict[str, tuple[int, Appearance]] = {}

    def _has(self, name: str, frame: int, look: Appearance) -> bool:
        if name not in self._sent:
            return False
        then, colored = self._sent[name]
        return look.same_as(colored) and (name == "still" or then == frame)
