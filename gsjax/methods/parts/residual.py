"""The loss of `stream` as residuals of the handles' motions, for Gauss-Newton by `gsjax.optim`."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from gsjax.methods.parts.config import StreamConfig
from gsjax.methods.parts.screws import pose_of
from gsjax.methods.parts.stream import FINAL_TEAR, StreamBatch, gaps_between, posed, valid_pixels
from gsjax.optim.residuals import block_residual
from gsjax.scene.handles import HandlePose
from gsjax.scene.render import render

_LIMIT = 1.0  # of colour differences, so that none saturates, as in the loss


def pose_residual(
    motions: jaxlie.SE3,
    batch: StreamBatch,
    *,
    step: Any,
    key: Any,
    config: StreamConfig,
    block: int = 2,
    softness: float = 0.1,
) -> tuple[dict[str, Float[Array, "..."]], dict[str, Any]]:
    """The residuals of `stream_loss` as a function of the pose alone, without SSIM. Half the sum of their
    squares is that loss times the number of pixels that count, but for small differences, which
    `block_residual` rounds off.

    Args:
        motions: motions of all P handles, from `screws.motions_of`; the background's stays.
        batch: the plan must have derivative "forward", because the Jacobian is built by its 6 P columns. The
            weights are constant, and past frames are not used.
        step, key: not used; part of the signature of a residual.
        config: settings.
        block, softness: as for `block_residual`.
    """
    free = batch.canonical.free
    pose = jax.tree.map(lambda a: jnp.where(free, a, jax.lax.stop_gradient(a)), pose_of(motions))
    drawn = render(
        posed(batch.canonical, batch.weights, pose, config.blend),
        batch.now.cameras,
        batch.plan,
        roi=batch.now.masks,
    )
    frame, counts = batch.now, valid_pixels(batch.now).astype(drawn.colors.dtype)[..., None]
    pixels = counts.sum()
    residual = partial(block_residual, block=block, softness=softness)
    residuals = {
        "color": residual(drawn.colors - frame.colors, config.l1_weight / 3 * counts, _LIMIT),
        "tear": _torn(batch, pose, config) * jnp.sqrt(pixels * FINAL_TEAR**batch.progress),
    }
    if frame.depths is not None and config.depth_weight:
        known = counts[..., 0] * (frame.depths > 0) * jax.lax.stop_gradient(drawn.alphas > 0.5)
        share = config.depth_weight / config.depth_limit * pixels / jnp.maximum(known.sum(), 1)
        gap = (drawn.depths - frame.depths)[..., None]
        residuals["depth"] = residual(gap, share * known[..., None], config.depth_limit)
    return residuals, {"overflow": drawn.meta.overflow.any(), "needed": drawn.meta.needed.max()}


def _torn(batch: StreamBatch, pose: HandlePose, config: StreamConfig) -> Float[Array, "M k 3"]:
    """Residuals whose halved sum of squares is `tearing`, weighted as in a frame's first step."""
    gaps = gaps_between(batch.canonical, batch.weights, pose)
    scale = config.tear_scale * batch.canonical.pixel
    far = jnp.sqrt(jnp.sum(gaps**2, axis=-1, keepdims=True) + scale**2)
    return gaps / far * jnp.sqrt(2 * config.tear_weight / (gaps.shape[0] * gaps.shape[1]))
