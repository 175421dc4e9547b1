"""What makes programs faster on the host changes none of what they give."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.optim.compiler import in_memory


def read(image, x, finite):
    """The sum of the two pixels around each place."""
    pixel = jnp.floor(x).astype(jnp.int32)
    pixel = pixel if finite is None else in_memory(pixel, finite)
    return image[pixel] + image[pixel + 1]


def test_what_is_written_to_memory_is_the_same_mapped_and_differentiated():
    image, finite = jax.random.normal(jax.random.key(0), (50, 4)), jnp.ones(1)
    x = jax.random.uniform(jax.random.key(1), (3, 20), maxval=48.0)
    mapped = jax.jit(jax.vmap(read, in_axes=(None, 0, None)))
    np.testing.assert_array_equal(mapped(image, x, finite), jnp.stack([read(image, row, None) for row in x]))
    slopes = [jax.grad(lambda a, by=by: (read(a, x[0], by) ** 2).sum())(image) for by in (finite, None)]
    np.testing.assert_allclose(*slopes, rtol=1e-6)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="elsewhere it is nothing")
def test_the_compiler_keeps_the_branch():
    """It would drop jax.lax.optimization_barrier. The flag is of no axis that is mapped over."""
    image, x = jnp.ones((50, 4)), jnp.ones((3, 20))
    mapped = jax.jit(jax.vmap(read, in_axes=(None, 0, None)))
    assert " conditional(" in mapped.lower(image, x, jnp.ones(1)).compile().as_text()


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="elsewhere it is nothing")
def test_what_is_not_finite_after_all_is_not_hidden():
    costs, pixels = in_memory((jnp.ones(3), jnp.arange(3)), jnp.array([jnp.nan, 1.0]))
    assert jnp.isnan(costs).all()
    np.testing.assert_array_equal(pixels, 0)
