"""A scene and cameras to images: the one place where activated Gaussians meet the rasterizer."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gsjax.geometry.cameras import Camera
from gsjax.rasterize.plan import Plan
from gsjax.rasterize.rasterization import Meta, rasterization
from gsjax.rasterize.rasterization import plan as _plan
from gsjax.scene.gaussians import Gaussians


class Rendered(NamedTuple):
    """Images of C cameras."""

    colors: Float[Array, "c height width 3"]
    depths: Float[Array, "c height width"]  # expected depth, metres; 0 where nothing is drawn
    alphas: Float[Array, "c height width"]
    features: Float[Array, "c height width f"] | None
    meta: Meta


def plan_render(gaussians: Gaussians, cameras: Camera, **options: Any) -> Plan:
    """A plan for `render`; `cameras` holds C of them. Options as for `gsjax.plan`."""
    return _plan(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        cameras.viewmat,
        cameras.K,
        cameras.width,
        cameras.height,
        **{"sh_degree": gaussians.sh_degree, "render_mode": "RGB+ED", **options},
    )


def render(
    gaussians: Gaussians,
    cameras: Camera,
    plan: Plan | None = None,
    *,
    features: Float[Array, "n f"] | None = None,
    backgrounds: Float[Array, "c 3"] | None = None,
    roi: Bool[Array, "c height width"] | None = None,
) -> Rendered:
    """Colour, expected depth and alpha of a scene in C cameras, differentiable in all of them.

    Args:
        gaussians: the scene.
        cameras: C cameras, viewmat [C,4,4] and K [C,3,3].
        plan: from `plan_render`; needed under jit.
        features: values composited beside the colours; the scene's own unless given.
        backgrounds, roi: as for `gsjax.rasterization`.

    Raises:
        ValueError: as `gsjax.rasterization`.
    """
    images, alphas, meta = rasterization(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        cameras.viewmat,
        cameras.K,
        cameras.width,
        cameras.height,
        plan=plan,
        sh_degree=gaussians.sh_degree,
        render_mode="RGB+ED",
        features=gaussians.features if features is None else features,
        backgrounds=backgrounds,
        roi=roi,
    )
    return Rendered(images[..., :3], images[..., 3], alphas[..., 0], meta.features, meta)


def stack_cameras(cameras: list[Camera]) -> Camera:
    """One Camera of C from C of the same size."""
    first = cameras[0]
    return Camera(
        viewmat=jnp.stack([c.viewmat for c in cameras]),
        K=jnp.stack([c.K for c in cameras]),
        width=first.width,
        height=first.height,
    )
