"""The first frame (section II-A): a dense labelled cloud of Gaussians from RGB-D cameras and one mask."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.cluster.vq import kmeans2

from gsjax.geometry.cameras import camera_centers
from gsjax.geometry.neighbors import voxel_thin
from gsjax.geometry.rotations import quats_to_matrices
from gsjax.methods.track.config import StartConfig
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians, concatenate, take
from gsjax.scene.initialize import estimate_normals, gaussians_from_points, points_from_rgbd, valid_depth
from gsjax.scene.labels import inherit_labels, lift_labels


class TrackedScene(eqx.Module):
    """Gaussians with labels, the moving ones first.

    Attributes:
        gaussians: the scene at the first frame.
        normals: outward normals of the moving ones in their own axes; zero where both sides can be seen.
        labels: group of each Gaussian: 0 is the background, 1..K the objects in the order of `label_ids`.
        label_ids: the mask value that each group came from, background first (static). Parts of one
            large object are groups of their own with the same value.
        num_moving: how many Gaussians, from the front, belong to objects (static).
    """

    gaussians: Gaussians
    normals: Float[Array, "m 3"]
    labels: Int[Array, "n"]
    label_ids: tuple[int, ...] = eqx.field(static=True)
    num_moving: int = eqx.field(static=True)

    @property
    def num_objects(self) -> int:
        """How many objects there are; the background is none."""
        return len(self.label_ids) - 1


class Cloud(NamedTuple):
    """Points, on the host."""

    points: Float[np.ndarray, "n 3"]
    colors: Float[np.ndarray, "n 3"]
    labels: Int[np.ndarray, "n"]
    footprints: Float[np.ndarray, "n"]  # width of a pixel at the point, as its camera saw it, metres
    eyes: Float[np.ndarray, "n 3"]  # where that camera stood


def labelled_cloud(
    frame: Frame, mask: Int[np.ndarray, "height width"], mask_camera: int, config: StartConfig
) -> Cloud:
    """All cameras' points; labels come from one camera's mask, and from it to near neighbours unseen there.

    Raises:
        ValueError: the frame has no depth or no valid depth, there is no mask or one of another size, or no
            such camera.
    """
    if frame.depths is None:
        raise ValueError(
            "the first frame needs depth to become Gaussians; without depth cameras give shapes (models)"
        )
    images, depths = np.asarray(frame.images), np.asarray(frame.depths)
    viewmats, Ks = np.asarray(frame.cameras.viewmat, np.float64), np.asarray(frame.cameras.K, np.float64)
    if not 0 <= mask_camera < len(depths):
        raise ValueError(f"mask_camera is {mask_camera}; the frame has {len(depths)} cameras, counted from 0")
    if mask is None:
        raise ValueError(
            "mask: expected labels [H, W] of one camera's image, found None, as of data without masks; "
            "a segmenter of gsjax.perception makes one"
        )
    if mask.shape != depths.shape[1:]:
        raise ValueError(f"mask has shape {mask.shape}; the images have {depths.shape[1:]} (height, width)")
    clouds = [points_from_rgbd(*view) for view in zip(images, depths, viewmats, Ks, strict=True)]
    footprints = [depth[valid_depth(depth)] / K[0, 0] for depth, K in zip(depths, Ks, strict=True)]
    points = np.concatenate([points for points, _ in clouds])
    colors = np.concatenate([colors for _, colors in clouds])
    if len(points) == 0:
        raise ValueError("the first frame has no valid depth in any camera: depth images are all zero")
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
    """Rows of the chosen points that are left when each voxel, `pixels` pixels wide, keeps one."""
    rows = np.flatnonzero(chosen)
    octave = np.floor(np.log2(pixels * cloud.footprints[rows]))
    kept = [
        members[voxel_thin(cloud.points[members], 2.0**level)]
        for level in np.unique(octave)
        for members in [rows[octave == level]]
    ]
    return np.concatenate(kept)


def _bodies(cloud: Cloud, config: StartConfig) -> list[tuple[int, np.ndarray]]:
    """(mask value, its points) of every body that moves as one; the background comes last.

    What is too large to be rigid is cut by k-means into parts, which keep the mask value they came from.
    """
    bodies = []
    for value in sorted(set(np.unique(cloud.labels).tolist()) - {0}):
        rows = np.flatnonzero(cloud.labels == value)
        points = cloud.points[rows]
        # Quantiles: a few pixels that fly off an edge, as depth cameras have them, make nothing large.
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
    """Thin the cloud, objects finely, background coarsely; each point becomes a disc on its surface."""
    parts, labels, towards, label_ids = [], [], [], [0]
    for value, chosen in _bodies(cloud, config):
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
    """A scene from Gaussians and their groups, sorted so that what can move comes first.

    Args:
        parts, labels: Gaussians, and the group (0 to K) of each.
        label_ids: the mask value of each group.
        towards: for discs, a direction on the side they were seen from; None: seen from both sides.

    Raises:
        ValueError: all of it is background.
    """
    gaussians, group = concatenate(parts), np.concatenate(labels)
    if len(label_ids) == 1:
        raise ValueError("no object to track: the mask labels nothing, or nothing that has depth")
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
