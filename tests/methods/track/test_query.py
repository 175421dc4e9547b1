import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsjax.methods.track import find_object

OBJECTS = jnp.array([[3.0, 0.0], [1.0, 1.0], [0.0, 0.0]])


def test_best_scores_and_margin():
    match = find_object(jnp.array([0.0, 5.0]), OBJECTS)
    assert match.best == 1
    np.testing.assert_allclose(match.scores, [0, np.sqrt(0.5), 0], atol=1e-6)
    assert match.margin == pytest.approx(np.sqrt(0.5), abs=1e-6)
    assert find_object(jnp.array([1.0, 0.0]), OBJECTS[:1]).margin == np.inf


def test_a_query_that_means_nothing_is_not_found():
    assert find_object(jnp.array([1.0, 0.1]), OBJECTS, 0.9).found
    assert not find_object(jnp.array([-1.0, 0.1]), OBJECTS, 0.2).found
    assert not find_object(jnp.zeros(2), OBJECTS, 0.2).found
    assert not find_object(jnp.array([1.0, 1.0]), jnp.full((2, 2), jnp.nan), 0.2).found


@given(st.integers(0, 99), st.floats(1e-3, 1e3))
def test_lengths_do_not_matter(seed, length):
    rng = np.random.default_rng(seed)
    text, objects = jnp.asarray(rng.normal(size=7)), jnp.asarray(rng.normal(size=(4, 7)))
    plain, scaled = find_object(text, objects), find_object(length * text, objects.at[1].multiply(length))
    np.testing.assert_allclose(plain.scores, scaled.scores, atol=1e-5)


def test_it_maps_over_queries():
    texts = jnp.asarray(np.random.default_rng(0).normal(size=(3, 2)))
    many = jax.vmap(find_object, (0, None))(texts, OBJECTS)
    assert many.best.tolist() == [int(find_object(text, OBJECTS).best) for text in texts]


def test_what_cannot_be_compared_is_refused():
    with pytest.raises(ValueError, match="expected at least one object"):
        find_object(jnp.zeros(2), jnp.zeros((0, 2)))
    with pytest.raises(ValueError, match=r"expected shape \[2\] as the objects', found \(3,\)"):
        find_object(jnp.zeros(3), OBJECTS)
