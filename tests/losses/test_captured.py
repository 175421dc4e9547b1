"""The values that custom losses capture: they are compiled in, so a change of one must be noticed."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.losses.extra import Recompiling, captured

WEIGHT, TRACES = 5.0, []


def nothing(scene, rendered, frame):
    return jnp.zeros(())


def height(scene, rendered, frame):
    return WEIGHT * jnp.mean(scene)


class Weighted:
    def __init__(self, weight):
        self.weight = weight

    def loss(self, scene, rendered, frame):
        return self.weight * nothing(scene, rendered, frame)

    __call__ = loss


def weighted(weight):
    def loss(scene, rendered, frame):
        return weight * nothing(scene, rendered, frame)

    return loss


@pytest.mark.parametrize(
    "value",
    [
        2,
        2.5,
        "b",
        np.float32(3),
        np.arange(3.0),
        np.zeros(200_000),
        jnp.arange(4),
        jax.random.key(1),
        (5, 1),
        {5, 1},
        frozenset({2}),
    ],
    ids=str,
)
def test_what_they_take_from_outside_counts(value, monkeypatch):
    assert captured((weighted(1.0),)) == captured((weighted(1.0),)) != captured((weighted(value),))
    assert captured((weighted(value),)) == captured((weighted(value),))
    assert captured((partial(nothing, frame=1.0),)) != captured((partial(nothing, frame=value),))
    assert captured((Weighted(1.0),)) != captured((Weighted(value),))
    assert captured((Weighted(1.0).loss,)) != captured((Weighted(value).loss,))

    def calls(scene, rendered, frame):
        return jax.vmap(lambda one: height(one, rendered, frame))(scene) + unset

    assert hash(captured((calls,))) == hash(captured((calls,)))
    before = captured((calls,))
    monkeypatch.setitem(globals(), "WEIGHT", value)
    assert captured((calls,)) != before
    unset = 0.0


def test_the_order_in_which_a_set_was_filled_is_no_change():
    """8 and 0 share a place in the table, so the set iterates in the order in which they came."""
    assert captured((weighted({8, 0}),)) == captured((weighted({0, 8}),)) != captured((weighted({0, 9}),))


def test_what_a_trace_itself_changes_is_no_change(monkeypatch):
    def noted(scene, rendered, frame):
        TRACES.append(1)
        return WEIGHT * nothing(scene, rendered, frame)

    made = []

    def compiled(outside):
        made.append(outside)
        return jax.jit(lambda scene: noted(scene, None, None))

    program = Recompiling((noted,), compiled)
    counts = []
    for weight in (5.0, 5.0, 2.0, 2.0):
        monkeypatch.setitem(globals(), "WEIGHT", weight)
        program(jnp.zeros(3))
        counts.append(len(made))
    assert counts == [1, 1, 2, 2]
    assert Recompiling((), lambda outside: lambda x: (outside, x))(3) == ((), 3)
