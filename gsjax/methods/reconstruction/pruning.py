"""Which Gaussians the photographs need: the light that each of them sends into each view."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gsjax.geometry.cameras import Camera
from gsjax.methods.reconstruction.start import View
from gsjax.optim.compiler import host_options
from gsjax.rasterize.plan import Plan
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import plan_render, render


def light_of(
    gaussians: Gaussians, views: list[View], rasterize_mode: str = "classic"
) -> Float[np.ndarray, "n"]:
    """How many pixels' worth of light each Gaussian sends into the view that sees the most of it: the largest
    over views of the sum over pixels of its weight in compositing, w_i = alpha_i T_i.

    The sums are the gradient of the composited sum of a feature that is 1 everywhere.
    """
    most, plans = np.zeros(gaussians.num, np.float32), {}
    for view in views:
        height, width = view.image.shape[:2]
        viewmat, K = (jnp.asarray(a, gaussians.means.dtype)[None] for a in (view.viewmat, view.K))
        camera = Camera(viewmat, K, width, height)
        while True:
            if (width, height) not in plans:
                plans[width, height] = plan_render(
                    gaussians, camera, headroom=1.3, rasterize_mode=rasterize_mode
                )
            weights, meta = _weights(gaussians, camera, plans[width, height])
            if not bool(meta.overflow.any()):
                break
            plans[width, height] = plans[width, height].grown(int(meta.needed.max()), 1.3)
        most = np.maximum(most, np.asarray(weights))
    return most


@partial(jax.jit, static_argnames="plan", compiler_options=host_options())
def _weights(gaussians: Gaussians, camera: Camera, plan: Plan) -> tuple[Float[Array, "n"], object]:
    def total(ones):
        drawn = render(gaussians, camera, plan, features=ones)
        return jnp.sum(drawn.features), drawn.meta

    gradient, meta = jax.grad(total, has_aux=True)(jnp.ones((gaussians.num, 1), gaussians.means.dtype))
    return gradient[:, 0], meta
