"""Wrong arguments: every message names the argument, what was found and what was expected."""

import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.rasterize.plan import Plan
from gsjax.rasterize.rasterization import plan, rasterization

pytestmark = pytest.mark.usefixtures("as_users_run")


def zeros(*shape):
    return jnp.zeros(shape)


GOOD = {
    "means": zeros(5, 3),
    "quats": zeros(5, 4),
    "scales": zeros(5, 3),
    "opacities": zeros(5),
    "colors": zeros(5, 3),
    "viewmats": zeros(2, 4, 4),
    "Ks": zeros(2, 3, 3),
}


def call(**changes):
    return rasterization(**GOOD | changes, width=20, height=10, plan=Plan(20, 10, 4096))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"means": zeros(5, 2)}, r"means must have shape \(..., N, 3\); got \(5, 2\)"),
        ({"means": zeros(3)}, r"means must have shape \(..., N, 3\); got \(3,\)"),
        ({"fisheye": zeros(4)}, r"fisheye must have shape \(2, 4\), k1 to k4.*got \(4,\)"),
        ({"quats": zeros(5, 3)}, r"quats must have shape \(5, 4\).*got \(5, 3\)"),
        ({"scales": zeros(4, 3)}, r"scales must have shape \(5, 3\).*N = 5 as in means; got \(4, 3\)"),
        ({"opacities": zeros(5, 1)}, r"opacities must have shape \(5,\).*got \(5, 1\)"),
        (
            {"colors": zeros(4, 3)},
            r"colors must have shape \(5, any\), values \[N, D\].*take sh_degree.*got \(4, 3\)",
        ),
        ({"colors": zeros(3, 5, 3)}, r"colors must have shape \(2, 5, any\).*got \(3, 5, 3\)"),
        ({"viewmats": zeros(4, 4)}, r"viewmats must have shape \(C, 4, 4\); got \(4, 4\).*viewmats\[None\]"),
        ({"viewmats": zeros(2, 3, 4)}, r"viewmats must have shape \(2, 4, 4\).*got \(2, 3, 4\)"),
        ({"viewmats": zeros(0, 4, 4), "Ks": zeros(0, 3, 3)}, r"viewmats must hold at least one camera"),
        (
            {"Ks": zeros(1, 3, 3)},
            r"Ks must have shape \(2, 3, 3\), one for each.*Ks\[None\].*got \(1, 3, 3\)",
        ),
        ({"backgrounds": zeros(3)}, r"backgrounds must have shape \(2, 3\).*got \(3,\)"),
        ({"features": zeros(4, 7)}, r"features must have shape \(5, any\).*got \(4, 7\)"),
        ({"roi": jnp.ones((10, 20), bool)}, r"roi must have shape \(2, 10, 20\).*roi\[None\]; got"),
        ({"roi": zeros(2, 10, 20)}, r"roi must hold booleans.*got float32"),
        ({"roi": [[[True] * 20] * 10] * 2}, r"roi must be an array; got list"),
        ({"colors": zeros(5, 0)}, r"colors must have at least one channel in render_mode 'RGB'; got 0"),
        ({"reads": zeros(2, 6)}, r"reads must hold integers, as meta.reads does; got float32"),
        ({"means2d_offset": zeros(5, 2)}, r"means2d_offset must have shape \(2, 5, 2\).*got \(5, 2\)"),
        ({"means": [[0.0] * 3] * 5}, "means must be an array; got list"),
        ({"means": jnp.zeros((5, 3), int)}, "means must hold floats; got int32"),
        ({"features": [[0.0] * 7] * 5}, "features must be an array; got list"),
        ({"backgrounds": jnp.zeros((2, 3), int)}, "backgrounds must hold floats; got int32"),
    ],
)
def test_a_wrong_shape_is_named(changes, says):
    with pytest.raises(ValueError, match=says):
        call(**changes)


def test_a_plan_of_another_type_is_named():
    with pytest.raises(ValueError, match=r"plan must be a gsjax.Plan, from gsjax.plan\(...\); got dict"):
        rasterization(**GOOD, width=20, height=10, plan={})


@pytest.mark.parametrize(("degree", "shape"), [(1, (5, 3, 3)), (3, (5, 9, 3))])
def test_too_few_harmonics_are_counted(degree, shape):
    with pytest.raises(ValueError, match=rf"{shape[1]} SH coefficients; sh_degree={degree} reads"):
        rasterization(**GOOD | {"colors": zeros(*shape)}, width=20, height=10, sh_degree=degree)


def test_values_where_harmonics_are_due_are_refused():
    with pytest.raises(ValueError, match=r"SH coefficients .* since sh_degree is given"):
        rasterization(**GOOD, width=20, height=10, sh_degree=0)


def test_plan_answers_like_the_call():
    arrays = {k: v for k, v in GOOD.items() if k != "colors"}
    with pytest.raises(ValueError, match=r"quats must have shape"):
        plan(**arrays | {"quats": zeros(5, 3)}, width=20, height=10)
    with pytest.raises(ValueError, match="means must be an array; got list"):
        plan(**arrays | {"means": [[0.0] * 3] * 5}, width=20, height=10)


def test_more_views_than_indices_reach_are_refused():
    with pytest.raises(
        ValueError, match=r"2 views of 5 Gaussians and 1073741824 pairs each exceed 32-bit indices"
    ):
        rasterization(**GOOD, width=20, height=10, plan=Plan(20, 10, 2**30))


@pytest.mark.thorough
def test_numpy_arrays_and_half_precision_are_drawn_in_float32():
    arrays = {k: np.asarray(v, np.float16) for k, v in GOOD.items()}
    colors, alphas, _ = rasterization(**arrays, width=20, height=10, plan=Plan(20, 10, 4096))
    assert (colors.dtype, colors.shape) == (jnp.float32, (2, 10, 20, 3))
    assert alphas.shape == (2, 10, 20, 1)
