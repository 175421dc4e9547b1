"""Detection of the Gaussians that move. A Gaussian moves if the pixels that show it change in most cameras at
once. Pixels also change where another object passes in front, but only in the few cameras on that line of
sight; a surface on which something comes to rest changes in all cameras, but only for a while."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gsjax.geometry.cameras import Camera
from gsjax.methods.parts.lift import pixel_votes, render_features
from gsjax.methods.parts.trajectory import BACKGROUND
from gsjax.rasterize.plan import Plan
from gsjax.scene.frame import one_camera
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import Rendered

_SMOOTH = 8  # neighbouring Gaussians that are judged together
_ONE_FRAME_IN = 8  # a Gaussian that may move changes in at least one of this many frames
_SEEN = 1e-3  # pixels that a Gaussian must cover to provide evidence
_TOUCHING = 16  # neighbours that may touch a Gaussian
_LEAST_WEIGHT = 0.1  # of all parts together, below which the masks do not determine the part
_LEAST_APART, _LEAST_SHARE = 16, 0.05  # Gaussians to split off, at least; relative to the largest
_LEAST_CHANGE = 0.35  # share of change below which a Gaussian hardly changes in any frame


class Changes(NamedTuple):
    """The share of each Gaussian's pixels, over all cameras, that change, 0 to 1.

    Attributes:
        most: the share that is reached in an eighth of the frames, or more.
        usual: the share that is reached in half of the frames, or more.
    """

    most: Float[np.ndarray, "N"]
    usual: Float[np.ndarray, "N"]


def changes_of(
    gaussians: Gaussians, cameras: Camera, plan: Plan, moved: Bool[np.ndarray, "C F H W"]
) -> Changes:
    """How much of each Gaussian's pixels changes, averaged over neighbours.

    Args:
        gaussians: the scene at the anchor frame.
        cameras: C cameras.
        plan: for one camera.
        moved: from `moved_pixels`.
    """
    votes = np.zeros((gaussians.num, moved.shape[1] + 1), np.float32)
    for c, changed in enumerate(moved):
        values = np.concatenate([changed, np.ones_like(changed[:1])]).transpose(1, 2, 0)
        votes += pixel_votes(gaussians, one_camera(cameras, c), plan, values[None].astype(np.float32))
    means = np.asarray(gaussians.means)
    near = cKDTree(means).query(means, k=min(_SMOOTH, len(means)))[1].reshape(len(means), -1)
    votes = votes[near].sum(1)
    seen = votes[:, -1:]
    shares = np.where(seen > _SEEN, votes[:, :-1] / np.maximum(seen, _SEEN), 0.0)
    shares, frames = np.sort(shares, axis=1), moved.shape[1]
    return Changes(shares[:, -max(1, frames // _ONE_FRAME_IN)], shares[:, (frames - 1) // 2])


def changing_views(
    gaussians: Gaussians, cameras: Camera, plan: Plan, changes: Changes, drawn: Sequence[Rendered]
) -> Bool[np.ndarray, "C H W"]:
    """The pixels of the anchor's pictures that show Gaussians that change much in some frames, or that show
    none at all.

    Args:
        gaussians: the scene at the anchor frame.
        cameras: C cameras.
        plan: for one camera.
        changes: from `changes_of`.
        drawn: the scene, as each camera sees it.
    """
    views = []
    for c, view in enumerate(drawn):
        most = render_features(gaussians, one_camera(cameras, c), plan, changes.most[:, None])
        views.append(most[0, ..., 0] >= _LEAST_CHANGE * np.asarray(view.alphas[0]))
    return np.stack(views)


def assign_moving_strays(
    weights: Float[np.ndarray, "N P"], gaussians: Gaussians, moves: Bool[np.ndarray, "N"]
) -> Float[np.ndarray, "N P"]:
    """The weights of parts, after moving Gaussians that no mask shows have joined the nearest part that they
    are connected to. Otherwise they would stay behind as a ghost.

    Args:
        weights: from the lifted masks; rows sum to 1.
        gaussians: the scene at the anchor frame.
        moves: which Gaussians move.
    """
    means, weights = np.asarray(gaussians.means), weights.copy()
    known = weights[:, BACKGROUND] < 1 - _LEAST_WEIGHT
    for group in _connected(gaussians, np.flatnonzero(moves)):
        placed, stray = group[known[group]], group[~known[group]]
        if len(placed):
            weights[stray] = weights[placed[cKDTree(means[placed]).query(means[stray])[1]]]
    belongs = moves & (weights[:, BACKGROUND] < 1 - _LEAST_WEIGHT)
    weights[belongs, BACKGROUND] = 0
    return weights / weights.sum(-1, keepdims=True)


def split_disconnected(weights: Float[np.ndarray, "N P"], gaussians: Gaussians) -> Float[np.ndarray, "N P"]:
    """The weights of parts, after splitting parts that are not connected: each further connected component
    becomes a part of its own, the largest first, while slots are free. Masks that agree between views by
    chance may tie a ball to somebody's head; no rigid motion fits both.

    Args:
        weights: of the parts; rows sum to 1.
        gaussians: the scene at the anchor frame.
    """
    labels, weights = weights.argmax(-1), weights.copy()
    apart: list[Int[np.ndarray, "m"]] = []
    for part in np.setdiff1d(labels, [BACKGROUND]):
        largest, *others = _connected(gaussians, np.flatnonzero(labels == part))
        least = max(_LEAST_APART, _LEAST_SHARE * len(largest))
        apart += [group for group in others if len(group) >= least]
    free = np.setdiff1d(np.arange(weights.shape[1]), [BACKGROUND, *labels])
    for slot, group in zip(free, sorted(apart, key=len, reverse=True), strict=False):
        part = labels[group[0]]
        weights[group, slot] += weights[group, part]
        weights[group, part] = 0
    return weights


def _connected(gaussians: Gaussians, chosen: Int[np.ndarray, "n"]) -> list[Int[np.ndarray, "m"]]:
    """The chosen Gaussians, as groups of those that touch, the largest first. Two touch if they are no
    farther apart than the sum of their largest scales."""
    if not len(chosen):
        return []
    means, sizes = np.asarray(gaussians.means)[chosen], np.asarray(gaussians.scales).max(-1)[chosen]
    apart, near = cKDTree(means).query(means, k=min(_TOUCHING + 1, len(chosen)))
    apart, near = apart.reshape(len(chosen), -1), near.reshape(len(chosen), -1)
    touch = apart <= sizes[:, None] + sizes[near]
    rows = np.repeat(np.arange(len(chosen)), touch.sum(1))
    links = coo_array((np.ones(len(rows), bool), (rows, near[touch])), shape=(len(chosen), len(chosen)))
    count, group_of = connected_components(links, directed=False)
    return sorted((chosen[group_of == i] for i in range(count)), key=len, reverse=True)
