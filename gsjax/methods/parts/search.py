"""Search for parts that jump: a ball that is thrown goes farther between two frames than it is wide, so that
no gradient leads to it. Before a frame's first step, what does not look as it should at its predicted place
is looked for around it, by the colours at the projections of its Gaussians in all cameras."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.geometry.cameras import Camera, project
from gsjax.geometry.spherical_harmonics import SH_C0
from gsjax.methods.parts.stream import Canonical
from gsjax.methods.parts.trajectory import BACKGROUND
from gsjax.optim.compiler import host_jit
from gsjax.scene.frame import Frame
from gsjax.scene.handles import Blend, HandlePose, skin

_POINTS = 64  # Gaussians by which a group of parts is recognised
_TOUCH = 0.05  # share of a part's neighbours in another one with which it moves as a group
_MOST = 0.3  # difference of colours, 0 to 1, that counts as entirely wrong
_ASTRAY = 1.25, 0.02  # a group is looked for if its difference is so much larger than at the anchor
_BETTER = 0.75  # share of its difference at the predicted place that a better place may have
_AS_USUAL = 1.1  # share of its difference at the anchor that a better place may have
_GRIDS = (6.0, 1.0), (1.0, 0.5), (0.5, 0.25)  # reach and spacing of the places, in radii of the group
_INSIDE = 0.5  # share of the points that a place must keep in the pictures


class Group(NamedTuple):
    """Parts that touch, and the Gaussians by which they are recognised.

    Attributes:
        parts: indices of the parts.
        rows: rows of the movable Gaussians, the most visible ones.
        radius: distance from its middle that nearly all of its Gaussians keep, metres.
    """

    parts: Int[np.ndarray, "p"]
    rows: Int[np.ndarray, "n"]
    radius: float


def groups_of(canonical: Canonical, weights: Float[np.ndarray, "M P"]) -> list[Group]:
    """The parts in groups of those that touch at the anchor frame.

    Args:
        canonical: the scene at rest, with neighbours.
        weights: weights of its movable Gaussians.
    """
    labels, slots = weights.argmax(-1), weights.shape[1]
    around = np.concatenate([labels, np.full(canonical.fixed.num, BACKGROUND)])[canonical.neighbors]
    touching = np.zeros((slots, slots))
    np.add.at(touching, (np.repeat(labels, around.shape[1]), around.ravel()), 1)
    touching /= np.maximum(touching.sum(-1, keepdims=True), 1)
    left, groups = set(np.unique(labels).tolist()) - {BACKGROUND}, []
    means = np.asarray(canonical.movable.means)
    sizes = np.asarray(canonical.movable.opacities) * np.sort(canonical.movable.scales, -1)[:, 1:].prod(-1)
    while left:
        parts, new = set(), [min(left)]
        while new:
            part = new.pop()
            parts.add(part)
            near = (touching[part] > _TOUCH) | (touching[:, part] > _TOUCH)
            new += [q for q in np.flatnonzero(near).tolist() if q in left - parts]
        left -= parts
        rows = np.flatnonzero(np.isin(labels, sorted(parts)))
        radius = float(np.quantile(np.linalg.norm(means[rows] - means[rows].mean(0), axis=-1), 0.95))
        groups.append(Group(np.array(sorted(parts)), rows[np.argsort(-sizes[rows])[:_POINTS]], radius))
    return groups


def searched(
    canonical: Canonical,
    weights: Float[Array, "M P"],
    predicted: HandlePose,
    now: Frame,
    anchor: Frame,
    blend: Blend,
) -> HandlePose:
    """The predicted pose, with groups of parts shifted that look wrong there and right elsewhere.

    Args:
        canonical: the scene at rest.
        weights: weights of its movable Gaussians.
        predicted: poses of the handles in this frame.
        now: all cameras in this frame.
        anchor: all cameras in the anchor frame.
        blend: how rotations are blended.
    """
    moved = np.asarray(skin(canonical.movable, weights, canonical.centers, predicted, blend).means)
    means, colors = np.asarray(canonical.movable.means), 0.5 + SH_C0 * np.asarray(canonical.movable.sh0)[:, 0]
    translations, found = np.array(predicted.translations), False
    for group in groups_of(canonical, np.asarray(weights)):
        if group.radius == 0:
            continue
        rows = np.resize(group.rows, _POINTS)

        def costs(points, frame, shifts, rows=rows):
            return np.asarray(_costs(frame.images, frame.cameras, points[rows], colors[rows], shifts))

        nowhere = np.zeros((1, 3), np.float32)
        usual, here = costs(means, anchor, nowhere)[0], costs(moved, now, nowhere)[0]
        if here <= _ASTRAY[0] * usual + _ASTRAY[1]:
            continue
        best, there = nowhere, here
        for reach, spacing in _GRIDS:
            places = best + np.float32(group.radius) * _grid(reach, spacing)
            at = costs(moved, now, places)
            best, there = places[at.argmin()][None], at.min()
        if there <= min(_BETTER * here, _AS_USUAL * usual):
            translations[group.parts] += best[0]
            found = True
    return HandlePose(predicted.quats, jnp.asarray(translations)) if found else predicted


def _grid(reach: float, spacing: float) -> Float[np.ndarray, "K 3"]:
    """Places within a reach of the origin, which is the first of them."""
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
    shift of the points; points outside a picture do not count, unless most are that the first shift has
    inside."""
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
