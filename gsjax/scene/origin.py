"""Scenes far from the origin, such as in UTM or earth-centred coordinates: float32 would round them to steps
of centimetres or metres, so their coordinates are held relative to an origin of their own, in float64."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gsjax.geometry.cameras import NEAR
from gsjax.scene.gaussians import Gaussians

FAR = 1e3
"""A scene is far if its distance from the origin is this many times its size: float32 then rounds positions
to about 1e-4 of the scene, a tenth of a pixel. (Without a new origin, a fit of 200 steps lost 0.01 dB at this
distance, 0.05 dB at ten times it, and 6.7 dB in UTM.)"""
_MOST = 0.9  # quantile of distances that counts as the size, so that a few stray points do not matter


def far_origin(
    places: Float[np.ndarray, "n 3"], others: Sequence[Float[np.ndarray, "m 3"]] = (), least: float = 0.0
) -> Float[np.ndarray, "3"] | None:
    """An origin near the middle of `places`, in round numbers; None if they are not far from the current one.

    Args:
        places: positions of cameras or Gaussians, float64.
        others: further sets of positions in the same scene; its size is the largest of any set.
        least: lower bound on the size, if above `NEAR`.
    """
    finite = [each[np.isfinite(each).all(1)] for each in (places, *others)]
    if not len(finite[0]):
        return None
    middle = np.median(finite[0], axis=0)
    sizes = [np.quantile(np.linalg.norm(each - middle, axis=1), _MOST) for each in finite if len(each)]
    size = max(*sizes, least, NEAR)
    if np.abs(middle).max() <= FAR * size:
        return None
    step = 10.0 ** np.floor(np.log10(size))
    return np.round(middle / step) * step + 0.0  # no -0


def about(
    viewmats: Float[np.ndarray, "*batch 4 4"], origin: Float[np.ndarray, "3"] | None
) -> Float[np.ndarray, "*batch 4 4"]:
    """View matrices of the same cameras for coordinates relative to `origin`; unchanged if it is None.

    Args:
        viewmats: world to camera, float64.
        origin: in the coordinates of `viewmats`.
    """
    if origin is None:
        return viewmats
    moved = np.array(viewmats, np.float64)
    moved[..., :3, 3] += moved[..., :3, :3] @ origin
    return moved


def cameras_in_world(
    viewmats: Float[np.ndarray, "*batch 4 4"], origin: Float[np.ndarray, "3"] | None
) -> Float[np.ndarray, "*batch 4 4"]:
    """View matrices for the coordinates of the data, from those relative to an origin: inverts `about`."""
    return viewmats if origin is None else about(viewmats, -origin)


def in_world(
    places: Float[np.ndarray, "*batch 3"], origin: Float[np.ndarray, "3"] | None
) -> Float[np.ndarray, "*batch 3"]:
    """Positions relative to an origin, as float64 in the coordinates of the data; unchanged if it is None."""
    return places if origin is None else np.asarray(places, np.float64) + origin


def relative_to(
    places: Float[np.ndarray, "*batch 3"], origin: Float[np.ndarray, "3"] | None
) -> Float[np.ndarray, "*batch 3"]:
    """Positions in the coordinates of the data, in float64 relative to an origin: inverts `in_world`."""
    return places if origin is None else np.asarray(places, np.float64) - origin


def rebased(
    gaussians: Gaussians, was: Float[np.ndarray, "3"] | None, now: Float[np.ndarray, "3"] | None
) -> Gaussians:
    """Gaussians given relative to the origin `was`, now relative to `now`; None is the origin of the data."""
    if was is None and now is None:
        return gaussians
    means = relative_to(in_world(np.asarray(gaussians.means), was), now)
    return eqx.tree_at(lambda g: g.means, gaussians, jnp.asarray(means, gaussians.means.dtype))


def origin_text(origin: Float[np.ndarray, "3"]) -> str:
    """An origin as text: "(500000, 5000000, 300)"."""
    return f"({', '.join(f'{value:.12g}' for value in origin)})"


def origin_message(places: Float[np.ndarray, "n 3"], origin: Float[np.ndarray, "3"]) -> str:
    """The message that says that coordinates are taken relative to an origin, and why."""
    largest = np.abs(places[np.isfinite(places).all(1)]).max()
    step = np.spacing(np.float32(largest))
    return (
        f"coordinates reach {largest:.4g}, where float32 has steps of {step:.2g}; they are taken relative to "
        f"the origin {origin_text(origin)}"
    )
