"""The tracker's step: from S_{t-1} and the new images to S_t (Object-Aware Gaussian Splatting for Robotic
Manipulation, sections II-B and II-C)."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Key

from gsjax.losses.extra import ExtraLosses, named_losses
from gsjax.methods.track.config import TrackConfig
from gsjax.methods.track.frames import FrameShape, prepared
from gsjax.methods.track.grow import empty_slots, grow
from gsjax.methods.track.layers import draw_backdrop, reduced
from gsjax.methods.track.lost import confidence
from gsjax.methods.track.motion import Motion, group_means
from gsjax.methods.track.points import first_keyframe, sight_of
from gsjax.methods.track.reference import all_facing, reference_points
from gsjax.methods.track.search import first_watch
from gsjax.methods.track.stages import (
    Moment,
    align_and_search,
    detect_lost,
    look_back,
    memory_of,
    pixels_shown,
    refine_motion,
    remember,
    show,
    starting_points,
)
from gsjax.methods.track.state import TrackBatch, Tracked, TrackState, blank_state
from gsjax.optim.step import Step, all_finite, keep_if
from gsjax.scene.frame import Frame


def track_step(
    config: TrackConfig, shape: FrameShape, reduction: int = 1, extra_losses: ExtraLosses = ()
) -> Step:
    """The step of the object-aware tracker, one frame an update.

    params: `Tracked`, a scene with its slots (`with_slots`, as many as `config.grow.slots`) and the pose of
    its objects. state: `TrackState`; that of `init` has seen nothing yet, and `first_look` fills in what the
    frame shows that the scene was made from. batch: `TrackBatch`, with the frame as it was seen. `key` draws
    the places where what is lost is looked for; `step` is not used.

    A frame goes through six stages (`gsjax.methods.track.stages`):

    1. see what the last scene shows of each object;
    2. collect where each may have gone: nowhere, on as before and, with `config.matching`, to where its
       template is found;
    3. align each object with the images from there, take what agrees best, and look everywhere for those
       that agree worst, and elsewhere for what may be lost;
    4. with `config.refine.iterations`, refine D_k and delta_i photometrically, where that is better;
    5. detect what is lost, and move what was found again;
    6. draw what the scene shows now, for the next frame to go on from. With `config.redraw` "moving", only
       the moving Gaussians are drawn.

    Then surfaces that come into view join the objects that they continue (`grow`). What no camera sees stays
    where it is. Where a plan overflows, no pixel of the frame or not all of its cameras are finite, or a new
    pose is not finite, the update changes nothing.

    `info` has, beside what every step reports: `residual`, `visible`, `agrees`, `lost`, `turn_known` and
    `looked_for` of each group; `motion` and `centers`; `found` and `score` of template matching; `joined`,
    how many Gaussians have joined; `broken_pixels`; and what the refinement reports. `loss` is the mean
    residual of visible groups, and `needed` is what `TrackPlan.grown` takes.

    Args:
        config: see `TrackConfig`.
        shape: of all frames, as they are seen.
        reduction: factor by which images shrink for template matching (objects larger than the template).
        extra_losses: custom losses (`gsjax.losses.extra`) beside that of the refinement. Their scene is a
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

    def update(params: Tracked, state: TrackState, batch: TrackBatch, *, step: Any, key: Key[Array, ""]):
        frame, broken = prepared(batch.frame, config)
        with jax.default_matmul_precision("highest"):  # poses compound: no TF32 on GPUs that have it
            now = _moment(params, state, batch._replace(frame=frame), config)
            past = look_back(now, config)
            starts = starting_points(now, past, config, reduction)
            everywhere = _looked_for(batch, now.scene.num_objects, config)
            hunt = align_and_search(now, past, starts, everywhere, key, config)
            refined = refine_motion(now, past, starts, hunt, config, extra_losses)
            settled = detect_lost(now, past, hunt, refined, config)
            pose, new_state, shown, needed = remember(now, past, hunt, refined, settled, config)

        overflow = needed.exceeds(batch.plan)
        sound = all_finite((pose, refined.shifted)) & ~overflow & _can_be_read(frame, broken)
        new = Tracked(refined.scene, pose)
        growing = bool(config.grow.slots) and frame.depths is not None
        if growing:
            how = (config.grow, config.coarseness, new_state.watch.lost)
            new = Tracked(*grow(*new, shown, frame, new_state.count, *how))
        params, state = keep_if(sound, (new, new_state), (params, state))
        still = jax.tree.map(jnp.zeros_like, settled.motion)
        motion, watch = keep_if(sound, settled.motion, still), state.watch
        joined = config.grow.slots - empty_slots(params.scene).sum() if growing else jnp.int32(0)
        visible = past.visible
        residuals = jnp.where(visible, refined.residual, 0.0)
        info = refined.info | {
            "loss": residuals.sum() / jnp.maximum(visible.sum(), 1),
            "overflow": overflow,
            "needed": needed,
            "skipped": ~sound,
            "score": starts.score,
            "found": starts.found,
            "visible": visible,
            "residual": refined.residual,
            "agrees": watch.agrees,
            "lost": watch.lost,
            "turn_known": watch.turn_known,
            "looked_for": hunt.sought.looked_for,
            "motion": motion,
            "centers": now.centers + motion.twists[:, :3],
            "broken_pixels": broken,
            "joined": joined,
        }
        return params, state, info

    return Step(partial(blank_state, config=config, shape=shape), update)


def first_look(params: Tracked, batch: TrackBatch, config: TrackConfig) -> TrackState:
    """The state after the frame that `params` shows, from which the step goes on.

    Args:
        params: the scene and where its objects are in this frame.
        batch: the frame, as it was seen, and a plan that holds the scene (`plan_tracker`).
        config: the tracker's.
    """
    (scene, pose), plan = params, batch.plan
    frame, _ = prepared(batch.frame, config)
    nowhere = Motion(jnp.zeros((scene.num_objects, 6), pose.means.dtype), jnp.zeros_like(pose.means))
    views = reduced(frame.cameras, config.coarseness)
    backdrop = draw_backdrop(scene, views, plan.full)[0] if config.redraw == "moving" else None
    shown, _ = show(scene, pose, frame, backdrop, plan, config)
    sight = sight_of(frame, config.align.shading)
    pixels, unexplained_pixels = pixels_shown(shown, sight, scene.num_objects, config)
    reference = reference_points(scene, pose, config.align)
    centers = group_means(pose.means, scene.labels[: scene.num_moving], scene.num_objects)
    facing = all_facing(reference, nowhere.twists, centers, sight)
    showed = confidence(facing, sight, config.start.depth_gap).shows
    return TrackState(
        nowhere,
        pixels,
        first_keyframe(pixels),
        unexplained_pixels,
        nowhere.twists,
        first_watch(showed),
        jnp.int32(0),
        *memory_of(shown, backdrop, frame, config),
    )


def _moment(params: Tracked, state: TrackState, batch: TrackBatch, config: TrackConfig) -> Moment:
    """What the stages share."""
    scene, pose = params
    centers = group_means(pose.means, scene.labels[: scene.num_moving], scene.num_objects)
    sight = sight_of(batch.frame, config.align.shading)
    reference = reference_points(scene, pose, config.align)
    return Moment(scene, pose, state, batch.frame, batch.plan, sight, centers, reference)


def _looked_for(batch: TrackBatch, num_objects: int, config: TrackConfig) -> Array:
    """How many groups are looked for everywhere."""
    if batch.everywhere is not None:
        return batch.everywhere
    return jnp.int32(num_objects if config.align.everywhere is None else config.align.everywhere)


def _can_be_read(frame: Frame, broken: Array) -> Bool[Array, ""]:
    """Whether the frame has a pixel that is finite, and cameras that are."""
    count = frame.images.size // 3
    return (broken < count) & all_finite((frame.cameras.viewmat, frame.cameras.K))
