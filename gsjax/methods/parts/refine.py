"""All frames together: the scene, which the canonical frame alone has shaped so far, and the poses, each of
which was found from the last, go down the gradient of what any camera saw in any frame. What came to light
later, and the shade that parts carry along, are known only then.

The paper leaves the canonical scene as it is. While parts are still being found, so do we: a scene that may
change explains away what a piece that is not yet known does.
"""

from collections.abc import Iterator
from functools import lru_cache, partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int

from gsjax.losses.extra import ExtraLosses, extra_terms, named_losses
from gsjax.methods.parts.config import PartsConfig
from gsjax.methods.parts.discover import Views
from gsjax.methods.parts.follow import Parts
from gsjax.methods.parts.stream import Canonical, PosedScene, Seen, moved_on, picture_loss, posed
from gsjax.optim.compiler import host_options
from gsjax.optim.step import Step, all_finite, keep_if, per_field_adam
from gsjax.rasterize.plan import Plan
from gsjax.scene.frame import Frame, one_camera
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.handles import HandlePose
from gsjax.scene.render import plan_render, render

_CAMERAS = 4  # of a frame that are looked through before another frame is opened
_RATES = {"quats": 1e-3, "log_scales": 5e-3, "logit_opacities": 2.5e-2, "sh0": 2.5e-3, "shN": 1.25e-4}
_FINAL_RATE = 0.1


class RefineParams(NamedTuple):
    """What changes: the canonical scene, what may move and what not, and where handles are in T frames."""

    movable: Gaussians
    fixed: Gaussians
    poses: HandlePose


class RefineBatch(NamedTuple):
    """What a step is given.

    Attributes:
        canonical: the handles; its Gaussians are not read.
        weights: of the movable Gaussians; they stay.
        seen: what one camera saw at frame t.
        t: which frame it is.
        anchor: the canonical frame, at which all handles are at rest.
        plan: for its pictures.
    """

    canonical: Canonical
    weights: Float[Array, "M P"]
    seen: Seen
    t: Int[Array, ""]
    anchor: Int[Array, ""]
    plan: Plan


def refine_step(config: PartsConfig, extra_losses: ExtraLosses = ()) -> Step:
    """Adam on `RefineParams`, with a state for each frame's pose; `step` is the share that is done.

    The background's handle does not move, nor does any at the canonical frame. A step whose loss or gradient
    is not finite, or whose plan overflowed, changes nothing, and `info["skipped"]` says so.

    Args:
        config: of the parts.
        extra_losses: of one's own (`gsjax.losses.extra`), beside that of pictures.
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
            drawn = render(moved, batch.seen.frame.cameras, batch.plan)
            told = {"overflow": drawn.meta.overflow.any(), "needed": drawn.meta.needed.max()}
            value = picture_loss(drawn, batch.seen, config.stream)
            if extra_losses:
                scene = PosedScene(moved, batch.weights, pose)
                told["extra"] = extra_terms(extra_losses, scene, drawn, batch.seen.frame)
                value += sum(told["extra"].values())
            return value, told

        (value, told), slope = jax.value_and_grad(loss, (0, 1), has_aux=True)(both(params), pose)
        fall = _FINAL_RATE**step
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
        sound = all_finite((value, slope, gaussians, pose)) & ~told["overflow"]
        new = RefineParams(*gaussians, everywhere[0]), (tuple(known), everywhere[1])
        params, state = keep_if(sound, new, (params, state))
        return params, state, {**told, "loss": value, "skipped": ~sound}

    return Step(init, update)


class Refined(NamedTuple):
    """What is known after one more step.

    Attributes:
        parts: with the scene and all poses refined.
        loss: of this step, on the device.
        skipped: it changed nothing, because a number in it was not finite.
    """

    parts: Parts
    loss: Float[Array, ""]
    skipped: Bool[Array, ""]


def refine(
    views: Views, parts: Parts, config: PartsConfig, *, extra_losses: ExtraLosses = ()
) -> Iterator[Refined]:
    """Step by step over all frames that were found, in a random order; one may stop after any. The same
    arguments give the same bits.

    Args:
        views: what the cameras saw.
        parts: all that is to be known of them, from `without_needless`.
        config: how.
        extra_losses: as for `follow`.
    """
    named_losses(extra_losses)  # before it is a key, which a list cannot be
    advance, rng = _compiled(config, extra_losses), np.random.default_rng((config.seed, 1))
    canonical, weights, frames = parts.canonical, parts.weights, np.flatnonzero(parts.done)
    anchor = jnp.asarray(int(np.flatnonzero(parts.found == 0)[0]))
    poses = HandlePose(jnp.asarray(parts.quats), jnp.asarray(parts.translations))
    params = RefineParams(canonical.movable, canonical.fixed, poses)
    state, plan, i = refine_step(config).init(params), None, 0
    while i < config.refine.iterations:
        t = int(rng.choice(frames))
        frame = views.frame(t)
        turns = rng.permutation(len(frame.images))[:_CAMERAS]
        for c in turns[: config.refine.iterations - i].tolist():
            seen = _whole(one_camera(frame, c))
            while True:
                if plan is None:
                    scene = posed(canonical, weights, parts.pose(t))
                    plan = plan_render(scene, frame.cameras, headroom=config.headroom)
                batch = RefineBatch(canonical, weights, seen, jnp.asarray(t), anchor, plan)
                params, state, info = advance(params, state, batch, i / config.refine.iterations)
                if not bool(info["overflow"]):
                    break
                plan = plan.grown(int(info["needed"]), config.headroom)
            i += 1
            yield Refined(_refined(parts, params), info["loss"], info["skipped"])


def _refined(parts: Parts, params: RefineParams) -> Parts:
    canonical = parts.canonical._replace(movable=params.movable, fixed=params.fixed)
    quats, translations = np.asarray(params.poses.quats), np.asarray(params.poses.translations)
    return parts._replace(canonical=canonical, quats=quats, translations=translations)


def _whole(frame: Frame) -> Seen:
    return Seen(frame, jnp.ones(frame.images.shape[:-1], bool))


@lru_cache(maxsize=2)
def _compiled(config: PartsConfig, extra_losses: ExtraLosses):
    """The jitted step; it leaves whole what it replaces, a megabyte or two, for one may stop at any step."""
    step = refine_step(config, extra_losses)

    @partial(jax.jit, compiler_options=host_options())
    def advance(params, state, batch, share):
        return step.update(params, state, batch, step=share, key=None)

    return advance
