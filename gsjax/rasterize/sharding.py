"""Rasterization over a mesh of devices: each device draws its own cameras or scenes; Gaussians are shared.

The image of a camera depends only on that camera and its scene, so drawing needs no communication. Only the
backward pass does: a Gaussian drawn by several devices receives the sum of their gradients.
"""

import functools
import inspect
import math
from collections.abc import Callable
from typing import Any

import jax
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from gsjax.rasterize.capacity import plan_for
from gsjax.rasterize.checks import check_inputs
from gsjax.rasterize.plan import OPTION_NAMES, UNSET, Plan, resolve
from gsjax.rasterize.rasterization import rasterization

AxisNames = str | tuple[str, ...]

_PER_SCENE = ("means", "quats", "scales", "opacities", "features")
_PER_CAMERA = ("viewmats", "Ks", "fisheye", "backgrounds", "roi", "means2d_offset", "reads")
_ARRAYS = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "fisheye")
_ARRAYS += ("backgrounds", "features", "roi", "means2d_offset", "reads")  # in the order of `check_inputs`
_SIGNATURE = inspect.signature(rasterization)


def sharded_rasterization(
    mesh: Mesh, *, cameras: AxisNames | None = None, scenes: AxisNames | None = None
) -> Callable:
    """`gsjax.rasterization` over a mesh: the same arguments, options, results and derivatives.

    Cameras (axis C of viewmats, Ks, fisheye, backgrounds, roi, means2d_offset, reads, and of colors that have
    one) are split over the mesh axis `cameras`, scenes (the first leading axis of all arrays) over `scenes`.
    Gaussians are replicated on every device of their scene, and their gradients are summed over `cameras`.
    Images and every field of `meta` are split in the same way. Mesh axes named in neither repeat the work.

    Args:
        mesh: mesh of devices, from `jax.make_mesh`; with `jax.distributed`, of the devices of all processes.
        cameras: the mesh axis, or a tuple of axes, over which to split cameras; None does not split them.
        scenes: the same for scenes, which then need a leading axis.

    Returns:
        A function with the arguments of `gsjax.rasterization`. It can be called under jit, grad (a reverse
        plan) and jvp (a forward plan). As usual, a plan must fit the camera with the largest need.

    Raises:
        ValueError: an axis is not in the mesh, or both are the same, or neither is given. When called: as
            `gsjax.rasterization`, and if cameras or scenes do not divide evenly over their axis.
    """
    cameras, scenes = _names("cameras", cameras, mesh), _names("scenes", scenes, mesh)
    if not cameras and not scenes:
        raise ValueError("name the mesh axis to split over: cameras=..., scenes=..., or both")
    if shared := set(cameras) & set(scenes):
        raise ValueError(f"cameras and scenes cannot both be split over mesh axis {shared.pop()!r}")

    @functools.wraps(rasterization)
    def draw(*args, **kwargs):
        given = _SIGNATURE.bind(*args, **kwargs).arguments
        arrays = {name: given[name] for name in _ARRAYS if given.get(name) is not None}
        options = {name: given[name] for name in OPTION_NAMES if given.get(name, UNSET) is not UNSET}
        width, height, plan = given["width"], given["height"], given.get("plan")
        plan = resolve(plan, width, height, options)
        # Shapes only, and those of the whole arrays: a message about one device's shard would be confusing.
        shapes = {name: _shape_of(array) for name, array in arrays.items()}
        jax.eval_shape(functools.partial(check_inputs, plan), *map(shapes.get, _ARRAYS))
        _check_divides(arrays, mesh, cameras, scenes)
        if plan.capacity == 0:
            views, _ = check_inputs(plan, *(_placed(arrays.get(name), mesh, P()) for name in _ARRAYS))
            plan = plan_for(views, plan, headroom=1.0)
        return _draw(arrays, mesh, cameras, scenes, plan)

    return draw


def _shape_of(array):
    """Shape and type for the checks, without sharding: their reshapes do not support an explicit one."""
    return jax.ShapeDtypeStruct(array.shape, array.dtype) if hasattr(array, "dtype") else array


def _placed(array, mesh: Mesh, spec: P):
    """The array sharded as in `spec` if the mesh has explicit axes; otherwise XLA takes care of it."""
    if array is None or AxisType.Explicit not in mesh.axis_types:
        return array
    return jax.reshard(array, NamedSharding(mesh, spec))


def _names(what: str, axes: AxisNames | None, mesh: Mesh) -> tuple[str, ...]:
    names = () if axes is None else (axes,) if isinstance(axes, str) else tuple(axes)
    for name in names:
        if name not in mesh.axis_names:
            raise ValueError(f"{what}={name!r} is not an axis of the mesh, which has {mesh.axis_names}")
    return names


def _check_divides(arrays: dict[str, Any], mesh: Mesh, cameras, scenes) -> None:
    means, viewmats = arrays["means"], arrays["viewmats"]
    _check_even("viewmats", "cameras", viewmats.shape[-3], mesh, cameras)
    if scenes and means.ndim == 2:
        raise ValueError(
            f"means has no leading axis to split over mesh axis {_quoted(scenes)}; got shape {means.shape}, "
            "wanted (B, N, 3). To split one scene by its cameras, pass cameras=... instead of scenes=..."
        )
    _check_even("means", "scenes", means.shape[0], mesh, scenes)


def _check_even(argument: str, things: str, count: int, mesh: Mesh, axes: tuple[str, ...]) -> None:
    parts = math.prod(mesh.shape[name] for name in axes)  # 1 if they are not split
    if count % parts:
        raise ValueError(
            f"{argument} holds {count} {things}, which do not divide evenly over the {parts} devices of mesh "
            f"axis {_quoted(axes)}. Use a mesh whose axis divides {count}; or repeat one of the {things} in "
            f"every argument until there are {-(-count // parts) * parts}, and leave copies out of the loss"
        )


def _quoted(names: tuple[str, ...]) -> str:
    return " x ".join(map(repr, names))


def _specs(arrays: dict[str, Any], plan: Plan, cameras, scenes) -> tuple[dict[str, P], P]:
    """Partition specs of each argument, and of all results."""
    lead = arrays["means"].ndim - 2
    per_scene = P(*((scenes or None), *(None,) * (lead - 1))) if lead else P()
    per_camera = P(*per_scene, cameras or None)
    specs = dict.fromkeys(_PER_SCENE, per_scene) | dict.fromkeys(_PER_CAMERA, per_camera)
    shared_colors = arrays["colors"].ndim == lead + (2 if plan.sh_degree is None else 3)
    specs["colors"] = per_scene if shared_colors else per_camera
    return {name: specs[name] for name in arrays}, per_camera


@functools.partial(jax.jit, static_argnames=("mesh", "cameras", "scenes", "plan"))
def _draw(arrays: dict[str, Any], mesh: Mesh, cameras, scenes, plan: Plan):
    specs, per_camera = _specs(arrays, plan, cameras, scenes)

    def own_part(arrays):
        return rasterization(**arrays, width=plan.width, height=plan.height, plan=plan)

    # Inner loops start from constants, which are replicated, and end with varying values; the check of
    # varying axes rejects that. Without the check, gradients of shared inputs are still summed.
    split = jax.shard_map(own_part, mesh=mesh, in_specs=(specs,), out_specs=per_camera, check_vma=False)
    return split({name: _placed(array, mesh, specs[name]) for name, array in arrays.items()})
