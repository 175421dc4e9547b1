"""A scene from above and from the side: its points, and the positions and frusta of its cameras."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from gsjax.viz.plots import FAINT, INK, literal, style_axes
from gsjax.viz.viewer.cameras import up_direction

_FRUSTUM = 0.05  # length of a drawn frustum, as a fraction of the extent of the picture
_DRAWN_CAMERAS, _DRAWN_POINTS = 200, 30_000
_OUTER = 2.0  # percent of the points that may lie beyond each edge
_ROOM = 4.0  # points may widen the picture by this multiple of the cameras' extent, on each side
_MARGIN = 0.08
_PANEL, _HEIGHTS = 5.0, (2.0, 8.0)  # inches


class CameraGroup(NamedTuple):
    """Cameras drawn in one colour.

    Attributes:
        viewmats: world to camera, OpenCV axes, [N,4,4].
        Ks: intrinsics, pixels, [N,3,3].
        sizes: width and height, pixels, [N,2].
        color: a matplotlib colour.
    """

    viewmats: Float[np.ndarray, "n 4 4"]
    Ks: Float[np.ndarray, "n 3 3"]
    sizes: np.ndarray
    color: str


def cameras_and_points(
    groups: Mapping[str, CameraGroup],
    points: Float[np.ndarray, "m 3"] | None = None,
    colors: Float[np.ndarray, "m 3"] | None = None,
    *,
    unit: str = "units of the data",
    title: str = "",
) -> Figure:
    """Two drawings of one scene with equal axes: from above and from the side.

    Up is perpendicular to the right-hand axes of the cameras, snapped to a nearby world axis; +z without
    cameras. Every camera is in the picture. The limits ignore the outermost two percent of the points on each
    side, and points farther away than four times the extent of the cameras; the points beyond the edges are
    counted below the picture.

    Args:
        groups: legend name to cameras; cameras with the same pose are drawn once.
        points, colors: points of the scene and their colours, RGB 0 to 1.
        unit: unit of lengths, for the axis labels.
        title: title of the figure.
    """
    viewmats = np.concatenate([np.zeros((0, 4, 4)), *(group.viewmats for group in groups.values())])
    to_world = np.linalg.inv(viewmats)
    centers = to_world[:, :3, 3]
    up = up_direction(viewmats) if len(viewmats) else np.array([0.0, 0.0, 1.0])
    axes_of_world, names = _axes(up)
    shown = np.zeros((0, 3)) if points is None else points @ axes_of_world.T
    low, high = _limits(centers @ axes_of_world.T, shown)
    inside = ((shown >= low) & (shown <= high)).all(1)
    span = high - low
    tall = np.clip(_PANEL * max(span[1], span[2]) / span[0], *_HEIGHTS)
    figure = Figure(figsize=(2 * _PANEL + 1, tall + 1.2), facecolor="white", layout="constrained")
    figure.suptitle(literal(title), x=0.01, ha="left", fontsize=13, fontweight="bold", color=INK)
    above, side = figure.subplots(1, 2)
    length = _FRUSTUM * float(np.max(span))
    order = _thinned(np.flatnonzero(inside), _DRAWN_POINTS)
    for panel, (i, j), subtitle in ((above, (0, 1), "from above"), (side, (0, 2), "from the side")):
        panel.set_title(subtitle, loc="left", fontsize=11, color=INK)
        style_axes(panel, f"{names[i]} ({unit})", f"{names[j]} ({unit})")
        if len(order):
            shade = "#9aa1ab" if colors is None else np.clip(colors[order], 0, 1)
            panel.scatter(*shown[order][:, [i, j]].T, c=shade, s=1.2, lw=0, rasterized=True)
        for group in groups.values():
            lines = _frusta(group, length) @ axes_of_world.T
            panel.add_collection(LineCollection(lines[..., [i, j]], colors=group.color, lw=0.9, alpha=0.9))
        panel.set_xlim(low[i], high[i])
        panel.set_ylim(low[j], high[j])
        panel.set_aspect("equal", adjustable="box", anchor="N")
    for name, group in groups.items():
        above.plot([], [], color=group.color, lw=2.2, label=f"{name} ({len(group.viewmats)})")
    handles, labels = above.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", ncols=6, frameon=False, fontsize=9.5)
    if len(shown):
        beyond = f", {np.mean(~inside):.1%} of them beyond the edges" if not inside.all() else ""
        figure.text(0.995, 0.015, f"{len(shown):,} points{beyond}", ha="right", fontsize=9.5, color=FAINT)
    return figure


def _axes(up: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "3 3"], list[str]]:
    """The directions right, ahead and up of the drawings, as rows, and their names. If up is a world axis, so
    are the other two; otherwise they are as close to world axes as possible."""
    first = np.eye(3)[0] if abs(up[0]) < 0.9 else np.eye(3)[1]
    right = first - (first @ up) * up
    right = right / np.linalg.norm(right)
    rows = np.stack([right, np.cross(up, right), up])
    nearest = np.abs(rows).argmax(1)
    if np.abs(rows).max(1).min() < 1 - 1e-9:
        return rows, ["right", "ahead", "up"]
    return rows, [("-" if rows[i, k] < 0 else "") + "xyz"[k] for i, k in enumerate(nearest)]


def _limits(
    centers: Float[np.ndarray, "n 3"], points: Float[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Lower and upper corner of the box that is shown."""
    finite = points[np.isfinite(points).all(1)]
    if not len(centers) and not len(finite):
        return -np.ones(3), np.ones(3)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    if len(finite):
        low, high = np.percentile(finite, [_OUTER, 100 - _OUTER], axis=0)
    if len(centers):
        near, far = centers.min(0), centers.max(0)
        reach = _ROOM * (far - near).max()
        if reach > 0:
            low, high = np.maximum(low, near - reach), np.minimum(high, far + reach)
        low, high = np.minimum(low, near), np.maximum(high, far)
    margin = _MARGIN * max(float((high - low).max()), 1e-9)
    return low - margin, high + margin


def _thinned(indices: np.ndarray, most: int) -> np.ndarray:
    """At most `most` of the indices, drawn at random with a fixed seed: a regular stride could alias with
    their order."""
    if len(indices) <= most:
        return indices
    return np.random.default_rng(0).choice(indices, most, replace=False)


def _frusta(group: CameraGroup, length: float) -> Float[np.ndarray, "lines 2 3"]:
    """Line segments of each frustum: four edges from the centre, and the four sides of the image rectangle at
    depth `length`."""
    poses = np.round(group.viewmats, 9).reshape(-1, 16)
    _, first = np.unique(poses, axis=0, return_index=True)
    first = np.sort(first)[:: max(1, -(-len(first) // _DRAWN_CAMERAS))]
    to_world = np.linalg.inv(group.viewmats[first])
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])[None] * group.sizes[first][:, None]
    homogeneous = np.concatenate([corners, np.ones((*corners.shape[:2], 1))], axis=-1)
    rays = length * np.einsum("nij,nkj->nki", np.linalg.inv(group.Ks[first]), homogeneous)
    ends = np.einsum("nij,nkj->nki", to_world[:, :3, :3], rays) + to_world[:, None, :3, 3]
    centers = np.broadcast_to(to_world[:, None, :3, 3], ends.shape)
    edges, sides = np.stack([centers, ends], axis=2), np.stack([ends, np.roll(ends, 1, axis=1)], axis=2)
    return np.concatenate([edges, sides], axis=1).reshape(-1, 2, 3)
