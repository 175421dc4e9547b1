"""Reference points: the Gaussians labelled by the first mask, carried along with their groups.

They alone define what a group looks like, because Gaussians that joined it later may belong to a neighbour.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gsjax.geometry.cameras import Camera, camera_centers
from gsjax.geometry.rotations import matrix_of, quats_to_matrices
from gsjax.geometry.spherical_harmonics import SH_C0
from gsjax.methods.track.config import AlignConfig
from gsjax.methods.track.layers import Shown, seen_from
from gsjax.methods.track.motion import Pose
from gsjax.methods.track.points import Points, ToneImages, carry, first_members, rotated, sum_of_three, tones
from gsjax.methods.track.scene import TrackedScene


class ReferencePoints(NamedTuple):
    """Up to p reference points of each group, at its estimated pose."""

    means: Float[Array, "*k 3 p"]
    normals: Float[Array, "*k 3 p"]  # outward; 0 if both sides are visible
    tones: Float[Array, "*k 3 p"]
    real: Bool[Array, "*k p"]  # False for padding


def reference_points(scene: TrackedScene, pose: Pose, config: AlignConfig) -> ReferencePoints:
    """The reference points of every group, up to `config.centers`."""
    # Gaussians that joined later have no normal. Neither have known shapes, but nothing joins those.
    with_normal = jnp.any(scene.normals != 0, axis=-1)
    named = jnp.where(with_normal | ~with_normal.any(), scene.groups, 0)
    rows, real = first_members(named, scene.num_objects, min(config.centers, scene.num_moving))
    normals = jnp.einsum("kpij,kpj->kpi", quats_to_matrices(pose.quats[rows]), scene.normals[rows])
    colors = tones(scene.gaussians.sh0[rows, 0] * SH_C0 + 0.5, config.shading)
    return ReferencePoints(*(jnp.swapaxes(a, 1, 2) for a in (pose.means[rows], normals, colors)), real)


def radii(reference: ReferencePoints, centers: Float[Array, "k 3"]) -> Float[Array, "k"]:
    """Root mean square distance of the reference points from the centres of their groups, metres."""
    squared = jnp.sum((reference.means - centers[..., None]) ** 2, axis=-2)
    return jnp.sqrt(jnp.sum(squared * reference.real, axis=-1) / jnp.maximum(reference.real.sum(-1), 1))


def points_last_seen(reference: ReferencePoints, shown: Shown, cameras: Camera, gap: float) -> Points:
    """The reference points of every group, with weight 1 in the cameras that saw them in the last frame.

    Args:
        reference: reference points of every group.
        shown: what the last scene shows in `cameras`.
        gap: tolerance of depth, metres.
    """
    count, _, size = reference.means.shape
    groups = jnp.repeat(jnp.arange(1, count + 1), size)
    means = jnp.swapaxes(reference.means, 1, 2).reshape(-1, 3)
    seen = seen_from(means, groups, shown, cameras, gap).reshape(-1, count, size)
    in_all = (count, len(seen), 3, size)
    of_each = (jnp.broadcast_to(a[:, None], in_all) for a in (reference.means, reference.tones))
    return Points(*of_each, jnp.moveaxis(seen, 0, 1) * reference.real[:, None])


def points_facing(
    reference: ReferencePoints, twist: Float[Array, "6"], center: Float[Array, "3"], images: ToneImages
) -> Points:
    """The reference points of one group after a twist (translation, metres, and rotation vector) about its
    centre, with weight 1 in the cameras that they face. Occlusion is ignored: what occludes the group where
    it is believed to be need not occlude it elsewhere.

    Args:
        reference: reference points of the group.
        twist, center: as for `carry`.
        images: the frame, whose cameras are used.
    """
    moved = carry(Points(reference.means, reference.tones, reference.real), twist, center)
    normals = rotated(matrix_of(twist[3:]), reference.normals)
    rays = camera_centers(images.cameras.viewmat)[:, :, None] - moved.means
    one_sided = jnp.any(normals != 0, axis=0)
    toward = sum_of_three(normals * rays, axis=1)
    faces = reference.real & ((toward > 0) | ~one_sided)
    of_each = (jnp.broadcast_to(a, (len(rays), *a.shape)) for a in (moved.means, reference.tones))
    return Points(*of_each, faces.astype(rays.dtype))


all_points_facing = jax.vmap(points_facing, in_axes=(0, 0, 0, None))
"""`points_facing` of many groups, each after its own twist."""
