"""The Gaussian that a ray hits."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gsjax.geometry.rotations import quats_to_matrices
from gsjax.scene.gaussians import Gaussians

_FAINTEST, _FULL = 1 / 255, 0.99  # the rasterizer's alpha_min and alpha_max
_NEAR, _LEAST = 0.01, 0.5  # nearer Gaussians are ignored; a ray with less total alpha hits nothing


class Picked(NamedTuple):
    """The Gaussian that a ray hits.

    Attributes:
        index: row of the Gaussian that contributes most of the colour.
        depth: distance along the ray to its point of highest density.
        point: that point.
        share: its weight in the colour, 0 to 1.
        alpha: opacity of all Gaussians together along the ray, 0 to 1.
    """

    index: int
    depth: float
    point: Float[np.ndarray, "3"]
    share: float
    alpha: float


def pick(
    gaussians: Gaussians,
    origin: Float[np.ndarray, "3"],
    direction: Float[np.ndarray, "3"],
) -> Picked | None:
    """The Gaussian that contributes most of the colour along a ray; None if the ray passes through.

    Along a ray o + t d a Gaussian is densest at its smallest Mahalanobis distance q, where
    alpha = opacity exp(-q^2 / 2). Gaussians are composited in the order of these t, as in a picture: the
    share of one is its alpha times the transmittance of those before it.

    Args:
        gaussians: N Gaussians.
        origin: origin of the ray, in the world.
        direction: direction of the ray, of any length but 0.

    Raises:
        ValueError: `direction` has zero length.
    """
    origin, direction = np.asarray(origin, np.float64), np.asarray(direction, np.float64)
    length = np.linalg.norm(direction)
    if not length > 0:
        raise ValueError(f"direction: expected a non-zero vector, found {direction}")
    direction = direction / length
    # In the axes of each Gaussian, in units of its standard deviations.
    axes = np.asarray(quats_to_matrices(jnp.asarray(gaussians.quats)), np.float64)
    scales = np.exp(np.asarray(gaussians.log_scales, np.float64))
    start = np.einsum("nji,nj->ni", axes, origin - np.asarray(gaussians.means, np.float64)) / scales
    along = np.einsum("nji,j->ni", axes, direction) / scales
    depths = -np.sum(start * along, axis=1) / np.sum(along * along, axis=1)
    squared = np.sum((start + depths[:, None] * along) ** 2, axis=1)
    alphas = np.minimum(np.asarray(gaussians.opacities, np.float64) * np.exp(-squared / 2), _FULL)
    met = np.flatnonzero((depths > _NEAR) & (alphas >= _FAINTEST))
    met = met[np.argsort(depths[met], kind="stable")]
    through = np.concatenate([[1.0], np.cumprod(1 - alphas[met])])
    stopped = 1 - through[-1]
    if stopped < _LEAST:
        return None
    shares = alphas[met] * through[:-1]
    best = int(shares.argmax())
    depth = float(depths[met[best]])
    return Picked(int(met[best]), depth, origin + depth * direction, float(shares[best]), float(stopped))
