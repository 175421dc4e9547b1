"""The tracker's step: from S_{t-1} and the new images to S_t (sections II-B and II-C of the paper)."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.cameras import camera_centers, project
from gsjax.geometry.spherical_harmonics import SH_C0
from gsjax.methods.object_tracker.align import (
    Points,
    align,
    disagreement,
    join,
    pixels_of_groups,
    sample_groups,
)
from gsjax.methods.object_tracker.config import TrackerConfig
from gsjax.methods.object_tracker.matching import lift, match_templates
from gsjax.methods.object_tracker.motion import Motion, Pose, facing, group_means, move, place, turn_about
from gsjax.methods.object_tracker.refine import RefineBatch, refine
from gsjax.methods.object_tracker.region import (
    Needed,
    TrackerPlan,
    near_background,
    near_scene,
    tiles_to_pixels,
    touched_tiles,
)
from gsjax.methods.object_tracker.scene import TrackedScene
from gsjax.optim.step import Step, all_finite, keep_if
from gsjax.rasterize.plan import Plan, rung
from gsjax.scene.frame import Frame
from gsjax.scene.render import Rendered, plan_render, render

_MIN_SEEN = 0.02  # share of a group's Gaussians that must be seen somewhere for it to be moved


class TrackerState(NamedTuple):
    """What the tracker carries from frame to frame."""

    motion: Motion  # of the last frame: where delta starts, and the constant-velocity hypothesis
    frame: Frame  # the last frame, whose pixels show what the first one did not
    count: Int[Array, ""]  # frames so far


class TrackerBatch(NamedTuple):
    """What a step is given."""

    scene: TrackedScene
    frame: Frame
    plan: TrackerPlan


def render_labels(
    scene: TrackedScene, pose: Pose, frame: Frame, plan: Plan, *, one_sided: bool = False
) -> Rendered:
    """The scene as it stands, with the share of each label in each pixel as features [C, H, W, K+1].

    `one_sided` leaves out what a camera sees from behind: right for comparing with images, while for
    silhouettes the far side of an object stands in for a near side that no camera has seen yet.
    """
    one_hot = jax.nn.one_hot(scene.labels, scene.num_objects + 1)
    visibility = facing(scene, pose, camera_centers(frame.cameras.viewmat)) if one_sided else None
    return render(place(scene, pose), frame.cameras, plan, features=one_hot, visibility=visibility)


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


def _stack(motions: list[Motion]) -> Motion:
    """Hypotheses along a first axis."""
    return jax.tree.map(lambda *a: jnp.stack(a), *motions)


def _choose(residuals: Float[Array, "h k"], motions: Motion, groups: Int[Array, "m"]) -> Motion:
    """For each group the motion of the hypothesis with the least residual; the first wins ties."""
    best = jnp.argmin(jnp.where(jnp.isfinite(residuals), residuals, jnp.inf), axis=0)
    group = jnp.arange(best.shape[0])
    member = jnp.arange(groups.shape[0])
    return Motion(
        translations=motions.translations[best, group],
        rotations=motions.rotations[best, group],
        delta=motions.delta[best[groups - 1], member],
    )


def _turned(motion: Motion, angle: float) -> Motion:
    """The motion itself, and the same followed by a turn to either side about each axis: 7 hypotheses."""
    axes = jnp.concatenate([jnp.zeros((1, 3)), jnp.eye(3), -jnp.eye(3)])
    turns = angle * axes.astype(motion.rotations.dtype)

    def one(turn):
        turn = jnp.broadcast_to(turn, motion.rotations.shape)
        rotation = jaxlie.SO3.exp(turn) @ jaxlie.SO3.exp(motion.rotations)
        return Motion(motion.translations, rotation.log(), motion.delta)

    return jax.vmap(one)(turns)


def _object_pixels(
    scene: TrackedScene, pose: Pose, frame: Frame, plan: TrackerPlan, config: TrackerConfig
) -> Points:
    """Pixels of the last frame that show an object, on sides too that the first frame did not see."""
    solid = render_labels(scene, pose, frame, plan.full)
    assert solid.features is not None
    shown = jnp.where(solid.alphas > 0.5, jnp.argmax(solid.features, axis=-1), 0)
    return pixels_of_groups(frame, shown, solid.depths, scene.num_objects, config.align)


def object_tracker(config: TrackerConfig, num_objects: int, first_frame: Frame, reduction: int = 1) -> Step:
    """The step of the object-aware tracker.

    params: the `Pose` of the moving Gaussians. state: `TrackerState`. batch: `TrackerBatch`.

    A frame goes through: render the last scene with its labels; match each object's template in every camera
    and lift the match to a translation; from standing still, going on as before and the match, align
    each object with the images and take what agrees best; refine D_k and delta_i photometrically; and keep
    the refinement of an object only where it agrees better still. What no camera sees stays where it is.

    Args:
        config: see `TrackerConfig`.
        num_objects: groups that can move, K.
        first_frame: the frame that the first pose shows; `init` puts it into the state.
        reduction: factor by which images shrink for template matching (objects larger than the template).
    """

    def init(params: Pose) -> TrackerState:
        nowhere = jnp.zeros((num_objects, 3), params.means.dtype)
        return TrackerState(Motion(nowhere, nowhere, jnp.zeros_like(params.means)), first_frame, jnp.int32(0))

    def update(params: Pose, state: TrackerState, batch: TrackerBatch, *, step: Any, key: Any):
        scene, frame, plan = batch
        groups = scene.labels[: scene.num_moving]
        centers = group_means(params.means, groups, scene.num_objects)

        last = render_labels(scene, params, frame, plan.full, one_sided=True)
        assert last.features is not None
        seen = seen_from(scene, params, last, frame, config.start.depth_gap)
        visible = group_means(seen.max(0), groups, scene.num_objects) > _MIN_SEEN
        match = match_templates(
            last.colors, last.depths, last.features[..., 1:], frame, config.match, reduction
        )
        jump, found = lift(match, frame, config.match)

        zero = jax.tree.map(jnp.zeros_like, state.motion)
        start_delta = state.motion.delta
        still = Motion(zero.translations, zero.rotations, start_delta)
        jumped = Motion(jnp.where(found[:, None], jump, 0.0), zero.rotations, start_delta)
        going = state.motion
        both = Motion(jumped.translations, going.rotations, start_delta)
        # Only Gaussians that a mask has named speak for the pose; what joined may be a neighbour's.
        named = jnp.any(scene.normals != 0, axis=-1) | ~jnp.any(scene.normals != 0)
        points = Points(params.means, _colors(scene), groups, seen * named)
        points = sample_groups(points, scene.num_objects, config.align.centers)
        if config.align.pixels:
            points = points._replace(seen=config.align.center_weight * points.seen)
            points = join(points, _object_pixels(scene, params, state.frame, plan, config))

        def judge(motion):
            twists = jnp.concatenate([motion.translations, motion.rotations], axis=-1)
            means = turn_about(points.means, twists, centers, points.groups)
            return disagreement(points, means, scene.num_objects, frame, config.align)

        def best_of(motions):
            return _choose(jax.lax.map(judge, motions), motions, groups)

        def aligned(motions, widen):
            return jax.lax.map(lambda m: align(m, points, centers, frame, config.align, widen), motions)

        # Every start is aligned, widely at first: far off, the wrong one ends in the wrong place. Then turns
        # to all sides are tried from the best, because a knock changes a spin from one frame to the next.
        begun = best_of(aligned(_stack([still, jumped, going, both]), 3.0))
        begun = best_of(aligned(_turned(begun, config.align.turn), 3.0))
        begun = best_of(_stack([still, begun, align(begun, points, centers, frame, config.align)]))

        if not config.refine.se3:
            begun = Motion(begun.translations, zero.rotations, begun.delta)
        tiles = touched_tiles([params.means, move(params, begun, centers, groups).means], frame)
        near = near_background(scene, last, tiles)
        around = near_scene(scene, near, plan.num_near)
        roi = tiles_to_pixels(tiles, frame)
        refine_batch = RefineBatch(around, frame, plan.near, params, centers, roi)
        refined, info = refine(begun, refine_batch, config.refine)
        # Points know nothing of outlines, which rendered images do, so these are overruled only where they
        # went clearly astray; without depth the points hardly know better at all.
        lead = 0.1 if frame.depths is None else 0.01
        verdict = jnp.stack([judge(refined) - lead, judge(begun)])
        kept = _choose(verdict, _stack([refined, begun]), groups)
        kept = _mask(kept, visible, groups)

        pose = move(params, kept, centers, groups)
        needed = Needed(last.meta.needed.max(), info["needed"], near.sum())
        overflow = needed.exceeds(plan)
        sound = all_finite(pose) & ~overflow
        new_state = TrackerState(kept, frame, state.count + 1)
        pose, new_state = keep_if(sound, (pose, new_state), (params, state))
        info |= {
            "overflow": overflow,
            "needed": needed,
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


def plan_tracker(scene: TrackedScene, pose: Pose, frame: Frame, headroom: float) -> TrackerPlan:
    """Capacities for a step from `pose` with cameras as in `frame`, with `headroom` for what motion adds."""
    full = plan_render(place(scene, pose), frame.cameras, headroom=headroom)
    rendered = render(place(scene, pose), frame.cameras, full)
    near = near_background(scene, rendered, touched_tiles([pose.means], frame))
    num_near = rung(int(near.sum()) * headroom)
    around = near_scene(scene, near, num_near)
    return TrackerPlan(full, plan_render(place(around, pose), frame.cameras, headroom=headroom), num_near)
