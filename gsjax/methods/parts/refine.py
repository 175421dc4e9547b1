"""Refinement over all frames: gradient descent on the scene, so far fitted to the canonical frame alone, and
on all poses, so far each found from the previous one. Each step uses a picture of any frame. Only here can
the scene learn surfaces that are revealed later, and the shadows that move with parts.

The paper leaves the canonical scene fixed. So do we while parts are still being discovered: a scene that may
change would explain away the motion of an undiscovered part. `parts_step` combines both stages in one step.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from gsjax.losses.extra import ExtraLosses, extra_terms, named_losses
from gsjax.methods.parts.config import PartsConfig
from gsjax.methods.parts.stream import (
    Canonical,
    PosedScene,
    StreamParams,
    image_loss,
    pose_after,
    posed,
    stream_step,
)
from gsjax.optim.step import Step, all_finite, keep_if, per_field_adam
from gsjax.rasterize.plan import Plan
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.handles import HandlePose
from gsjax.scene.render import render

_RATES = {"quats": 1e-3, "log_scales": 5e-3, "logit_opacities": 2.5e-2, "sh0": 2.5e-3, "shN": 1.25e-4}
_FINAL_RATE = 0.1


class RefineParams(NamedTuple):
    """The parameters of the refinement.

    Attributes:
        movable: Gaussians of the canonical scene that handles may move.
        fixed: all others.
        poses: poses of the handles in T frames.
    """

    movable: Gaussians
    fixed: Gaussians
    poses: HandlePose


class RefineBatch(NamedTuple):
    """The input of a step.

    Attributes:
        canonical: the handles; its Gaussians are not read.
        weights: weights of the movable Gaussians, which are constant.
        frame: the picture of one camera at frame t; its masks select the pixels that count.
        t, camera: their positions in the recording.
        anchor: index of the canonical frame, at which all handles are at rest.
        held: whether all poses stay as they are.
        shown: 1 for each part that is present in the frame, else 0; None if all are.
        progress: share of the refinement that is done, 0 to 1, over which learning rates fall.
        plan: the render plan.
    """

    canonical: Canonical
    weights: Float[Array, "M P"]
    frame: Frame
    t: Int[Array, ""]
    camera: Int[Array, ""]
    anchor: Int[Array, ""]
    progress: Float[Array, ""] | float
    plan: Plan
    held: Bool[Array, ""] | bool = False
    shown: Float[Array, "P"] | None = None


def refine_step(config: PartsConfig, extra_losses: ExtraLosses = ()) -> Step:
    """Adam on `RefineParams`, with a state for each frame's pose, given a `RefineBatch`; neither `step` nor
    `key` is used.

    The background's handle never moves, nor does any handle at the canonical frame. A step whose loss or
    gradient is not finite, or that overflowed its plan, changes nothing, and `info["skipped"]` reports it.

    Args:
        config: settings of the parts.
        extra_losses: custom losses (`gsjax.losses.extra`), added to the picture loss.
    """
    named_losses(extra_losses)
    poses = optax.adam(1.0, b2=0.99)

    def scene(params: RefineParams) -> optax.GradientTransformation:
        there = {name: r for name, r in _RATES.items() if getattr(params.fixed, name) is not None}
        return per_field_adam({"means": 1.0, **there})

    def both(params: RefineParams) -> tuple[Gaussians, Gaussians]:
        return params.movable, params.fixed

    def init(params: RefineParams):
        gaussians = tuple(scene(params).init(one) for one in both(params))
        return gaussians, jax.vmap(poses.init)(params.poses)

    def update(params: RefineParams, state, batch: RefineBatch, *, step, key):
        pose, pose_state = jax.tree.map(lambda a: a[batch.t], (params.poses, state[1]))

        def loss(gaussians, pose):
            canonical = batch.canonical._replace(movable=gaussians[0], fixed=gaussians[1])
            moved = posed(canonical, batch.weights, pose, config.stream.blend, opacities=batch.shown)
            drawn = render(moved, batch.frame.cameras, batch.plan)
            info: dict[str, Any] = {"overflow": drawn.meta.overflow.any(), "needed": drawn.meta.needed.max()}
            value = image_loss(drawn, batch.frame, config.stream)
            if extra_losses:
                scene = PosedScene(moved, batch.weights, pose)
                context = {"index": batch.t, "camera": batch.camera, "progress": batch.progress}
                info["extra"] = extra_terms(extra_losses, scene, drawn, batch.frame, **context)
                value += sum(info["extra"].values())
            return value, info

        (value, info), slope = jax.value_and_grad(loss, (0, 1), has_aux=True)(both(params), pose)
        fall = _FINAL_RATE**batch.progress
        pixel = batch.canonical.pixel
        gaussians, known = [], []
        for before, down, was in zip(both(params), slope[0], state[0], strict=True):
            moves, now = scene(params).update(down, was)
            shifts = config.refine.rate * fall * pixel * moves.means
            moves = eqx.tree_at(lambda g: g.means, jax.tree.map(lambda a: fall * a, moves), shifts)
            gaussians.append(optax.apply_updates(before, moves))
            known.append(now)
        moves, pose_state = poses.update(slope[1], pose_state)
        stays = (batch.t == batch.anchor) | batch.held
        far = jnp.where(stays, 0.0, config.refine.pose_rate * fall * pixel)
        far = far if batch.shown is None else far * batch.shown[:, None]
        pose = pose_after(pose, moves, batch.canonical, far, far)
        everywhere = jax.tree.map(
            lambda every, one: every.at[batch.t].set(one), (params.poses, state[1]), (pose, pose_state)
        )
        sound = all_finite((value, slope, gaussians, pose)) & ~info["overflow"]
        new = RefineParams(*gaussians, everywhere[0]), (tuple(known), everywhere[1])
        params, state = keep_if(sound, new, (params, state))
        return params, state, {**info, "loss": value, "skipped": ~sound}

    return Step(init, update)


def parts_step(config: PartsConfig, extra_losses: ExtraLosses = ()) -> Step:
    """`stream_step` for `StreamParams`, and `refine_step` for `RefineParams`; neither uses `step` or `key`.

    Args:
        config: settings of the parts.
        extra_losses: custom losses `loss(scene, rendered, frame)` (`gsjax.losses.extra`), whose scene is a
            `PosedScene`.
    """
    stream, refine = stream_step(config.stream, extra_losses), refine_step(config, extra_losses)

    def stage(params: StreamParams | RefineParams) -> Step:
        return refine if isinstance(params, RefineParams) else stream

    def update(params: StreamParams | RefineParams, state: Any, batch: Any, *, step: Any, key: Any):
        return stage(params).update(params, state, batch, step=step, key=key)

    return Step(lambda params: stage(params).init(params), update)
