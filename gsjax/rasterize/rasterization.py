"""The public rasterizer: Gaussians and cameras in, images out. A pure function of arrays.

The counterpart of gsplat's function of this name (https://docs.gsplat.studio), in JAX: jit, grad, jvp, vmap.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.cameras import camera_centers
from gsjax.geometry.spherical_harmonics import evaluate_sh, num_sh_bases
from gsjax.rasterize import fused
from gsjax.rasterize.binning import bin_gaussians
from gsjax.rasterize.capacity import plan_for
from gsjax.rasterize.checks import check_inputs
from gsjax.rasterize.compositing import Lists, Splats
from gsjax.rasterize.gradients import composite
from gsjax.rasterize.lanes import LANES, slots
from gsjax.rasterize.plan import HEADROOM, OPTION_NAMES, UNSET, Plan, resolve
from gsjax.rasterize.projection import Projected, project_gaussians
from gsjax.rasterize.tiles import split_views, untile
from gsjax.rasterize.views import Views, usable


class Meta(NamedTuple):
    """Outputs of a rasterization besides its images."""

    means2d: Float[Array, "*batch n 2"]  # pixels, where visible
    radii: Int[Array, "*batch n 2"]  # half-widths in pixels, (x, y); 0 where not visible
    depths: Float[Array, "*batch n"]  # z in the camera's frame, or distance (fisheye), where visible
    features: Float[Array, "*batch height width channels"] | None
    reads: Int[Array, "*batch tiles"]  # entries of each tile's list read until all its pixels were opaque
    pairs: Int[Array, "*batch"]  # Gaussian-tile pairs drawn
    culled: Int[Array, "*batch"]  # Gaussians rejected for their values (NaN, no rotation, no area)
    overflow: Bool[Array, "*batch"]  # the plan was too small: nothing was drawn
    needed: Int[Array, "*batch"]  # capacity that the plan needs


def rasterization(
    means: Float[Array | np.ndarray, "*batch n 3"],
    quats: Float[Array | np.ndarray, "*batch n 4"],
    scales: Float[Array | np.ndarray, "*batch n 3"],
    opacities: Float[Array | np.ndarray, "*batch n"],
    colors: Float[Array | np.ndarray, "*batch_and_cameras n channels"]
    | Float[Array | np.ndarray, "*batch_and_cameras n bases channels"],
    viewmats: Float[Array | np.ndarray, "*batch c 4 4"],
    Ks: Float[Array | np.ndarray, "*batch c 3 3"],
    width: int,
    height: int,
    *,
    plan: Plan | None = None,
    fisheye: Float[Array | np.ndarray, "*batch c 4"] | None = None,
    near_plane: float = UNSET,
    far_plane: float = UNSET,
    eps2d: float = UNSET,
    sh_degree: int | None = UNSET,
    backgrounds: Float[Array | np.ndarray, "*batch c channels"] | None = None,
    render_mode: str = UNSET,
    rasterize_mode: str = UNSET,
    features: Float[Array | np.ndarray, "*batch n f"] | None = None,
    roi: Bool[Array | np.ndarray, "*batch c height width"] | None = None,
    means2d_offset: Float[Array | np.ndarray, "*batch c n 2"] | None = None,
    reads: Int[Array | np.ndarray, "*batch c tiles"] | None = None,
    derivative: str = UNSET,
    alpha_min: float = UNSET,
    alpha_max: float = UNSET,
    min_transmittance: float = UNSET,
    max_per_tile: int | None = UNSET,
    tile_size: int = UNSET,
    tiles_per_batch: int | None = UNSET,
    sort: str = UNSET,
) -> tuple[Float[Array, "*batch c height width d"], Float[Array, "*batch c height width 1"], Meta]:
    """Render 3D Gaussians (Kerbl et al. 2023) for one or more cameras.

    Differentiable in everything continuous: means, quats, scales, opacities, colors, features, viewmats, Ks,
    fisheye, backgrounds, means2d_offset. Gaussians that cannot be drawn (NaN, a zero quaternion, no area, a
    colour whose square overflows) are culled, counted in `meta.culled`, and receive gradients of exactly
    zero.

    Args:
        means: centres, metres.
        quats: rotations wxyz, need not be normalised.
        scales: standard deviations along the Gaussian's own axes, metres.
        opacities: 0 to 1 (values outside are clipped).
        colors: values of any dimension D, or SH coefficients [N, K, D] when `sh_degree` is given. With an
            axis of cameras before N, [..., C, N, D], they differ between cameras. bfloat16 and float16 values
            keep their type until they are composited, in float32.
        viewmats: world to camera, OpenCV axes.
        Ks: intrinsics, pixels; pixel centres at +0.5.
        width, height: image size, static.
        plan: capacities and options, from `gsjax.plan`. Without one the call makes its own, which needs
            concrete values: under jit or vmap, plan outside and pass it in.
        fisheye: coefficients k1 to k4 of fisheye cameras (Kannala and Brandt 2006, in OpenCV's form; zeros
            for an equidistant one). Depths are then distances from the camera, because it may see beyond 90
            degrees off its axis. Default: pinhole cameras.
        near_plane, far_plane: depths between which Gaussians are drawn (default 0.01, 1e10).
        eps2d: variance added on the image, square pixels (default 0.3).
        sh_degree: degree up to which coefficients are used, 0 to 3 (default None: colors are values).
        backgrounds: value behind everything, one row per camera, with the colours' dimension (default:
            black). One whose square is not finite also counts as black; this is not counted in `meta.culled`.
        render_mode: RGB (default), D (sum of w z), ED (D over alpha), RGB+D or RGB+ED: depth comes last.
        rasterize_mode: classic (default) or antialiased.
        features: more values [N, F], composited in the same pass into `meta.features`, without background.
            If they share a half-precision type with the colours, both keep it until they are composited.
        roi: pixels of interest. Tiles without one are not drawn and show the background.
        means2d_offset: added to the projected means; pass zeros to read their gradient.
        reads: `meta.reads` of an earlier call with a similar view. The image does not change, but tiles with
            similar numbers of reads are batched together, which is faster.
        derivative: "reverse" (default, a fast VJP) or "forward" (jvp, linearize, Gauss-Newton).
        alpha_min: fainter contributions are skipped (default 1/255).
        alpha_max: where a single contribution saturates (default 0.99).
        min_transmittance: a pixel ends before the Gaussian that would reduce its transmittance to this
            (default 1e-4).
        max_per_tile: draw at most this many Gaussians per tile, nearest first (default None: all). With a
            number the image is an approximation; `docs/choosing.md` says how good.
        tile_size: edge of a tile, pixels (default 8); 4, 8, 16 or 32. Affects speed, and the
            rounding of gradients in float32, which grows with its square.
        tiles_per_batch: tiles composited together (default: 2048 pixels, 16384 on a GPU). Affects only speed.
        sort: "host" (default) sorts with numpy where XLA runs on the CPU, "device" with XLA; affects only
            speed.

    Returns:
        (render_colors, render_alphas, meta).

    Raises:
        ValueError: a shape or an option is wrong, an option contradicts the plan, or there is no plan and
            values are traced.
    """
    plan = resolve(plan, width, height, _options(locals()))
    gaussians = (means, quats, scales, opacities, colors)
    others = (backgrounds, features, roi, means2d_offset, reads)
    views, batch = check_inputs(plan, *gaussians, viewmats, Ks, fisheye, *others)
    if plan.capacity == 0:
        plan = plan_for(views, plan, headroom=1.0)
    return _rasterize(views, plan, batch)


def plan(
    means: Float[Array | np.ndarray, "*batch n 3"],
    quats: Float[Array | np.ndarray, "*batch n 4"],
    scales: Float[Array | np.ndarray, "*batch n 3"],
    opacities: Float[Array | np.ndarray, "*batch n"],
    viewmats: Float[Array | np.ndarray, "*batch c 4 4"],
    Ks: Float[Array | np.ndarray, "*batch c 3 3"],
    width: int,
    height: int,
    *,
    headroom: float = HEADROOM,
    fisheye: Float[Array | np.ndarray, "*batch c 4"] | None = None,
    roi: Bool[Array | np.ndarray, "*batch c height width"] | None = None,
    near_plane: float = UNSET,
    far_plane: float = UNSET,
    eps2d: float = UNSET,
    sh_degree: int | None = UNSET,
    render_mode: str = UNSET,
    rasterize_mode: str = UNSET,
    derivative: str = UNSET,
    alpha_min: float = UNSET,
    alpha_max: float = UNSET,
    min_transmittance: float = UNSET,
    max_per_tile: int | None = UNSET,
    tile_size: int = UNSET,
    tiles_per_batch: int | None = UNSET,
    sort: str = UNSET,
) -> Plan:
    """A plan whose capacity is the largest need among these cameras, times `headroom`.

    Arguments as for `rasterization`. Values must be concrete: call it outside jit. With `roi` the plan is for
    calls that draw no more than this region.

    Raises:
        ValueError: a shape or an option is wrong, or values are traced.
    """
    bare = resolve(None, width, height, _options(locals()))
    bases = () if bare.sh_degree is None else (num_sh_bases(bare.sh_degree),)
    colors = np.zeros((*np.shape(means)[:-1], *bases, 1), jnp.result_type(float))
    gaussians = (means, quats, scales, opacities, colors)
    views, _ = check_inputs(bare, *gaussians, viewmats, Ks, fisheye, None, None, roi, None, None)
    return plan_for(views, bare, headroom)


def _options(arguments: dict[str, Any]) -> dict[str, Any]:
    return {name: arguments[name] for name in OPTION_NAMES if name in arguments}


def _project_all(views: Views, plan: Plan) -> Projected:
    """Every scene in each of its cameras: fields [B, C, N, ...]."""

    def one_camera(gaussians, camera):
        viewmat, K, offset, fisheye = camera
        return project_gaussians(*gaussians, viewmat, K, plan, offset, fisheye)

    scenes = jax.vmap(jax.vmap(one_camera, in_axes=(None, 0)))
    cameras = (views.viewmats, views.Ks, views.means2d_offset, views.fisheye)
    return scenes((*views[:4], usable(views)), cameras)


def _paint(views: Views, projected: Projected, plan: Plan) -> Float[Array, "b c n channels"]:
    """The values that each camera composites: colours, depth and features, as the plan requires."""
    seen = projected.visible[..., None]
    columns = []
    if "RGB" in plan.render_mode:
        colors = views.colors
        if plan.sh_degree is not None:
            means = jnp.where(seen, views.means[:, None], 0.0)
            viewmats = jnp.where(jnp.isfinite(views.viewmats), views.viewmats, 0.0)
            directions = jnp.where(seen, means - camera_centers(viewmats)[:, :, None], 0.0)
            colors = jnp.where(seen[..., None], colors, 0.0)
            colors = jnp.maximum(evaluate_sh(plan.sh_degree, colors, directions), 0.0)
        columns.append(jnp.where(seen, colors, 0.0))
    if "D" in plan.render_mode:
        columns.append(projected.depths[..., None])
    if views.features is not None:
        columns.append(jnp.where(seen, views.features[:, None], 0.0))
    same = len({c.dtype for c in columns}) == 1  # half precision is kept only if all have the same type
    dtype = columns[0].dtype if same else views.means.dtype
    return jnp.concatenate([c.astype(dtype) for c in columns], axis=-1)


class _Counts(NamedTuple):
    reads: Int[Array, "views tiles"]
    pairs: Int[Array, "views"]
    overflow: Bool[Array, "views"]
    needed: Int[Array, "views"]


@partial(jax.jit, static_argnames=("plan", "batch"))
def _rasterize(views: Views, plan: Plan, batch: tuple[int, ...]):
    shape = views.viewmats.shape[:2]
    projected = _project_all(views, plan)
    values = _paint(views, projected, plan)

    def merge(a):
        return a.reshape(math.prod(shape), *a.shape[2:])

    mask, reads = jax.tree.map(merge, (views.tile_mask, views.reads))
    image, transmittance, counts = _draw(jax.tree.map(merge, projected), merge(values), mask, reads, plan)
    alphas = 1 - untile(transmittance[:, None], plan)
    image, alphas = split_views(image, shape, plan), split_views(alphas, shape, plan)
    return _finish(image, alphas, views, projected, counts, plan, batch)


def _draw(projected: Projected, values: Float[Array, "views n channels"], mask, reads, plan: Plan):
    """Bin and composite all views at once, with the tiles of each view after those of the previous one."""
    num_views, n, channels = values.shape
    if num_views * max(n, plan.capacity + LANES) >= 2**31:
        raise ValueError(
            f"{num_views} views of {n} Gaussians and {plan.capacity} pairs each exceed 32-bit indices; "
            "draw fewer cameras or scenes at a time"
        )
    if n == 0:
        zeros = jnp.zeros(num_views, jnp.int32)
        light = jnp.ones((num_views * plan.num_tiles, plan.tile_pixels), projected.depths.dtype)
        image = untile(jnp.zeros((len(light), channels, plan.tile_pixels), light.dtype), plan)
        unread = jnp.zeros((num_views, plan.num_tiles), jnp.int32)
        return image, light, _Counts(unread, zeros, zeros > 0, zeros)

    lists, pairs, needed, overflow = _bin_views(projected, mask, plan)
    rows = (projected.means2d, projected.conics, projected.opacities, values)
    splats = Splats(*(a.reshape(num_views * n, *a.shape[2:]) for a in rows))
    reads = None if reads is None else reads.ravel()
    image, transmittance, reads = composite(splats, lists, reads, plan)
    reads = reads.reshape(num_views, plan.num_tiles)
    return image, transmittance, _Counts(reads, pairs, overflow, needed)


def _bin_views(projected: Projected, mask, plan: Plan):
    """The lists of all views, one after another, and the pairs, needed capacity and overflow of each."""
    views, n = projected.depths.shape

    def in_xla(projected, mask):
        bin_view = partial(bin_gaussians, plan=plan)
        binned = jax.vmap(bin_view, in_axes=(0, None if mask is None else 0))(projected, mask)
        view = jnp.arange(views, dtype=jnp.int32)[:, None]
        lists = Lists(
            ids=(binned.ids + view * n).ravel(),
            starts=(binned.starts + view * binned.ids.shape[1]).ravel(),
            counts=binned.counts.ravel(),
        )
        return lists, binned.pairs, binned.needed, binned.overflow

    def in_kernels(projected, mask, lanes):
        del lanes  # these kernels have one thread per Gaussian
        return fused.tile_lists(projected, mask, plan, views * slots(plan.capacity).size)

    return fused.by_platform(in_xla, in_kernels, jax.lax.stop_gradient(projected), mask)


def _finish(image, alphas, views: Views, projected: Projected, counts: _Counts, plan: Plan, batch):
    """Backgrounds, expected depth, and the caller's own batch axes."""
    shape = image.shape[:2]
    depth_channels = int("D" in plan.render_mode)
    num_colors = views.colors.shape[-1] if "RGB" in plan.render_mode else 0
    colors = image[..., :num_colors]
    if views.backgrounds is not None and num_colors:
        # As with colours: a background whose square overflows would make the gradients overflow too.
        squares = jax.lax.stop_gradient(views.backgrounds) ** 2
        backgrounds = jnp.where(jnp.isfinite(squares), views.backgrounds, 0.0)
        colors = colors + (1 - alphas) * backgrounds[:, :, None, None, :]
    depth = image[..., num_colors : num_colors + depth_channels]
    if "ED" in plan.render_mode:
        depth = depth / jnp.maximum(alphas, 1e-10)
    features = None if views.features is None else image[..., num_colors + depth_channels :]

    def outer(a):
        return a.reshape(*batch, *a.shape[2:])

    counts = jax.tree.map(lambda a: outer(a.reshape(*shape, *a.shape[1:])), counts)
    meta = Meta(
        means2d=outer(projected.means2d),
        radii=outer(jnp.ceil(jnp.minimum(projected.extents, 2.0**30)).astype(jnp.int32)),
        depths=outer(projected.depths),
        features=None if features is None else outer(features),
        reads=counts.reads,
        pairs=counts.pairs,
        culled=outer(projected.culled),
        overflow=counts.overflow,
        needed=counts.needed,
    )
    return outer(jnp.concatenate([colors, depth], axis=-1)), outer(alphas), meta
