"""One step of the streaming optimisation (MotionSplicer, sections 3.3 and 3.4): gradient descent on the pose
of the handles at this frame, and on the skinning weights, which all frames share. The loss is that of the
current picture of one camera and of past pictures, whose poses are frozen.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.rotations import normalize_quats
from gsjax.losses.extra import ExtraLosses, extra_terms, named_losses
from gsjax.losses.photometric import l1_loss, ssim, weighted_mean
from gsjax.methods.parts.config import StreamConfig
from gsjax.methods.parts.trajectory import BACKGROUND, faded
from gsjax.methods.parts.weights import Field, SimplexTable, weights_of
from gsjax.optim.constrained import simplex_descent
from gsjax.optim.step import Step, all_finite, keep_if, steady_adam
from gsjax.rasterize.plan import Plan
from gsjax.scene.feature_grid import Located
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.handles import Blend, HandlePose, rigid_motions, skin
from gsjax.scene.render import Rendered, render

FINAL_TEAR = 0.2
"""Tear weight in a frame's last step, relative to its first; it falls so that parts can come apart."""


class Canonical(NamedTuple):
    """The scene at the anchor frame, and its handles.

    Attributes:
        movable: M Gaussians that handles may move.
        fixed: all other Gaussians.
        located: locations of the movable Gaussians in the grid; None if weights are a table.
        centers: positions of the handles, metres.
        radii: radii of the parts around their handles, metres.
        pixel: width of a pixel of fine pictures (`gsjax.methods.parts.sizes`) at the moving parts, metres.
        alive: the slots, of P, that hold a handle; the background's is one of them.
        neighbors: neighbours of each movable Gaussian, as indices into all Gaussians, movable ones first.
    """

    movable: Gaussians
    fixed: Gaussians
    located: Located | None
    centers: Float[Array, "P 3"]
    radii: Float[Array, "P"]
    pixel: Float[Array, ""]
    alive: Bool[Array, "P"]
    neighbors: Int[Array, "M k"]

    @property
    def free(self) -> Bool[Array, "P 1"]:
        """The handles that may move: those of living slots, without the background's."""
        return (self.alive & (jnp.arange(len(self.alive)) != BACKGROUND))[:, None]


class StreamParams(NamedTuple):
    """The parameters of a frame.

    Attributes:
        pose: poses of the handles.
        field: the skinning weights.
        nudges: offsets of the movable means, metres; always 0, they exist for their gradient, which points
            away from where the pictures pull each Gaussian.
    """

    pose: HandlePose
    field: Field
    nudges: Float[Array, "M 3"]


class PosedScene(NamedTuple):
    """The scene at one moment, as passed to extra losses.

    Attributes:
        gaussians: the moved Gaussians, movable ones first.
        weights: weights of the movable Gaussians.
        pose: poses of the handles.
    """

    gaussians: Gaussians
    weights: Float[Array, "M P"]
    pose: HandlePose


class StreamBatch(NamedTuple):
    """The input of a step.

    Attributes:
        canonical: the canonical scene.
        now: the current frame, of one camera; its masks select the pixels that count.
        index, camera: their positions in the recording.
        progress: share of the frame's steps that are done, 0 to 1, over which learning rates and
            `tear_weight` fall.
        plan: the render plan of the current frame.
        weights: the weights before this frame, to which `hold_weight` ties the current ones.
        past: past frames and their poses.
        past_plan: the render plan of past frames.
    """

    canonical: Canonical
    now: Frame
    index: Int[Array, ""] | int
    camera: Int[Array, ""] | int
    progress: Float[Array, ""] | float
    plan: Plan
    weights: Float[Array, "M P"]
    past: tuple[tuple[Frame, HandlePose], ...] = ()
    past_plan: Plan | None = None


def skinning_weights(field: Field, canonical: Canonical) -> Float[Array, "M P"]:
    """Weights of the movable Gaussians; 0 for slots without a handle."""
    return weights_of(field, canonical.located, canonical.alive)


@partial(jax.jit, static_argnames="blend", inline=True)
def posed(
    canonical: Canonical,
    weights: Float[Array, "M P"],
    pose: HandlePose,
    blend: Blend = "quaternion",
    nudges: Float[Array, "M 3"] | None = None,
    opacities: Float[Array, "P"] | None = None,
) -> Gaussians:
    """The whole scene with its handles at a pose, movable Gaussians first.

    Args:
        canonical: the scene at rest.
        weights: weights of its movable Gaussians; rows sum to 1.
        pose: poses of the handles.
        blend: how rotations are blended.
        nudges: offsets of the movable means, metres.
        opacities: factors on the opacities of each part's Gaussians, 0 to 1.
    """
    moved = skin(canonical.movable, weights, canonical.centers, pose, blend)
    if nudges is not None:
        moved = eqx.tree_at(lambda g: g.means, moved, moved.means + nudges)
    if opacities is not None:
        logits = faded(moved.logit_opacities, jnp.matmul(weights, 1 - opacities, precision="highest"))
        moved = eqx.tree_at(lambda g: g.logit_opacities, moved, logits)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), moved, canonical.fixed)


def valid_pixels(frame: Frame) -> Bool[Array, "C H W"]:
    """The pixels of a frame that count."""
    return jnp.ones(frame.images.shape[:-1], bool) if frame.masks is None else jnp.asarray(frame.masks)


def image_loss(drawn: Rendered, frame: Frame, config: StreamConfig) -> Float[Array, ""]:
    """lambda L1 + (1 - lambda)(1 - SSIM) over the pixels that count, and where cameras measure depth, the
    depth error, which saturates at a limit.

    Args:
        drawn: the rendered scene.
        frame: the observed pictures; their masks select the pixels that count.
        config: lambda, and the weight and limit of the depth error.
    """
    target, masks = frame.colors, valid_pixels(frame)
    counts = masks.astype(drawn.colors.dtype)
    image = jnp.where(masks[..., None], drawn.colors, target)
    share = jnp.maximum(counts.mean(), 1e-3)  # so that the loss does not depend on how much moves
    loss = config.l1_weight * l1_loss(image, target)
    loss += (1 - config.l1_weight) * (1 - ssim(image, target))
    loss = loss / share
    if frame.depths is not None and config.depth_weight:
        known = counts * (frame.depths > 0) * jax.lax.stop_gradient(drawn.alphas > 0.5)
        off = jnp.minimum(jnp.abs(drawn.depths - frame.depths), config.depth_limit)
        loss += config.depth_weight * weighted_mean(off, known) / config.depth_limit
    return loss


def tearing(
    canonical: Canonical, weights: Float[Array, "M P"], pose: HandlePose, scale: Float[Array, ""]
) -> Float[Array, ""]:
    """How much of the scene is torn: the share of pairs of neighbours whose motions move the same point
    apart, each counted as r^2 / (r^2 + scale^2) for a gap r. A hinge tears nothing along its axis, and parts
    that have come apart pay hardly more for moving farther, but a surface that no picture shows follows its
    neighbours.

    Args:
        canonical: the scene at rest, with neighbours.
        weights: weights of its movable Gaussians.
        pose: poses of the handles.
        scale: gap that counts as half, metres.
    """
    squared = jnp.sum(gaps_between(canonical, weights, pose) ** 2, axis=-1)
    return jnp.mean(squared / (squared + scale**2))


def gaps_between(
    canonical: Canonical, weights: Float[Array, "M P"], pose: HandlePose
) -> Float[Array, "M k 3"]:
    """The gaps that open when each Gaussian's mean is moved by its own motion and by its neighbours', metres.

    Args:
        canonical: the scene at rest, with neighbours.
        weights: weights of its movable Gaussians.
        pose: poses of the handles.
    """
    rotations, offsets = rigid_motions(canonical.centers, pose)
    rigid = jnp.concatenate([rotations, offsets[..., None]], axis=-1).reshape(-1, 12)
    still = jnp.eye(3, 4, dtype=rigid.dtype).ravel()
    mine = jnp.matmul(weights, rigid, precision="highest")
    all_ = jnp.concatenate([mine, jnp.broadcast_to(still, (canonical.fixed.num, 12))])
    apart = (mine[:, None] - all_[canonical.neighbors]).reshape(*canonical.neighbors.shape, 3, 4)
    at = canonical.movable.means
    return jnp.einsum("nkij,nj->nki", apart[..., :3], at, precision="highest") + apart[..., 3]


def stream_loss(config: StreamConfig, extra_losses: ExtraLosses = ()) -> Callable:
    """`loss(params, batch, *, step, key)`: the loss of the current frame, with gradients to pose and field,
    plus the mean loss of past frames, with gradients to the field alone. Neither `step` nor `key` is used.

    Args:
        config: settings.
        extra_losses: custom losses of the current frame's `PosedScene`, its rendering and the frame.
    """

    def loss(params: StreamParams, batch: StreamBatch, *, step: Any, key: Any):
        weights = skinning_weights(params.field, batch.canonical)
        gaussians = posed(batch.canonical, weights, params.pose, config.blend, params.nudges)
        drawn = render(gaussians, batch.now.cameras, batch.plan, roi=batch.now.masks)
        value = image_loss(drawn, batch.now, config)
        fixed = jax.lax.stop_gradient(weights)  # the tear penalty moves handles and leaves weights alone
        scale = config.tear_scale * batch.canonical.pixel
        info: dict[str, Any] = {
            "now": value,
            "torn": tearing(batch.canonical, fixed, params.pose, scale),
            "overflow": drawn.meta.overflow.any(),
            "needed": drawn.meta.needed.max(),
        }
        changed = -jnp.sum(batch.weights * jnp.log(jnp.maximum(weights, 1e-6)), axis=-1).mean()
        tear = config.tear_weight * FINAL_TEAR**batch.progress
        value += tear * info["torn"] + config.hold_weight * changed
        if batch.past:
            past, overflow, needed = [], [], []
            for frame, pose in batch.past:
                then = posed(batch.canonical, weights, jax.lax.stop_gradient(pose), config.blend)
                before = render(then, frame.cameras, batch.past_plan, roi=frame.masks)
                past.append(image_loss(before, frame, config))
                overflow.append(before.meta.overflow.any())
                needed.append(before.meta.needed.max())
            info["past"] = jnp.stack(past).mean()
            info["overflow"] |= jnp.stack(overflow).any()
            info["needed"] = info["needed"], jnp.stack(needed).max()
            value += info["past"]
        if extra_losses:
            scene = PosedScene(gaussians, weights, params.pose)
            context = {"index": batch.index, "camera": batch.camera, "progress": batch.progress}
            info["extra"] = extra_terms(extra_losses, scene, drawn, batch.now, **context)
            value += sum(info["extra"].values())
        return value, info

    return loss


class StreamState(NamedTuple):
    """The state of a step.

    Attributes:
        pose: Adam's moments of the pose, reset in each frame.
        field: the optimizer's state of the field.
        pulls: the direction in which pictures pull each movable Gaussian: the sum of the negative gradients
            with respect to its position over the later half of each frame's steps, when the pulls on a rigid
            part are balanced.
    """

    pose: optax.OptState
    field: optax.OptState
    pulls: Float[Array, "M 3"]

    def for_new_frame(self) -> "StreamState":
        """The state before a frame's first step."""
        return self._replace(pose=jax.tree.map(jnp.zeros_like, self.pose))


def pose_after(
    pose: HandlePose, moves: HandlePose, canonical: Canonical, shift: Array, turn: Array
) -> HandlePose:
    """The pose after an update of Adam: an update of length 1 shifts a part by `shift`, and rotates it such
    that its border moves by `turn`, metres. The background's handle and empty slots stay.

    Args:
        pose: the pose before.
        moves: updates of Adam, of length about 1.
        canonical: the living slots, and the radii of the parts.
        shift, turn: metres, [] for all parts or [P,1].
    """
    shift, turn = (jnp.where(canonical.free, length, 0.0) for length in (shift, turn))
    quats = pose.quats + turn / (2 * canonical.radii[:, None]) * moves.quats  # half the angle
    return HandlePose(normalize_quats(quats), pose.translations + shift * moves.translations)


def stream_step(config: StreamConfig, extra_losses: ExtraLosses = ()) -> Step:
    """Adam on `StreamParams`, given a `StreamBatch`; neither `step` nor `key` is used.

    The background's handle does not move. A step whose loss or gradient is not finite, or that overflowed a
    plan, changes nothing, and `info["skipped"]` reports it. In addition to what every step reports, `info`
    has the picture loss of the current frame (`now`), that of past frames (`past`), and how much is torn
    (`torn`); if there are past frames, `needed` is a pair, one number for each plan.

    Args:
        config: settings.
        extra_losses: custom losses (`gsjax.losses.extra`), added to the picture loss.
    """
    named_losses(extra_losses)
    loss = stream_loss(config, extra_losses)
    poses = optax.adam(1.0, b2=0.99)

    def fields(field: Field) -> optax.GradientTransformationExtraArgs:
        if isinstance(field, SimplexTable):
            return simplex_descent(config.field_rate)
        return optax.with_extra_args_support(steady_adam(config.field_rate, eps=1e-12))

    def init(params: StreamParams) -> StreamState:
        field = fields(params.field).init(params.field)
        return StreamState(poses.init(params.pose), field, jnp.zeros_like(params.nudges))

    def update(params: StreamParams, state: StreamState, batch: StreamBatch, *, step, key):
        at = params._replace(nudges=jnp.zeros_like(params.nudges))  # always 0, and a constant costs nothing
        (value, info), slope = jax.value_and_grad(loss, has_aux=True)(at, batch, step=step, key=key)
        moves, pose_state = poses.update(slope.pose, state.pose)
        unit = batch.canonical.pixel * config.final_rate**batch.progress
        pose = pose_after(params.pose, moves, batch.canonical, config.rate * unit, config.turn_rate * unit)
        changes, field_state = fields(params.field).update(
            slope.field, state.field, params.field, allowed=batch.canonical.alive
        )
        field = eqx.apply_updates(params.field, changes)
        sound = all_finite((value, slope, pose, eqx.filter(field, eqx.is_array))) & ~info["overflow"]
        pulls = state.pulls - jnp.where(batch.progress >= 0.5, slope.nudges, 0.0)
        new = StreamParams(pose, field, params.nudges), StreamState(pose_state, field_state, pulls)
        params, state = keep_if(sound, new, (params, state))
        return params, state, {**info, "loss": value, "skipped": ~sound}

    return Step(init, update)
