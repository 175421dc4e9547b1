"""Exposure and white balance of each camera, relative to the canonical scene. Where cameras differ, a scene
can only agree with all of them if their pictures are corrected first."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gsjax.scene.frame import Frame
from gsjax.scene.render import Rendered

AS_GIVEN = np.eye(3, 4, dtype=np.float32)
"""The map that leaves colours as they are."""
_LEAST_ALPHA = 0.5  # pixels with a lower rendered alpha are ignored
_TRUSTED = 0.2  # difference of colours, 0 to 1, above which a pixel shows something else
_ROUNDS = 3  # fits, each without the outliers of the one before
_PRIOR = 1e-3  # weight of the prior, which is no correction, relative to the pixels


def exposures_of(drawn: Sequence[Rendered], frame: Frame) -> Float[np.ndarray, "C 3 4"]:
    """The affine map from each camera's colours to those of the scene, [colour; 1] -> colour. The mean of the
    maps is [I | 0]: an exposure that all cameras share belongs to the scene.

    Args:
        drawn: renderings of the scene at the anchor frame, one for each camera.
        frame: all cameras in that frame; its masks select the pixels that count.
    """
    same, maps = np.eye(3, 4), []
    masks = [True] * len(drawn) if frame.masks is None else np.asarray(frame.masks)
    for view, picture, mask in zip(drawn, np.asarray(frame.images, np.float64), masks, strict=True):
        counts = (np.asarray(view.alphas[0]) > _LEAST_ALPHA) & mask
        true, seen = np.asarray(view.colors[0])[counts], np.insert(picture[counts], 3, 1.0, axis=-1)
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
    """All cameras of a frame, corrected to the scene's colours.

    Args:
        frame: all cameras.
        exposures: from `exposures_of`.
    """
    images = jnp.einsum("cij,chwj->chwi", exposures[..., :3], frame.images) + exposures[:, None, None, :, 3]
    return eqx.tree_at(lambda f: f.images, frame, jnp.clip(images, 0.0, 1.0))
