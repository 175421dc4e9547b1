"""The cost of low precision: far from the origin in float32, and for colours in half precision.

Figures: docs/numerics.md.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.scenes import relative_error
from tests.rasterize.front import TRAINED, cotangent, drawn, plan_for, scene_before


def far_away(distance: float):
    """(pixel error, image error) of float32 with camera and scene `distance` metres from the origin."""
    scene = {k: np.float64(v) for k, v in scene_before().items()}
    offset = distance * np.array([0.6, 0.48, 0.64])
    scene["means"] = scene["means"] + offset
    scene["viewmats"][0, :3, 3] -= offset
    with jax.enable_x64(True):
        want, _, exact = jax.tree.map(np.asarray, drawn(scene, np.float64(cotangent()), plan_for()))
    rounded = {k: np.float32(v) for k, v in scene.items()}
    got, gradient, meta = drawn(rounded, cotangent(), plan_for())
    assert all(np.isfinite(gradient[key]).all() for key in TRAINED)
    assert np.isfinite(got).all()
    # Only the colours: the expected depth jumps from 0 to metres at the edge of a footprint.
    return float(np.abs(meta.means2d - exact.means2d).max()), relative_error(got[..., :3], want[..., :3])


# float32 has a relative precision of 6e-8: half a millimetre at 1e4 m, which here is 0.003 pixels.
@pytest.mark.thorough
@pytest.mark.parametrize(("distance", "pixels"), [(1.0, 1e-4), (1e2, 1e-3), (1e4, 0.1), (1e6, 10.0)])
def test_the_error_in_pixels_grows_with_the_distance_from_the_origin(distance, pixels):
    error, _ = far_away(distance)
    assert pixels / 1e3 < error < pixels


def half_precision(dtype, scene, this):
    """Errors of (image, colours' gradient, other gradients) with `dtype` colours, relative to the maximum."""
    weights = cotangent(this.width, this.height)
    halved = scene | {"colors": jnp.asarray(scene["colors"], dtype)}
    want, slope, _ = drawn(scene, weights, this)
    got, gradient, _ = drawn(halved, weights, this)
    assert gradient["colors"].dtype == dtype
    others = max(relative_error(gradient[k], slope[k]) for k in TRAINED if k != "colors")
    return relative_error(got, want), relative_error(gradient["colors"], slope["colors"]), others


# Half the spacing of values: 2^-9 for bfloat16, 2^-12 for float16.
@pytest.mark.thorough
@pytest.mark.parametrize(
    ("dtype", "spacing"), [(jnp.bfloat16, 2**-9), pytest.param(jnp.float16, 2**-12, marks=pytest.mark.slow)]
)
def test_colours_in_half_precision_cost_their_own_rounding_and_no_more(dtype, spacing):
    scene, this = scene_before(64, 48, num=300), dataclasses.replace(plan_for(64, 48, 300), render_mode="RGB")
    image, painted, others = half_precision(dtype, scene, this)
    assert spacing / 100 < image <= spacing
    assert painted <= 1.2 * spacing  # their gradient is rounded once more
    assert others <= 4 * spacing


@pytest.mark.thorough
@pytest.mark.parametrize("dtype", [jnp.bfloat16, pytest.param(jnp.float16, marks=pytest.mark.slow)])
def test_half_precision_is_composited_in_float32(dtype):
    scene, this = scene_before(64, 48, num=300), dataclasses.replace(plan_for(64, 48, 300), render_mode="RGB")
    halved = scene | {"colors": jnp.asarray(scene["colors"], dtype)}
    rounded = scene | {"colors": halved["colors"].astype(jnp.float32)}
    got, gradient, _ = drawn(halved, cotangent(64, 48), this)
    want, slope, _ = drawn(rounded, cotangent(64, 48), this)
    assert got.dtype == jnp.float32
    np.testing.assert_allclose(got, want, atol=1e-5)  # half precision would be 1e-3 off
    for key in set(TRAINED) - {"colors"}:
        assert relative_error(gradient[key], slope[key]) < 1e-5
    np.testing.assert_array_equal(gradient["colors"], slope["colors"].astype(dtype))
