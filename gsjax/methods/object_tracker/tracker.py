"""The tracker's step: from S_{t-1} and the new images to S_t (sections II-B and II-C of the paper)."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.cameras import camera_centers, project
from gsjax.geometry.spherical_harmonics import SH_C0
from gsjax.methods.object_tracker.config import TrackerConfig
from gsjax.methods.object_tracker.matching import lift, match_templates
from gsjax.methods.object_tracker.motion import Motion, Pose, facing, group_means, move, place
from gsjax.methods.object_tracker.points import (
    Keyframe,
    Points,
    carry_keyframe,
    faded,
    first_keyframe,
    join,
    pixels_of_groups,
    renewed,
    sample_groups,
)
from gsjax.methods.object_tracker.refine import RefineBatch, refine
from gsjax.methods.object_tracker.region import (
    Needed,
    TrackerPlan,
    near_background,
    near_scene,
    shift_background,
    spread,
    tiles_to_pixels,
    touched_tiles,
)
from gsjax.methods.object_tracker.scene import TrackedScene
from gsjax.methods.object_tracker.search import judge, search
from gsjax.optim.step import Step, all_finite, keep_if
from gsjax.rasterize.plan import Plan, rung
from gsjax.scene.frame import Frame
from gsjax.scene.render import Rendered, plan_render, render

_MIN_SEEN = 0.02  # share of a group's Gaussians that must be seen somewhere for it to be moved


class TrackerState(NamedTuple):
    """What the tracker carries from frame to frame."""

    motion: Motion  # of the last frame: where delta starts, and the constant-velocity hypothesis
    pixels: Points  # what showed each group in the last frame
    keyframe: Keyframe  # and in an earlier one
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


def _pixels(frame: Frame, rendered: Rendered, num_objects: int, config: TrackerConfig) -> Points:
    """The pixels of a frame that show each group, as the scene rendered solid says."""
    assert rendered.features is not None
    shown = jnp.where(rendered.alphas > 0.5, jnp.argmax(rendered.features, axis=-1), 0)
    return pixels_of_groups(frame, shown, rendered.depths, num_objects, config.align)


def _named(scene: TrackedScene, pose: Pose, seen: Float[Array, "c m"], config: TrackerConfig) -> Points:
    """Centres of Gaussians that the first mask named: what joined an object later may be a neighbour's."""
    # What joins has no normal. Neither have shapes known beforehand, but nothing joins those.
    with_normal = jnp.any(scene.normals != 0, axis=-1)
    named = with_normal | ~with_normal.any()
    colors = scene.gaussians.sh0[: scene.num_moving, 0] * SH_C0 + 0.5
    groups = scene.labels[: scene.num_moving]
    seen = config.align.center_weight * seen * named
    return sample_groups(pose.means, colors, seen, groups, scene.num_objects, config.align.centers)


def object_tracker(config: TrackerConfig, num_objects: int, first: TrackerBatch, reduction: int = 1) -> Step:
    """The step of the object-aware tracker.

    params: the `Pose` of the moving Gaussians. state: `TrackerState`. batch: `TrackerBatch`.

    A frame goes through: render the last scene with its labels; match each object's template in every camera
    and lift the match to a translation; from standing still, going on as before and the match, align
    each object with the images and take what agrees best; refine D_k and delta_i photometrically; and keep
    the refinement of an object only where it agrees better still. What no camera sees stays where it is.

    Args:
        config: see `TrackerConfig`.
        num_objects: groups that can move, K.
        first: the frame that the first pose shows, with the scene, for `init`.
        reduction: factor by which images shrink for template matching (objects larger than the template).
    """

    def init(params: Pose) -> TrackerState:
        nowhere = Motion(jnp.zeros((num_objects, 6), params.means.dtype), jnp.zeros_like(params.means))
        rendered = render_labels(first.scene, params, first.frame, first.plan.full)
        pixels = _pixels(first.frame, rendered, num_objects, config)
        return TrackerState(nowhere, pixels, first_keyframe(pixels), jnp.int32(0))

    def update(params: Pose, state: TrackerState, batch: TrackerBatch, *, step: Any, key: Any):
        scene, frame, plan = batch
        groups = scene.labels[: scene.num_moving]
        centers = group_means(params.means, groups, num_objects)

        last = render_labels(scene, params, frame, plan.full, one_sided=True)
        assert last.features is not None
        seen = seen_from(scene, params, last, frame, config.start.depth_gap)
        visible = group_means(seen.max(0), groups, num_objects) > _MIN_SEEN
        jump, found, score = _match(last, frame, num_objects, config, reduction)

        remembered = faded(state.keyframe, config.align.keyframe_turn)
        points = join(_named(scene, params, seen, config), join(state.pixels, remembered))
        still = jnp.zeros_like(state.motion.twists)
        jumped = still.at[:, :3].set(jnp.where(found[:, None], jump, 0.0))
        going = state.motion.twists
        starts, delta = [still, jumped], jnp.zeros_like(state.motion.delta)
        if config.warm_start:
            starts += [going, going.at[:, :3].set(jumped[:, :3])]
            delta = state.motion.delta
        aligned = search(jnp.stack(starts), points, centers, frame, config.align)
        begun = Motion(aligned, delta)
        tiles = touched_tiles([params.means, move(params, begun, centers, groups).means], frame)
        near = near_background(scene, last, tiles)
        around = near_scene(scene, near, plan.num_near)
        roi = tiles_to_pixels(tiles, frame)
        refine_batch = RefineBatch(around, frame, plan.near, params, centers, roi)
        refined, shifts, info = refine(begun, refine_batch, config.refine)
        if shifts is not None:
            shifts = spread(near, shifts)
            scene = shift_background(scene, shifts)
        # Points know nothing of outlines, which rendered images do, so these are overruled only where they
        # went clearly astray; without depth the points hardly know better at all.
        lead = 0.1 if frame.depths is None else 0.01
        of_refined, of_begun = (
            judge(m.twists, points, centers, frame, config.align) for m in (refined, begun)
        )
        better = of_refined - lead <= of_begun
        nowhere = jax.tree.map(jnp.zeros_like, begun)
        kept = _select(visible, _select(better, refined, begun, groups), nowhere, groups)

        pose = move(params, kept, centers, groups)
        solid = render_labels(scene, pose, frame, plan.full)
        full = jnp.maximum(last.meta.needed.max(), solid.meta.needed.max())
        needed = Needed(full, info["needed"], near.sum())
        overflow = needed.exceeds(plan)
        sound = all_finite((pose, shifts)) & ~overflow
        pixels = _pixels(frame, solid, num_objects, config)
        keyframe = carry_keyframe(state.keyframe, kept.twists, centers)
        keyframe = renewed(keyframe, pixels, config.align.keyframe_turn)
        new_state = TrackerState(kept, pixels, keyframe, state.count + 1)
        pose, new_state = keep_if(sound, (pose, new_state), (params, state))
        info |= {
            "overflow": overflow,
            "needed": needed,
            "skipped": ~sound,
            "score": score,
            "found": found,
            "visible": visible,
            "residual": jnp.where(better, of_refined, of_begun),
            "motion": kept,
            "rendered": solid,
            "background": shifts,
        }
        return pose, new_state, info

    return Step(init, update)


def _match(last: Rendered, frame: Frame, num_objects: int, config: TrackerConfig, reduction: int):
    """Where template matching says that each group has gone, whether it found it, and its scores [C, K]."""
    if not config.matching:
        num_cameras = len(frame.images)
        return (
            jnp.zeros((num_objects, 3)),
            jnp.zeros(num_objects, bool),
            jnp.zeros((num_cameras, num_objects)),
        )
    assert last.features is not None
    labels = last.features[..., 1:]
    match = match_templates(last.colors, last.depths, labels, frame, config.match, reduction)
    return *lift(match, frame, config.match), match.score


def _select(chosen: Bool[Array, "k"], a: Motion, b: Motion, groups: Int[Array, "m"]) -> Motion:
    """The motion `a` of the chosen groups, and `b` of the others."""
    return Motion(
        jnp.where(chosen[:, None], a.twists, b.twists),
        jnp.where(chosen[groups - 1][:, None], a.delta, b.delta),
    )


def plan_tracker(scene: TrackedScene, pose: Pose, frame: Frame, headroom: float) -> TrackerPlan:
    """Capacities for a step from `pose` with cameras as in `frame`, with `headroom` for what motion adds."""
    full = plan_render(place(scene, pose), frame.cameras, headroom=headroom)
    rendered = render(place(scene, pose), frame.cameras, full)
    near = near_background(scene, rendered, touched_tiles([pose.means], frame))
    num_near = rung(int(near.sum()) * headroom)
    around = near_scene(scene, near, num_near)
    return TrackerPlan(full, plan_render(place(around, pose), frame.cameras, headroom=headroom), num_near)
