"""Sinkhorn: turns scores of pairs into a soft matching whose rows and columns sum to 1 (SurstSplat, eq. 10).

    A = exp(S / tau + f 1^T + 1 g^T),    f and g such that A 1 = 1 and A^T 1 = 1,

maximises the sum of A (S - tau log A) over all such matrices (Cuturi 2013): it is nearly the best assignment
for a small temperature tau, and uniform for a large one. Rows and columns are normalised in turn by setting f
and then g, in logarithms because exp(S / tau) overflows long before a matching is sharp.

If there are more rows than columns or vice versa, no such A exists. Then each side gets an extra partner, the
slack, which absorbs the unmatched (the dustbin of SuperGlue, Sarlin et al. 2020): as the temperature falls, a
pair is matched only if its score is higher than the slack.
"""

import math
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

Derivative = Literal["unrolled", "implicit"]

_NEVER = -1e30  # logarithm of an impossible pair; finite, so that no difference of two is NaN


def sinkhorn(
    scores: Float[Array, "n m"],
    temperature: Float[Array, ""] | float,
    *,
    rows: Bool[Array, "n"] | None = None,
    columns: Bool[Array, "m"] | None = None,
    slack: Float[Array, ""] | float | None = None,
    iterations: int = 20,
    derivative: Derivative = "unrolled",
) -> Float[Array, "n m"]:
    """The soft matching for `scores`: near 1 where a row and a column belong together.

    Columns sum to 1 exactly, rows as closely as `iterations` allow; with a slack both sum to less, and the
    remainder is unmatched. A pair whose score is not finite is never matched, so -inf forbids a pair. A row
    or column without any allowed pair takes no part, and its entries are 0.

    Derivatives reach scores, temperature and slack, in forward and reverse mode. "unrolled" is the derivative
    of what is returned, and repeats all iterations. "implicit" is the derivative of the limit: equal to the
    former if the iterations have converged (rows sum to 1), off by about the error of those sums if not, and
    faster: it solves one linear system at the end, by conjugate gradients, which converge at least as fast as
    the iterations did.

    Args:
        scores: S, larger for more similar pairs.
        temperature: tau, in units of the scores, above 0.
        rows, columns: which rows and columns are present (default: all).
        slack: score of being unmatched (default: no slack if equally many rows and columns take part, else a
            slack of score 0).
        iterations: number of normalisations of rows and columns.
        derivative: how to differentiate.

    Raises:
        ValueError: `derivative` is unknown, `iterations` is below 1, `temperature` is not above 0, or `slack`
            is not finite.
    """
    if derivative not in ("unrolled", "implicit"):
        raise ValueError(f"derivative={derivative!r}: expected 'unrolled' or 'implicit'")
    if iterations < 1:
        raise ValueError(f"iterations={iterations}: expected 1 or more")
    if isinstance(temperature, int | float) and not temperature > 0:
        raise ValueError(f"temperature={temperature}: expected a number above 0")
    if isinstance(slack, int | float) and not math.isfinite(slack):
        raise ValueError(f"slack={slack}: expected a finite score, or None")
    pairs = jnp.isfinite(scores)
    if rows is not None:
        pairs &= rows[:, None]
    if columns is not None:
        pairs &= columns
    rows, columns = pairs.any(axis=1), pairs.any(axis=0)
    slackens = rows.sum() != columns.sum() if slack is None else pairs.any()
    row_masses = jnp.append(rows, slackens * columns.sum()).astype(scores.dtype)
    column_masses = jnp.append(columns, slackens * rows.sum()).astype(scores.dtype)
    possible = jnp.pad(pairs, (0, 1), constant_values=True) & (row_masses[:, None] > 0) & (column_masses > 0)
    slack = jnp.asarray(0.0 if slack is None else slack, scores.dtype)
    scores = jax.lax.pad(jnp.where(pairs, scores, 0.0), slack, [(0, 1, 0), (0, 1, 0)])
    # Subtracting the largest changes nothing; without it a common offset would cost precision.
    largest = jax.lax.stop_gradient(jnp.max(scores, where=possible, initial=_NEVER))
    logits = jnp.where(possible, (scores - largest) / temperature, _NEVER)
    matching = _converged if derivative == "implicit" else _iterated
    return matching(logits, row_masses, column_masses, iterations)[:-1, :-1]


def _iterated(
    logits: Float[Array, "n m"], rows: Float[Array, "n"], columns: Float[Array, "m"], iterations: int
) -> Float[Array, "n m"]:
    """exp(logits + f + g) after some iterations; `rows` and `columns` are the wanted sums, 0 if absent."""

    def iterate(potentials, _):
        _, g = potentials
        f = _potential(logits + g, rows, axis=1)
        g = _potential(logits + f[:, None], columns, axis=0)
        return (f, g), None

    start = jnp.zeros_like(rows), jnp.zeros_like(columns)
    # The backward pass needs matrices of each iteration; it recomputes them from f and g, which are stored.
    (f, g), _ = jax.lax.scan(jax.checkpoint(iterate), start, length=iterations)
    return jnp.exp(logits + f[:, None] + g)


def _potential(logits: Float[Array, "n m"], sums: Float[Array, "k"], axis: int) -> Float[Array, "k"]:
    """The potential to add along `axis` for exp(logits) to have these sums."""
    there = sums > 0
    return jnp.where(there, jnp.log(jnp.where(there, sums, 1.0)) - jax.nn.logsumexp(logits, axis=axis), 0.0)


@partial(jax.custom_jvp, nondiff_argnums=(3,))
def _converged(
    logits: Float[Array, "n m"], rows: Float[Array, "n"], columns: Float[Array, "m"], iterations: int
) -> Float[Array, "n m"]:
    """As `_iterated`, with the derivative of the limit.

    f and g compensate what a change of the logits L adds to any row or column. With a and b the sums of A,

        dA = A (dL + df 1^T + 1 dg^T),    a df + A dg = -(A dL) 1,    A^T df + b dg = -(A dL)^T 1.

    Eliminating df, and with h = sqrt(b) dg, this is (1 - Q^T Q) h = ..., Q = A / sqrt(a b^T), symmetric and
    positive semidefinite. The second largest singular value s of Q determines the convergence: each Sinkhorn
    iteration reduces the error by s^2, each of conjugate gradients by (1 - sqrt(1 - s^2)) /
    (1 + sqrt(1 - s^2)), which is smaller. So the same number of iterations is enough.
    """
    return _iterated(logits, rows, columns, iterations)


@_converged.defjvp
def _converged_jvp(iterations, primals, tangents):
    matching = _converged(*primals, iterations)
    moved = matching * tangents[0]
    a = jnp.where(primals[1] > 0, matching.sum(axis=1), 1.0)
    b = jnp.where(primals[2] > 0, matching.sum(axis=0), 1.0)
    root, dot = jnp.sqrt(b), partial(jnp.matmul, precision="highest")
    # For a sharp matching, a permutation, Q^T Q = 1 up to rounding, from which this term protects h.
    rounding = 10 * jnp.finfo(matching.dtype).eps

    def system(h):
        return (1 + rounding) * h - dot(dot(matching, h / root) / a, matching) / root

    def solve(system, wanted):
        return jax.scipy.sparse.linalg.cg(system, wanted, tol=rounding, maxiter=iterations)[0]

    wanted = (dot(moved.sum(axis=1) / a, matching) - moved.sum(axis=0)) / root
    dg = jax.lax.custom_linear_solve(system, wanted, solve, symmetric=True) / root
    df = -(moved.sum(axis=1) + dot(matching, dg)) / a
    return matching, moved + matching * (df[:, None] + dg)
