"""Measurements of a deforming scene at some frames: positions, depths, distances and motions of its classes.
Questions are answered from these alone (`questions`)."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Any, NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import cKDTree

from gsjax.geometry.cameras import Camera, pixels_of
from gsjax.methods.deform.query import most_likely, prompt_probabilities
from gsjax.methods.deform.result import DeformResult
from gsjax.methods.deform.update import DeformingScene, Moving
from gsjax.rasterize.plan import HEADROOM, Plan, with_room
from gsjax.rasterize.rasterization import Meta
from gsjax.scene.render import plan_render, render

LEAST_SHARE = 1e-3
"""Share of the image below which a connected piece of a class is ignored as a speck."""
_LEAST_ALPHA = 0.5  # below which a pixel shows nothing
_LEAST_OPACITY = 0.3  # below which a Gaussian belongs to no surface
_SURFACE = 0.03  # relative difference in depth between a Gaussian and its pixel, for it to be visible there
_SMOOTH = 0.03  # relative difference in depth between a pixel and its neighbours, on one surface
_STRAY = 3  # the n-th nearest point measures a gap, as one or two may belong to another surface
_MOST_POINTS = 4000  # largest number of points of a class


class LabelledView(NamedTuple):
    """The rendered view of one frame, with the points of each class at its time.

    Attributes:
        labels: class of each pixel, -1 for none.
        depths: metres along the optical axis, 0 where nothing is drawn.
        viewmat: world to camera, OpenCV axes.
        K: intrinsics, pixels.
        points: world positions of the points of each class; the same points in all frames.
    """

    labels: Int[np.ndarray, "h w"]
    depths: Float[np.ndarray, "h w"]
    viewmat: Float[np.ndarray, "4 4"]
    K: Float[np.ndarray, "3 3"]
    points: tuple[Float[np.ndarray, "_ 3"], ...]


@dataclass(frozen=True, eq=False)
class SceneFacts:
    """Measurements of k classes in T frames; NaN where a class is not in view.

    Attributes:
        names: names of the classes.
        frames: frame numbers in the recording, in order.
        times: their times, 0 to 1 over the recording.
        unit: unit of lengths: "mm", or "% of the depth" for a scene of unknown scale.
        gaussians: number of Gaussians of each class, in the whole scene.
        shares: share of the image that a class covers; 0 where it is not in view.
        pieces: number of its connected components in the image (8 neighbours).
        places: their centroid in the image, from the left and from the top, 0 to 1.
        depths: median depth along the optical axis.
        centers: mean of its visible points, in the camera's axes: right, down, forward.
        extents: distance from their 5th to their 95th percentile, along the same axes.
        gaps: smallest distance between the visible surfaces of two classes: between their pixels, or between
            their points at depth discontinuities, where pixels blend foreground and background.
        moved: [i, j]: median distance that the points visible in frame i are displaced in frame j.
        shifts: [i, j]: their mean displacement, in the axes of the camera of frame i.
    """

    names: tuple[str, ...]
    frames: tuple[int, ...]
    times: Float[np.ndarray, "T"]
    unit: str
    gaussians: Int[np.ndarray, "k"]
    shares: Float[np.ndarray, "T k"]
    pieces: Int[np.ndarray, "T k"]
    places: Float[np.ndarray, "T k 2"]
    depths: Float[np.ndarray, "T k"]
    centers: Float[np.ndarray, "T k 3"]
    extents: Float[np.ndarray, "T k 3"]
    gaps: Float[np.ndarray, "T k k"]
    moved: Float[np.ndarray, "T T k"]
    shifts: Float[np.ndarray, "T T k 3"]

    def present(self, row: int, thing: int) -> bool:
        """Whether a class is in view in a frame, by its row."""
        return bool(self.pieces[row, thing] > 0)

    def of_frame(self, row: int) -> dict[str, Any]:
        """The facts of one frame, by class, ready for JSON."""
        classes = {}
        for k, name in enumerate(self.names):
            gaps = {other: _plain(self.gaps[row, k, j]) for j, other in enumerate(self.names) if j != k}
            classes[name] = {
                "present": self.present(row, k),
                "share_of_picture": _plain(self.shares[row, k]),
                "pieces": int(self.pieces[row, k]),
                "place_from_left_top": _plain(self.places[row, k]),
                "depth": _plain(self.depths[row, k]),
                "center_right_down_forward": _plain(self.centers[row, k]),
                "extent": _plain(self.extents[row, k]),
                "distance_to": gaps,
            }
        return {"frame": self.frames[row], "classes": classes}

    def of_motion(self, row: int, other: int) -> dict[str, Any]:
        """The motion from one frame to another, by class, ready for JSON."""
        classes = {
            name: {
                "moved": _plain(self.moved[row, other, k]),
                "shift_right_down_forward": _plain(self.shifts[row, other, k]),
            }
            for k, name in enumerate(self.names)
        }
        return {"from_frame": self.frames[row], "to_frame": self.frames[other], "classes": classes}


def _plain(value: Any) -> Any:
    """A number or a list of them for JSON, which has no NaN."""
    if np.ndim(value):
        return [_plain(x) for x in value]
    return round(float(value), 6) if np.isfinite(value) else None


def scene_facts(result: DeformResult, rows: Sequence[int]) -> SceneFacts:
    """Facts of a deforming scene at some of its frames.

    A pixel belongs to the class most similar to its rendered features, a Gaussian to that most similar to its
    own features in the first of these frames; to none where all are equally likely. In a scene of unknown
    scale, lengths are in per cent of the median depth of the first frame.

    Args:
        result: a scene with a meaning.
        rows: indices of the frames, 0 to T - 1.

    Raises:
        ValueError: the scene has no features with a meaning, or there are no frames.
    """
    if not len(rows):
        raise ValueError("rows: expected at least one frame, found none")
    timeline = result.timeline
    times, frames = timeline.times[list(rows)], timeline.frame_ids[list(rows)].tolist()
    solid = result.scene.gaussians.opacities > _LEAST_OPACITY
    labels = np.asarray(jnp.where(solid, most_likely(result.probabilities(times[0])), -1))
    members = [np.flatnonzero(labels == k) for k in range(len(result.names))]
    points = tuple(some[:: max(1, -(-len(some) // _MOST_POINTS))] for some in members)
    facts = facts_of_views(_views(result, rows, points), result.names, frames, times, metric=timeline.metric)
    return replace(facts, gaussians=np.array([len(some) for some in members]))


def _views(
    result: DeformResult, rows: Sequence[int], points: tuple[Int[np.ndarray, "_"], ...]
) -> Iterator[LabelledView]:
    """The views of the frames, rendered one at a time."""
    assert result.meaning is not None
    codebook, plan = jnp.asarray(result.meaning.codebook, jnp.float32), None
    for row in rows:
        camera, time = result.camera(row), jnp.asarray(result.timeline.times[row], jnp.float32)
        if plan is None:
            plan = plan_render(result.scene.at(time, result.moving), camera, headroom=HEADROOM)
        draw = partial(_drawn, result.scene, result.moving, time, camera, codebook)
        (means, labels, depths), plan = with_room(draw, plan)
        means, viewmat, K = (np.asarray(a) for a in (means, camera.viewmat[0], camera.K[0]))
        yield LabelledView(
            np.asarray(labels), np.asarray(depths), viewmat, K, tuple(means[some] for some in points)
        )


@jax.jit
def _drawn(
    scene: DeformingScene,
    moving: Moving,
    time: Float[Array, ""],
    camera: Camera,
    codebook: Float[Array, "k c"],
    plan: Plan,
) -> tuple[tuple[Float[Array, "n 3"], Int[Array, "h w"], Float[Array, "h w"]], Meta]:
    now = scene.at(time, moving)
    drawn = render(now, camera, plan)
    assert drawn.features is not None
    likely = prompt_probabilities(drawn.features[0], codebook)
    labels = jnp.where(drawn.alphas[0] > _LEAST_ALPHA, most_likely(likely), -1)
    return (now.means, labels, drawn.depths[0]), drawn.meta._replace(features=None)


def facts_of_views(
    views: Iterable[LabelledView],
    names: Sequence[str],
    frames: Sequence[int],
    times: Float[np.ndarray, "T"],
    *,
    metric: bool = True,
) -> SceneFacts:
    """Facts of rendered views; on the host.

    Args:
        views: one for each frame, all with the same number of points of each class.
        names: names of the classes.
        frames: frame numbers in the recording.
        times: their times, 0 to 1.
        metric: whether the unit of depths and points is the metre; lengths are then given in mm, else in per
            cent of the median depth of the first view.
    """
    views = list(views)
    scale = 1e3 if metric else 100 / _median_depth(views[0])
    visible, measured = zip(*(_measured(view, scale) for view in views), strict=True)
    moved, shifts = _motions(views, visible, scale)
    return SceneFacts(
        names=tuple(names),
        frames=tuple(int(frame) for frame in frames),
        times=np.asarray(times, float),
        unit="mm" if metric else "% of the depth",
        gaussians=np.array([len(points) for points in views[0].points]),
        moved=moved,
        shifts=shifts,
        **{name: np.stack([one[name] for one in measured]) for name in measured[0]},
    )


def _measured(
    view: LabelledView, scale: float
) -> tuple[list[Bool[np.ndarray, "_"]], dict[str, Float[np.ndarray, "k *_"] | Int[np.ndarray, "k"]]]:
    """The visible points of each class, and the measurements of one view by their names in `SceneFacts`."""
    height, width = view.labels.shape
    count, smooth = len(view.points), _smooth(view.depths)
    shares, pieces = np.zeros(count), np.zeros(count, int)
    places, depths, centers, extents, gaps = (
        np.full((count, *more), np.nan) for more in ((2,), (), (3,), (3,), (count,))
    )
    visible, surfaces = [], []
    for k, points in enumerate(view.points):
        mask, pieces[k] = _without_specks(view.labels == k)
        visible.append(_visible(points, mask, view))
        surfaces.append(_unprojected(mask & smooth, view))
        if not pieces[k]:
            continue
        rows, columns = np.nonzero(mask)
        shares[k] = mask.mean()
        places[k] = (columns.mean() + 0.5) / width, (rows.mean() + 0.5) / height
        known = view.depths[mask & (view.depths > 0)]
        if len(known):
            depths[k] = scale * np.median(known)
        if visible[k].any():
            local = scale * (points[visible[k]] @ view.viewmat[:3, :3].T + view.viewmat[:3, 3])
            centers[k] = local.mean(axis=0)
            extents[k] = np.ptp(np.quantile(local, (0.05, 0.95), axis=0), axis=0)
    for i, j in combinations(range(count), 2):
        points = [view.points[k][visible[k]] for k in (i, j)]
        gap = np.fmin(_gap(surfaces[i], surfaces[j], 1), _gap(*points, _STRAY))
        gaps[i, j] = gaps[j, i] = scale * gap
    measured = {"shares": shares, "pieces": pieces, "places": places, "depths": depths}
    return visible, measured | {"centers": centers, "extents": extents, "gaps": gaps}


def _motions(
    views: list[LabelledView], visible: Sequence[Sequence[np.ndarray]], scale: float
) -> tuple[Float[np.ndarray, "T T k"], Float[np.ndarray, "T T k 3"]]:
    """`SceneFacts.moved` and `SceneFacts.shifts`."""
    count, classes = len(views), len(views[0].points)
    moved, shifts = np.full((count, count, classes), np.nan), np.full((count, count, classes, 3), np.nan)
    for k in range(classes):
        path = np.stack([view.points[k] for view in views])
        for i, view in enumerate(views):
            if visible[i][k].any():
                shift = scale * (path[:, visible[i][k]] - path[i, visible[i][k]])
                moved[i, :, k] = np.median(np.linalg.norm(shift, axis=-1), axis=1)
                shifts[i, :, k] = shift.mean(axis=1) @ view.viewmat[:3, :3].T
    return moved, shifts


def _median_depth(view: LabelledView) -> float:
    """Median depth of the pixels that have a class; 1 if there are none."""
    drawn = view.depths[(view.labels >= 0) & (view.depths > 0)]
    return float(np.median(drawn)) if len(drawn) else 1.0


def _without_specks(mask: Bool[np.ndarray, "h w"]) -> tuple[Bool[np.ndarray, "h w"], int]:
    """The mask without specks, and the number of its pieces."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    large = 1 + np.flatnonzero(stats[1:, cv2.CC_STAT_AREA] >= LEAST_SHARE * mask.size)
    return np.isin(labels, large), len(large)


def _visible(
    points: Float[np.ndarray, "n 3"], mask: Bool[np.ndarray, "h w"], view: LabelledView
) -> Bool[np.ndarray, "n"]:
    """Which points of a class are visible: on one of its pixels, at about its depth."""
    height, width = mask.shape
    at = pixels_of(points, view.viewmat, view.K, width, height)
    depth = view.depths[at.rows, at.columns]
    return at.inside & mask[at.rows, at.columns] & (np.abs(at.depths - depth) <= _SURFACE * depth)


def _smooth(depths: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels whose neighbours have about the same depth."""
    square = np.ones((3, 3), np.uint8)
    far, near = cv2.dilate(depths, square), cv2.erode(depths, square)
    return (near > 0) & (far - near <= _SMOOTH * depths)


def _unprojected(mask: Bool[np.ndarray, "h w"], view: LabelledView) -> Float[np.ndarray, "n 3"]:
    """The points that the pixels of a mask show, in the camera's axes."""
    rows, columns = np.nonzero(mask)
    rays = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=1) @ np.linalg.inv(view.K).T
    return rays * view.depths[rows, columns, None]


def _gap(one: Float[np.ndarray, "_ 3"], other: Float[np.ndarray, "_ 3"], n: int) -> float:
    """The distance between two sets of points: that of the n-th nearest point of the smaller set; NaN if it
    has fewer than n."""
    few, many = sorted((one, other), key=len)
    if len(few) < n:
        return np.nan
    return float(np.partition(cKDTree(many).query(few)[0], n - 1)[n - 1])
