"""The first four stages: each group is followed to where it agrees best with the images."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from gsjax.losses.extra import ExtraLosses
from gsjax.methods.track.config import TrackConfig
from gsjax.methods.track.layers import Shown, are_same, keep_backdrop, reduced, render_labels
from gsjax.methods.track.matching import Template, lift, match_templates
from gsjax.methods.track.motion import Motion, move, select_motion
from gsjax.methods.track.plan import Needed
from gsjax.methods.track.points import faded, join, pixel_counts
from gsjax.methods.track.recover import (
    Relocation,
    SearchContext,
    depths_of_others,
    recover,
    unexplained_pixels,
)
from gsjax.methods.track.reference import points_last_seen
from gsjax.methods.track.refine import RefineBatch, refine
from gsjax.methods.track.region import near_background, near_scene, scatter, shift_background
from gsjax.methods.track.search import disagreements, follow, search
from gsjax.methods.track.stages.context import Alignment, Past, Refined, Starts, UpdateContext
from gsjax.methods.track.stages.shown import show
from gsjax.scene.region import tiles_to_pixels, touched_tiles
from gsjax.scene.render import Rendered

# Fewer pixels than this do not determine a rigid motion, so the group is not moved. For small groups, this
# fraction of the most pixels that they ever had is enough.
_ENOUGH_PIXELS, _MIN_SHARE = 200, 0.2


def last_view(now: UpdateContext, config: TrackConfig) -> Past:
    """First stage: what the last scene shows of each group."""
    scene, state, frame, plan = now.scene, now.state, now.frame, now.plan
    num_objects = scene.num_objects
    backdrop, background, needed = state.backdrop, None, jnp.int32(0)
    if backdrop is not None:
        views = reduced(frame.cameras, config.coarseness)
        backdrop, needed = keep_backdrop(backdrop, scene, views, plan.full)
        background = jnp.where(backdrop.covers, backdrop.depths, 0.0)
    template = rendered = None
    if config.redraw == "moving":
        assert state.shown is not None
        assert state.backdrop is not None
        shown, cameras = state.shown, state.backdrop.cameras
        if state.images is not None:
            template = Template(state.images, shown.depths, jax.nn.one_hot(shown.labels - 1, num_objects))
    else:
        rendered, cameras = render_labels(scene, now.pose, frame, plan.full, one_sided=True), frame.cameras
        assert rendered.features is not None
        mostly = rendered.features.max(-1) > 0.5
        labels = jnp.where(mostly, jnp.argmax(rendered.features, axis=-1), 0).astype(jnp.int32)
        template = Template(rendered.colors, rendered.depths, rendered.features[..., 1:])
        shown = Shown(labels, rendered.depths, mostly)
    enough = _ENOUGH_PIXELS / config.coarseness**2
    counts = pixel_counts(shown.labels, num_objects)
    visible = (counts > jnp.minimum(_MIN_SHARE * state.watch.largest, enough)) & ~state.is_blank
    return Past(shown, cameras, template, rendered, backdrop, background, needed, counts, visible)


def motion_hypotheses(now: UpdateContext, past: Past, config: TrackConfig, reduction: int) -> Starts:
    """Second stage: hypotheses of the motion from the last frame until now: none, the same as before, and
    that of template matching, for which `reduction` is the factor by which images shrink."""
    before, num_objects = now.state.motion, now.scene.num_objects
    still, delta = jnp.zeros_like(before.twists), jnp.zeros_like(before.delta)
    starts = [still]
    found, score = jnp.zeros(num_objects, bool), jnp.zeros((len(now.frame.images), num_objects))
    if config.matching:
        assert past.template is not None
        match = match_templates(past.template, now.frame, config.match, reduction)
        shifts, found = lift(match, now.frame, config.match)
        shifts, score = jnp.where(found[:, None], shifts, 0.0), match.score
        starts += [still.at[:, :3].set(shifts)]
    if config.warm_start:
        starts += [before.twists]
        delta = before.delta
        if config.matching:
            starts += [before.twists.at[:, :3].set(shifts)]
    return Starts(jnp.stack(starts), delta, found, score)


def align_and_search(
    now: UpdateContext,
    past: Past,
    starts: Starts,
    everywhere: Int[Array, ""],
    key: Key[Array, ""],
    config: TrackConfig,
) -> Alignment:
    """Third stage: each group is aligned with the images; if it agrees worse than usual, shifts are tried.
    For those that agree worst after that, rotations are tried or, if they may be lost, other places.

    Args:
        now, past, starts: from the earlier stages.
        everywhere: number of groups for which rotations or other places are tried.
        key: random key of the relocation.
    """
    state, gap = now.state, config.start.depth_gap
    keyframe = faded(state.keyframe, config.align.keyframe_turn)
    reference = points_last_seen(now.reference, past.shown, past.cameras, gap)
    weighted = reference._replace(seen=config.align.center_weight * reference.seen)
    points = join(weighted, state.pixels, keyframe)
    given = (starts.twists, points, now.centers, now.images)
    how = (config.align, state.watch, past.visible, everywhere)
    followed = follow(*given, *how)
    doubtful = state.watch.doubtful
    in_turn = in_search_round(state.count, now.scene.num_objects) | state.watch.glimpsed
    suspects = state.watch.lost | (doubtful & in_turn) | followed.missed
    shown, needed = _show_again(now, past, suspects.any(), config)
    other_depths = depths_of_others(shown, doubtful)
    # Without depth, an occluder cannot be distinguished from anything else that is not the group.
    elsewhere = ()
    if now.images.depths is not None:
        elsewhere = suspects, _relocation(now, past, shown, suspects.any(), other_depths, key, config)
    result = search(followed, *given, *how, *elsewhere)
    return Alignment(result, points, reference, suspects, followed.missed, other_depths, needed)


def _relocation(
    now: UpdateContext,
    past: Past,
    shown: Shown,
    wanted: Bool[Array, ""],
    other_depths: Float[Array, "c h w"],
    key: Key[Array, ""],
    config: TrackConfig,
) -> Callable[[Int[Array, ""]], Relocation]:
    """A function from the index of a group to where it may be instead; the input that groups share is
    prepared only if `wanted`."""
    gap = config.start.depth_gap
    how = (config.grow.min_gap, config.align, config.coarseness)
    found = partial(unexplained_pixels, shown, now.images, *how)
    nothing = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(found))
    unexplained = jax.lax.cond(wanted, found, lambda: nothing)
    context = SearchContext(now.images, past.background, other_depths, unexplained)

    def relocate(group) -> Relocation:
        own = jax.tree.map(lambda a: a[group], (now.reference, now.centers, now.state.relocation_guesses))
        return recover(jax.random.fold_in(key, group), *own, context, config.align, gap)

    return relocate


def in_search_round(count: Int[Array, ""], num_objects: int) -> Bool[Array, "k"]:
    """Groups that are searched for elsewhere in this frame if in doubt: each in two of four frames, because a
    relocation takes two; in the other two, the group is followed. Odd and even groups alternate, so that no
    update searches for all."""
    return (count + 2 * jnp.arange(num_objects)) % 4 < 2


def refine_motion(
    now: UpdateContext,
    past: Past,
    starts: Starts,
    alignment: Alignment,
    config: TrackConfig,
    extra_losses: ExtraLosses,
) -> Refined:
    """Fourth stage, if `config.refine.iterations` is above 0: D_k and delta_i are refined against rendered
    images, and kept for the groups that agree better then. Groups with too few visible pixels stand still.
    Arguments as for `track_step`, and from the earlier stages."""
    estimate, scene = alignment.search.estimate, now.scene
    residuals = estimate.residuals
    kept = start = Motion(estimate.twists, starts.delta)
    needed, info, shifts = Needed(jnp.int32(0), jnp.int32(0), jnp.int32(0)), {}, None
    if config.refine.iterations:
        assert past.rendered is not None
        refined, shifts, needed, info = _refine(now, start, past.rendered, config, extra_losses)
        if shifts is not None:
            shifts = jnp.where(now.state.is_blank, 0.0, shifts)
            scene = shift_background(scene, shifts)
        # Points, unlike rendered images, do not capture outlines, so they veto the refinement only if it
        # clearly went wrong; without depth they are hardly more reliable than it.
        lead = 0.1 if now.frame.depths is None else 0.01
        of_refined = disagreements(refined.twists, alignment.points, now.centers, now.images, config.align)
        better = of_refined - lead <= residuals
        if extra_losses:  # which points do not capture either
            better = jnp.ones_like(better)
        kept = select_motion(better, refined, start, scene.groups)
        residuals = jnp.where(better, of_refined, residuals)
    kept = select_motion(past.visible, kept, jax.tree.map(jnp.zeros_like, start), scene.groups)
    return Refined(kept, residuals, scene, shifts, needed, info)


def _show_again(
    now: UpdateContext, past: Past, wanted: Bool[Array, ""], config: TrackConfig
) -> tuple[Shown, Int[Array, ""]]:
    """What the last scene shows, in the new cameras if that is `wanted`, and the capacity needed."""
    backdrop, before = past.backdrop, (past.shown, jnp.int32(0))
    if backdrop is None or now.frame.depths is None:
        return before
    moved = wanted & ~are_same(past.cameras, backdrop.cameras)
    again = partial(show, now.scene, now.pose, now.frame, backdrop, now.plan, config)
    return jax.lax.cond(moved, again, lambda: before)


def _refine(
    now: UpdateContext, start: Motion, last: Rendered, config: TrackConfig, extra_losses: ExtraLosses
) -> tuple[Motion, Float[Array, "b 3"] | None, Needed, dict[str, Any]]:
    """Refined motion, shifts of the background (None if that is frozen), capacities needed, and info."""
    moved = move(now.pose, start, now.centers, now.scene.groups)
    tiles = touched_tiles([now.pose.means, moved.means], now.frame)
    near = near_background(now.scene, last, tiles)
    around = near_scene(now.scene, near, now.plan.num_near)
    roi = tiles_to_pixels(tiles, now.frame)
    batch = RefineBatch(around, now.frame, now.plan.near, now.pose, now.centers, roi)
    refined, shifts, info = refine(start, batch, config.refine, extra_losses)
    needed = Needed(jnp.int32(0), info.pop("needed"), near.sum())
    info["refine_loss"] = info.pop("loss")
    return refined, None if shifts is None else scatter(near, shifts), needed, info
