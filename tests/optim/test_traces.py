"""Traces on disk: they are read back unchanged, told apart, and not used where they cannot be kept."""

from dataclasses import dataclass, field
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.io import checkpoints
from gsjax.optim import traces
from gsjax.optim.compiler import TRACES
from gsjax.optim.traces import jit_once
from gsjax.rasterize.plan import Plan
from gsjax.rasterize.sorting import argsort_keys


class Ball(eqx.Module):
    center: jax.Array
    names: tuple[str, ...] = eqx.field(static=True)


class Found(NamedTuple):
    ball: Ball
    nothing: None
    count: jax.Array


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The folder of traces during a test, in which functions and types of this module are kept too."""
    monkeypatch.setattr(traces, "_PACKAGE", __name__.split(".")[0])
    libraries = (*checkpoints._LIBRARIES, __name__.split(".")[0])
    monkeypatch.setattr(checkpoints, "_LIBRARIES", libraries)
    before = jax.config.jax_compilation_cache_dir
    (tmp_path / TRACES).mkdir()
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path / TRACES
    jax.config.update("jax_compilation_cache_dir", before)


class Counted:
    """Defines a function anew, as another process would, and counts how often it is traced."""

    def __init__(self):
        self.traced = 0

    def jitted(self, factor=2.0, **options):
        def moved(ball, step, key):
            self.traced += 1
            center = ball.center * factor + jax.random.normal(key, ball.center.shape)
            return Found(Ball(center, ball.names), None, step + 1)

        return jit_once(moved, factor, **options)


BALL = (Ball(jnp.arange(3.0), ("red", "round")), np.int32(4), jax.random.key(1))


def test_what_is_read_back_gives_the_same_tree_and_the_same_bits(folder):
    count = Counted()
    first = count.jitted()(*BALL)
    again = count.jitted()(*BALL)
    assert count.traced == 1
    assert jax.tree.structure(first) == jax.tree.structure(again)
    assert again.ball.names == ("red", "round")
    assert all(
        np.array_equal(a, b) for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True)
    )


def test_results_can_be_arguments_without_another_program(folder):
    advance = Counted().jitted(donate_argnums=0)
    ball, step, key = BALL
    for _ in range(3):
        found = advance(jax.tree.map(jnp.copy, ball), step, key)
        ball, step = found.ball, found.count
    assert int(step) == 7
    assert advance._cache_size() <= 2
    assert len(list(folder.glob("*.npz"))) == 1


@pytest.mark.parametrize(
    "other",
    [
        lambda count: count.jitted(3.0)(*BALL),
        lambda count: count.jitted()(Ball(jnp.arange(4.0), ("red", "round")), *BALL[1:]),
        lambda count: count.jitted()(Ball(jnp.arange(3.0), ("red", "square")), *BALL[1:]),
        lambda count: count.jitted()(BALL[0], np.float32(4), BALL[2]),
    ],
    ids=["what is closed over", "a shape", "a static field", "a type"],
)
def test_a_trace_serves_only_its_own_inputs(folder, other):
    count = Counted()
    count.jitted()(*BALL)
    other(count)
    assert count.traced == 2
    assert len(list(folder.glob("*.npz"))) == 2


def test_plans_are_told_apart(folder):
    def slots(plan, x):
        return x + plan.capacity

    jitted = jit_once(slots, None)
    small, large = (Plan(width=16, height=16, capacity=capacity) for capacity in (1024, 2048))
    assert float(jitted(small, 1.0)) == 1025
    assert float(jit_once(slots, None)(large, 1.0)) == 2049


@dataclass(frozen=True)
class Weights:
    """A configuration with a field that its repr leaves out."""

    first: float = 1.0
    second: float = field(default=1.0, repr=False)


def test_configurations_are_told_apart_by_every_field(folder):
    count = Counted()
    for weights in (Weights(), Weights(second=2.0), Weights(2.0), Weights()):
        weighted(count, weights)(1.0)
    assert count.traced == 3


def weighted(count, weights):
    def product(x):
        count.traced += 1
        return x * weights.first * weights.second

    return jit_once(product, weights)


def test_what_others_define_is_not_kept_as_its_sources_are_unknown(folder, monkeypatch):
    monkeypatch.setattr(traces, "_PACKAGE", "gsjax")
    count = Counted()
    for _ in range(2):
        weighted(count, Weights())(1.0)
    assert count.traced == 2
    assert not list(folder.iterdir())


def test_nothing_is_kept_of_sources_that_change_meanwhile(folder, monkeypatch):
    monkeypatch.setattr(traces, "_BEGUN", 0.0)  # as if all files were saved after the process began
    traces._sources.cache_clear()
    count = Counted()
    for _ in range(2):
        weighted(count, Weights())(1.0)
    traces._sources.cache_clear()
    assert count.traced == 2


def test_functions_that_have_no_name_in_another_process_are_not_kept(folder):
    count = Counted()
    weight = 3.0

    def doubled(x):
        count.traced += 1
        return weight * x

    for _ in range(2):
        assert float(jit_once(doubled, lambda x: weight * x)(1.0)) == 3.0
    assert count.traced == 2
    assert not list(folder.iterdir())


def test_a_damaged_trace_is_made_again(folder):
    count = Counted()
    first = count.jitted()(*BALL)
    (file,) = folder.glob("*.npz")
    file.write_bytes(file.read_bytes()[:-100])
    again = count.jitted()(*BALL)
    assert count.traced == 2
    assert np.array_equal(first.ball.center, again.ball.center)
    count.jitted()(*BALL)
    assert count.traced == 2


def test_sorting_by_numpy_is_kept_too(folder):
    def ordered(keys):
        return argsort_keys(keys)

    keys = jnp.asarray([5, 3, 9], jnp.uint32)
    for _ in range(2):
        assert jit_once(ordered, None)(keys).tolist() == [1, 0, 2]
    assert len(list(folder.glob("*.npz"))) == 1


def test_an_error_while_tracing_is_raised_as_it_is(folder):
    def fails(x):
        raise ValueError("points: expected 3 columns")

    with pytest.raises(ValueError, match="points: expected 3 columns"):
        jit_once(fails, None)(1.0)


def test_nothing_is_kept_without_a_folder_of_traces(folder):
    folder.rmdir()
    count = Counted()
    for _ in range(2):
        count.jitted()(*BALL)
    assert count.traced == 2
    assert not folder.exists()
