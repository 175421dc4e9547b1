"""Removal of Gaussians that no photograph needs, by the light that each contributes to each view."""

from collections.abc import Iterable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gsjax.geometry.cameras import Camera, on_device
from gsjax.methods.fit.config import FitConfig
from gsjax.optim.compiler import host_jit
from gsjax.rasterize.plan import HEADROOM, Plan, with_room
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians, take
from gsjax.scene.render import plan_render, render


def needed(light: Float[np.ndarray, "n"], share: float) -> Bool[np.ndarray, "n"]:
    """All but the least needed Gaussians, which together contribute at most a share of the light of any view.

    Args:
        light: from `light_of`.
        share: share of the light, 0 to 1.
    """
    order = np.argsort(light, kind="stable")
    kept = np.ones(len(light), bool)
    # The sum of the Gaussians' maxima over views bounds their sum in each view.
    kept[order[np.cumsum(light[order], dtype=np.float64) <= share]] = False
    return kept


def prune(
    gaussians: Gaussians, frames: Iterable[Frame], config: FitConfig
) -> tuple[Gaussians, Float[np.ndarray, "n"]]:
    """The Gaussians that some photograph needs, and the light that each contributes.

    Args:
        gaussians: the scene.
        frames: the photographs of the fit, with one camera each.
        config: settings of the fit; with `prune` 0 all Gaussians are kept.
    """
    if not gaussians.num:
        return gaussians, np.zeros(0)
    light = light_of(gaussians, frames, "antialiased" if config.antialiased else "classic")
    kept = needed(light, config.prune) if config.prune else np.ones(len(light), bool)
    return take(gaussians, kept), light[kept]


def light_of(
    gaussians: Gaussians, frames: Iterable[Frame], rasterize_mode: str = "classic"
) -> Float[np.ndarray, "n"]:
    """Each Gaussian's share of the light of a view, in the view where that share is largest. The share is
    the sum of its compositing weights, w_i = alpha_i T_i, over the pixels that count, divided by the same
    sum for all Gaussians.

    The sums are computed as gradients of the sum of a rendered feature that is 1 for every Gaussian.

    Args:
        gaussians: the scene.
        frames: all photographs, with one camera each.
        rasterize_mode: "classic" or "antialiased", as in the fit.
    """
    most, plans = np.zeros(gaussians.num, np.float32), {}
    for frame in frames:
        camera = on_device(frame.cameras)
        size = camera.width, camera.height
        if size not in plans:
            plans[size] = plan_render(gaussians, camera, headroom=HEADROOM, rasterize_mode=rasterize_mode)
        mask = None if frame.masks is None else jnp.asarray(frame.masks)
        weights, plans[size] = with_room(partial(_weights, gaussians, camera, mask), plans[size])
        total = float(weights.sum())
        most = np.maximum(most, np.asarray(weights) / max(total, 1e-12))
    return most


@partial(host_jit, static_argnames="plan")
def _weights(
    gaussians: Gaussians, camera: Camera, mask: Bool[Array, "1 h w"] | None, plan: Plan
) -> tuple[Float[Array, "n"], object]:
    def total(ones):
        drawn = render(gaussians, camera, plan, features=ones)
        seen = drawn.features if mask is None else jnp.where(mask[..., None], drawn.features, 0.0)
        return jnp.sum(seen), drawn.meta

    gradient, meta = jax.grad(total, has_aux=True)(jnp.ones((gaussians.num, 1), gaussians.means.dtype))
    return gradient[:, 0], meta
