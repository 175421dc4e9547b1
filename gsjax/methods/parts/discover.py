"""The start of a discovery: from a canonical scene and synchronised views to candidate parts."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray
from scipy.spatial import cKDTree
from scipy.special import softmax

from gsjax.geometry.cameras import Camera
from gsjax.methods.parts.anchor import Anchor
from gsjax.methods.parts.config import PartsConfig
from gsjax.methods.parts.exposure import AS_GIVEN, exposures_of
from gsjax.methods.parts.lift import label_votes, lift_masks, render_features
from gsjax.methods.parts.masks import propagate_masks, view_order
from gsjax.methods.parts.motion import assign_moving_strays, changes_of, changing_views, split_disconnected
from gsjax.methods.parts.sizes import pixel_width
from gsjax.methods.parts.stream import Canonical
from gsjax.methods.parts.trajectory import BACKGROUND
from gsjax.methods.parts.weights import Field, fit_field_to_weights, new_field
from gsjax.methods.protocols import Segmenter, SequenceLike
from gsjax.rasterize.plan import Plan
from gsjax.scene.frame import Frame, one_camera
from gsjax.scene.gaussians import Gaussians, take
from gsjax.scene.render import Rendered, plan_render, render

_SURELY_FIXED = 0.9  # background weight above which a Gaussian is fixed ...
_NEAR = 3.0  # ... unless a moving one is this near, in typical distances between Gaussians
_NEIGHBORS = 8
_LEAST_SHOWN = 0.3  # share of a pixel that must show a label of earlier views for it to take that label


class Start(NamedTuple):
    """The start of a discovery, before any frame is tracked.

    Attributes:
        anchor: the canonical frame.
        order: rows of the given Gaussians, movable ones first.
        canonical: the scene in that order.
        field: the skinning weights, fitted to the lifted masks.
        exposures: maps of each camera's colours to those of the scene.
        masks: candidate parts in every view of the anchor frame, [C,H,W].
        losses: losses of lifting the masks (`lifting`) and of fitting the field (`warming`).
        motions: motion of each part, in the world, to the other of two states; None if parts are tracked.
    """

    anchor: Anchor
    order: Int[np.ndarray, "N"]
    canonical: Canonical
    field: Field
    exposures: Float[np.ndarray, "C 3 4"]
    masks: Int[np.ndarray, "C H W"]
    losses: dict[str, np.ndarray]
    motions: Float[np.ndarray, "P 4 4"] | None = None


def begin(
    sequence: SequenceLike,
    gaussians: Gaussians,
    anchor: Anchor,
    moved: Bool[np.ndarray, "C F H W"],
    config: PartsConfig,
    segmenter: Segmenter | None,
    key: PRNGKeyArray,
    masks: Int[np.ndarray, "C H W"] | None = None,
) -> Start:
    """Candidate parts: the Gaussians seen in pixels that change in other frames, divided by the segments of
    the anchor's pictures.

    Args:
        sequence: the recording of synchronised cameras.
        gaussians: the scene at the anchor frame, as `gsjax.methods.fit` fits it.
        anchor: from `choose_anchor`.
        moved: from `moved_pixels`.
        config: settings.
        segmenter: finds the segments of a picture; not used if masks are given.
        key: random key for the initial values of the field.
        masks: labels of the candidate parts in every view, if known.

    Raises:
        ValueError: there is only one camera, there are too few Gaussians, neither masks nor a segmenter are
            given, or nothing may move.
    """
    if sequence.num_cameras < 2:
        raise ValueError(
            "cameras: expected at least 2, synchronised, found 1; one view does not show motion in 3D"
        )
    if gaussians.num <= _NEIGHBORS:
        raise ValueError(
            f"gaussians: expected more than {_NEIGHBORS}, found {gaussians.num}; fit the anchor frame first"
        )
    frame = sequence.frame(anchor.frame)
    plan = plan_render(gaussians, frame.cameras, headroom=config.headroom)
    drawn = [render(gaussians, one_camera(frame.cameras, c), plan) for c in range(sequence.num_cameras)]
    moves = None
    if masks is None:
        if segmenter is None:
            raise ValueError("segmenter, masks: expected one of them, found none")
        shown = np.ones((moved.shape[0], *moved.shape[2:]), bool)
        if config.discover.difference:
            changes = changes_of(gaussians, frame.cameras, plan, moved)
            moves = changes.usual >= config.discover.moving
            shown = moved.any(1) & changing_views(gaussians, frame.cameras, plan, changes, drawn)
        masks = _find_masks(sequence, gaussians, frame, drawn, plan, anchor, shown, config, segmenter)
    if not (masks > 0).any():
        raise ValueError(
            "masks: expected a segment with at least 30 % of its pixels changed in other frames, found "
            "none; choose another anchor, lower discover.threshold, or turn discover.difference off"
        )
    slots = config.discover.most_parts + 1
    logits, lifting = lift_masks(
        gaussians, frame.cameras, plan, masks, slots, config.discover.lift_iterations
    )
    weights = softmax(np.asarray(logits), axis=-1)
    if moves is not None:
        weights = assign_moving_strays(weights, gaussians, moves)
    weights = split_disconnected(weights, gaussians)
    exposures = exposures_of(drawn, frame) if config.exposures else np.tile(AS_GIVEN, (len(drawn), 1, 1))
    return start_from(anchor, gaussians, weights, frame.cameras, exposures, masks, config, key, lifting)


def start_from(
    anchor: Anchor,
    gaussians: Gaussians,
    weights: Float[np.ndarray, "N P"],
    cameras: Camera,
    exposures: Float[np.ndarray, "C 3 4"],
    masks: Int[np.ndarray, "C H W"],
    config: PartsConfig,
    key: PRNGKeyArray,
    lifting: Float[np.ndarray, "steps"],
    motions: Float[np.ndarray, "P 4 4"] | None = None,
) -> Start:
    """The start of a discovery, given each Gaussian's weights for the parts.

    Args:
        anchor: the canonical frame.
        gaussians: the scene at the anchor frame.
        weights: each Gaussian's weights for the parts; rows sum to 1.
        cameras: all cameras at the anchor frame.
        exposures: from `exposures_of`.
        masks: candidate parts in every view of the anchor frame.
        config: settings.
        key: random key for the initial values of the field.
        lifting: losses of lifting the masks; empty if they were not lifted.
        motions: motion of each part to the other of two states; None if parts are tracked.

    Raises:
        ValueError: no Gaussian belongs to a part.
    """
    means, slots = np.asarray(gaussians.means), weights.shape[1]
    order, count = _movable_first(means, weights)
    weights = weights[order[:count]]
    labels = weights.argmax(-1)
    if not (labels != BACKGROUND).any():
        raise ValueError(
            f"gaussians: expected some that show the {masks.max()} segments that changed, found none among "
            f"{gaussians.num}; is this the scene at frame {anchor.frame}?"
        )
    movable, fixed = take(gaussians, order[:count]), take(gaussians, order[count:])
    alive = np.isin(np.arange(slots), [BACKGROUND, *np.unique(labels)])
    weights = np.where(alive, weights, 0)
    weights /= weights.sum(-1, keepdims=True)
    field, located = new_field(key, config, movable.means, slots)
    field, warming = fit_field_to_weights(field, located, jnp.asarray(weights), jnp.asarray(alive))
    means = means[order]
    centers = centers_of(means[:count], labels, slots)
    canonical = Canonical(
        movable,
        fixed,
        located,
        jnp.asarray(centers),
        jnp.asarray(radii_of(means[:count], labels, centers)),
        jnp.asarray(pixel_width(means[:count][labels != BACKGROUND], cameras), means.dtype),
        jnp.asarray(alive),
        jnp.asarray(cKDTree(means).query(means[:count], k=_NEIGHBORS + 1)[1][:, 1:], jnp.int32),
    )
    losses = {"lifting": lifting, "warming": warming}
    return Start(anchor, order, canonical, field, exposures, masks, losses, motions)


def _find_masks(
    sequence: SequenceLike,
    gaussians: Gaussians,
    frame: Frame,
    drawn: list[Rendered],
    plan: Plan,
    anchor: Anchor,
    moved: Bool[np.ndarray, "C H W"],
    config: PartsConfig,
    segmenter: Segmenter,
) -> Int[np.ndarray, "C H W"]:
    """Labels of the segments that changed, which agree between views; see `gsjax.methods.parts.masks`."""
    depths = np.stack([np.where(np.asarray(d.alphas[0]) > 0.5, np.asarray(d.depths[0]), 0.0) for d in drawn])
    pictures = [sequence.image(anchor.frame, c) for c in range(sequence.num_cameras)]
    first = int(moved.mean((1, 2)).argmax())
    order = view_order(np.asarray(frame.cameras.viewmat), first, np.median(np.asarray(gaussians.means), 0))
    room = 4 * config.discover.most_parts  # labels before the smallest are dropped
    total = np.zeros((gaussians.num, room), np.float32)

    def known(c: int, last: int, mask: Int[np.ndarray, "H W"]) -> Int[np.ndarray, "H W"]:
        """Labels of view c implied by earlier views, of which `last` is the newest."""
        nonlocal total
        total += label_votes(gaussians, one_camera(frame.cameras, last), plan, mask[None], room)
        sums = total.sum(-1, keepdims=True)
        used = np.union1d([BACKGROUND], np.flatnonzero(total.any(0)))
        shares = np.where(sums > 1e-2, total[:, used] / np.maximum(sums, 1e-6), 0.0)
        shown = render_features(gaussians, one_camera(frame.cameras, c), plan, shares)[0]
        return np.where(shown.max(-1) > _LEAST_SHOWN, used[shown.argmax(-1)], -1)

    return propagate_masks(
        pictures,
        depths,
        np.asarray(frame.cameras.K),
        moved,
        order,
        segmenter,
        known,
        config.discover.most_parts,
        room - 1,
    )


def centers_of(
    means: Float[np.ndarray, "M 3"], labels: Int[np.ndarray, "M"], slots: int
) -> Float[np.ndarray, "P 3"]:
    """The centroid of each part's Gaussians, metres; that of all Gaussians for a part without any.

    Args:
        means: means of the Gaussians, metres.
        labels: the part of each Gaussian.
        slots: number of slots for parts.
    """
    centers = np.tile(means.mean(0), (slots, 1))
    for part in np.unique(labels):
        centers[part] = means[labels == part].mean(0)
    return centers.astype(means.dtype)


def radii_of(
    means: Float[np.ndarray, "M 3"], labels: Int[np.ndarray, "M"], centers: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, "P"]:
    """The radius of each part around its handle, root mean square, metres; 1 for a part without Gaussians.

    Args:
        means: means of the Gaussians, metres.
        labels: the part of each Gaussian.
        centers: centres of all parts, metres.
    """
    squared = np.sum((means - centers[labels]) ** 2, axis=1)
    sums, counts = (np.bincount(labels, w, len(centers)) for w in (squared, np.ones_like(squared)))
    radii = np.sqrt(sums / np.maximum(counts, 1))
    return np.where(radii > 0, radii, 1.0).astype(means.dtype)


def _movable_first(
    means: Float[np.ndarray, "N 3"], weights: Float[np.ndarray, "N P"]
) -> tuple[Int[np.ndarray, "N"], int]:
    """Row indices, movable Gaussians first, and the number of movable ones. A Gaussian is movable unless it
    is surely background, and also if it is so near to a moving one that the part's border may run there."""
    moves = weights[:, BACKGROUND] < 0.5
    tree = cKDTree(means[moves])
    spacing = np.median(tree.query(means[moves], k=2)[0][:, 1]) if moves.sum() > 1 else 0.0
    near = tree.query(means)[0] < _NEAR * spacing if moves.any() else moves
    may = (weights[:, BACKGROUND] < _SURELY_FIXED) | near
    return np.concatenate([np.flatnonzero(may), np.flatnonzero(~may)]), int(may.sum())
