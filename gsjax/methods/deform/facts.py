"""Measurements of a deforming scene at some frames: where its classes are, how deep, how far from each other,
and how they move. Questions are answered from these alone (`questions`)."""

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
from gsjax.methods.deform.update import DeformingScene, Moving
from gsjax.rasterize.plan import HEADROOM, Plan, with_room
from gsjax.rasterize.rasterization import Meta
from gsjax.scene.render import plan_render, render

LEAST_SHARE = 1e-3
"""Of the picture: pieces of a class that are smaller are taken for specks."""
_DRAWN = 0.5  # alpha below which a pixel shows nothing
_SOLID = 0.3  # opacity below which a Gaussian is no part of a surface
_NEAR = 0.03  # share of the depth by which a Gaussian may lie before or behind what its pixel sees
_EDGE = (
    0.03  # share of the depth by which it may vary between a pixel and its neighbours, to be of one surface
)
_STRAY = 3  # the nearest point that counts for a gap, as one or two may be of another surface
_MOST_POINTS = 4000  # of a class


class Sight(NamedTuple):
    """What one frame shows, and where the points of each class are then.

    Attributes:
        labels: class of each pixel, -1 where there is none.
        depths: metres along the camera's axis, 0 where nothing is drawn.
        viewmat, K: of the camera.
        points: of each class, the same ones in all frames, world.
    """

    labels: Int[np.ndarray, "h w"]
    depths: Float[np.ndarray, "h w"]
    viewmat: Float[np.ndarray, "4 4"]
    K: Float[np.ndarray, "3 3"]
    points: tuple[Float[np.ndarray, "_ 3"], ...]


@dataclass(frozen=True, eq=False)
class SceneFacts:
    """Measurements of k classes in T frames. What a class does not have, where it is not in view, is NaN.

    Attributes:
        names: of classes.
        frames: the recording's own numbers, in order.
        times: of these, 0 to 1 over the recording.
        unit: of lengths: "mm", or "% of the depth" in a scene of no known scale.
        gaussians: number of those that mean the class, in the whole scene.
        shares: of the picture that the class covers; 0 where it is not in view.
        pieces: number of those in the picture, connected by sides or corners.
        places: their centre in the picture, from the left and from the top, 0 to 1.
        depths: median along the camera's axis.
        centers: of its visible points, in axes of the camera: right, down, forward.
        extents: from the 5th to the 95th of a hundred of these points, along the same axes.
        gaps: between what the frame shows of two classes, where that is nearest: their pixels, or their
            points where depth has an edge, for there a mean of what lies before and behind is drawn.
        moved: [i, j]: how far the points that frame i shows are in frame j from where they were, the median.
        shifts: [i, j]: their mean displacement, in axes of the camera of frame i.
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
        """Whether a class is in view in the frame of a row."""
        return bool(self.pieces[row, thing] > 0)

    def of_frame(self, row: int) -> dict[str, Any]:
        """What is known of one frame, by class, ready for JSON."""
        known = {}
        for k, name in enumerate(self.names):
            gaps = {other: _number(self.gaps[row, k, j]) for j, other in enumerate(self.names) if j != k}
            known[name] = {
                "present": self.present(row, k),
                "share_of_picture": _number(self.shares[row, k]),
                "pieces": int(self.pieces[row, k]),
                "place_from_left_top": [_number(x) for x in self.places[row, k]],
                "depth": _number(self.depths[row, k]),
                "center_right_down_forward": [_number(x) for x in self.centers[row, k]],
                "extent": [_number(x) for x in self.extents[row, k]],
                "distance_to": gaps,
            }
        return {"frame": self.frames[row], "classes": known}

    def of_motion(self, row: int, other: int) -> dict[str, Any]:
        """What is known of the way from one frame to another, by class, ready for JSON."""
        known = {
            name: {
                "moved": _number(self.moved[row, other, k]),
                "shift_right_down_forward": [_number(x) for x in self.shifts[row, other, k]],
            }
            for k, name in enumerate(self.names)
        }
        return {"from_frame": self.frames[row], "to_frame": self.frames[other], "classes": known}


def _number(value: Any) -> float | None:
    """Ready for JSON, which has no NaN."""
    return round(float(value), 6) if np.isfinite(value) else None


def scene_facts(
    scene: DeformingScene,
    moving: Moving,
    times: Float[np.ndarray, "T"],
    cameras: Camera,
    codebook: Float[np.ndarray, "k c"],
    names: Sequence[str],
    frames: Sequence[int],
    *,
    metric: bool = True,
) -> SceneFacts:
    """Facts of a deforming scene at some frames.

    A pixel is of the class that its rendered features are most like, a Gaussian of that which its own are in
    the first of the frames, unless two are as likely (`prompt_probabilities`).

    Args:
        scene, moving: as for `DeformingScene.at`.
        times: of the frames, 0 to 1.
        cameras: one a frame, viewmat [T,4,4] and K [T,3,3].
        codebook: the feature of each class, in the scene's channels.
        names: of the classes.
        frames: the recording's own numbers of the frames.
        metric: whether the scene's unit is the metre, and lengths are given in mm; if not, they are given in
            per cent of the median depth of all that the first frame shows.

    Raises:
        ValueError: the scene has no features, or names, codebook, times, cameras and frames do not fit.
    """
    features = scene.gaussians.features
    if features is None or codebook.shape != (len(names), features.shape[1]):
        found = "none" if features is None else f"{features.shape[1]} channels"
        raise ValueError(
            f"features: expected those of {len(names)} classes in {codebook.shape[1]} channels, found {found}"
        )
    if not len(times) == len(frames) == len(cameras.viewmat) or not len(times):
        raise ValueError(
            f"expected a time, a camera and a number for each frame, found {len(times)}, "
            f"{len(cameras.viewmat)} and {len(frames)}"
        )
    features = scene.at(jnp.asarray(times[0], features.dtype), moving).features
    assert features is not None
    likely = np.asarray(prompt_probabilities(features, jnp.asarray(codebook, features.dtype)))
    labels = np.where(np.asarray(scene.gaussians.opacities) > _SOLID, most_likely(likely), -1)
    counts = np.array([(labels == k).sum() for k in range(len(names))])
    rows = tuple(_thinned(np.flatnonzero(labels == k)) for k in range(len(names)))
    sights = _sights(scene, moving, times, cameras, codebook, rows)
    facts = facts_of_sights(sights, names, frames, times, metric=metric)
    return replace(facts, gaussians=counts)


def _thinned(rows: Int[np.ndarray, "n"]) -> Int[np.ndarray, "_"]:
    return rows[:: -(-len(rows) // _MOST_POINTS)] if len(rows) else rows


def _sights(
    scene: DeformingScene,
    moving: Moving,
    times: Float[np.ndarray, "T"],
    cameras: Camera,
    codebook: Float[np.ndarray, "k c"],
    rows: tuple[Int[np.ndarray, "_"], ...],
) -> Iterator[Sight]:
    """What each frame shows, drawn as it is asked for."""
    codes = jnp.asarray(codebook, jnp.float32)
    plan = None
    for i, time in enumerate(times):
        camera = replace(cameras, viewmat=cameras.viewmat[i : i + 1], K=cameras.K[i : i + 1])
        now = jnp.asarray(time, jnp.float32)
        if plan is None:
            plan = plan_render(scene.at(now, moving), camera, headroom=HEADROOM)
        draw = partial(_drawn, scene, moving, now, camera, codes)
        (means, labels, depths), plan = with_room(draw, plan)
        places = np.asarray(means)
        viewmat, K = np.asarray(camera.viewmat[0]), np.asarray(camera.K[0])
        yield Sight(np.asarray(labels), np.asarray(depths), viewmat, K, tuple(places[r] for r in rows))


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
    shown = (drawn.alphas[0] > _DRAWN) & (likely.max(axis=-1) > likely.min(axis=-1))
    labels = jnp.where(shown, likely.argmax(axis=-1), -1)
    return (now.means, labels, drawn.depths[0]), drawn.meta._replace(features=None)


def facts_of_sights(
    sights: Iterable[Sight],
    names: Sequence[str],
    frames: Sequence[int],
    times: Float[np.ndarray, "T"],
    *,
    metric: bool = True,
) -> SceneFacts:
    """Facts of what frames show; on the host.

    Args:
        sights: one a frame, all with the same number of points of each class.
        names, frames, times, metric: as for `scene_facts`.
    """
    seen = list(sights)
    scale = 1e3 if metric else 100 / _median_depth(seen[0])
    shown = [_shown(sight, scale) for sight in seen]
    moved, shifts = _ways(seen, [one.visible for one in shown], scale)
    stacked = {name: np.stack([getattr(one, name) for one in shown]) for name in _Shown._fields[:-1]}
    return SceneFacts(
        names=tuple(names),
        frames=tuple(int(frame) for frame in frames),
        times=np.asarray(times, float),
        unit="mm" if metric else "% of the depth",
        gaussians=np.array([len(points) for points in seen[0].points]),
        moved=moved,
        shifts=shifts,
        **stacked,
    )


class _Shown(NamedTuple):
    """Measurements of one frame, as in `SceneFacts`, and which points of each class are visible in it."""

    shares: Float[np.ndarray, "k"]
    pieces: Int[np.ndarray, "k"]
    places: Float[np.ndarray, "k 2"]
    depths: Float[np.ndarray, "k"]
    centers: Float[np.ndarray, "k 3"]
    extents: Float[np.ndarray, "k 3"]
    gaps: Float[np.ndarray, "k k"]
    visible: tuple[Bool[np.ndarray, "_"], ...]


def _shown(sight: Sight, scale: float) -> _Shown:
    height, width = sight.labels.shape
    classes = len(sight.points)
    found = _Shown(
        np.zeros(classes),
        np.zeros(classes, int),
        *(np.full((classes, *more), np.nan) for more in ((2,), (), (3,), (3,))),
        np.full((classes, classes), np.nan),
        (),
    )
    visible, surfaces, smooth = [], [], _smooth(sight.depths)
    for k, points in enumerate(sight.points):
        mask, found.pieces[k] = _without_specks(sight.labels == k)
        visible.append(_visible(points, mask, sight))
        surfaces.append(_behind(mask & smooth, sight))
        if not found.pieces[k]:
            continue
        rows, columns = np.nonzero(mask)
        found.shares[k] = mask.mean()
        found.places[k] = (columns.mean() + 0.5) / width, (rows.mean() + 0.5) / height
        known = sight.depths[mask & (sight.depths > 0)]
        if len(known):
            found.depths[k] = scale * np.median(known)
        if visible[k].any():
            local = scale * (points[visible[k]] @ sight.viewmat[:3, :3].T + sight.viewmat[:3, 3])
            found.centers[k] = local.mean(axis=0)
            found.extents[k] = np.ptp(np.quantile(local, (0.05, 0.95), axis=0), axis=0)
    for i, j in combinations(range(classes), 2):
        points = [sight.points[k][visible[k]] for k in (i, j)]
        gap = np.fmin(_gap(surfaces[i], surfaces[j], 1), _gap(*points, _STRAY))
        found.gaps[i, j] = found.gaps[j, i] = scale * gap
    return found._replace(visible=tuple(visible))


def _ways(
    seen: list[Sight], visible: list[tuple[np.ndarray, ...]], scale: float
) -> tuple[Float[np.ndarray, "T T k"], Float[np.ndarray, "T T k 3"]]:
    """How points move from each frame to each other one, as in `SceneFacts`."""
    count, classes = len(seen), len(seen[0].points)
    moved, shifts = np.full((count, count, classes), np.nan), np.full((count, count, classes, 3), np.nan)
    for k in range(classes):
        path = np.stack([sight.points[k] for sight in seen])
        for i, sight in enumerate(seen):
            if visible[i][k].any():
                way = scale * (path[:, visible[i][k]] - path[i, visible[i][k]])
                moved[i, :, k] = np.median(np.linalg.norm(way, axis=-1), axis=1)
                shifts[i, :, k] = way.mean(axis=1) @ sight.viewmat[:3, :3].T
    return moved, shifts


def _median_depth(sight: Sight) -> float:
    """Median depth of all that a frame shows; 1 where that is nothing."""
    drawn = sight.depths[(sight.labels >= 0) & (sight.depths > 0)]
    return float(np.median(drawn)) if len(drawn) else 1.0


def _without_specks(mask: Bool[np.ndarray, "h w"]) -> tuple[Bool[np.ndarray, "h w"], int]:
    """Pieces of a mask that are no specks, and their number."""
    _, found, about, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    large = 1 + np.flatnonzero(about[1:, cv2.CC_STAT_AREA] >= LEAST_SHARE * mask.size)
    return np.isin(found, large), len(large)


def _visible(
    points: Float[np.ndarray, "n 3"], mask: Bool[np.ndarray, "h w"], sight: Sight
) -> Bool[np.ndarray, "n"]:
    """Which points of a class a frame shows: they fall on a pixel of it, at about the depth that it has."""
    height, width = mask.shape
    at = pixels_of(points, sight.viewmat, sight.K, width, height)
    depth = sight.depths[at.rows, at.columns]
    return at.inside & mask[at.rows, at.columns] & (np.abs(at.depths - depth) <= _NEAR * depth)


def _smooth(depths: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels whose neighbours are about as deep."""
    square = np.ones((3, 3), np.uint8)
    far, near = cv2.dilate(depths, square), cv2.erode(depths, square)
    return (near > 0) & (far - near <= _EDGE * depths)


def _behind(mask: Bool[np.ndarray, "h w"], sight: Sight) -> Float[np.ndarray, "n 3"]:
    """What pixels show, in axes of the camera."""
    rows, columns = np.nonzero(mask)
    rays = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=1) @ np.linalg.inv(sight.K).T
    return rays * sight.depths[rows, columns, None]


def _gap(one: Float[np.ndarray, "_ 3"], other: Float[np.ndarray, "_ 3"], nearest: int) -> float:
    """The distance of two sets of points: that of the n-th nearest point of the smaller one; NaN of too few.

    Args:
        one, other: the sets.
        nearest: n, 1 or more.
    """
    few, many = sorted((one, other), key=len)
    if len(few) < nearest:
        return np.nan
    return float(np.partition(cKDTree(many).query(few)[0], nearest - 1)[nearest - 1])
