"""`composite_tile` alone, against a plain loop over pixels and Gaussians."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.rasterize.compositing import Splats, start_tile
from gsjax.rasterize.compositing import composite_tile as one_tile
from gsjax.rasterize.plan import Limits

composite_tile = jax.jit(one_tile, static_argnames="limits")


def random_list(length: int, seed: int = 0, channels: int = 3, opaque: float = 0.3) -> Splats:
    rng = np.random.default_rng(seed)
    a, c = rng.uniform(0.05, 1.0, (2, length))
    b = rng.uniform(-0.9, 0.9, length) * np.sqrt(a * c)
    return Splats(
        means2d=jnp.asarray(rng.uniform(0, 6, (length, 2))),
        conics=jnp.asarray(np.stack([a, b, c], axis=-1)),
        opacities=jnp.asarray(rng.uniform(0, opaque, length)),
        values=jnp.asarray(rng.normal(size=(length, channels))),
    )


def grid(size: int = 6):
    return jnp.stack(jnp.meshgrid(jnp.arange(size) + 0.5, jnp.arange(size) + 0.5), -1).reshape(-1, 2)


def plain_loop(splats: Splats, pixels, alpha_max=0.99):
    """(values [channels, pixels], transmittance [pixels]) as the paper defines them."""
    means, conics, opacities, values = map(np.asarray, splats)
    images, left = np.zeros((values.shape[1], len(pixels))), np.ones(len(pixels))
    for p, (x, y) in enumerate(np.asarray(pixels)):
        for i in range(len(opacities)):
            dx, dy = x - means[i, 0], y - means[i, 1]
            a, b, c = conics[i]
            alpha = min(
                alpha_max, opacities[i] * np.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
            )
            if alpha < 1 / 255:
                continue
            if left[p] * (1 - alpha) <= 1e-4:
                break
            images[:, p] += left[p] * alpha * values[i]
            left[p] *= 1 - alpha
    return images, left


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("channels", [1, 3, 11])
@pytest.mark.parametrize("length", [0, 1, 15, 16, 17, 300])
def test_a_list_of_any_length_equals_the_plain_loop(length, channels):
    splats = random_list(length, seed=length, channels=channels)
    state = composite_tile(splats, grid())
    values, transmittance = plain_loop(splats, grid())
    np.testing.assert_allclose(state.values, values, atol=1e-12)
    np.testing.assert_allclose(state.transmittance, transmittance, atol=1e-12)


@pytest.mark.usefixtures("x64")
def test_passing_the_state_on_equals_a_single_pass():
    splats = random_list(40)
    whole = composite_tile(splats, grid())
    state = None
    for piece in (slice(0, 1), slice(1, 1), slice(1, 17), slice(17, 40)):
        state = composite_tile(Splats(*(a[piece] for a in splats)), grid(), state)
    np.testing.assert_allclose(state.values, whole.values, atol=1e-13)
    np.testing.assert_allclose(state.transmittance, whole.transmittance, atol=1e-14)


@pytest.mark.usefixtures("x64")
def test_vmapped_over_tiles_equals_a_loop():
    lists = [random_list(20, seed) for seed in range(3)]
    stacked = Splats(*(jnp.stack(a) for a in zip(*lists, strict=True)))
    together = jax.jit(jax.vmap(one_tile, in_axes=(0, None)))(stacked, grid())
    for i, splats in enumerate(lists):
        np.testing.assert_allclose(together.values[i], composite_tile(splats, grid()).values, atol=1e-14)


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
def test_it_is_differentiable_by_plain_autodiff_both_ways():
    splats = random_list(20)
    rng = np.random.default_rng(1)
    tangent = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape)), splats)

    def image(splats):
        return composite_tile(splats, grid()).values

    value, push = jax.jvp(image, (splats,), (tangent,))
    weights = jnp.asarray(rng.normal(size=value.shape))
    (pulled,) = jax.vjp(image, splats)[1](weights)
    inner = sum(jnp.vdot(a, b) for a, b in zip(pulled, tangent, strict=True))
    np.testing.assert_allclose(jnp.vdot(push, weights), inner, rtol=1e-10)


def stack_of(alphas, values=None):
    """Gaussians so wide that alpha is the same at every pixel."""
    n = len(alphas)
    values = jnp.ones((n, 1)) if values is None else values
    return Splats(jnp.zeros((n, 2)), jnp.zeros((n, 3)), jnp.asarray(alphas, jnp.float32), values)


def test_the_gaussian_that_crosses_the_early_stop_is_excluded_and_all_behind_it():
    # 0.02^2 = 4e-4 is left; 0.9 would take it to 4e-5. The faint one behind would fit, but comes too late.
    state = composite_tile(stack_of([0.98, 0.98, 0.9, 0.1]), grid())
    np.testing.assert_allclose(state.transmittance, 4e-4, rtol=1e-4)
    np.testing.assert_allclose(state.values, 1 - 4e-4, rtol=1e-6)
    np.testing.assert_array_equal(state.light < 0, True)


def test_a_contribution_under_1_in_255_is_skipped():
    below, above = 0.999 / 255, 1.001 / 255
    np.testing.assert_array_equal(composite_tile(stack_of([below]), grid()).values, 0)
    np.testing.assert_allclose(composite_tile(stack_of([above]), grid()).values, above, rtol=1e-6)


def test_a_contribution_saturates_at_alpha_max_without_gradient():
    def alpha(opacity, alpha_max):
        return composite_tile(
            stack_of(opacity[None]), grid(), limits=Limits(alpha_max=alpha_max)
        ).values.mean()

    value, slope = jax.value_and_grad(alpha)(jnp.float32(0.995), 0.99)
    assert (float(value), float(slope)) == (pytest.approx(0.99), 0.0)
    assert float(jax.grad(alpha)(jnp.float32(0.99), 0.99)) == 0.0
    value, slope = jax.value_and_grad(alpha)(jnp.float32(0.995), 0.999)
    assert (float(value), float(slope)) == (pytest.approx(0.995), pytest.approx(1.0))


def test_an_untouched_tile_is_transparent():
    state = start_tile(4, 2)
    assert state.values.shape == (2, 4)
    np.testing.assert_array_equal(state.transmittance, 1)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"values": jnp.ones(4)}, r"splats.values must have shape \(4, any\).*got \(4,\)"),
        ({"means2d": jnp.ones((3, 2))}, r"splats.means2d must have shape \(4, 2\).*got \(3, 2\)"),
        ({"conics": jnp.ones((4, 2, 2))}, r"splats.conics must have shape \(4, 3\).*got \(4, 2, 2\)"),
        ({"opacities": jnp.ones((4, 1))}, r"splats.opacities must have shape \(4,\).*got \(4, 1\)"),
    ],
)
def test_a_wrong_shape_is_named(changes, says):
    with pytest.raises(ValueError, match=says):
        composite_tile(random_list(4)._replace(**changes), grid())


def test_pixels_without_two_coordinates_are_named():
    with pytest.raises(ValueError, match=r"pixels must have shape \(any, 2\).*got \(36,\)"):
        composite_tile(random_list(4), grid()[:, 0])
