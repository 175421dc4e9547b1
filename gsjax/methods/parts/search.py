"""Search for parts that jump: a thrown ball moves farther between two frames than it is wide, so that no
gradient leads to it. Before a frame's first step, parts whose colours do not match at their predicted place
are searched for around it, by the colours at the projections of their Gaussians in all cameras."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gsjax.geometry.cameras import Camera, project
from gsjax.geometry.spherical_harmonics import SH_C0
from gsjax.methods.parts.discovery import Discovery, adjacent_parts
from gsjax.methods.parts.trajectory import BACKGROUND
from gsjax.optim.compiler import host_jit
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.handles import Blend, HandlePose, skin

POINTS = 64
"""Number of Gaussians by which a part, or a group of parts, is recognised."""
_MOST = 0.3  # difference of colours, 0 to 1, that counts as entirely wrong
_MISMATCH = 1.25, 0.02  # factor on the anchor's difference, and offset, above which a group is searched for
_LEFT = 0.3  # share of the excess over the anchor's difference that may remain at a better place
_GRIDS = (6.0, 1.0), (1.0, 0.5), (0.5, 0.25)  # reach and spacing of the search grids, in radii of the group
_NOWHERE = np.zeros((1, 3), np.float32)
_INSIDE = 0.5  # share of the visible points that must stay inside the pictures


class Group(NamedTuple):
    """Parts that touch, and the Gaussians by which they are recognised.

    Attributes:
        parts: indices of the parts.
        rows: rows of the movable Gaussians, the most visible ones.
        radius: distance from its middle within which 95 % of its Gaussians lie, metres.
    """

    parts: Int[np.ndarray, "p"]
    rows: Int[np.ndarray, "n"]
    radius: float


def groups_of(discovery: Discovery) -> list[Group]:
    """The parts, in groups of parts that touch at the anchor frame.

    Args:
        discovery: the scene at rest, with neighbours, and the weights.
    """
    canonical, weights = discovery.canonical, np.asarray(discovery.weights)
    labels = weights.argmax(-1)
    parts = np.setdiff1d(labels, [BACKGROUND])
    if not len(parts):
        return []
    touching = [np.isin(parts, adjacent_parts(discovery, weights, part)) for part in parts.tolist()]
    count, group_of = connected_components(coo_array(touching), directed=False)
    means = np.asarray(canonical.movable.means)
    groups = []
    for members in (parts[group_of == i] for i in range(count)):
        mine = np.isin(labels, members)
        rows = np.flatnonzero(mine)
        radius = float(np.quantile(np.linalg.norm(means[rows] - means[rows].mean(0), axis=-1), 0.95))
        groups.append(Group(members, most_visible(canonical.movable, mine), radius))
    return groups


def most_visible(gaussians: Gaussians, mine: Bool[np.ndarray, "M"]) -> Int[np.ndarray, "n"]:
    """The rows of the most visible of some Gaussians, at most `POINTS` of them.

    Args:
        gaussians: M Gaussians.
        mine: the ones to choose from.
    """
    rows = np.flatnonzero(mine)
    sizes = np.asarray(gaussians.opacities) * np.sort(gaussians.scales, -1)[:, 1:].prod(-1)
    return rows[np.argsort(-sizes[rows])[:POINTS]]


def colors_of(gaussians: Gaussians) -> Float[np.ndarray, "M 3"]:
    """The view-independent colours of Gaussians."""
    return 0.5 + SH_C0 * np.asarray(gaussians.sh0)[:, 0]


def color_differences(
    frame: Frame,
    points: Float[np.ndarray, "n 3"],
    colors: Float[np.ndarray, "n 3"],
    shifts: Float[np.ndarray, "K 3"] = _NOWHERE,
) -> Float[np.ndarray, "K"]:
    """The mean difference between the colours of points and of the pixels that they project to; see `_costs`.

    Args:
        frame: all cameras.
        points: their positions, metres.
        colors: their colours.
        shifts: shifts of all points to try, metres (default: none).
    """
    return np.asarray(_costs(frame.images, frame.cameras, points, colors, shifts))


def searched(discovery: Discovery, now: Frame, anchor: Frame, blend: Blend) -> HandlePose:
    """The predicted pose of a frame, with groups of parts shifted that match badly there but well elsewhere.

    Args:
        discovery: the scene, its weights and the predicted pose.
        now: all cameras in this frame.
        anchor: all cameras in the anchor frame.
        blend: how rotations are blended.
    """
    canonical, predicted = discovery.canonical, discovery.predicted
    moved = skin(canonical.movable, discovery.weights, canonical.centers, predicted, blend)
    moved, means = np.asarray(moved.means), np.asarray(canonical.movable.means)
    colors, shifts = colors_of(canonical.movable), {}
    for group in groups_of(discovery):
        rows = np.resize(group.rows, POINTS)
        usual = color_differences(anchor, means[rows], colors[rows])[0]
        here = color_differences(now, moved[rows], colors[rows])[0]
        if here <= _MISMATCH[0] * usual + _MISMATCH[1]:
            continue
        best, there = _NOWHERE, here
        for reach, spacing in _GRIDS:
            places = best + np.float32(group.radius) * _grid(reach, spacing)
            at = color_differences(now, moved[rows], colors[rows], places)
            best, there = places[at.argmin()][None], at.min()
        if there <= usual + _LEFT * (here - usual):  # `usual` includes what occludes it
            shifts |= dict.fromkeys(group.parts.tolist(), best[0])
    if not shifts:
        return predicted
    translations = np.array(predicted.translations)
    translations[list(shifts)] += np.stack(list(shifts.values()))
    return HandlePose(predicted.quats, jnp.asarray(translations))


def _grid(reach: float, spacing: float) -> Float[np.ndarray, "K 3"]:
    """Grid points within a reach of the origin, which comes first."""
    steps = spacing * np.arange(-int(reach / spacing), int(reach / spacing) + 1)
    grid = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(-1, 3)
    distances = np.linalg.norm(grid, axis=-1)
    near = np.argsort(distances, kind="stable")
    return grid[near[distances[near] <= reach + 1e-6]].astype(np.float32)


@host_jit
def _costs(
    images: Float[Array, "C H W 3"],
    cameras: Camera,
    points: Float[Array, "n 3"],
    colors: Float[Array, "n 3"],
    shifts: Float[Array, "K 3"],
) -> Float[Array, "K"]:
    """The mean difference between the colours of points and of the pixels that they project to, for each
    shift of the points. Points outside a picture do not count, but a shift that keeps at most half as
    many inside as the first one counts as entirely wrong."""
    height, width = images.shape[1:3]

    def of_camera(image, viewmat, K):
        def of_shift(shift):
            pixels, depth = project(points + shift, viewmat, K)
            column, row = jnp.floor(pixels).astype(jnp.int32).T
            inside = (depth > 1e-3) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
            seen = image[jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)]
            off = jnp.minimum(jnp.abs(seen - colors).mean(-1), _MOST)
            return jnp.sum(off * inside), inside.sum()

        return jax.lax.map(of_shift, shifts, batch_size=128)

    off, counts = jax.lax.map(lambda one: of_camera(*one), (images, cameras.viewmat, cameras.K))
    total = counts.sum(0)
    return jnp.where(total > _INSIDE * total[0], off.sum(0) / jnp.maximum(total, 1), _MOST)
