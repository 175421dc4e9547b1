"""Checks of the rasterizer's arguments, with errors that name them, and their conversion to one layout."""

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from gsjax.geometry.spherical_harmonics import num_sh_bases
from gsjax.rasterize.plan import Plan
from gsjax.rasterize.views import Views


def is_concrete(tree: Any) -> bool:
    """Whether every array holds concrete values, as opposed to traced ones."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def _expect(name: str, array, want: tuple, meaning: str) -> None:
    shape = jnp.shape(array)
    fits = len(shape) == len(want) and all(w is None or s == w for s, w in zip(shape, want, strict=True))
    if not fits:
        wanted = str(tuple("any" if w is None else w for w in want)).replace("'", "")
        raise ValueError(f"{name} must have shape {wanted}, {meaning}; got {tuple(shape)}")


def check_tile(means2d, conics, opacities, values, pixels) -> None:
    """Raises a ValueError that names the argument of `gsjax.composite_tile` whose shape is wrong.

    Args:
        means2d, conics, opacities, values: the fields of its `Splats`, [L, ...].
        pixels: positions [P, 2].
    """
    length = len(values) if jnp.ndim(values) else None
    _expect("splats.values", values, (length, None), "a row per Gaussian")
    _expect("splats.means2d", means2d, (length, 2), "the centre of each Gaussian")
    _expect("splats.conics", conics, (length, 3), "xx, xy, yy of each Gaussian")
    _expect("splats.opacities", opacities, (length,), "one per Gaussian")
    _expect("pixels", pixels, (None, 2), "the position of each pixel")


def check_inputs(
    plan: Plan,
    means,
    quats,
    scales,
    opacities,
    colors,
    viewmats,
    Ks,
    fisheye,
    backgrounds,
    features,
    roi,
    means2d_offset,
    reads,
) -> tuple[Views, tuple[int, ...]]:
    """All arguments with leading axes flattened to [scenes, cameras, ...], and those leading axes.

    Arguments as for `gsjax.rasterization`, under a resolved plan. Half precision is computed in float32;
    colours and features (not SH coefficients) are stored as they are.

    Raises:
        ValueError: names the argument, the shape found and the shape expected.
    """
    arrays = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}
    arrays |= {"viewmats": viewmats, "Ks": Ks}
    more = {"fisheye": fisheye, "backgrounds": backgrounds, "features": features}
    more |= {"means2d_offset": means2d_offset}
    arrays |= {name: array for name, array in more.items() if array is not None}
    for name, array in {**arrays, "roi": roi, "reads": reads}.items():
        if array is not None and not hasattr(array, "dtype"):
            raise ValueError(f"{name} must be an array; got {type(array).__name__}")
    for name, array in arrays.items():
        if not jnp.issubdtype(array.dtype, jnp.floating):
            raise ValueError(f"{name} must hold floats; got {array.dtype}")
    if means.ndim < 2 or means.shape[-1] != 3:
        raise ValueError(f"means must have shape (..., N, 3); got {tuple(means.shape)}")
    *lead, n, _ = means.shape
    lead = tuple(lead)
    lead_words = f"leading axes {lead} and N = {n} as in means"
    _expect("quats", quats, (*lead, n, 4), lead_words)
    _expect("scales", scales, (*lead, n, 3), lead_words)
    _expect("opacities", opacities, (*lead, n), lead_words)
    if viewmats.ndim != len(lead) + 3:
        wanted = ", ".join(map(str, (*lead, "C", 4, 4)))
        raise ValueError(
            f"viewmats must have shape ({wanted}); got {tuple(viewmats.shape)}; one camera: viewmats[None]"
        )
    num_cameras = viewmats.shape[-3]
    _expect("viewmats", viewmats, (*lead, num_cameras, 4, 4), "leading axes as in means")
    _expect("Ks", Ks, (*lead, num_cameras, 3, 3), "one for each of viewmats; one camera: Ks[None]")
    if 0 in (*lead, num_cameras):
        raise ValueError(f"viewmats must hold at least one camera of one scene; got {tuple(viewmats.shape)}")
    colors_shape = _check_colors(colors, plan, lead, num_cameras, n)

    dtype, channels = jnp.result_type(*arrays.values(), jnp.float32), colors.shape[-1]
    shapes, kinds = {}, {}

    def lay_out(name, *inner, kind=dtype):
        shapes[name], kinds[name] = (math.prod(lead), *inner), jnp.dtype(kind)

    def stored(array):
        return array.dtype if array.dtype in (jnp.bfloat16, jnp.float16) else dtype

    if fisheye is not None:
        wanted = (*lead, num_cameras, 4)
        _expect("fisheye", fisheye, wanted, "k1 to k4 of each of viewmats; one camera: fisheye[None]")
        lay_out("fisheye", num_cameras, 4)
    if backgrounds is not None:
        wanted = (*lead, num_cameras, channels)
        _expect("backgrounds", backgrounds, wanted, "one row per camera, as wide as colors")
        lay_out("backgrounds", num_cameras, channels)
    if features is not None:
        _expect("features", features, (*lead, n, None), lead_words)
        lay_out("features", *features.shape[-2:], kind=stored(features))
    if means2d_offset is not None:
        wanted = (*lead, num_cameras, n, 2)
        _expect("means2d_offset", means2d_offset, wanted, "a pixel offset per camera and Gaussian")
        lay_out("means2d_offset", num_cameras, n, 2)
    if roi is not None:
        inner = (num_cameras, plan.height, plan.width)
        _expect("roi", roi, (*lead, *inner), "a pixel mask per camera; one camera: roi[None]")
        if roi.dtype != bool:
            raise ValueError(f"roi must hold booleans, True where a pixel is wanted; got {roi.dtype}")
        lay_out("roi", *inner, kind=bool)
    if reads is not None:
        wanted = (*lead, num_cameras, plan.num_tiles)
        _expect("reads", reads, wanted, "meta.reads of a call under the same plan")
        if not jnp.issubdtype(jnp.result_type(reads), jnp.integer):
            raise ValueError(f"reads must hold integers, as meta.reads does; got {reads.dtype}")
        lay_out("reads", num_cameras, plan.num_tiles, kind=jnp.int32)
    lay_out("means", n, 3)
    lay_out("quats", n, 4)
    lay_out("scales", n, 3)
    lay_out("opacities", n)
    lay_out("colors", *colors_shape[len(lead) :], kind=stored(colors) if plan.sh_degree is None else dtype)
    lay_out("viewmats", num_cameras, 4, 4)
    lay_out("Ks", num_cameras, 3, 3)
    given = {
        name: array for name, array in {**arrays, "roi": roi, "reads": reads}.items() if array is not None
    }
    views = _laid_out(given, tuple(shapes.items()), tuple(kinds.items()), plan.tile_size)
    return views, (*lead, num_cameras)


@partial(jax.jit, static_argnums=(1, 2, 3), inline=True)
def _laid_out(arrays: dict[str, Any], shapes: tuple, kinds: tuple, edge: int) -> Views:
    """The arrays in their shapes and types, by one program; the pixels of interest as tiles."""
    types = dict(kinds)
    laid_out = {name: arrays[name].astype(types[name]).reshape(shape) for name, shape in shapes}
    if "roi" in laid_out:
        laid_out["tile_mask"] = _tiles_with_a_pixel(laid_out["roi"], edge)
    return Views(*(laid_out.get(name) for name in Views._fields))


def _check_colors(colors, plan: Plan, lead: tuple[int, ...], num_cameras: int, n: int) -> tuple[int, ...]:
    """The shape of colours as [*lead, 1 or C, N, ...]."""
    inner = 1 if plan.sh_degree is None else 2
    per_camera = colors.ndim == len(lead) + 2 + inner
    bases = () if plan.sh_degree is None else (None,)
    cameras = (num_cameras,) if per_camera else ()
    meaning = "values [N, D] (SH coefficients [N, K, D] take sh_degree)"
    if plan.sh_degree is not None:
        meaning = "SH coefficients [N, K, D] since sh_degree is given"
    _expect("colors", colors, (*lead, *cameras, n, *bases, None), meaning)
    if plan.sh_degree is not None and colors.shape[-2] < num_sh_bases(plan.sh_degree):
        raise ValueError(
            f"colors holds {colors.shape[-2]} SH coefficients; sh_degree={plan.sh_degree} "
            f"reads {num_sh_bases(plan.sh_degree)}"
        )
    if colors.shape[-1] == 0 and "RGB" in plan.render_mode:
        raise ValueError(f"colors must have at least one channel in render_mode {plan.render_mode!r}; got 0")
    return colors.shape if per_camera else (*lead, 1, *colors.shape[len(lead) :])


def _tiles_with_a_pixel(roi, edge: int):
    scenes, cameras, height, width = roi.shape
    padded = jnp.pad(roi, ((0, 0), (0, 0), (0, -height % edge), (0, -width % edge)))
    tiles = padded.reshape(scenes, cameras, padded.shape[2] // edge, edge, padded.shape[3] // edge, edge)
    return tiles.any(axis=(3, 5)).reshape(scenes, cameras, -1)
