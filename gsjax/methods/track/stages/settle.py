"""The last two stages: lost groups are detected and relocated, and the next frame's input is stored."""

from functools import partial

import jax
import jax.numpy as jnp

from gsjax.methods.track.config import TrackConfig
from gsjax.methods.track.layers import Shown
from gsjax.methods.track.lost import PROBATION, SURELY_FOUND, Confidence, group_confidence, is_found
from gsjax.methods.track.motion import Motion, Pose, move, select_motion
from gsjax.methods.track.plan import Needed
from gsjax.methods.track.points import carry, carry_keyframe, pixels_of_groups, renewed, select_groups
from gsjax.methods.track.recover import evidence, relative_twists
from gsjax.methods.track.reference import all_points_facing, radii
from gsjax.methods.track.stages.context import Alignment, Past, Refined, Settled, UpdateContext
from gsjax.methods.track.stages.shown import show, stored_view
from gsjax.methods.track.state import TrackState
from gsjax.methods.track.watch import first_watch

# A group is moved elsewhere only if the evidence for the other place is stronger by the first of these
# factors or, if the group was just found, by the second.
_BETTER, _STILL_BETTER = 1.3, 1.1


def detect_lost(
    now: UpdateContext, past: Past, alignment: Alignment, refined: Refined, config: TrackConfig
) -> Settled:
    """Fifth stage: whether each group is where it is believed to be, and whether it moves to where it was
    found instead. Arguments `now`, `past` and others from the earlier stages."""
    state, gap, kept = now.state, config.start.depth_gap, refined.motion
    lost, showed, background = state.watch.lost, state.watch.showed, past.background
    if background is not None:  # all that is seen at first counts, even in the surface of the background
        background = jnp.where(state.is_blank, 0.0, background)
    tried, relocation = alignment.search.relocation_tried, alignment.search.relocation
    carried = jax.vmap(carry)(alignment.reference, kept.twists, now.centers)
    confidence = group_confidence(carried, now.images, gap, background)

    def by_all_facing() -> Confidence:
        """Confidence from all points that face the cameras: a lost group is not where it was last seen, and
        at first nothing has been seen yet."""
        points = all_points_facing(now.reference, kept.twists, now.centers, now.images)
        return group_confidence(points, now.images, gap, background, alignment.other_depths)

    of_facing = jax.lax.cond(alignment.suspects.any() | state.is_blank, by_all_facing, lambda: confidence)
    confidence = jax.tree.map(partial(select_groups, lost | state.is_blank), of_facing, confidence)
    on_probation, astray = state.watch.probation > 0, lost | alignment.missed
    factor = jnp.where(on_probation, _STILL_BETTER, _BETTER)
    better = evidence(relocation.confidence) > factor * evidence(of_facing)
    found = is_found(relocation.confidence, showed)
    twice = found & is_found(relocation.guess_confidence, showed)
    surely = found & (relocation.confidence.agreement > SURELY_FOUND)
    # A group that is not lost is seen where it is, so a guess that only rotates it is no other place; but one
    # that was just found may have the wrong orientation.
    away = jnp.linalg.norm(relocation.twists[:, :3], axis=-1) > radii(now.reference, now.centers)
    elsewhere = tried & better & (astray | away | on_probation)
    # Among many guesses one may agree by chance, but not twice.
    relocated = elsewhere & jnp.where(astray, twice | surely, twice & (surely | on_probation))
    guesses = select_groups(tried, relocation.twists, state.relocation_guesses)
    there = Motion(relocation.twists, jnp.zeros_like(kept.delta))
    kept = select_motion(relocated, there, kept, now.scene.groups)
    confidence = jax.tree.map(partial(select_groups, relocated), relocation.confidence, confidence)
    return Settled(kept, confidence, elsewhere, relocated, guesses)


def store_state(
    now: UpdateContext,
    past: Past,
    alignment: Alignment,
    refined: Refined,
    settled: Settled,
    config: TrackConfig,
) -> tuple[Pose, TrackState, Shown, Needed]:
    """Sixth stage: draw what the scene shows now, from which the next frame continues. Arguments `now`,
    `past` and others from the earlier stages.

    Returns:
        The new pose and state, what they show, and the capacities that the whole update needed.
    """
    state, motion, groups, relocated = now.state, settled.motion, now.scene.groups, settled.relocated
    pose = move(now.pose, motion, now.centers, groups)
    shown, shown_needed = show(refined.scene, pose, now.frame, past.backdrop, now.plan, config)
    needed = refined.needed
    if past.rendered is not None:
        needed = needed._replace(full=jnp.maximum(past.rendered.meta.needed.max(), shown_needed))
    else:
        near = jnp.maximum(alignment.needed, shown_needed)
        needed = needed._replace(full=past.needed, near=jnp.maximum(needed.near, near))
    how = (now.scene.num_objects, config.align, config.coarseness)
    pixels = pixels_of_groups(now.images, shown.labels, shown.depths, *how)
    keyframe = carry_keyframe(state.keyframe, motion.twists, now.centers)
    keyframe = renewed(keyframe, pixels, config.align.keyframe_turn, relocated | state.is_blank)
    watch = state.watch.after(
        refined.residuals,
        alignment.search,
        past.counts,
        settled.confidence,
        settled.elsewhere,
        relocated,
        searches=0 if now.images.depths is None else PROBATION,
    )
    at_first = first_watch(settled.confidence.coverage)
    watch = jax.tree.map(partial(jnp.where, state.is_blank), at_first, watch)
    still = jnp.zeros_like(motion.twists)
    guesses = select_groups(
        watch.doubtful & ~relocated, relative_twists(settled.guesses, motion.twists), still
    )
    # A relocation does not give a velocity, unless the group was in its place one frame ago.
    no_velocity = relocated & ~alignment.missed
    velocity = select_motion(no_velocity, jax.tree.map(jnp.zeros_like, motion), motion, groups)
    memory = stored_view(shown, past.backdrop, now.frame, config)
    new = TrackState(velocity, pixels, keyframe, guesses, watch, state.count + 1, *memory)
    return pose, new, shown, needed
