"""Alignment of two sets of cameras of the same photographs, each with its own world frame and unit."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class Alignment(NamedTuple):
    """A similarity transform between two sets of cameras, and the residuals after it.

    Attributes:
        scale, rotation, translation: map a point of the first world to scale * rotation @ point + translation
            in the second.
        turned_deg: residual rotation of each camera, degrees, [N].
        moved: residual distance of each camera's centre, in the second world's unit, [N].
        extent: the largest distance between two cameras of the second set, in its unit.
    """

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    turned_deg: Float[np.ndarray, "n"]
    moved: Float[np.ndarray, "n"]
    extent: float


def align_cameras(viewmats: Float[np.ndarray, "n 4 4"], onto: Float[np.ndarray, "n 4 4"]) -> Alignment:
    """The similarity that maps the camera centres onto those of `onto` in the least-squares sense (Umeyama
    1991).

    Args:
        viewmats, onto: world to camera, of the same photographs in the same order.

    Raises:
        ValueError: there are fewer than three cameras, or they are collinear, so the rotation is ambiguous.
    """
    if len(viewmats) != len(onto) or len(onto) < 3:
        raise ValueError(
            f"viewmats, onto: expected the same number of cameras, three or more, found {len(viewmats)} and "
            f"{len(onto)}"
        )
    centers, targets = _centers(viewmats), _centers(onto)
    a, b = centers - centers.mean(0), targets - targets.mean(0)
    U, strengths, Vt = np.linalg.svd(b.T @ a)
    if strengths[1] <= 1e-9 * max(strengths[0], 1e-300):
        raise ValueError(
            "viewmats, onto: the cameras are collinear, so the rotation about their line is ambiguous"
        )
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    rotation = U @ np.diag(signs) @ Vt
    scale = float((strengths * signs).sum() / (a**2).sum())
    translation = targets.mean(0) - scale * rotation @ centers.mean(0)
    moved = np.linalg.norm(scale * centers @ rotation.T + translation - targets, axis=1)
    residual = onto[:, :3, :3] @ rotation @ np.swapaxes(viewmats[:, :3, :3], 1, 2)
    cosines = (np.trace(residual, axis1=1, axis2=2) - 1) / 2
    sines = np.linalg.norm(residual - np.swapaxes(residual, 1, 2), axis=(1, 2)) / np.sqrt(8)
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
