"""Where a reconstruction found that the camera stood, at the frames it learned from and between them. On the
host."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gsjax.geometry.cameras import perturbed
from gsjax.scene.frame import Frame


def refined_viewmats(
    viewmats: Float[np.ndarray, "T C 4 4"],
    times: Float[np.ndarray, "T"],
    twists: Float[Array, "frames 6"],
    learned: Float[np.ndarray, "frames"],
    radius: float,
) -> Float[np.ndarray, "T C 4 4"]:
    """View matrices at any times, by the twists of the frames that were learned from: another frame has what
    lies between those of its neighbours in time, as errors of an arm that holds a camera change slowly; one
    before or after all of them has that of the nearest. Nothing of its picture is used.

    Args:
        viewmats: as given; camera 0 is the one that is learned from, and the others move along with it.
        times: of these, 0 to 1.
        twists: of the frames that were learned from.
        learned: times of these frames.
        radius: of the scene, the unit of shifts.
    """
    order = np.argsort(learned)
    rows = np.asarray(twists, np.float64)[order]
    at = np.stack([np.interp(times, learned[order], column) for column in rows.T], axis=1)
    dtype = jnp.result_type(float)
    apply = jax.jit(jax.vmap(lambda viewmat, twist: perturbed(viewmat, twist, radius)))
    found = apply(jnp.asarray(viewmats[:, :1], dtype), jnp.asarray(at, dtype))
    first = np.asarray(found, np.float64)
    return (viewmats @ np.linalg.inv(viewmats[:, :1])) @ first


def refined_frames(frames: Sequence[Frame], twists: Float[Array, "frames 6"], radius: float) -> list[Frame]:
    """Frames of one camera each, from where they were found to be.

    Args:
        frames: as they were given.
        twists: of each frame.
        radius: of the scene, the unit of shifts.
    """
    given, times = np.stack([frame.cameras.viewmat for frame in frames]), times_of(frames)
    found = refined_viewmats(given, times, twists, times, radius)
    return [
        eqx.tree_at(lambda f: f.cameras.viewmat, frame, viewmat)
        for frame, viewmat in zip(frames, found, strict=True)
    ]


def times_of(frames: Sequence[Frame]) -> Float[np.ndarray, "frames"]:
    """When frames were seen, 0 to 1; 0 for those that do not say."""
    return np.array([0.0 if frame.time is None else float(frame.time) for frame in frames])
