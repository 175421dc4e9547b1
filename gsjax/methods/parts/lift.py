"""Lifting of masks to Gaussians: each Gaussian gets a logit for each part, learned by rendering
(MotionSplicer, section 3.2)."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from gsjax.geometry.cameras import Camera
from gsjax.optim.compiler import host_jit
from gsjax.rasterize.plan import Plan
from gsjax.scene.frame import one_camera
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import render

_OPTIMIZER = optax.adam(0.5)
_CHANNELS = 32  # rendered, or voted for, at once, so that one program serves any number
_LEAST_ALPHA = 0.5  # pixels with a lower rendered alpha are ignored
_SURE = 10.0  # initial logit of a label that all pixels agree on, relative to the others


def label_votes(
    gaussians: Gaussians, cameras: Camera, plan: Plan, masks: Int[np.ndarray, "C H W"], count: int
) -> Float[np.ndarray, "N K"]:
    """The votes of each Gaussian for labels 0 to `count` - 1: the sum of its compositing weight,
    w_i = alpha_i T_i, over the masks' pixels of each label; the transpose of rendering features."""
    total = np.zeros((gaussians.num, count), np.float32)
    for c, mask in enumerate(masks):
        present = np.intersect1d(mask, np.arange(count))
        labels = (mask[None, ..., None] == present).astype(np.float32)
        total[:, present] += pixel_votes(gaussians, one_camera(cameras, c), plan, labels)
    return total


def pixel_votes(
    gaussians: Gaussians, camera: Camera, plan: Plan, values: Float[np.ndarray, "1 H W K"]
) -> Float[np.ndarray, "N K"]:
    """For each Gaussian, the sum of the values of one camera's pixels, weighted by the Gaussian's compositing
    weight in each, w_i = alpha_i T_i."""
    zeros = jax.device_put(np.zeros((gaussians.num, _CHANNELS), gaussians.means.dtype))
    groups = _groups_of_channels(values.astype(zeros.dtype))
    votes = [_votes(zeros, gaussians, camera, plan, group) for group in groups]
    return np.concatenate(votes, axis=-1)[:, : values.shape[-1]]


def render_features(
    gaussians: Gaussians, camera: Camera, plan: Plan, features: Float[np.ndarray, "N K"]
) -> Float[np.ndarray, "1 H W K"]:
    """Features of Gaussians rendered for one camera, sum_i w_i f_i; the transpose of `pixel_votes`."""
    drawn = [_drawn(group, gaussians, camera, plan) for group in _groups_of_channels(features)]
    return np.concatenate(drawn, axis=-1)[..., : features.shape[-1]]


def _groups_of_channels(values: Float[np.ndarray, "... K"]) -> list[Float[np.ndarray, "... channels"]]:
    """The channels in groups of the size that one program takes, padded with zeros."""
    count = max(1, -(-values.shape[-1] // _CHANNELS))
    padded = np.zeros((*values.shape[:-1], count * _CHANNELS), values.dtype)
    padded[..., : values.shape[-1]] = values
    return np.split(padded, count, axis=-1)


@partial(host_jit, static_argnames="plan")
def _drawn(features, gaussians: Gaussians, cameras: Camera, plan: Plan):
    return render(gaussians, cameras, plan, features=features).features


@partial(host_jit, static_argnames="plan")
def _votes(zeros, gaussians: Gaussians, cameras: Camera, plan: Plan, values):
    # Zeros created here would be constant-folded through the whole render, which takes many seconds.
    _, transpose = jax.vjp(lambda f: render(gaussians, cameras, plan, features=f).features, zeros)
    return transpose(values)[0]


def lift_masks(
    gaussians: Gaussians,
    cameras: Camera,
    plan: Plan,
    masks: Int[np.ndarray, "C H W"],
    count: int,
    iterations: int = 40,
) -> tuple[Float[Array, "N K"], Float[np.ndarray, "iterations"]]:
    """Logits whose rendering agrees with the masks, by cross-entropy, and the loss of each iteration.

    The logits start from the votes of all pixels, which are the answer if each Gaussian shows in pixels of
    one label only; rendering then resolves occlusion. Gaussians that are visible nowhere are background.

    Args:
        gaussians: the canonical scene.
        cameras: C cameras.
        plan: for one camera.
        masks: label of each pixel, 0 to `count` - 1; -1 is unknown.
        count: K, the number of labels.
        iterations: steps of Adam, with one camera each.
    """
    votes = label_votes(gaussians, cameras, plan, masks, count)
    total = votes.sum(-1, keepdims=True)
    shares = votes / np.maximum(total, 1e-6)
    shares[:, :1] += total < 1e-3
    logits = jax.device_put(np.float32(_SURE) * shares)
    state, losses = jax.jit(_OPTIMIZER.init)(logits), []
    for i in range(iterations):
        c = i % len(masks)
        one = one_camera(cameras, c)
        logits, state, loss = _lift_step(logits, state, gaussians, one, plan, masks[c : c + 1])
        losses.append(loss)
    return logits, np.asarray(losses)


@partial(host_jit, static_argnames="plan")
def _lift_step(logits, state, gaussians, cameras, plan, masks):
    def loss(logits):
        drawn = render(gaussians, cameras, plan, features=jax.nn.softmax(logits))
        assert drawn.features is not None
        shares = drawn.features / jnp.maximum(drawn.alphas[..., None], 1e-6)
        picked = jnp.take_along_axis(shares, jnp.maximum(masks, 0)[..., None], axis=-1)[..., 0]
        counts = (masks >= 0) & (jax.lax.stop_gradient(drawn.alphas) > _LEAST_ALPHA)
        return -jnp.sum(jnp.log(jnp.maximum(picked, 1e-4)) * counts) / jnp.maximum(counts.sum(), 1)

    value, gradient = jax.value_and_grad(loss)(logits)
    updates, state = _OPTIMIZER.update(gradient, state)
    return optax.apply_updates(logits, updates), state, value
