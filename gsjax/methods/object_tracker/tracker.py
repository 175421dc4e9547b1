"""The tracker's step: from S_{t-1} and the new images to S_t (papers/000, sections II-B and II-C)."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gsjax.geometry.cameras import project
from gsjax.geometry.spherical_harmonics import SH_C0
from gsjax.methods.object_tracker.config import TrackerConfig
from gsjax.methods.object_tracker.matching import lift, match_templates
from gsjax.methods.object_tracker.motion import Motion, Pose, group_means, move, place
from gsjax.methods.object_tracker.refine import RefineBatch, point_residuals, refine, region_of_interest
from gsjax.methods.object_tracker.scene import TrackedScene
from gsjax.optim.step import Step, all_finite, keep_if
from gsjax.rasterize.plan import Plan
from gsjax.scene.frame import Frame
from gsjax.scene.render import Rendered, render

_MIN_SEEN = 0.02  # share of a group's Gaussians that must be seen somewhere for it to be moved


class TrackerState(NamedTuple):
    """What the tracker carries from frame to frame."""

    motion: Motion  # of the last frame: where delta starts, and the constant-velocity hypothesis


class TrackerBatch(NamedTuple):
    """What a step is given."""

    scene: TrackedScene
    frame: Frame
    plan: Plan


def render_labels(scene: TrackedScene, pose: Pose, frame: Frame, plan: Plan) -> Rendered:
    """The scene as it stands, with the share of each label in each pixel as features [C, H, W, K+1]."""
    one_hot = jax.nn.one_hot(scene.labels, scene.num_objects + 1)
    return render(place(scene, pose), frame.cameras, plan, features=one_hot)


def seen_from(
    scene: TrackedScene, pose: Pose, rendered: Rendered, frame: Frame, gap: float
) -> Float[Array, "c m"]:
    """1 for each moving Gaussian that a camera sees: its label is on top there and its depth agrees."""
    groups = scene.labels[: scene.num_moving]
    height, width = frame.images.shape[1:3]

    def one(viewmat, K, depth, weights):
        pixels, z = project(pose.means, viewmat, K)
        column, row = jnp.floor(pixels).astype(jnp.int32).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (z > 1e-3)
        column, row = jnp.clip(column, 0, width - 1), jnp.clip(row, 0, height - 1)
        on_top = (weights[row, column, groups] > 0.5) & (jnp.abs(depth[row, column] - z) < gap)
        return (inside & on_top).astype(depth.dtype)

    return jax.vmap(one)(frame.cameras.viewmat, frame.cameras.K, rendered.depths, rendered.features)


def _choose(residuals: Float[Array, "h k"], motions: list[Motion], groups) -> Motion:
    """For each group the motion of the hypothesis with the least residual; the first wins ties."""
    best = jnp.argmin(residuals, axis=0)
    stacked = jax.tree.map(lambda *a: jnp.stack(a), *motions)
    group = jnp.arange(best.shape[0])
    member = jnp.arange(groups.shape[0])
    return Motion(
        translations=stacked.translations[best, group],
        rotations=stacked.rotations[best, group],
        delta=stacked.delta[best[groups - 1], member],
    )


def object_tracker(config: TrackerConfig, num_objects: int, reduction: int = 1) -> Step:
    """The step of the object-aware tracker.

    params: the `Pose` of the moving Gaussians. state: `TrackerState`. batch: `TrackerBatch`.

    A frame goes through: render the last scene with its labels; match each object's template in every camera
    and lift the match to a translation; of standing still, going on as before and the match, take for each
    object what agrees best with the images; refine D_k and delta_i photometrically; and keep the
    refinement of an object only where it agrees better still. An object that no camera sees stays where it is.

    Args:
        config: see `TrackerConfig`.
        num_objects: groups that can move, K.
        reduction: factor by which images shrink for template matching (objects larger than the template).
    """

    def init(params: Pose) -> TrackerState:
        nowhere = jnp.zeros((num_objects, 3), params.means.dtype)
        return TrackerState(Motion(nowhere, nowhere, jnp.zeros_like(params.means)))

    def update(params: Pose, state: TrackerState, batch: TrackerBatch, *, step: Any, key: Any):
        scene, frame, plan = batch
        groups = scene.labels[: scene.num_moving]
        centers = group_means(params.means, groups, scene.num_objects)

        last = render_labels(scene, params, frame, plan)
        seen = seen_from(scene, params, last, frame, config.start.depth_gap)
        visible = group_means(seen.max(0), groups, scene.num_objects) > _MIN_SEEN
        match = match_templates(
            last.colors, last.depths, last.features[..., 1:], frame, config.match, reduction
        )
        jump, found = lift(match, frame, config.match)

        zero = jax.tree.map(jnp.zeros_like, state.motion)
        start_delta = state.motion.delta
        still = Motion(zero.translations, zero.rotations, start_delta)
        going = state.motion
        jumped = Motion(jnp.where(found[:, None], jump, 0.0), zero.rotations, start_delta)
        colors = _colors(scene)
        residuals = partial(
            point_residuals, colors, seen=seen, scene=scene, frame=frame, config=config.refine
        )

        def judge(motion):
            return residuals(move(params, motion, centers, groups).means)

        hypotheses = [still, jumped, going]
        begun = _choose(jnp.stack([judge(h) for h in hypotheses]), hypotheses, groups)

        positions = [params.means, move(params, begun, centers, groups).means]
        roi = region_of_interest(positions, frame)
        refined, info = refine(begun, RefineBatch(scene, frame, plan, params, centers, roi), config.refine)
        kept = _choose(jnp.stack([judge(refined), judge(begun)]), [refined, begun], groups)
        kept = _mask(kept, visible, groups)

        pose = move(params, kept, centers, groups)
        overflow = info["overflow"] | last.meta.overflow.any()
        sound = all_finite(pose) & ~overflow
        new_state = TrackerState(kept)
        pose, new_state = keep_if(sound, (pose, new_state), (params, state))
        info |= {
            "overflow": overflow,
            "needed": jnp.maximum(info["needed"], last.meta.needed.max()),
            "skipped": ~sound,
            "score": match.score,
            "found": found,
            "visible": visible,
            "residual": judge(kept),
            "motion": kept,
        }
        return pose, new_state, info

    return Step(init, update)


def _mask(motion: Motion, chosen: Bool[Array, "k"], groups) -> Motion:
    """No motion for the groups that are not chosen."""
    return Motion(
        jnp.where(chosen[:, None], motion.translations, 0.0),
        jnp.where(chosen[:, None], motion.rotations, 0.0),
        jnp.where(chosen[groups - 1][:, None], motion.delta, 0.0),
    )


def _colors(scene: TrackedScene) -> Float[Array, "m 3"]:
    """The constant colour of each moving Gaussian."""
    return scene.gaussians.sh0[: scene.num_moving, 0] * SH_C0 + 0.5
