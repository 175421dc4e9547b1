"""Rendering a scene in cameras: the one place where activated Gaussians are passed to the rasterizer."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gsjax.geometry.cameras import Camera
from gsjax.rasterize.plan import HEADROOM, Plan, with_room
from gsjax.rasterize.rasterization import Meta, rasterization
from gsjax.rasterize.rasterization import plan as _plan
from gsjax.scene.gaussians import Gaussians


class Rendered(NamedTuple):
    """Images of C cameras."""

    colors: Float[Array, "c height width 3"]
    depths: Float[Array, "c height width"]  # expected depth (see `Camera`), metres; 0 where nothing is drawn
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
        fisheye=cameras.fisheye,
        **{
            "sh_degree": gaussians.sh_degree,
            "render_mode": "RGB+ED",
            "near_plane": cameras.near,
            **options,
        },
    )


def render(
    gaussians: Gaussians,
    cameras: Camera,
    plan: Plan | None = None,
    *,
    features: Float[Array | np.ndarray, "n f"] | None = None,
    backgrounds: Float[Array | np.ndarray, "c 3"] | None = None,
    roi: Bool[Array | np.ndarray, "c height width"] | None = None,
    visibility: Float[Array | np.ndarray, "c n"] | None = None,
    means2d_offset: Float[Array | np.ndarray, "c n 2"] | None = None,
) -> Rendered:
    """Colour, expected depth and alpha of a scene in C cameras, differentiable in all of them.

    Args:
        gaussians: the scene.
        cameras: C cameras, viewmat [C,4,4] and K [C,3,3], and fisheye [C,4] for fisheyes.
        plan: from `plan_render`; required under jit.
        features: values composited with the colours (default: the scene's own features).
        backgrounds, roi, means2d_offset: as for `gsjax.rasterization`.
        visibility: factor on each opacity in each camera, 0 to 1 (default: 1).

    Raises:
        ValueError: as for `gsjax.rasterization`.
    """
    features = gaussians.features if features is None else features
    scene = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh, features)
    per_camera = (cameras.viewmat, cameras.K, cameras.fisheye, backgrounds, roi, means2d_offset)
    if visibility is not None:
        # Opacities that differ between cameras require a separate scene for each camera.
        scene = jax.tree.map(lambda a: jnp.broadcast_to(a, (len(visibility), *a.shape)), scene)
        scene = (*scene[:3], scene[3] * visibility, *scene[4:])
        per_camera = jax.tree.map(lambda a: a[:, None], per_camera)
    *scene, features = scene
    viewmats, Ks, fisheye, backgrounds, roi, means2d_offset = per_camera
    images, alphas, meta = rasterization(
        *scene,
        viewmats,
        Ks,
        cameras.width,
        cameras.height,
        plan=plan,
        fisheye=fisheye,
        sh_degree=gaussians.sh_degree,
        render_mode="RGB+ED",
        features=features,
        backgrounds=backgrounds,
        roi=roi,
        means2d_offset=means2d_offset,
        **({"near_plane": cameras.near} if plan is None else {}),
    )
    return _rendered(images, alphas, meta, visibility is not None)


@partial(jax.jit, static_argnums=3, inline=True)
def _rendered(images: Array, alphas: Array, meta: Meta, each_alone: bool) -> Rendered:
    """The rasterizer's results as `Rendered`; with `each_alone`, each camera was a scene of its own."""
    if each_alone:
        images, alphas, meta = jax.tree.map(lambda a: a[:, 0], (images, alphas, meta))
    return Rendered(images[..., :3], images[..., 3], alphas[..., 0], meta.features, meta)


def render_with_room(
    gaussians: Gaussians,
    cameras: Camera,
    plan: Plan | None = None,
    *,
    backgrounds: Float[Array, "c 3"] | None = None,
    rasterize_mode: str = "classic",
    headroom: float = HEADROOM,
) -> tuple[Rendered, Plan]:
    """The result of `render`, and a plan that is large enough for it: the given one, grown if needed, or a
    new one. For host loops over views of one size.

    Args:
        gaussians, cameras, backgrounds: as for `render`.
        plan: the plan of an earlier call.
        rasterize_mode: mode of a new plan.
        headroom: capacity of a new or grown plan relative to what is needed.
    """
    if plan is None or plan.sh_degree != gaussians.sh_degree:
        plan = plan_render(gaussians, cameras, headroom=headroom, rasterize_mode=rasterize_mode)

    def draw(plan: Plan) -> tuple[Rendered, Any]:
        drawn = render(gaussians, cameras, plan, backgrounds=backgrounds)
        return drawn, drawn.meta

    return with_room(draw, plan, headroom)
