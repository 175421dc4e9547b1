"""Two sets of cameras of the same photographs, each with a world and unit of its own, brought together."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class Alignment(NamedTuple):
    """A similarity, and what is left between the cameras after it.

    Attributes:
        scale, rotation, translation: a point of the first world is scale * rotation @ point + translation in
            the second.
        turned_deg: by how many degrees each camera is turned against its twin, [N].
        moved: how far each stands from its twin, in the second world's unit, [N].
        extent: the largest distance between two cameras of the second set.
    """

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    turned_deg: Float[np.ndarray, "n"]
    moved: Float[np.ndarray, "n"]
    extent: float


def align_cameras(viewmats: Float[np.ndarray, "n 4 4"], onto: Float[np.ndarray, "n 4 4"]) -> Alignment:
    """The similarity that brings the centres of cameras nearest to those of `onto`, in the mean of squares
    (Umeyama 1991).

    Args:
        viewmats, onto: world to camera, of the same photographs in the same order.

    Raises:
        ValueError: there are fewer than three cameras, or all stand in one line, so that the turn is open.
    """
    if len(viewmats) != len(onto) or len(onto) < 3:
        raise ValueError(
            f"viewmats, onto: expected three cameras or more, the same number of each, found {len(viewmats)} "
            f"and {len(onto)}"
        )
    centers, targets = _centers(viewmats), _centers(onto)
    a, b = centers - centers.mean(0), targets - targets.mean(0)
    U, strengths, Vt = np.linalg.svd(b.T @ a)
    if strengths[1] <= 1e-9 * max(strengths[0], 1e-300):
        raise ValueError(
            "viewmats, onto: the cameras stand in one line, about which the worlds may be turned"
        )
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    rotation = U @ np.diag(signs) @ Vt
    scale = float((strengths * signs).sum() / (a**2).sum())
    translation = targets.mean(0) - scale * rotation @ centers.mean(0)
    moved = np.linalg.norm(scale * centers @ rotation.T + translation - targets, axis=1)
    left = onto[:, :3, :3] @ rotation @ np.swapaxes(viewmats[:, :3, :3], 1, 2)
    cosines = (np.trace(left, axis1=1, axis2=2) - 1) / 2
    sines = np.linalg.norm(left - np.swapaxes(left, 1, 2), axis=(1, 2)) / np.sqrt(8)
    distances = np.linalg.norm(targets[:, None] - targets[None], axis=-1)
    return Alignment(
        scale,
        rotation,
        translation,
        np.degrees(np.arctan2(sines, cosines)),
        moved,
        float(distances.max()),
    )


def _centers(viewmats: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 3"]:
    return -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])
