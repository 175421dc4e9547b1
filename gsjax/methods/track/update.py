"""The step of the tracker: from S_{t-1} and the new images to S_t (Object-Aware Gaussian Splatting for
Robotic Manipulation, sections II-B and II-C)."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from gsjax.losses.extra import ExtraLosses, named_losses
from gsjax.methods.track.config import TrackConfig
from gsjax.methods.track.frames import FrameShape, prepared
from gsjax.methods.track.grow import empty_slots, grow
from gsjax.methods.track.motion import group_means
from gsjax.methods.track.points import tone_images
from gsjax.methods.track.reference import reference_points
from gsjax.methods.track.stages.context import UpdateContext
from gsjax.methods.track.stages.follow import align_and_search, last_view, motion_hypotheses, refine_motion
from gsjax.methods.track.stages.settle import detect_lost, store_state
from gsjax.methods.track.state import TrackBatch, Tracked, TrackState, blank_state
from gsjax.optim.step import Step, all_finite, keep_if


def track_step(
    config: TrackConfig, shape: FrameShape, reduction: int = 1, extra_losses: ExtraLosses = ()
) -> Step:
    """The step of the object-aware tracker: one frame per update.

    params: `Tracked`, a scene with `config.grow.slots` slots (see `with_slots`) and the pose of its objects.
    state: `TrackState`; that of `init` has seen no frame yet, so the first update, with the frame that the
    scene shows, only observes: it changes no parameters. batch: `TrackBatch`, with the frame of all cameras.
    `key` is used to relocate lost groups; `step` is not used.

    A frame passes through six stages (`gsjax.methods.track.stages`):

    1. determine what the last scene shows of each object;
    2. collect hypotheses of the motion: none, the same as in the last frame and, with `config.matching`, that
       of template matching;
    3. align each object with the images from the best of these; try shifts of those that agree worse than
       usual, rotations of those that agree worst, and other places for those that may be lost;
    4. with `config.refine.iterations`, refine D_k and delta_i photometrically, and keep the improvements;
    5. detect lost objects, and move those that were found again;
    6. draw what the scene shows now, from which the next frame continues. With `config.redraw` "moving", only
       the moving Gaussians are drawn.

    Then surfaces that come into view join the objects that they continue (`grow`). Objects that no camera
    sees stay where they are. If a plan overflows, no pixel of the frame or not all of its cameras are finite,
    or a new pose is not finite, the update changes nothing.

    Besides what every step reports, `info` has `residual`, `visible`, `agrees`, `lost`, `turn_known` and
    `looked_for` (rotations or other places were tried) of each group; `motion` and `centers`; `found` and
    `score` of template matching; `joined`, the number of Gaussians that have joined; `broken_pixels`; and the
    info of the refinement. `loss` is the mean residual of the visible groups, and `needed` is for
    `TrackPlan.grown`.

    Args:
        config: see `TrackConfig`.
        shape: shape of all frames, before `prepared`.
        reduction: factor by which images shrink for template matching (objects larger than the template).
        extra_losses: custom losses (`gsjax.losses.extra`) added to that of the refinement. Their scene is a
            `TrackedScene` of the moving Gaussians and the background near them, with labels. Their result is
            always kept, because they may use information that is not in the images; `info["extra"]` has
            their values.

    Raises:
        ValueError: there are extra losses but no refinement to add them to.
    """
    if named_losses(extra_losses) and not config.refine.iterations:
        raise ValueError(
            "extra_losses: expected none with config.refine.iterations 0, because they are added to the "
            f"refinement's; found {len(extra_losses)}: take PRESETS['paper'], or set redraw to all, "
            "coarseness to 1 and refine.iterations above 0"
        )

    def update(params: Tracked, state: TrackState, batch: TrackBatch, *, step: Any, key: Key[Array, ""]):
        (scene, pose), (frame, broken) = params, prepared(batch.frame, config)
        everywhere = batch.everywhere
        if everywhere is None:
            most = config.align.everywhere
            everywhere = jnp.int32(scene.num_objects if most is None else most)
        with jax.default_matmul_precision("highest"):  # errors of poses add up: no TF32 on GPUs that have it
            centers = group_means(pose.means, scene.groups, scene.num_objects)
            images = tone_images(frame, config.align.shading)
            reference = reference_points(scene, pose, config.align)
            now = UpdateContext(scene, pose, state, frame, batch.plan, images, centers, reference)
            past = last_view(now, config)
            starts = motion_hypotheses(now, past, config, reduction)
            alignment = align_and_search(now, past, starts, everywhere, key, config)
            refined = refine_motion(now, past, starts, alignment, config, extra_losses)
            settled = detect_lost(now, past, alignment, refined, config)
            pose, new_state, shown, needed = store_state(now, past, alignment, refined, settled, config)

        overflow = needed.exceeds(batch.plan)
        readable = (broken < frame.images.size // 3) & all_finite((frame.cameras.viewmat, frame.cameras.K))
        sound = all_finite((pose, refined.shifts)) & ~overflow & readable
        new = Tracked(refined.scene, pose)
        growing = bool(config.grow.slots) and frame.depths is not None
        if growing:
            how = (config.grow, config.coarseness, new_state.watch.lost)
            new = Tracked(*grow(*new, shown, frame, new_state.count, *how))
        params = keep_if(sound & ~state.is_blank, new, params)
        state = keep_if(sound, new_state, state)
        still = jax.tree.map(jnp.zeros_like, settled.motion)
        motion, watch = keep_if(sound, settled.motion, still), state.watch
        joined = config.grow.slots - empty_slots(params.scene).sum() if growing else jnp.int32(0)
        visible = past.visible
        residuals = jnp.where(visible, refined.residuals, 0.0)
        info = refined.info | {
            "loss": residuals.sum() / jnp.maximum(visible.sum(), 1),
            "overflow": overflow,
            "needed": needed,
            "skipped": ~sound,
            "score": starts.score,
            "found": starts.found,
            "visible": visible,
            "residual": refined.residuals,
            "agrees": watch.agrees,
            "lost": watch.lost,
            "turn_known": watch.turn_known,
            "looked_for": alignment.search.searched,
            "motion": motion,
            "centers": centers + motion.twists[:, :3],
            "broken_pixels": broken,
            "joined": joined,
        }
        return params, state, info

    return Step(partial(blank_state, config=config, shape=shape), update)
