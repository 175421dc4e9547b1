"""The Gaussians in a browser's scene: those that stand still, and those that are sent anew for each frame."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gsjax.scene.gaussians import Gaussians
from gsjax.viz.viewer.splats import Palette, browser_scale, splats
from gsjax.viz.viewer.viewable import Coloring, Viewable, most_opaque, rows_of


class Look(NamedTuple):
    """How Gaussians are coloured.

    Attributes:
        coloring: by what.
        viewmat: of the camera that depth is seen from, or None before there is one.
        depths: the ends of the scale of depth, or None.
    """

    coloring: Coloring
    viewmat: Float[np.ndarray, "4 4"] | None = None
    depths: tuple[float, float] | None = None

    def same_as(self, other: "Look | None") -> bool:
        """Whether Gaussians that do not move have the same colours; only depth asks for the camera."""
        if other is None or self.coloring != other.coloring:
            return False
        return self.coloring != "depth" or (
            self.depths == other.depths and np.array_equal(self.viewmat, other.viewmat)
        )


class SplatNodes:
    """Splats of one browser; for one thread.

    Args:
        api: viser's scene of that browser.
        scene: what is shown.
        max_gaussians: the most opaque ones that are sent.
    """

    def __init__(self, api: Any, scene: Viewable, max_gaussians: int):
        self._api, self._scene = api, scene
        rows = most_opaque(scene.gaussians, max_gaussians)
        self._rows = {
            "moving": rows[rows < scene.num_moving],
            "still": rows[rows >= scene.num_moving],
        }
        self._scale = browser_scale(scene.gaussians)
        self._palette = Palette(scene)
        self._sent: dict[str, tuple[int, Look]] = {}
        self._nodes: dict[str, Any] = {}

    def show(self, gaussians: Gaussians, frame: int, look: Look) -> None:
        """Send what differs from what the browser has.

        Args:
            gaussians: all of the scene, in that frame.
            frame: which.
            look: how they are coloured.
        """
        for name, rows in self._rows.items():
            if len(rows) == 0 or self._has(name, frame, look):
                continue
            part = splats(rows_of(gaussians, rows), self._scale)
            colors = self._palette(
                look.coloring, np.asarray(gaussians.means), rows, look.viewmat, look.depths
            )
            self._send(name, part.centers, part.covariances, colors, part.opacities)
            self._sent[name] = (frame, look)

    def _has(self, name: str, frame: int, look: Look) -> bool:
        if name not in self._sent:
            return False
        then, colored = self._sent[name]
        return look.same_as(colored) and (name == "still" or then == frame)

    def _send(
        self,
        name: str,
        centers: Float[np.ndarray, "n 3"],
        covariances: Float[np.ndarray, "n 3 3"],
        colors: Float[np.ndarray, "n 3"],
        opacities: Float[np.ndarray, "n 1"],
    ) -> None:
        if name in self._nodes:
            self._nodes[name].set_gaussians(centers, covariances, colors, opacities)
        else:
            self._nodes[name] = self._api.add_gaussian_splats(
                f"/splats/{name}", centers, covariances, colors, opacities, scale=self._scale
            )
