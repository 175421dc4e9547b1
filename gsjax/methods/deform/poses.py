"""Where a reconstruction found that the camera stood, at looks and between them. On the host."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gsjax.geometry.cameras import perturbed
from gsjax.methods.deform.start import Look


def refined_viewmats(
    viewmats: Float[np.ndarray, "T C 4 4"],
    times: Float[np.ndarray, "T"],
    twists: Float[Array, "looks 6"],
    looks: Sequence[Look],
    radius: float,
) -> Float[np.ndarray, "T C 4 4"]:
    """View matrices at any times, by the twists of looks: a frame that was not learned from has what lies
    between those of its neighbours in time, as errors of an arm that holds a camera change slowly; one before
    or after all looks has that of the nearest. Nothing of its picture is used.

    Args:
        viewmats: as given; camera 0 is the one that is learned from, and the others move along with it.
        times: of these, 0 to 1.
        twists: of looks.
        looks: that were learned from.
        radius: of the scene, the unit of shifts.
    """
    known = np.array([look.time for look in looks])
    order = np.argsort(known)
    rows = np.asarray(twists, np.float64)[order]
    at = np.stack([np.interp(times, known[order], column) for column in rows.T], axis=1)
    dtype = jnp.result_type(float)
    apply = jax.jit(jax.vmap(lambda viewmat, twist: perturbed(viewmat, twist, radius)))
    found = apply(jnp.asarray(viewmats[:, :1], dtype), jnp.asarray(at, dtype))
    first = np.asarray(found, np.float64)
    return (viewmats @ np.linalg.inv(viewmats[:, :1])) @ first


def refined_looks(looks: Sequence[Look], twists: Float[Array, "looks 6"], radius: float) -> list[Look]:
    """Looks from where they were found to be.

    Args:
        looks: as they were given.
        twists: of each look.
        radius: of the scene: what shifts are counted in.
    """
    given, times = np.stack([look.viewmat for look in looks]), np.array([look.time for look in looks])
    found = refined_viewmats(given[:, None], times, twists, looks, radius)
    return [look._replace(viewmat=viewmat) for look, viewmat in zip(looks, found[:, 0], strict=True)]
