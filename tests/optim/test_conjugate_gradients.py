"""Conjugate gradients solve any positive definite system, column by column, and stay there once solved."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsjax.optim.conjugate_gradients import Conjugate, advanced, turned


@pytest.mark.thorough
@settings(max_examples=30, deadline=None)
@given(st.integers(2, 12), st.integers(1, 4), st.integers(0, 2**16))
def test_they_reach_the_solution_in_as_many_iterations_as_unknowns(size, columns, seed):
    random = np.random.default_rng(seed)
    root = random.normal(size=(size, size))
    A = (root @ root.T / size + 2 * np.eye(size)).astype(np.float32)
    b = random.normal(size=(size, columns)).astype(np.float32)
    b[:, 0] = 0.0  # a column that is solved from the start
    x, scale = jnp.zeros((size, columns)), jnp.asarray(np.diag(A))
    state = turned(Conjugate(x, x, jnp.zeros(columns)), jnp.asarray(b) - A @ x, scale)
    errors = []
    for _ in range(size + 3):
        x, state = advanced(x, state, A @ state.direction, scale)
        errors.append(np.linalg.norm(np.asarray(x) - np.linalg.solve(A, b)))
    assert errors[-1] < 1e-4 * max(1.0, np.linalg.norm(b))
    assert not np.asarray(x)[:, 0].any()
    assert np.isfinite(np.asarray(state.direction)).all()
