"""Exposure and white balance of each camera, against the canonical scene. Where cameras differ, a scene can
only agree with all of them if their pictures are corrected first."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gsjax.rasterize.plan import Plan
from gsjax.scene.frame import Frame, one_camera
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import render

_LEAST_ALPHA = 0.5  # pixels with a lower rendered alpha are ignored
_TRUSTED = 0.2  # difference of colours, 0 to 1, above which something else is seen
_ROUNDS = 3  # fits, each without what the one before explains badly
_PRIOR = 1e-3  # weight of no correction at all, relative to the pixels


def exposures_of(gaussians: Gaussians, frame: Frame, plan: Plan) -> Float[np.ndarray, "C 3 4"]:
    """The affine map of each camera's colours to those of the scene, [colour; 1] -> colour. Their mean is
    [I | 0]: an exposure that all cameras share belongs to the scene.

    Args:
        gaussians: the scene at the anchor frame.
        frame: all cameras in that frame; its masks select the pixels that count.
        plan: for one camera.
    """
    same, maps = np.eye(3, 4), []
    for c in range(len(frame.images)):
        one = one_camera(frame, c)
        drawn = render(gaussians, one.cameras, plan)
        counts = np.asarray(drawn.alphas[0]) > _LEAST_ALPHA
        if one.masks is not None:
            counts &= np.asarray(one.masks[0])
        seen = np.asarray(one.images[0], np.float64)[counts]
        true, seen = np.asarray(drawn.colors[0])[counts], np.insert(seen, 3, 1.0, axis=-1)
        found = same
        for _ in range(_ROUNDS):
            trusted = np.abs(seen @ found.T - true).max(-1, initial=0.0) < _TRUSTED
            prior = np.sqrt(_PRIOR * trusted.sum() + 1) * np.eye(4)
            rows = np.concatenate([seen[trusted], prior])
            found = np.linalg.lstsq(rows, np.concatenate([true[trusted], prior @ same.T]), rcond=None)[0].T
        maps.append(found)
    return (np.stack(maps) - np.mean(maps, axis=0) + same).astype(np.float32)


@jax.jit
def corrected(frame: Frame, exposures: Float[Array, "C 3 4"] | Float[np.ndarray, "C 3 4"]) -> Frame:
    """All cameras of a frame with the colours of the scene.

    Args:
        frame: all cameras.
        exposures: from `exposures_of`.
    """
    images = jnp.einsum("cij,chwj->chwi", exposures[..., :3], frame.images) + exposures[:, None, None, :, 3]
    return eqx.tree_at(lambda f: f.images, frame, jnp.clip(images, 0.0, 1.0))
