"""The tracker's step: from S_{t-1} and the new images to S_t (sections II-B and II-C of the paper)."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.cameras import Camera
from gsjax.losses.extra import ExtraLosses, named_losses
from gsjax.methods.track.config import TrackConfig
from gsjax.methods.track.layers import (
    Backdrop,
    Shown,
    are_same,
    draw_backdrop,
    keep_backdrop,
    reduced,
    render_labels,
    show_moving,
    shown_by,
)
from gsjax.methods.track.lost import Confidence, confidence, is_found
from gsjax.methods.track.matching import Template, lift, match_templates
from gsjax.methods.track.motion import Motion, Pose, group_means, move
from gsjax.methods.track.plan import Needed, TrackPlan
from gsjax.methods.track.points import (
    Keyframe,
    Points,
    Sight,
    carry,
    carry_keyframe,
    faded,
    first_keyframe,
    join,
    of_groups,
    pixel_counts,
    pixels_of_groups,
    renewed,
    sight_of,
)
from gsjax.methods.track.recover import (
    Relocation,
    SearchContext,
    depths_of_others,
    evidence,
    recover,
    since,
    with_unexplained,
)
from gsjax.methods.track.reference import all_facing, as_last_seen, radii, reference_points
from gsjax.methods.track.refine import RefineBatch, refine
from gsjax.methods.track.region import near_background, near_scene, shift_background, spread
from gsjax.methods.track.scene import TrackedScene
from gsjax.methods.track.search import Watch, first_watch, judge, search
from gsjax.optim.step import Step, all_finite, keep_if
from gsjax.scene.frame import Frame
from gsjax.scene.region import tiles_to_pixels, touched_tiles
from gsjax.scene.render import Rendered

# Pixels that must show a group for it to be moved: fewer cannot decide six numbers. So many are enough, and
# this share of what there once were, for what is small.
_ENOUGH_PIXELS, _MIN_SHARE = 200, 0.2
_BETTER = 1.3  # factor in evidence by which a group has to be seen better elsewhere to be moved there


class TrackState(NamedTuple):
    """What the tracker carries from frame to frame."""

    motion: Motion  # of the last frame: where delta starts, and the constant-velocity hypothesis
    pixels: Points  # what showed each group in the last frame
    keyframe: Keyframe  # and in an earlier one
    unexplained_pixels: Points  # pixels of the last frame that no group explains
    relocation_guesses: Float[
        Array, "k 6"
    ]  # where what may be elsewhere is then, from where it is believed to be
    watch: Watch
    count: Int[Array, ""]  # frames so far
    shown: Shown | None  # of the last frame, and what it was drawn over; where only what moves is redrawn
    backdrop: Backdrop | None
    images: Float[Array, "c height width 3"] | None  # of the last frame, where templates are taken from them


class TrackBatch(NamedTuple):
    """What a step is given."""

    scene: TrackedScene
    frame: Frame
    plan: TrackPlan
    everywhere: Int[Array, ""] | None = None  # groups to look for everywhere; None: as the config says


class _Last(NamedTuple):
    """The last scene, before it has moved."""

    shown: Shown
    cameras: Camera  # it is shown to
    template: Template | None
    rendered: Rendered | None  # where the whole scene was drawn


def track_step(
    config: TrackConfig,
    num_objects: int,
    first: TrackBatch,
    reduction: int = 1,
    extra_losses: ExtraLosses = (),
) -> Step:
    """The step of the object-aware tracker.

    params: the `Pose` of the moving Gaussians. state: `TrackState`. batch: `TrackBatch`.

    A frame goes through: see what the last scene shows of each object; from standing still and going on as
    before, align each object with the images and take what agrees best; look everywhere for those that agree
    worst, and for what is lost; draw what the scene shows now; and tell what is lost. What no camera sees
    stays where it is.

    With `config.redraw` "moving", what is drawn are the moving Gaussians. With `config.matching`, each
    object's template is matched first, in every camera, and lifted to one more start. With
    `config.refine.iterations`, D_k and delta_i are refined photometrically, and kept where that is better.

    Args:
        config: see `TrackConfig`.
        num_objects: groups that can move, K.
        first: the frame that the first pose shows, with the scene, for `init`.
        reduction: factor by which images shrink for template matching (objects larger than the template).
        extra_losses: of one's own (`gsjax.losses.extra`), beside that of the refinement. Their scene is a
            `TrackedScene`: what moves and the background near it, with labels. What they lead to is kept, for
            they know what pixels do not, and `info["extra"]` has their values.

    Raises:
        ValueError: there are extra losses, and no refinement to add them to.
    """
    if named_losses(extra_losses) and not config.refine.iterations:
        raise ValueError(
            "extra_losses: expected none where config.refine.iterations is 0, for they are added to the "
            f"refinement's; found {len(extra_losses)}: take PRESETS['paper'], or set redraw to all and "
            "refine.iterations above 0"
        )
    keep = config.redraw == "moving"

    def init(params: Pose) -> TrackState:
        nowhere = Motion(jnp.zeros((num_objects, 6), params.means.dtype), jnp.zeros_like(params.means))
        scene, frame, plan, _ = first
        views = reduced(frame.cameras, config.coarseness)
        backdrop = draw_backdrop(scene, views, plan.full)[0] if keep else None
        shown, _ = show(scene, params, frame, backdrop, plan)
        sight = sight_of(frame, config.align.shading)
        pixels, unexplained_pixels = look_at(shown, sight)
        reference = reference_points(scene, params, config.align)
        centers = group_means(params.means, scene.labels[: scene.num_moving], num_objects)
        showed = confidence(
            all_facing(reference, nowhere.twists, centers, sight), sight, config.start.depth_gap
        ).shows
        return TrackState(
            nowhere,
            pixels,
            first_keyframe(pixels),
            unexplained_pixels,
            nowhere.twists,
            first_watch(showed),
            jnp.int32(0),
            *memory(shown, backdrop, frame),
        )

    def look_at(shown: Shown, sight: Sight) -> tuple[Points, Points]:
        """Pixels that show each group, and those that none explains."""
        gaps = (config.grow.min_gap, config.align.max_thickness)
        labelled = with_unexplained(shown, sight, num_objects, *gaps, config.coarseness)
        how = (num_objects + 1, config.align, config.coarseness)
        pixels = pixels_of_groups(sight, labelled.labels, labelled.depths, *how)
        return jax.tree.map(lambda a: a[:-1], pixels), jax.tree.map(lambda a: a[-1], pixels)

    def memory(shown: Shown, backdrop: Backdrop | None, frame: Frame):
        """What the next frame looks back on where the last scene is not drawn again."""
        return (shown, backdrop, frame.images if config.matching else None) if keep else (None,) * 3

    def show(scene: TrackedScene, pose: Pose, frame: Frame, backdrop: Backdrop | None, plan: TrackPlan):
        """What the scene shows, and what capacities that took (`near`, `full`)."""
        if backdrop is None:
            rendered = render_labels(scene, pose, frame, plan.full)
            return shown_by(rendered), rendered.meta.needed.max()
        return show_moving(scene, pose, backdrop, plan.near, config.coarseness)

    def look_again(params: Pose, last: _Last, backdrop: Backdrop | None, batch: TrackBatch, asked):
        """What the last scene shows to the cameras of now, if that is asked, and what capacity that took."""
        scene, frame, plan, _ = batch
        before = last.shown, jnp.int32(0)
        if backdrop is None or frame.depths is None:
            return before
        moved = asked & ~are_same(last.cameras, backdrop.cameras)
        return jax.lax.cond(moved, lambda: show(scene, params, frame, backdrop, plan), lambda: before)

    def look_back(params: Pose, state: TrackState, batch: TrackBatch) -> _Last:
        """What the last scene shows."""
        scene, frame, plan, _ = batch
        if keep:
            assert state.shown is not None
            assert state.backdrop is not None
            shown, cameras, template = state.shown, state.backdrop.cameras, None
            if state.images is not None:
                template = Template(state.images, shown.depths, jax.nn.one_hot(shown.labels - 1, num_objects))
            return _Last(shown, cameras, template, None)
        last = render_labels(scene, params, frame, plan.full, one_sided=True)
        assert last.features is not None
        mostly = last.features.max(-1) > 0.5
        labels = jnp.where(mostly, jnp.argmax(last.features, axis=-1), 0).astype(jnp.int32)
        template = Template(last.colors, last.depths, last.features[..., 1:])
        return _Last(Shown(labels, last.depths, mostly), frame.cameras, template, last)

    def update(params: Pose, state: TrackState, batch: TrackBatch, *, step: Any, key: Any):
        scene, frame, plan, everywhere = batch
        groups = scene.labels[: scene.num_moving]
        centers = group_means(params.means, groups, num_objects)
        sight = sight_of(frame, config.align.shading)

        backdrop, background, drawn = state.backdrop, None, jnp.int32(0)
        if backdrop is not None:
            views = reduced(frame.cameras, config.coarseness)
            backdrop, drawn = keep_backdrop(backdrop, scene, views, plan.full)
            background = jnp.where(backdrop.covers, backdrop.depths, 0.0)
        last = look_back(params, state, batch)
        enough = _ENOUGH_PIXELS / config.coarseness**2
        counts = pixel_counts(last.shown.labels, num_objects)
        visible = counts > jnp.minimum(_MIN_SHARE * state.watch.largest, enough)
        jump, found, score = _match(last.template, frame, num_objects, config, reduction)

        remembered = faded(state.keyframe, config.align.keyframe_turn)
        reference, gap = reference_points(scene, params, config.align), config.start.depth_gap
        named = as_last_seen(reference, last.shown, last.cameras, gap)
        weighted = named._replace(seen=config.align.center_weight * named.seen)
        points = join(weighted, state.pixels, remembered)
        doubtful = state.watch.doubtful
        in_turn = in_search_round(state.count, num_objects) | state.watch.glimpsed
        astray = state.watch.lost | (doubtful & in_turn)
        before_now, near_needed = look_again(params, last, backdrop, batch, astray.any())
        others = depths_of_others(before_now, doubtful)
        around = SearchContext(sight, background, others, state.unexplained_pixels)

        def recovered(group) -> Relocation:
            key = jax.random.fold_in(jax.random.fold_in(jax.random.key(0), state.count), group)
            own = jax.tree.map(lambda a: a[group], (reference, centers, state.relocation_guesses))
            return recover(key, *own, around, config.align, gap)

        def where_it_is() -> Confidence:
            """By all that faces the cameras: what is lost is not where it was seen last."""
            points = all_facing(reference, kept.twists, centers, sight)
            return confidence(points, sight, gap, background, others)

        still = jnp.zeros_like(state.motion.twists)
        jumped = still.at[:, :3].set(jnp.where(found[:, None], jump, 0.0))
        before = state.motion.twists
        starts, delta = [still], jnp.zeros_like(state.motion.delta)
        if config.matching:
            starts += [jumped]
        if config.warm_start:
            starts += [before]
            delta = state.motion.delta
        if config.matching and config.warm_start:
            starts += [before.at[:, :3].set(jumped[:, :3])]
        if everywhere is None:
            everywhere = jnp.int32(
                num_objects if config.align.everywhere is None else config.align.everywhere
            )
        how = (config.align, state.watch, visible, everywhere)
        # Without depth, what hides a group cannot be told from what is not it.
        beyond = () if sight.depths is None else (astray, recovered)
        sought = search(jnp.stack(starts), points, centers, sight, *how, *beyond)
        residual = sought.found.residuals
        kept = begun = Motion(sought.found.twists, delta)
        needed, info, shifted = Needed(jnp.int32(0), jnp.int32(0), jnp.int32(0)), {}, None
        if config.refine.iterations:
            assert last.rendered is not None
            refined, shifted, needed, info = _refine(
                begun, params, centers, last.rendered, batch, config, extra_losses
            )
            if shifted is not None:
                scene = shift_background(scene, shifted)
            # Points know nothing of outlines, which rendered images do, so these are overruled only where
            # they went clearly astray; without depth the points hardly know better at all.
            lead = 0.1 if frame.depths is None else 0.01
            of_refined = judge(refined.twists, points, centers, sight, config.align)
            better = of_refined - lead <= residual
            if extra_losses:  # of which points know nothing either
                better = jnp.ones_like(better)
            kept = _select(better, refined, begun, groups)
            residual = jnp.where(better, of_refined, residual)
        kept = _select(visible, kept, jax.tree.map(jnp.zeros_like, begun), groups)
        again, carried = sought.again, jax.vmap(carry)(named, kept.twists, centers)
        sure = confidence(carried, sight, gap, background)
        faced = jax.lax.cond(astray.any(), where_it_is, lambda: sure)
        sure = jax.tree.map(partial(of_groups, state.watch.lost), faced, sure)
        better = evidence(again.sure) > _BETTER * evidence(faced)
        twice = is_found(again.sure, state.watch.showed) & is_found(again.before, state.watch.showed)
        # What is not lost is seen where it is. Turned otherwise there, it is in no other place.
        away = jnp.linalg.norm(again.twists[:, :3], axis=-1) > radii(reference, centers)
        elsewhere = sought.recovered & better & (state.watch.lost | away)
        retaken = elsewhere & twice
        relocation_guesses = of_groups(sought.recovered, again.twists, state.relocation_guesses)
        kept = _select(retaken, Motion(again.twists, jnp.zeros_like(delta)), kept, groups)
        sure = jax.tree.map(partial(of_groups, retaken), again.sure, sure)

        pose = move(params, kept, centers, groups)
        shown, shown_needed = show(scene, pose, frame, backdrop, plan)
        if last.rendered is not None:
            drawn = jnp.maximum(last.rendered.meta.needed.max(), shown_needed)
            needed = needed._replace(full=drawn)
        else:
            near_needed = jnp.maximum(near_needed, shown_needed)
            needed = needed._replace(full=drawn, near=jnp.maximum(needed.near, near_needed))
        overflow = needed.exceeds(plan)
        sound = all_finite((pose, shifted)) & ~overflow
        pixels, unexplained_pixels = look_at(shown, sight)
        keyframe = carry_keyframe(state.keyframe, kept.twists, centers)
        keyframe = renewed(keyframe, pixels, config.align.keyframe_turn, retaken)
        told = memory(shown, backdrop, frame)
        watch = state.watch.after(residual, sought, counts, sure, elsewhere, retaken)
        relocation_guesses = of_groups(
            watch.doubtful & ~retaken, since(relocation_guesses, kept.twists), still
        )
        going = _select(retaken, jax.tree.map(jnp.zeros_like, kept), kept, groups)  # a find is no velocity
        new_state = TrackState(
            going, pixels, keyframe, unexplained_pixels, relocation_guesses, watch, state.count + 1, *told
        )
        pose, new_state = keep_if(sound, (pose, new_state), (params, state))
        kept, watch = keep_if(sound, kept, jax.tree.map(jnp.zeros_like, kept)), new_state.watch
        info |= {
            "overflow": overflow,
            "needed": needed,
            "skipped": ~sound,
            "score": score,
            "found": found,
            "visible": visible,
            "residual": residual,
            "agrees": watch.agrees,
            "lost": watch.lost,
            "turn_known": watch.turn_known,
            "looked_for": sought.looked_for,
            "motion": kept,
            "centers": centers + kept.twists[:, :3],
            "shown": shown,
            "background": shifted,
        }
        return pose, new_state, info

    return Step(init, update)


def in_search_round(count: Int[Array, ""], num_objects: int) -> Bool[Array, "k"]:
    """Which groups are looked for elsewhere in this frame, if in doubt: each in two of four, which finding
    takes, and followed in two. Odd and even ones take turns, so that no update looks for all."""
    return (count + 2 * jnp.arange(num_objects)) % 4 < 2


def _match(template: Template | None, frame: Frame, num_objects: int, config: TrackConfig, reduction: int):
    """Where template matching says that each group has gone, whether it found it, and its scores [C, K]."""
    if not config.matching:
        num_cameras = len(frame.images)
        return (
            jnp.zeros((num_objects, 3)),
            jnp.zeros(num_objects, bool),
            jnp.zeros((num_cameras, num_objects)),
        )
    assert template is not None
    match = match_templates(template, frame, config.match, reduction)
    return *lift(match, frame, config.match), match.score


def _refine(
    begun: Motion,
    params: Pose,
    centers,
    last: Rendered,
    batch: TrackBatch,
    config: TrackConfig,
    extra_losses: ExtraLosses,
):
    """Refined motion, shifts of the background (None if that is frozen), capacities needed, and info."""
    scene, frame, plan, _ = batch
    groups = scene.labels[: scene.num_moving]
    tiles = touched_tiles([params.means, move(params, begun, centers, groups).means], frame)
    near = near_background(scene, last, tiles)
    around = near_scene(scene, near, plan.num_near)
    roi = tiles_to_pixels(tiles, frame)
    refine_batch = RefineBatch(around, frame, plan.near, params, centers, roi)
    refined, shifts, info = refine(begun, refine_batch, config.refine, extra_losses)
    needed = Needed(jnp.int32(0), info.pop("needed"), near.sum())
    return refined, None if shifts is None else spread(near, shifts), needed, info


def _select(chosen: Bool[Array, "k"], a: Motion, b: Motion, groups: Int[Array, "m"]) -> Motion:
    """The motion `a` of the chosen groups, and `b` of the others."""
    return Motion(
        jnp.where(chosen[:, None], a.twists, b.twists),
        jnp.where(chosen[groups - 1][:, None], a.delta, b.delta),
    )
