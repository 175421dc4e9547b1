"""The last two stages: what is lost is detected and found again, and what the next frame needs is kept."""

from functools import partial

import jax
import jax.numpy as jnp

from gsjax.methods.track.config import TrackConfig
from gsjax.methods.track.layers import Shown
from gsjax.methods.track.lost import Confidence, confidence, is_found
from gsjax.methods.track.motion import Motion, Pose, move, select_motion
from gsjax.methods.track.plan import Needed
from gsjax.methods.track.points import carry, carry_keyframe, of_groups, renewed
from gsjax.methods.track.recover import evidence, relative_twists
from gsjax.methods.track.reference import all_facing, radii
from gsjax.methods.track.stages.moment import Hunt, Moment, Past, Refined, Settled
from gsjax.methods.track.stages.shown import memory_of, pixels_shown, show
from gsjax.methods.track.state import TrackState

_BETTER = 1.3  # factor in evidence by which a group has to be seen better elsewhere to be moved there


def detect_lost(now: Moment, past: Past, hunt: Hunt, refined: Refined, config: TrackConfig) -> Settled:
    """Fifth stage: whether each group is where it is believed to be, and whether it moves to where it was
    found instead.

    Args:
        now: see `Moment`.
        past: what the last scene shows.
        hunt: where groups may be instead.
        refined: where they were followed to.
        config: the tracker's.
    """
    state, gap, kept, again = now.state, config.start.depth_gap, refined.motion, hunt.sought.again
    lost, showed = state.watch.lost, state.watch.showed
    carried = jax.vmap(carry)(hunt.named, kept.twists, now.centers)
    sure = confidence(carried, now.sight, gap, past.background)

    def where_it_is() -> Confidence:
        """By all that faces the cameras: what is lost is not where it was seen last."""
        points = all_facing(now.reference, kept.twists, now.centers, now.sight)
        return confidence(points, now.sight, gap, past.background, hunt.others)

    faced = jax.lax.cond(hunt.astray.any(), where_it_is, lambda: sure)
    sure = jax.tree.map(partial(of_groups, lost), faced, sure)
    better = evidence(again.sure) > _BETTER * evidence(faced)
    twice = is_found(again.sure, showed) & is_found(again.before, showed)
    # What is not lost is seen where it is. Turned otherwise there, it is in no other place.
    away = jnp.linalg.norm(again.twists[:, :3], axis=-1) > radii(now.reference, now.centers)
    elsewhere = hunt.sought.recovered & better & (lost | away)
    retaken = elsewhere & twice
    guesses = of_groups(hunt.sought.recovered, again.twists, state.relocation_guesses)
    found_again = Motion(again.twists, jnp.zeros_like(kept.delta))
    kept = select_motion(retaken, found_again, kept, now.groups)
    sure = jax.tree.map(partial(of_groups, retaken), again.sure, sure)
    return Settled(kept, sure, elsewhere, retaken, guesses)


def remember(
    now: Moment, past: Past, hunt: Hunt, refined: Refined, settled: Settled, config: TrackConfig
) -> tuple[Pose, TrackState, Shown, Needed]:
    """Sixth stage: draw what the scene shows now, from which the next frame goes on.

    Args:
        now: see `Moment`.
        past: with the background.
        hunt: what was looked for.
        refined: the scene, and how well groups agree.
        settled: where groups are.
        config: the tracker's.

    Returns:
        the new pose and state, what they show, and the capacities that the whole update needed.
    """
    state, motion, groups, retaken = now.state, settled.motion, now.groups, settled.retaken
    pose = move(now.pose, motion, now.centers, groups)
    shown, shown_needed = show(refined.scene, pose, now.frame, past.backdrop, now.plan, config)
    needed = refined.needed
    if past.rendered is not None:
        drawn = jnp.maximum(past.rendered.meta.needed.max(), shown_needed)
        needed = needed._replace(full=drawn)
    else:
        near = jnp.maximum(hunt.near, shown_needed)
        needed = needed._replace(full=past.drawn, near=jnp.maximum(needed.near, near))
    pixels, unexplained_pixels = pixels_shown(shown, now.sight, now.scene.num_objects, config)
    keyframe = carry_keyframe(state.keyframe, motion.twists, now.centers)
    keyframe = renewed(keyframe, pixels, config.align.keyframe_turn, retaken)
    watch = state.watch.after(
        refined.residual, hunt.sought, past.counts, settled.sure, settled.elsewhere, retaken
    )
    still = jnp.zeros_like(motion.twists)
    guesses = of_groups(watch.doubtful & ~retaken, relative_twists(settled.guesses, motion.twists), still)
    going = select_motion(
        retaken, jax.tree.map(jnp.zeros_like, motion), motion, groups
    )  # a find is no velocity
    memory = memory_of(shown, past.backdrop, now.frame, config)
    new = TrackState(going, pixels, keyframe, unexplained_pixels, guesses, watch, state.count + 1, *memory)
    return pose, new, shown, needed
