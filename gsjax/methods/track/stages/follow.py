"""The first four stages: each group is followed to where it agrees best with the images."""

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
from gsjax.methods.track.recover import Relocation, SearchContext, depths_of_others, recover
from gsjax.methods.track.reference import as_last_seen
from gsjax.methods.track.refine import RefineBatch, refine
from gsjax.methods.track.region import near_background, near_scene, shift_background, spread
from gsjax.methods.track.search import judge, search
from gsjax.methods.track.stages.moment import Hunt, Moment, Past, Refined, Starts
from gsjax.methods.track.stages.shown import show
from gsjax.scene.region import tiles_to_pixels, touched_tiles
from gsjax.scene.render import Rendered

# Pixels that must show a group for it to be moved: fewer cannot decide six numbers. This many are enough, and
# this share of what there once were, for what is small.
_ENOUGH_PIXELS, _MIN_SHARE = 200, 0.2


def look_back(now: Moment, config: TrackConfig) -> Past:
    """First stage: what the last scene shows of each group."""
    scene, state, frame, plan = now.scene, now.state, now.frame, now.plan
    num_objects = scene.num_objects
    backdrop, background, drawn = state.backdrop, None, jnp.int32(0)
    if backdrop is not None:
        views = reduced(frame.cameras, config.coarseness)
        backdrop, drawn = keep_backdrop(backdrop, scene, views, plan.full)
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
    visible = counts > jnp.minimum(_MIN_SHARE * state.watch.largest, enough)
    return Past(shown, cameras, template, rendered, backdrop, background, drawn, counts, visible)


def starting_points(now: Moment, past: Past, config: TrackConfig, reduction: int) -> Starts:
    """Second stage: standing still, going on as before, and where template matching finds it.

    Args:
        now: see `Moment`.
        past: what the last scene shows.
        config: the tracker's.
        reduction: factor by which images shrink for template matching.
    """
    jump, found, score = _match(past.template, now, config, reduction)
    before = now.state.motion.twists
    still = jnp.zeros_like(before)
    jumped = still.at[:, :3].set(jnp.where(found[:, None], jump, 0.0))
    starts, delta = [still], jnp.zeros_like(now.state.motion.delta)
    if config.matching:
        starts += [jumped]
    if config.warm_start:
        starts += [before]
        delta = now.state.motion.delta
    if config.matching and config.warm_start:
        starts += [before.at[:, :3].set(jumped[:, :3])]
    return Starts(jnp.stack(starts), delta, found, score)


def align_and_search(
    now: Moment,
    past: Past,
    starts: Starts,
    everywhere: Int[Array, ""],
    key: Key[Array, ""],
    config: TrackConfig,
) -> Hunt:
    """Third stage: each group is aligned with the images; those that agree worst are looked for everywhere
    around, and what may be lost is looked for elsewhere.

    Args:
        now: see `Moment`.
        past: what the last scene shows.
        starts: where each group may have gone.
        everywhere: how many groups are looked for everywhere.
        key: of the random places where what may be lost is looked for.
        config: the tracker's.
    """
    state, gap = now.state, config.start.depth_gap
    remembered = faded(state.keyframe, config.align.keyframe_turn)
    named = as_last_seen(now.reference, past.shown, past.cameras, gap)
    weighted = named._replace(seen=config.align.center_weight * named.seen)
    points = join(weighted, state.pixels, remembered)
    doubtful = state.watch.doubtful
    in_turn = in_search_round(state.count, now.scene.num_objects) | state.watch.glimpsed
    astray = state.watch.lost | (doubtful & in_turn)
    before_now, near = _look_again(now, past, astray.any(), config)
    others = depths_of_others(before_now, doubtful)
    around = SearchContext(now.sight, past.background, others, state.unexplained_pixels)

    def recovered(group) -> Relocation:
        own = jax.tree.map(lambda a: a[group], (now.reference, now.centers, state.relocation_guesses))
        return recover(jax.random.fold_in(key, group), *own, around, config.align, gap)

    how = (config.align, state.watch, past.visible, everywhere)
    # Without depth, an occluder cannot be distinguished from anything else that is not the group.
    beyond = () if now.sight.depths is None else (astray, recovered)
    sought = search(starts.twists, points, now.centers, now.sight, *how, *beyond)
    return Hunt(sought, points, named, astray, others, near)


def in_search_round(count: Int[Array, ""], num_objects: int) -> Bool[Array, "k"]:
    """Which groups are looked for elsewhere in this frame, if in doubt: each in two of four, which finding
    takes, and followed in two. Odd and even ones take turns, so that no update looks for all."""
    return (count + 2 * jnp.arange(num_objects)) % 4 < 2


def refine_motion(
    now: Moment, past: Past, starts: Starts, hunt: Hunt, config: TrackConfig, extra_losses: ExtraLosses
) -> Refined:
    """Fourth stage, where `config.refine.iterations` is above 0: D_k and delta_i against rendered images,
    kept for the groups that agree better with it. What too few pixels show stands still.

    Args:
        now: see `Moment`.
        past: what the last scene shows.
        starts: with the displacements that Gaussians go on with.
        hunt: where groups were aligned.
        config: the tracker's.
        extra_losses: custom losses; see `track_step`.
    """
    found, scene, groups = hunt.sought.found, now.scene, now.groups
    residual = found.residuals
    kept = begun = Motion(found.twists, starts.delta)
    needed, info, shifted = Needed(jnp.int32(0), jnp.int32(0), jnp.int32(0)), {}, None
    if config.refine.iterations:
        assert past.rendered is not None
        refined, shifted, needed, info = _refine(now, begun, past.rendered, config, extra_losses)
        if shifted is not None:
            scene = shift_background(scene, shifted)
        # Points know nothing of outlines, which rendered images do, so these are overruled only where
        # they went clearly astray; without depth the points hardly know better at all.
        lead = 0.1 if now.frame.depths is None else 0.01
        of_refined = judge(refined.twists, hunt.points, now.centers, now.sight, config.align)
        better = of_refined - lead <= residual
        if extra_losses:  # of which points know nothing either
            better = jnp.ones_like(better)
        kept = select_motion(better, refined, begun, groups)
        residual = jnp.where(better, of_refined, residual)
    kept = select_motion(past.visible, kept, jax.tree.map(jnp.zeros_like, begun), groups)
    return Refined(kept, residual, scene, shifted, needed, info)


def _look_again(
    now: Moment, past: Past, asked: Bool[Array, ""], config: TrackConfig
) -> tuple[Shown, Int[Array, ""]]:
    """What the last scene shows to the cameras of this frame, if that is asked, and what capacity it took."""
    backdrop, before = past.backdrop, (past.shown, jnp.int32(0))
    if backdrop is None or now.frame.depths is None:
        return before
    moved = asked & ~are_same(past.cameras, backdrop.cameras)
    again = partial(show, now.scene, now.pose, now.frame, backdrop, now.plan, config)
    return jax.lax.cond(moved, again, lambda: before)


def _match(template: Template | None, now: Moment, config: TrackConfig, reduction: int):
    """Each group's shift by template matching, whether it was found, and scores [C, K]."""
    num_objects, num_cameras = now.scene.num_objects, len(now.frame.images)
    if not config.matching:
        nowhere, unfound = jnp.zeros((num_objects, 3)), jnp.zeros(num_objects, bool)
        return nowhere, unfound, jnp.zeros((num_cameras, num_objects))
    assert template is not None
    match = match_templates(template, now.frame, config.match, reduction)
    return *lift(match, now.frame, config.match), match.score


def _refine(
    now: Moment, begun: Motion, last: Rendered, config: TrackConfig, extra_losses: ExtraLosses
) -> tuple[Motion, Float[Array, "b 3"] | None, Needed, dict[str, Any]]:
    """Refined motion, shifts of the background (None if that is frozen), capacities needed, and info."""
    moved = move(now.pose, begun, now.centers, now.groups)
    tiles = touched_tiles([now.pose.means, moved.means], now.frame)
    near = near_background(now.scene, last, tiles)
    around = near_scene(now.scene, near, now.plan.num_near)
    roi = tiles_to_pixels(tiles, now.frame)
    batch = RefineBatch(around, now.frame, now.plan.near, now.pose, now.centers, roi)
    refined, shifts, info = refine(begun, batch, config.refine, extra_losses)
    needed = Needed(jnp.int32(0), info.pop("needed"), near.sum())
    info["refine_loss"] = info.pop("loss")
    return refined, None if shifts is None else spread(near, shifts), needed, info
