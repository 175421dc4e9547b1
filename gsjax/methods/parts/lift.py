"""From masks to Gaussians: a logit for each part on each Gaussian, learned by rendering (MotionSplicer,
section 3.2)."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from gsjax.geometry.cameras import Camera
from gsjax.optim.compiler import host_options
from gsjax.rasterize.plan import Plan
from gsjax.scene.frame import one_camera
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import render

_OPTIMIZER = optax.adam(0.5)
_LEAST_ALPHA = 0.5  # a pixel in which less of the scene shows tells nothing
_SURE = 10.0  # the logit by which what all pixels agree on begins above the others


def votes(
    gaussians: Gaussians, cameras: Camera, plan: Plan, values: Float[Array, "C H W K"]
) -> Float[Array, "N K"]:
    """What each Gaussian gets of the pixels in which it shows: sum over pixels of its weight in compositing,
    w_i = alpha_i T_i, times their values. It is the transpose of rendering features."""
    nothing = jnp.zeros((gaussians.num, values.shape[-1]), gaussians.means.dtype)
    return _votes(nothing, gaussians, cameras, plan, values)


@partial(jax.jit, static_argnames="plan", compiler_options=host_options())
def _votes(nothing, gaussians: Gaussians, cameras: Camera, plan: Plan, values):
    # Zeros made in here would be followed through the whole render by the compiler, for many seconds.
    _, transpose = jax.vjp(lambda f: render(gaussians, cameras, plan, features=f).features, nothing)
    return transpose(values)[0]


def label_votes(
    gaussians: Gaussians, cameras: Camera, plan: Plan, masks: Int[np.ndarray, "C H W"], count: int
) -> Float[np.ndarray, "N K"]:
    """Votes of masks for labels 0 to `count` - 1, camera by camera."""
    total = np.zeros((gaussians.num, count), np.float32)
    for c, mask in enumerate(masks):
        one = one_camera(cameras, c)
        total += np.asarray(votes(gaussians, one, plan, jax.nn.one_hot(mask[None], count)))
    return total


def lift_masks(
    gaussians: Gaussians,
    cameras: Camera,
    plan: Plan,
    masks: Int[np.ndarray, "C H W"],
    count: int,
    iterations: int = 40,
) -> tuple[Float[Array, "N K"], Float[np.ndarray, "iterations"]]:
    """Logits whose render agrees with masks, by cross-entropy; and the loss over the iterations.

    It begins with the votes of all pixels, which is the answer where each Gaussian shows in pixels of one
    label; rendering then tells apart what hides behind what. What shows nowhere is background.

    Args:
        gaussians: the canonical scene.
        cameras: C of them.
        plan: for one of them.
        masks: a label a pixel, 0 to `count` - 1; -1 is not known.
        count: K.
        iterations: steps of Adam, a camera each.
    """
    total = jnp.asarray(label_votes(gaussians, cameras, plan, masks, count))
    shares = total / jnp.maximum(total.sum(-1, keepdims=True), 1e-6)
    logits = _SURE * shares.at[:, 0].add(jnp.where(total.sum(-1) < 1e-3, 1.0, 0.0))
    state, losses = _OPTIMIZER.init(logits), []
    for i in range(iterations):
        c = i % len(masks)
        one = one_camera(cameras, c)
        logits, state, loss = _lift_step(logits, state, gaussians, one, plan, masks[c : c + 1])
        losses.append(loss)
    return logits, np.asarray(losses)


@partial(jax.jit, static_argnames="plan", compiler_options=host_options())
def _lift_step(logits, state, gaussians, cameras, plan, masks):
    def loss(logits):
        shares, alphas = _shares(gaussians, cameras, plan, logits)
        picked = jnp.take_along_axis(shares, jnp.maximum(masks, 0)[..., None], axis=-1)[..., 0]
        counts = (masks >= 0) & (jax.lax.stop_gradient(alphas) > _LEAST_ALPHA)
        return -jnp.sum(jnp.log(jnp.maximum(picked, 1e-4)) * counts) / jnp.maximum(counts.sum(), 1)

    value, gradient = jax.value_and_grad(loss)(logits)
    updates, state = _OPTIMIZER.update(gradient, state)
    return optax.apply_updates(logits, updates), state, value


def _shares(
    gaussians: Gaussians, cameras: Camera, plan: Plan, logits: Float[Array, "N K"]
) -> tuple[Float[Array, "C H W K"], Float[Array, "C H W"]]:
    """Each pixel's share of each label, and how much of the scene shows in it."""
    drawn = render(gaussians, cameras, plan, features=jax.nn.softmax(logits))
    assert drawn.features is not None
    return drawn.features / jnp.maximum(drawn.alphas[..., None], 1e-6), drawn.alphas
