"""One step of the streaming optimisation (MotionSplicer, sections 3.3 and 3.4): the handles' pose at this
frame and the skinning weights, which all frames share, go down the gradient of what one camera sees now, and
another saw in a frame of the past, whose pose is frozen.
"""

from collections.abc import Callable
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
from gsjax.methods.parts.trajectory import BACKGROUND
from gsjax.methods.parts.weights import Field, SimplexTable, weights_of
from gsjax.optim.constrained import simplex_descent
from gsjax.optim.step import Step, all_finite, keep_if
from gsjax.rasterize.plan import Plan
from gsjax.scene.feature_grid import Located
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.handles import Blend, HandlePose, rigid_motions, skin
from gsjax.scene.render import Rendered, render

FINAL_TEAR = 0.2  # of a frame's last step, over that of its first: less would hold back what does tear off


class Canonical(NamedTuple):
    """The scene at the anchor frame, and its handles.

    Attributes:
        movable: M Gaussians that handles may move.
        fixed: all others.
        located: where the movable ones lie in the grid; None where weights are a table.
        centers: the handles' places, metres.
        radii: how far from its handle each part reaches, metres.
        pixel: width of a pixel where things move, metres.
        alive: which of the P slots hold a handle; the background's is one.
        neighbors: of each movable Gaussian, rows of all Gaussians, the movable ones first.
    """

    movable: Gaussians
    fixed: Gaussians
    located: Located | None
    centers: Float[Array, "P 3"]
    radii: Float[Array, "P"]
    pixel: Float[Array, ""]
    alive: Bool[Array, "P"]
    neighbors: Int[Array, "M k"]


class StreamParams(NamedTuple):
    """What a frame changes.

    Attributes:
        pose: where handles are.
        field: what weights are made of.
        nudges: added to the movable means, metres; always 0, their gradient says where pictures would have
            each Gaussian go.
    """

    pose: HandlePose
    field: Field
    nudges: Float[Array, "M 3"]


class PosedScene(NamedTuple):
    """The scene at one moment, as extra losses are given it.

    Attributes:
        gaussians: where they are, the movable ones first.
        weights: of the movable ones.
        pose: of the handles.
    """

    gaussians: Gaussians
    weights: Float[Array, "M P"]
    pose: HandlePose


class StreamBatch(NamedTuple):
    """What a step is given.

    Attributes:
        canonical: the scene.
        now: this frame; its masks say which pixels count.
        progress: share of the frame's steps that were made, 0 to 1, over which rates and `tear_weight` fall.
        plan: for its pictures.
        weights: before this frame, which are held unless pictures tell otherwise.
        past: frames of the past and their poses.
        past_plan: for their pictures.
    """

    canonical: Canonical
    now: Frame
    progress: Float[Array, ""] | float
    plan: Plan
    weights: Float[Array, "M P"]
    past: tuple[tuple[Frame, HandlePose], ...] = ()
    past_plan: Plan | None = None


def skinning_weights(field: Field, canonical: Canonical) -> Float[Array, "M P"]:
    """Weights of the movable Gaussians; 0 for slots that hold no handle."""
    return weights_of(field, canonical.located, canonical.alive)


def posed(
    canonical: Canonical,
    weights: Float[Array, "M P"],
    pose: HandlePose,
    blend: Blend = "quaternion",
    nudges: Float[Array, "M 3"] | None = None,
) -> Gaussians:
    """The whole scene with its handles at a pose, the movable Gaussians first.

    Args:
        canonical: the scene at rest.
        weights: of its movable Gaussians; rows sum to 1.
        pose: where handles are.
        blend: of rotations.
        nudges: added to the movable means, metres.
    """
    moved = skin(canonical.movable, weights, canonical.centers, pose, blend)
    if nudges is not None:
        moved = eqx.tree_at(lambda g: g.means, moved, moved.means + nudges)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), moved, canonical.fixed)


def counted(frame: Frame) -> Bool[Array, "C H W"]:
    """Which pixels of a frame count."""
    return jnp.ones(frame.images.shape[:-1], bool) if frame.masks is None else jnp.asarray(frame.masks)


def picture_loss(drawn: Rendered, frame: Frame, config: StreamConfig) -> Float[Array, ""]:
    """lambda L1 + (1 - lambda)(1 - SSIM) on the pixels that count; and where cameras measured depth, its
    difference, which beyond a limit is that of another thing.

    Args:
        drawn: the scene.
        frame: what was seen; its masks say which pixels count.
        config: with lambda, the depth's weight and its limit.
    """
    target, masks = frame.colors, counted(frame)
    counts = masks.astype(drawn.colors.dtype)
    image = jnp.where(masks[..., None], drawn.colors, target)
    share = jnp.maximum(counts.mean(), 1e-3)  # a step is as long where little moves
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
    """How much of the scene is torn: the share of neighbours whose motions take the same place apart, each
    counted by r^2 / (r^2 + scale^2) of the gap r. A hinge tears nothing along its axis, and what is torn for
    good costs no more the farther it goes; but a piece that no picture holds goes with its neighbours.

    Args:
        canonical: the scene at rest, with neighbours.
        weights: of its movable Gaussians.
        pose: where handles are.
        scale: metres.
    """
    squared = jnp.sum(gaps_between(canonical, weights, pose) ** 2, axis=-1)
    return jnp.mean(squared / (squared + scale**2))


def gaps_between(
    canonical: Canonical, weights: Float[Array, "M P"], pose: HandlePose
) -> Float[Array, "M k 3"]:
    """By how much the motions of neighbours take the same place apart, metres.

    Args:
        canonical: the scene at rest, with neighbours.
        weights: of its movable Gaussians.
        pose: where handles are.
    """
    rotations, offsets = rigid_motions(canonical.centers, pose)
    rigid = jnp.concatenate([rotations, offsets[..., None]], axis=-1).reshape(-1, 12)
    still = jnp.eye(3, 4, dtype=rigid.dtype).ravel()
    mine = weights @ rigid
    all_ = jnp.concatenate([mine, jnp.broadcast_to(still, (canonical.fixed.num, 12))])
    apart = (mine[:, None] - all_[canonical.neighbors]).reshape(*canonical.neighbors.shape, 3, 4)
    at = canonical.movable.means
    return jnp.einsum("nkij,nj->nki", apart[..., :3], at) + apart[..., 3]


def stream_loss(config: StreamConfig, extra_losses: ExtraLosses = ()) -> Callable:
    """`loss(params, batch, *, step, key)`: of this frame by pose and field, and of past ones, in the mean, by
    the field alone. Neither `step` nor `key` is used.

    Args:
        config: of the stream.
        extra_losses: given this frame's `PosedScene`, its picture and the frame.
    """

    def loss(params: StreamParams, batch: StreamBatch, *, step: Any, key: Any):
        weights = skinning_weights(params.field, batch.canonical)
        gaussians = posed(batch.canonical, weights, params.pose, config.blend, params.nudges)
        drawn = render(gaussians, batch.now.cameras, batch.plan, roi=batch.now.masks)
        value = picture_loss(drawn, batch.now, config)
        fixed = jax.lax.stop_gradient(weights)  # what stands still in all frames so far tears at no part
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
                past.append(picture_loss(before, frame, config))
                overflow.append(before.meta.overflow.any())
                needed.append(before.meta.needed.max())
            info["past"] = jnp.stack(past).mean()
            info["overflow"] |= jnp.stack(overflow).any()
            info["needed"] = info["needed"], jnp.stack(needed).max()
            value += info["past"]
        if extra_losses:
            scene = PosedScene(gaussians, weights, params.pose)
            info["extra"] = extra_terms(extra_losses, scene, drawn, batch.now)
            value += sum(info["extra"].values())
        return value, info

    return loss


class StreamState(NamedTuple):
    """What a step carries along.

    Attributes:
        pose: Adam's moments of the pose, begun anew each frame.
        field: the optimizer's state of the field.
        pulls: where pictures would have each movable Gaussian go: the sum of the downward gradients by its
            place over the later half of each frame's steps, where those of a rigid part are balanced.
    """

    pose: optax.OptState
    field: optax.OptState
    pulls: Float[Array, "M 3"]

    def in_new_frame(self) -> "StreamState":
        """The state before a frame's first step."""
        return self._replace(pose=jax.tree.map(jnp.zeros_like, self.pose))


def moved_on(
    pose: HandlePose, moves: HandlePose, canonical: Canonical, shift: Array, turn: Array
) -> HandlePose:
    """The pose after moves of Adam, of which one of length 1 shifts a part by `shift`, and turns it so far
    that its border goes by `turn`, metres. The background's handle stays, and so do slots that hold none.

    Args:
        pose: before.
        moves: of Adam, of length 1 about.
        canonical: with the parts that there are, and how far each reaches.
        shift, turn: metres, [] for all parts or [P,1].
    """
    free = (canonical.alive & (jnp.arange(len(canonical.alive)) != BACKGROUND))[:, None]
    shift, turn = (jnp.where(free, far, 0.0) for far in (shift, turn))
    quats = pose.quats + turn / (2 * canonical.radii[:, None]) * moves.quats  # half the angle
    return HandlePose(normalize_quats(quats), pose.translations + shift * moves.translations)


def stream_step(config: StreamConfig, extra_losses: ExtraLosses = ()) -> Step:
    """Adam on `StreamParams`, given a `StreamBatch`; neither `step` nor `key` is used.

    The background's handle does not move. A step whose loss or gradient is not finite, or that overflowed a
    plan, changes nothing, and `info["skipped"]` reports it. `info` has the loss of this frame's picture
    (`now`), of those of the past (`past`) and how much is torn (`torn`), beside what every step reports;
    where there is a past, `needed` is what both plans needed.

    Args:
        config: of the stream.
        extra_losses: custom losses (`gsjax.losses.extra`) beside that of pictures.
    """
    named_losses(extra_losses)
    loss = stream_loss(config, extra_losses)
    poses = optax.adam(1.0, b2=0.99)

    def fields(field: Field) -> optax.GradientTransformationExtraArgs:
        if isinstance(field, SimplexTable):
            return simplex_descent(config.field_rate)
        return optax.with_extra_args_support(optax.adam(config.field_rate, eps=1e-12))

    def init(params: StreamParams) -> StreamState:
        field = fields(params.field).init(params.field)
        return StreamState(poses.init(params.pose), field, jnp.zeros_like(params.nudges))

    def update(params: StreamParams, state: StreamState, batch: StreamBatch, *, step, key):
        at = params._replace(nudges=jnp.zeros_like(params.nudges))  # a constant costs the program nothing
        (value, info), slope = jax.value_and_grad(loss, has_aux=True)(at, batch, step=step, key=key)
        moves, pose_state = poses.update(slope.pose, state.pose)
        unit = batch.canonical.pixel * config.final_rate**batch.progress
        pose = moved_on(params.pose, moves, batch.canonical, config.rate * unit, config.turn_rate * unit)
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
