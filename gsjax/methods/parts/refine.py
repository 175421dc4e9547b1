"""All frames together: the scene, which the canonical frame alone has shaped so far, and the poses, each of
which was found from the last, go down the gradient of what any camera saw in any frame. What came to light
later, and the shade that parts carry along, are known only then.

The paper leaves the canonical scene as it is. While parts are still being found, so do we: a scene that may
change explains away what a piece that is not yet known does.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from gsjax.losses.extra import ExtraLosses, extra_terms, named_losses
from gsjax.methods.parts.config import PartsConfig
from gsjax.methods.parts.stream import Canonical, PosedScene, moved_on, picture_loss, posed
from gsjax.optim.step import Step, all_finite, keep_if, per_field_adam
from gsjax.rasterize.plan import Plan
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.handles import HandlePose
from gsjax.scene.render import render

_RATES = {"quats": 1e-3, "log_scales": 5e-3, "logit_opacities": 2.5e-2, "sh0": 2.5e-3, "shN": 1.25e-4}
_FINAL_RATE = 0.1


class RefineParams(NamedTuple):
    """What changes.

    Attributes:
        movable: Gaussians of the canonical scene that handles may move.
        fixed: all others.
        poses: where handles are in T frames.
    """

    movable: Gaussians
    fixed: Gaussians
    poses: HandlePose


class RefineBatch(NamedTuple):
    """What a step is given.

    Attributes:
        canonical: the handles; its Gaussians are not read.
        weights: of the movable Gaussians; they stay.
        frame: what one camera saw at frame t; its masks say which pixels count.
        t: which frame it is.
        anchor: the canonical frame, at which all handles are at rest.
        progress: share of these steps that were made, 0 to 1, over which rates fall.
        plan: for its pictures.
    """

    canonical: Canonical
    weights: Float[Array, "M P"]
    frame: Frame
    t: Int[Array, ""]
    anchor: Int[Array, ""]
    progress: Float[Array, ""] | float
    plan: Plan


def refine_step(config: PartsConfig, extra_losses: ExtraLosses = ()) -> Step:
    """Adam on `RefineParams`, with a state for each frame's pose, given a `RefineBatch`; neither `step` nor
    `key` is used.

    The background's handle does not move, nor does any at the canonical frame. A step whose loss or gradient
    is not finite, or that overflowed its plan, changes nothing, and `info["skipped"]` reports it.

    Args:
        config: of the parts.
        extra_losses: custom losses (`gsjax.losses.extra`) beside that of pictures.
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
            moved = posed(canonical, batch.weights, pose, config.stream.blend)
            drawn = render(moved, batch.frame.cameras, batch.plan)
            info: dict[str, Any] = {"overflow": drawn.meta.overflow.any(), "needed": drawn.meta.needed.max()}
            value = picture_loss(drawn, batch.frame, config.stream)
            if extra_losses:
                scene = PosedScene(moved, batch.weights, pose)
                info["extra"] = extra_terms(extra_losses, scene, drawn, batch.frame)
                value += sum(info["extra"].values())
            return value, info

        (value, info), slope = jax.value_and_grad(loss, (0, 1), has_aux=True)(both(params), pose)
        fall = _FINAL_RATE**batch.progress
        length = config.refine.rate * fall * batch.canonical.pixel
        gaussians, known = [], []
        for before, down, was in zip(both(params), slope[0], state[0], strict=True):
            moves, now = scene(params).update(down, was)
            moves = eqx.tree_at(
                lambda g: g.means, jax.tree.map(lambda a: fall * a, moves), length * moves.means
            )
            gaussians.append(optax.apply_updates(before, moves))
            known.append(now)
        moves, pose_state = poses.update(slope[1], pose_state)
        far = jnp.where(batch.t == batch.anchor, 0.0, length)
        pose = moved_on(pose, moves, batch.canonical, far, far)
        everywhere = jax.tree.map(
            lambda every, one: every.at[batch.t].set(one), (params.poses, state[1]), (pose, pose_state)
        )
        sound = all_finite((value, slope, gaussians, pose)) & ~info["overflow"]
        new = RefineParams(*gaussians, everywhere[0]), (tuple(known), everywhere[1])
        params, state = keep_if(sound, new, (params, state))
        return params, state, {**info, "loss": value, "skipped": ~sound}

    return Step(init, update)
