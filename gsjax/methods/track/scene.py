"""The scene at the first frame: a dense labelled cloud of Gaussians from RGB-D cameras and one mask
(Object-Aware Gaussian Splatting for Robotic Manipulation, section II-A)."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.cluster.vq import kmeans2

from gsjax.geometry.cameras import camera_centers
from gsjax.geometry.neighbors import valid_depth, voxel_thin
from gsjax.geometry.rotations import quats_to_matrices
from gsjax.methods.track.config import StartConfig
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians, concatenate, take
from gsjax.scene.initialize import estimate_normals, gaussians_from_points, points_from_rgbd
from gsjax.scene.labels import inherit_labels, lift_labels

EMPTY = -30.0
"""Opacity logit of an invisible Gaussian, such as an empty slot."""


class TrackedScene(eqx.Module):
    """Gaussians with labels, the moving ones first.

    Attributes:
        gaussians: the scene at the first frame.
        normals: outward normals of the moving Gaussians in their own axes; zero if both sides are visible.
        labels: group of each Gaussian: 0 is the background, 1..K the objects in the order of `label_ids`.
        label_ids: mask value of each group, background first (static). The parts of a large object are
            separate groups with the same value.
        num_moving: number of Gaussians that belong to objects, which come first (static).
    """

    gaussians: Gaussians
    normals: Float[Array, "m 3"]
    labels: Int[Array, "n"]
    label_ids: tuple[int, ...] = eqx.field(static=True)
    num_moving: int = eqx.field(static=True)

    @property
    def num_objects(self) -> int:
        """K, the number of objects, without the background."""
        return len(self.label_ids) - 1

    @property
    def groups(self) -> Int[Array, "m"]:
        """Group of each moving Gaussian, 1..K; K+1 for an empty slot."""
        return self.labels[: self.num_moving]


def emptied(gaussians: Gaussians, rows: Bool[Array, "n"]) -> Gaussians:
    """The Gaussians with some rows made invisible."""
    logits = jnp.where(rows, EMPTY, gaussians.logit_opacities)
    return eqx.tree_at(lambda g: g.logit_opacities, gaussians, logits)


class Cloud(NamedTuple):
    """A labelled point cloud, on the host."""

    points: Float[np.ndarray, "n 3"]
    colors: Float[np.ndarray, "n 3"]
    labels: Int[np.ndarray, "n"]
    footprints: Float[np.ndarray, "n"]  # width of a pixel at the depth of the point, metres
    eyes: Float[np.ndarray, "n 3"]  # position of the camera that saw the point


def labelled_cloud(
    frame: Frame, mask: Int[np.ndarray, "height width"], mask_camera: int, config: StartConfig
) -> Cloud:
    """The points of all cameras. Their labels come from the mask of one camera, and spread from the points
    that it saw to near neighbours.

    Raises:
        ValueError: the frame has no depth or no valid depth, the mask is missing or has another size, or the
            camera does not exist.
    """
    if frame.depths is None:
        raise ValueError(
            "depths: expected those of the first frame, found None; without depth cameras, give models of "
            "the objects as shapes"
        )
    images, depths = np.asarray(frame.images), np.asarray(frame.depths)
    viewmats, Ks = np.asarray(frame.cameras.viewmat, np.float64), np.asarray(frame.cameras.K, np.float64)
    if not 0 <= mask_camera < len(depths):
        raise ValueError(f"mask_camera: expected 0 to {len(depths) - 1}, found {mask_camera}")
    if mask is None:
        raise ValueError(
            "mask: expected labels [H, W] of one camera's image, found None, because the data has no masks; "
            "make one with a segmenter of gsjax.perception"
        )
    if mask.shape != depths.shape[1:]:
        raise ValueError(f"mask: expected shape {depths.shape[1:]} to match images, found {mask.shape}")
    clouds = [points_from_rgbd(*view) for view in zip(images, depths, viewmats, Ks, strict=True)]
    footprints = [depth[valid_depth(depth)] / K[0, 0] for depth, K in zip(depths, Ks, strict=True)]
    points = np.concatenate([points for points, _ in clouds])
    colors = np.concatenate([colors for _, colors in clouds])
    if len(points) == 0:
        raise ValueError("depths: expected positive values in the first frame, found none in any camera")
    view = (depths[mask_camera], viewmats[mask_camera], Ks[mask_camera])
    labels = lift_labels(points, mask, *view, max_depth_gap=config.depth_gap)
    counts = [len(footprint) for footprint in footprints]
    eyes = np.repeat(np.asarray(camera_centers(jnp.asarray(viewmats))), counts, axis=0)
    normals = estimate_normals(points)
    normals *= np.sign(np.sum(normals * (eyes - points), axis=1, keepdims=True))
    reach = {"max_distance": config.label_distance, "max_step": config.label_step}
    labels = inherit_labels(points, labels, normals, **reach)
    return Cloud(points, colors, labels, np.concatenate(footprints), eyes)


def _thin(cloud: Cloud, chosen: np.ndarray, pixels: float) -> np.ndarray:
    """Indices of the chosen points, thinned to one in each voxel about `pixels` pixels wide."""
    rows = np.flatnonzero(chosen)
    octave = np.floor(np.log2(pixels * cloud.footprints[rows]))
    kept = [
        members[voxel_thin(cloud.points[members], 2.0**level)]
        for level in np.unique(octave)
        for members in [rows[octave == level]]
    ]
    return np.concatenate(kept)


def _rigid_parts(cloud: Cloud, config: StartConfig) -> list[tuple[int, np.ndarray]]:
    """(mask value, mask of its points) of every rigid body; the background comes last.

    Objects too large to be rigid are divided by k-means into parts, which keep the mask value.
    """
    bodies = []
    for value in sorted(set(np.unique(cloud.labels).tolist()) - {0}):
        rows = np.flatnonzero(cloud.labels == value)
        points = cloud.points[rows]
        # Quantiles exclude the few flying pixels that depth cameras produce at edges.
        extent = float(np.ptp(np.quantile(points, (0.01, 0.99), axis=0), axis=0).max())
        parts = np.zeros(len(rows), int)
        if extent > config.max_extent:
            count = int(np.ceil(extent / config.part_size))
            _, parts = kmeans2(points, count, minit="++", seed=0)
        for part in np.unique(parts):
            chosen = np.zeros(len(cloud.points), bool)
            chosen[rows[parts == part]] = True
            bodies.append((value, chosen))
    background = cloud.labels == 0
    return [*bodies, (0, background)] if background.any() else bodies


def scene_from_cloud(cloud: Cloud, config: StartConfig) -> TrackedScene:
    """Thin the cloud, objects less than the background, and turn each point into a disc on its surface."""
    parts, labels, towards, label_ids = [], [], [], [0]
    for value, chosen in _rigid_parts(cloud, config):
        kept = _thin(cloud, chosen, config.object_pixels if value else config.background_pixels)
        part = gaussians_from_points(cloud.points[kept], cloud.colors[kept], normals="pca")
        if value:
            label_ids.append(int(value))
        parts.append(part)
        towards.append(cloud.eyes[kept] - cloud.points[kept])
        labels.append(np.full(part.num, len(label_ids) - 1 if value else 0))
    return assemble(parts, labels, tuple(label_ids), towards)


def assemble(
    parts: list[Gaussians],
    labels: list[np.ndarray],
    label_ids: tuple[int, ...],
    towards: list[np.ndarray] | None = None,
) -> TrackedScene:
    """A scene from Gaussians and their groups, sorted so that the moving ones come first.

    Args:
        parts, labels: Gaussians, and the group (0 to K) of each.
        label_ids: mask value of each group.
        towards: a direction from each disc to the side it was seen from; None if both sides are visible.

    Raises:
        ValueError: there is no object.
    """
    if len(label_ids) == 1:
        raise ValueError("mask: expected an object, found none, or none that has depth")
    gaussians, group = concatenate(parts), np.concatenate(labels)
    order = np.argsort(group == 0, kind="stable")
    num_moving = int((group != 0).sum())
    normals = np.zeros((num_moving, 3), np.float32)
    if towards is not None:
        axes = np.asarray(quats_to_matrices(gaussians.quats))[:, :, 2]
        side = np.sign(np.sum(axes * np.concatenate(towards), axis=1))
        normals[:, 2] = side[order][:num_moving]
    return TrackedScene(
        gaussians=take(gaussians, order),
        normals=jnp.asarray(normals),
        labels=jnp.asarray(group[order], jnp.int32),
        label_ids=label_ids,
        num_moving=num_moving,
    )
