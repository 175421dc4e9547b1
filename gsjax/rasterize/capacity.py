"""The capacity that a plan needs for given inputs, found by projecting them."""

from functools import partial

import jax
import numpy as np

from gsjax.rasterize.binning import needed_capacity
from gsjax.rasterize.checks import is_concrete
from gsjax.rasterize.plan import Plan
from gsjax.rasterize.projection import project_gaussians
from gsjax.rasterize.views import Views, usable


def plan_for(views: Views, bare: Plan, headroom: float) -> Plan:
    """`bare` with a capacity for these checked inputs, times `headroom`.

    Args:
        views: inputs as returned by `check_inputs`.
        bare: a plan with the options.
        headroom: 1 or more.

    Raises:
        ValueError: values are traced, or `headroom` is below 1.
    """
    values = jax.lax.stop_gradient(views)
    if not is_concrete(values):
        raise ValueError(
            "planning looks at values, and these are traced (jit, vmap or scan). Call plan = "
            "gsjax.plan(means, quats, scales, opacities, viewmats, Ks, width, height, ...) outside, with "
            "typical values, and pass plan=plan inside; meta.overflow reports if it becomes too small"
        )
    if values.means.shape[1] == 0:
        return bare.grown(0, headroom)
    return bare.grown(_needed(jax.tree.map(np.asarray, values), bare), headroom)


_LEAST_COUNTED = 2**14  # Gaussians


def _needed(views: Views, plan: Plan) -> int:
    """The largest capacity that a view needs. Scenes are padded to a power of two and views counted one by
    one, so that many scenes share one compiled program."""
    size = max(_LEAST_COUNTED, 1 << (views.means.shape[1] - 1).bit_length())
    counting = Plan(plan.width, plan.height, 0, **{name: getattr(plan, name) for name in _COUNTING})

    def padded(a, axis):
        return np.pad(a, [(0, (size - a.shape[axis]) if i == axis else 0) for i in range(a.ndim)])

    with np.errstate(over="ignore", invalid="ignore"):
        scenes = (*views[:4], usable(views))
    scenes, needs = [padded(a, 1) for a in scenes], []
    for b, c in np.ndindex(views.viewmats.shape[:2]):
        per_view = (views.viewmats, views.Ks, views.fisheye, views.means2d_offset, views.tile_mask)
        viewmat, K, fisheye, offset, mask = (None if a is None else a[b, c] for a in per_view)
        offset = None if offset is None else padded(offset, 0)
        needs.append(_needed_in(*(a[b] for a in scenes), viewmat, K, fisheye, offset, mask, plan=counting))
    return max(map(int, needs), default=0)


_COUNTING = ("near_plane", "far_plane", "eps2d", "rasterize_mode", "alpha_min", "tile_size", "sort")
"""Options that a capacity depends on."""


@partial(jax.jit, static_argnames="plan")
def _needed_in(means, quats, scales, opacities, usable, viewmat, K, fisheye, offset, mask, plan: Plan):
    gaussians = (means, quats, scales, opacities, usable)
    projected = project_gaussians(*gaussians, viewmat, K, plan, offset, fisheye)
    return needed_capacity(projected, mask, plan)
