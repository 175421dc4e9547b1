"""Gaussians as a browser draws them: one colour from all sides, and covariances in half precision."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from gsjax.geometry.rotations import quats_to_matrices
from gsjax.geometry.spherical_harmonics import SH_C0
from gsjax.scene.gaussians import Gaussians
from gsjax.viz.colors import (
    PcaColors,
    colorize_depth,
    colorize_features,
    colorize_labels,
    fit_pca_colors,
)
from gsjax.viz.viewer.viewable import Coloring, Viewable

_MIDDLE = 0.25  # the median standard deviation is scaled to this length: mid-range for float16


class Splats(NamedTuple):
    """Arguments of viser's `add_gaussian_splats`, with lengths divided by `scale`."""

    centers: Float[np.ndarray, "n 3"]
    covariances: Float[np.ndarray, "n 3 3"]
    opacities: Float[np.ndarray, "n 1"]


def browser_scale(gaussians: Gaussians) -> float:
    """The length that is sent to the browser as 1.

    Browsers receive covariances in float16, in which a standard deviation below a quarter of a millimetre
    underflows, and one of a centimetre has three digits.
    """
    return float(np.exp(np.median(np.asarray(gaussians.log_scales, np.float64))) / _MIDDLE)


def splats(gaussians: Gaussians, scale: float) -> Splats:
    """Centres, covariances R S^2 R^T and opacities, with `scale` as the unit of length."""
    axes = np.asarray(quats_to_matrices(jnp.asarray(gaussians.quats)), np.float32)
    spread = axes * (np.asarray(gaussians.scales) / scale)[:, None, :]
    largest = np.finfo(np.float16).max
    covariances = np.clip(spread @ spread.transpose(0, 2, 1), -largest, largest)
    centers = np.asarray(gaussians.means, np.float32) / np.float32(scale)
    return Splats(centers, covariances, np.asarray(gaussians.opacities, np.float32)[:, None])


class Palette:
    """The colours of a scene's Gaussians in each of its colorings."""

    def __init__(self, scene: Viewable):
        self._scene = scene
        self._pca: PcaColors | None = None

    def __call__(
        self,
        coloring: Coloring,
        means: Float[np.ndarray, "n 3"],
        rows: Int[np.ndarray, "kept"],
        viewmat: Float[np.ndarray, "4 4"] | None,
        depths: tuple[float, float] | None,
    ) -> Float[np.ndarray, "kept 3"]:
        """RGB, 0 to 1, of the selected Gaussians.

        Args:
            coloring: one of the scene's colorings.
            means: current centres of all Gaussians.
            rows: the selected Gaussians.
            viewmat: world to camera, for depth; None gives all Gaussians one depth.
            depths: nearest and farthest depth of the colour scale.
        """
        scene = self._scene
        if coloring == "label":
            found = colorize_labels(np.asarray(scene.labels)[rows][None])[0]
        elif coloring == "features":
            features = np.asarray(scene.gaussians.features)
            self._pca = self._pca or fit_pca_colors(features)
            found = colorize_features(features[rows][None], self._pca)[0]
        elif coloring == "depth":
            z = np.ones(len(rows)) if viewmat is None else camera_depths(means[rows], viewmat)
            found = colorize_depth(z[None], *(depths or (None, None)))[0]
        else:
            sh0 = np.asarray(scene.gaussians.sh0, np.float32)[rows, 0]
            return np.clip(0.5 + SH_C0 * sh0, 0, 1)
        return found.astype(np.float32) / 255


def camera_depths(
    means: Float[np.ndarray, "n 3"], viewmat: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "n"]:
    """Depths along the optical axis of a camera."""
    return np.asarray(means, np.float64) @ viewmat[2, :3] + viewmat[2, 3]


def depth_range(
    means: Float[np.ndarray, "n 3"],
    viewmat: Float[np.ndarray, "4 4"],
    fov: float,
    aspect: float,
) -> tuple[float, float] | None:
    """Near and far end of a depth scale: the 2nd and 98th percentile of the centres that a camera sees.

    Args:
        means: centres of the Gaussians.
        viewmat: world to camera.
        fov: vertical field of view, radians.
        aspect: width over height.

    Returns:
        (near, far), or None if the camera sees no centre.
    """
    local = np.asarray(means, np.float64) @ viewmat[:3, :3].T + viewmat[:3, 3]
    up = np.tan(fov / 2) * local[:, 2]
    seen = (local[:, 2] > 0) & (np.abs(local[:, 1]) < up) & (np.abs(local[:, 0]) < aspect * up)
    if not seen.any():
        return None
    near, far = np.percentile(local[seen, 2], [2, 98])
    return float(near), float(far)
