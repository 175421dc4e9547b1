"""Consistency checks of a dataset, for mistakes that no part of it reveals by itself: a depth unit that does
not fit the poses, cameras that look away from each other or share one position, a clock that jumps.

Depth is in the right unit if two views measure a surface at the same place. Depth that is f times too large
fits cameras that are f times as far apart, so the factor is found by scaling the distance between the
cameras. If points come with the poses, depth is compared with them directly. A few views, subsampled, are
enough.
"""

import os
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from itertools import combinations, islice
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gsjax.data.errors import DataWarning
from gsjax.data.photographs import Photographs
from gsjax.data.sequence import Sequence
from gsjax.geometry.sight import pixels_at

_MOST_VIEWS, _MOST_PAIRS = 4, 3
_POINTS = 600  # per view
_FACTORS = np.geomspace(1e-3, 1e3, 271)  # 5 % apart
_AGREES = 0.05  # relative difference of two depths of one surface
_TOLERATED = 1.25  # a smaller factor may be noise, or a calibration that is slightly off
_LEAST_SHARE = 0.2  # of the points must agree with some factor, for a verdict
_LEAST_RATIO = 2.0  # of the points that agree to those that agree without a factor, or as given
_ANGLE = np.deg2rad(40)  # between views that may see the same surface
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # between the axes of OpenCV's and of OpenGL's cameras
_CONVENTIONS = {
    "from the camera to the world": np.linalg.inv,
    "in OpenGL's axes": lambda viewmats: _FLIP @ viewmats,
    "from the camera to the world, in OpenGL's axes": lambda viewmats: _FLIP @ np.linalg.inv(viewmats),
}
"""Conventions that poses may be in instead of world to camera in OpenCV's axes, and how to convert each."""
_JUMP, _FEW = 20.0, 0.1  # in median steps; of all steps
_SAME_PLACE = 1e-6  # of their distance from the origin
_LEAST_LEFT = 0.02  # share that masks must leave of the points in view or, without points, of the pixels


class _View(NamedTuple):
    """Intrinsics, world-to-camera transform, and depth, 0 = invalid."""

    K: Float[np.ndarray, "3 3"]
    viewmat: Float[np.ndarray, "4 4"]
    depth: Float[np.ndarray, "height width"]


def check_recording(sequence: Sequence) -> None:
    """Check a recording for mistakes that no part of it reveals by itself.

    Warns with DataWarning if depth is in another unit than the poses, or fits them only if they are inverted
    or in OpenGL's axes; if cameras look away from each other or share one position; if time jumps; or if a
    picture is listed for several frames.
    """
    name, cameras = sequence.name, sequence.num_cameras
    _check_clock(name, sequence)
    _check_files(name, sequence)
    if cameras > 1:
        _check_positions(name, sequence.viewmats[0], "cameras")
    if sequence.load_depth is None:
        return
    Ks, viewmats, load = sequence.Ks, sequence.viewmats, sequence.load_depth
    pairs = list(
        _separated_pairs(Ks[:, 0], viewmats[:, 0], partial(_at, load))
        if cameras == 1
        else _simultaneous_pairs(Ks[0], viewmats[0], partial(load, 0))
    )
    if cameras == 1 or not _are_misread(name, pairs):
        _warn_of_factor(name, _factor_of_pairs(pairs), "that of other views")


def check_photographs(photographs: Photographs) -> None:
    """Check a set of photographs for mistakes that none of them reveals by itself.

    Warns with DataWarning if depth is in another unit than the poses or the points that come with them; if
    the cameras look away from each other or from the points, or share one position; or if masks hide nearly
    everything.
    """
    name, cloud, load = photographs.name, photographs.cloud, photographs.load_depth
    _check_positions(name, photographs.viewmats, "photographs")
    points = np.zeros((0, 3)) if cloud is None else cloud.points
    if len(points):
        _check_directions(photographs, points)
    if photographs.load_mask is not None:
        _check_masks(photographs, points)
    if load is None or photographs.fisheye is not None:
        return
    Ks, viewmats = photographs.Ks, photographs.viewmats
    depths = ((i, _depth(partial(load, i))) for i in _spread(photographs.num))
    views = [_View(Ks[i], viewmats[i], depth) for i, depth in depths if depth is not None]
    factor, others = _factor_of_points(views, points), "the points that come with the poses"
    if factor is None:
        pairs = _separated_pairs(Ks, viewmats, load)
        factor, others = _factor_of_pairs(list(pairs)), "that of other views"
    _warn_of_factor(name, factor, others)


def _at(load: Callable[[int, int], np.ndarray | None], t: int) -> np.ndarray | None:
    return load(t, 0)


def _spread(count: int, most: int = _MOST_VIEWS) -> list[int]:
    """Indices of at most `most` of `count` views, evenly spaced."""
    return np.unique(np.linspace(0, count - 1, most).astype(int)).tolist()


def _simultaneous_pairs(
    Ks: Float[np.ndarray, "n 3 3"],
    viewmats: Float[np.ndarray, "n 4 4"],
    load: Callable[[int], np.ndarray | None],
) -> Iterator[tuple[_View, _View]]:
    """Pairs of the first cameras that have depth."""
    depths = ((c, _depth(partial(load, c))) for c in range(len(Ks)))
    known = (_View(Ks[c], viewmats[c], depth) for c, depth in depths if depth is not None)
    return combinations(islice(known, _MOST_VIEWS), 2)


def _depth(load: Callable[[], np.ndarray | None]) -> Float[np.ndarray, "height width"] | None:
    """Depth with 0 where it is invalid; None if there is none or it cannot be read, which is reported when it
    is used."""
    try:
        depth = load()
    except (ValueError, OSError):
        return None
    if depth is None or np.ndim(depth) != 2 or not np.any(valid := np.isfinite(depth) & (depth > 0)):
        return None
    return np.where(valid, depth, 0)


def _separated_pairs(
    Ks: Float[np.ndarray, "n 3 3"],
    viewmats: Float[np.ndarray, "n 4 4"],
    load: Callable[[int], np.ndarray | None],
) -> Iterator[tuple[_View, _View]]:
    """Pairs of views that look in similar directions from places that are well apart."""
    centers, axes = np.linalg.inv(viewmats)[:, :3, 3], viewmats[:, 2, :3]
    apart = np.linalg.norm(centers - centers[0], axis=1).max(initial=0)
    if apart <= _SAME_PLACE * max(1.0, float(np.abs(centers).max())):
        return
    for i in _spread(len(centers), _MOST_PAIRS):
        distances = np.linalg.norm(centers - centers[i], axis=1)
        usable = (axes @ axes[i] > np.cos(_ANGLE)) & (distances > 0.02 * apart)
        if not usable.any():
            continue
        j = int(np.argmin(np.where(usable, np.abs(distances - 0.25 * apart), np.inf)))
        depths = [_depth(partial(load, k)) for k in (i, j)]
        if depths[0] is not None and depths[1] is not None:
            yield _View(Ks[i], viewmats[i], depths[0]), _View(Ks[j], viewmats[j], depths[1])


def _factor_of_pairs(pairs: list[tuple[_View, _View]]) -> float | None:
    """The factor by which depth is too large, judged by how many points agree between the views of each pair;
    1 if depth is right, None if the views do not tell."""
    if not pairs:
        return None
    both = [pair for a, b in pairs for pair in ((a, b), (b, a))]
    shares = np.stack([_shares(a, b, _FACTORS) for a, b in both])
    coarse = _FACTORS[shares.mean(0).argmax()]
    fine = coarse * np.linspace(0.94, 1.06, 25)
    best = fine[np.mean([_shares(a, b, fine, 0.3 * _AGREES) for a, b in both], axis=0).argmax()]
    return _verdict(best, shares.mean(0))


def _are_misread(name: str, pairs: list[tuple[_View, _View]]) -> bool:
    """Whether the cameras' depth agrees much better with the poses in another convention; warns if so."""

    def agree(mended: Callable[[np.ndarray], np.ndarray]) -> float:
        views = [[view._replace(viewmat=mended(view.viewmat)) for view in pair] for pair in pairs]
        both = [(a, b) for pair in views for a, b in (pair, pair[::-1])]
        return float(np.mean([_shares(a, b, np.ones(1)) for a, b in both])) if both else 0.0

    as_they_are, shares = agree(np.asarray), {what: agree(mended) for what, mended in _CONVENTIONS.items()}
    what = max(shares, key=lambda what: shares[what])
    if shares[what] < max(_LEAST_SHARE, _LEAST_RATIO * as_they_are):
        return False
    found = f"depth of the cameras agrees in {as_they_are:.0%} of the pixels, and in {shares[what]:.0%}"
    advice = "give poses from the world to the camera, in OpenCV's axes (x right, y down, z forward)"
    warnings.warn(f"{name}: {found} if their poses are {what}; {advice}", DataWarning, stacklevel=3)
    return True


def _verdict(best: float, shares: Float[np.ndarray, "factors"]) -> float | None:
    """The best factor if it explains the data much better than 1 does, else 1; None if none explains them."""
    near_one = shares[(_FACTORS < _TOLERATED) & (_FACTORS > 1 / _TOLERATED)].max()
    if shares.max() < _LEAST_SHARE:
        return None
    return best if shares.max() > _LEAST_RATIO * near_one and max(best, 1 / best) > _TOLERATED else 1.0


def _shares(
    a: _View, b: _View, factors: Float[np.ndarray, "factors"], agrees: float = _AGREES
) -> Float[np.ndarray, "factors"]:
    """For each factor, the share of the points of view `a` that lie where view `b` measures them, assuming
    that depth is too large by that factor."""
    rows, columns = np.nonzero(a.depth)
    some = np.linspace(0, len(rows) - 1, min(len(rows), _POINTS)).astype(int)
    rows, columns = rows[some], columns[some]
    z = a.depth[rows, columns].astype(np.float64)
    rays = np.stack([columns + 0.5, rows + 0.5, np.ones(len(z))]) * z
    turned = b.viewmat @ np.linalg.inv(a.viewmat)
    points = (turned[:3, :3] @ np.linalg.inv(a.K) @ rays).T
    moved = points + factors[:, None, None] * turned[:3, 3]
    height, width = b.depth.shape
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = ((moved @ b.K[i]) / moved[..., 2] for i in (0, 1))
    seen = (moved[..., 2] > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    measured = b.depth[np.where(seen, y, 0).astype(int), np.where(seen, x, 0).astype(int)]
    return (seen & (measured > 0) & (np.abs(moved[..., 2] - measured) < agrees * measured)).mean(-1)


def _factor_of_points(views: list[_View], points: Float[np.ndarray, "m 3"]) -> float | None:
    """The factor by which depth exceeds that of the points that it should show; 1 if depth is right, None if
    it does not show them."""
    some = points[:: max(1, len(points) // (10 * _POINTS))]
    ratios = []
    for view in views:
        local = some @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
        local = local[local[:, 2] > 0]
        x, y = ((local @ view.K[i]) / local[:, 2] for i in (0, 1))
        height, width = view.depth.shape
        seen = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        measured = view.depth[y[seen].astype(int), x[seen].astype(int)]
        ratios.append((measured / local[seen, 2])[measured > 0])
    found = np.concatenate([*ratios, np.zeros(0)])
    if len(found) < 100:
        return None
    shares = (np.abs(np.log(found)[:, None] - np.log(_FACTORS)) < _AGREES).mean(0)
    near = found[np.abs(np.log(found / _FACTORS[shares.argmax()])) < 2 * _AGREES]
    return _verdict(float(np.median(near)), shares)


def _warn_of_factor(name: str, factor: float | None, others: str) -> None:
    if factor is None or factor == 1:
        return
    times, way = (factor, "large") if factor > 1 else (1 / factor, "small")
    message = f"{name}: depth looks {times:.1f} times too {way}: as it is, it does not agree with {others}"
    advice = "set depth_unit_m (--read.depth-unit-m), or correct the unit of the poses"
    warnings.warn(f"{message}; {advice}", DataWarning, stacklevel=4)


def _check_positions(name: str, viewmats: Float[np.ndarray, "n 4 4"], noun: str) -> None:
    """Warns if all views share one position, or all look away from the point that they surround."""
    centers, axes = np.linalg.inv(viewmats)[:, :3, 3], viewmats[:, 2, :3]
    if len(centers) < 2:
        return
    if np.ptp(centers, axis=0).max() <= _SAME_PLACE * max(1.0, float(np.abs(centers).max())):
        what = "depth cannot be told from pictures that are all taken from there"
        message = f"{name}: all {len(centers)} {noun} stand at one place: {what}"
        warnings.warn(f"{message}; give poses with their positions", DataWarning, stacklevel=4)
        return
    # The point nearest to all optical axes: sum of (I - a a^T) (p - c) = 0.
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal = across.sum(0)
    if np.linalg.eigvalsh(normal)[0] < 0.05 * len(axes):  # almost parallel
        return
    middle = np.linalg.solve(normal, np.einsum("nij,nj->i", across, centers))
    ahead = np.einsum("ni,ni->n", middle - centers, axes)
    missed = np.linalg.norm(np.einsum("nij,nj->ni", across, middle - centers), axis=1)
    if (ahead < 0).all() and np.median(missed / -ahead) < 0.5:
        message = f"{name}: all {len(centers)} {noun} look away from each other, from the point between them"
        advice = "if they should look at it, give poses in the axes that the layout expects"
        warnings.warn(f"{message}; {advice}", DataWarning, stacklevel=4)


def _check_directions(photographs: Photographs, points: Float[np.ndarray, "m 3"]) -> None:
    """Warns if most photographs have no point in view."""
    points = points[:: max(1, len(points) // _POINTS)]
    some, blind = _spread(photographs.num, 64), 0
    for i in some:
        blind += not len(_in_view(photographs, i, points))
    if 2 * blind > len(some):
        found = f"{blind} of {len(some)} photographs look away from all points that come with the poses"
        advice = "give points and poses in one frame, and in the axes that the layout expects"
        warnings.warn(f"{photographs.name}: {found}; {advice}", DataWarning, stacklevel=4)


def _in_view(
    photographs: Photographs, i: int, points: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "seen 2"]:
    """Pixel coordinates of the points that are in view of a photograph."""
    local = points @ photographs.viewmats[i, :3, :3].T + photographs.viewmats[i, :3, 3]
    lens = None if photographs.fisheye is None else photographs.fisheye[i]
    pixels, _ = pixels_at(local, photographs.Ks[i], lens)
    return pixels[((pixels >= 0) & (pixels < photographs.sizes[i])).all(1)]


def _check_masks(photographs: Photographs, points: Float[np.ndarray, "m 3"]) -> None:
    """Warns if masks hide nearly all points in view, or nearly all pixels if there are no points."""
    points, left = points[:: max(1, len(points) // (10 * _POINTS))], []
    for i in _spread(photographs.num):
        try:
            mask = photographs.mask(i)
        except (ValueError, OSError):  # reported when it is used
            return
        if mask is None:
            mask = np.ones(photographs.sizes[i][::-1], bool)
        if not len(points):
            left.append(mask.ravel())
            continue
        pixels = _in_view(photographs, i, points).astype(int)
        left.append(mask[pixels[:, 1], pixels[:, 0]])
    counted = np.concatenate(left)
    if len(counted) and (share := counted.mean()) < _LEAST_LEFT:
        what = "points in view" if len(points) else "pixels"
        message = f"{photographs.name}: masks hide {1 - share:.1%} of the {what}; what is black is left out"
        warnings.warn(f"{message}: are they inverted, or meant so?", DataWarning, stacklevel=4)


def _check_clock(name: str, sequence: Sequence) -> None:
    """Warns if a few time steps are many times longer than the others."""
    steps = np.diff(sequence.times)
    if (steps > 0).sum() < 3:
        return
    usual = float(np.median(steps[steps > 0]))
    jumps = np.flatnonzero(steps > _JUMP * usual)
    if 0 < len(jumps) <= max(1, _FEW * len(steps)):
        t = int(jumps[np.argmax(steps[jumps])])
        where = f"between frames {sequence.frame_ids[t]} and {sequence.frame_ids[t + 1]}"
        message = f"{name}: time jumps by {steps[t]:.4g} s {where}, where {usual:.4g} s is usual"
        advice = "give frames without the gap (--frames), or correct the times"
        warnings.warn(f"{message}; {advice}", DataWarning, stacklevel=4)


def _check_files(name: str, sequence: Sequence) -> None:
    """Warns if one file is the picture of several frames of a camera."""
    if sequence.locate is None:
        return
    for c in range(sequence.num_cameras):
        files = Counter(sequence.where("image", t, c) for t in range(sequence.num_frames))
        twice = [file for file, count in files.items() if count > 1 and os.path.isfile(file)]
        if twice:
            message = f"{name}: {len(twice)} pictures are listed for several frames, such as {twice[0]}"
            warnings.warn(f"{message}; give each frame its own", DataWarning, stacklevel=4)
            return
