"""Options that make programs faster on the host do not change their results."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.optim.compiler import forget_programs, in_memory


def read(image, x, finite):
    """The sum of the two pixels around each position."""
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


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="does nothing on other platforms")
def test_the_compiler_keeps_the_branch():
    """It would drop jax.lax.optimization_barrier. The flag is not mapped, so vmap keeps the branch."""
    image, x = jnp.ones((50, 4)), jnp.ones((3, 20))
    mapped = jax.jit(jax.vmap(read, in_axes=(None, 0, None)))
    assert " conditional(" in mapped.lower(image, x, jnp.ones(1)).compile().as_text()


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="does nothing on other platforms")
def test_a_flag_that_is_not_finite_is_not_hidden():
    costs, pixels = in_memory((jnp.ones(3), jnp.arange(3)), jnp.array([jnp.nan, 1.0]))
    assert jnp.isnan(costs).all()
    np.testing.assert_array_equal(pixels, 0)


PROGRAM = """
import sys, jax
from gsjax import keep_programs
place = keep_programs(sys.argv[1])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.jit(lambda x: x @ x + 1)(jax.numpy.ones((3, 3)))
print(place)
"""


@pytest.mark.thorough
def test_programs_are_cached_unless_jax_is_already_configured(tmp_path):
    """In separate processes, because JAX is configured once per process."""

    def run_program(place, **given):
        others = {k: v for k, v in os.environ.items() if "COMPILATION_CACHE" not in k}
        command = [sys.executable, "-c", PROGRAM, str(place)]
        return subprocess.run(command, env=others | given, check=True, capture_output=True, text=True)

    kept = run_program(tmp_path / "cache").stdout.strip()
    assert kept.startswith(str(tmp_path / "cache" / f"programs-jax-{jax.__version__}-"))
    assert list((tmp_path / "cache").glob("*/*-cache"))
    own = run_program(tmp_path / "no", JAX_COMPILATION_CACHE_DIR=str(tmp_path / "own"))
    assert own.stdout.strip() == "None"
    assert run_program(tmp_path / "no", JAX_ENABLE_COMPILATION_CACHE="0").stdout.strip() == "None"
    for mark in (tmp_path / "cache").glob("*/*-atime"):
        mark.unlink()  # as after a kill or on a full disk
    run_program(tmp_path / "cache")
    assert list((tmp_path / "cache").glob("*/*-atime"))
    (tmp_path / "file").touch()
    assert run_program(tmp_path / "file").stdout.strip() == "None"
    assert not (tmp_path / "no").exists()


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="needs Linux's /proc")
def test_programs_are_dropped_only_if_there_are_too_many():
    twice = jax.jit(lambda x: 2 * x)
    twice(1.0)
    assert not forget_programs(10**9)
    assert twice._cache_size() == 1
    assert forget_programs(0)
    assert twice._cache_size() == 0
    assert twice(2.0) == 4
