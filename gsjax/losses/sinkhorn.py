"""Scores of pairs become a matching, whose rows and columns sum to one (SurstSplat, eq. 10).

    A = exp(S / tau + f 1^T + 1 g^T),    f and g such that A 1 = 1 and A^T 1 = 1,

has the largest sum of A (S - tau log A) of all such matrices (Cuturi 2013): nearly the best assignment where
the temperature tau is small, all alike where it is large. Rows and columns are normalised in turn, which is
to set f and then g; in logarithms, for exp(S / tau) overflows long before a matching is sharp.

Where rows and columns are not as many, there is no such A. Then each side gets one more partner, the slack,
which takes whom nobody matches (the dustbin of SuperGlue, Sarlin et al. 2020): as the temperature falls, two
are matched only if that scores higher than the slack.
"""

from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

Derivative = Literal["unrolled", "implicit"]

_NEVER = -1e30  # the logarithm of what cannot be; finite, so that no difference of two is NaN


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
    """The matching that `scores` ask for: near 1 where a row and a column belong together.

    Columns sum to 1 exactly, rows as nearly as `iterations` bring them there; with a slack both sum to less,
    and what is missing is unmatched. A pair whose score is not finite is never matched, so -inf forbids one.
    A row or column without any other pair takes no part, and its entries are 0.

    Derivatives reach scores, temperature and slack, in forward and in reverse mode. "unrolled" is the
    derivative of what is returned, and works through all iterations again. "implicit" is that of the limit:
    the same where the iterations have converged, so that rows sum to 1, wrong by as much as those sums where
    not, and the faster of the two: it solves one linear system at the end, by conjugate gradients, which
    converge at least as fast as the iterations did.

    Args:
        scores: S, the larger the more alike.
        temperature: tau, in units of the scores, above 0.
        rows, columns: which are there; all unless given.
        slack: the score of being unmatched. Without one there is none where as many rows as columns take
            part, and one of score 0 where not.
        iterations: of rows and columns each.
        derivative: how to differentiate.

    Raises:
        ValueError: `derivative` is neither, `iterations` below 1, or a temperature not above 0.
    """
    if derivative not in ("unrolled", "implicit"):
        raise ValueError(f"derivative={derivative!r}: expected 'unrolled' or 'implicit'")
    if iterations < 1:
        raise ValueError(f"iterations={iterations}: expected 1 or more")
    if isinstance(temperature, int | float) and not temperature > 0:
        raise ValueError(f"temperature={temperature}: expected one above 0")
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
    # Below their largest, which changes nothing: what all have in common would take the digits.
    largest = jax.lax.stop_gradient(jnp.max(scores, where=possible, initial=_NEVER))
    logits = jnp.where(possible, (scores - largest) / temperature, _NEVER)
    matching = _converged if derivative == "implicit" else _iterated
    return matching(logits, row_masses, column_masses, iterations)[:-1, :-1]


def _iterated(
    logits: Float[Array, "n m"], rows: Float[Array, "n"], columns: Float[Array, "m"], iterations: int
) -> Float[Array, "n m"]:
    """exp(logits + f + g) after so many iterations, `rows` and `columns` the sums wanted; 0 is for absent."""

    def iterate(potentials, _):
        _, g = potentials
        f = _potential(logits + g, rows, axis=1)
        g = _potential(logits + f[:, None], columns, axis=0)
        return (f, g), None

    start = jnp.zeros_like(rows), jnp.zeros_like(columns)
    # Of each iteration the way back needs matrices; it makes them again from f and g, which alone are kept.
    (f, g), _ = jax.lax.scan(jax.checkpoint(iterate), start, length=iterations)
    return jnp.exp(logits + f[:, None] + g)


def _potential(logits: Float[Array, "n m"], sums: Float[Array, "k"], axis: int) -> Float[Array, "k"]:
    """What has to be added along `axis` for exp(logits) to have these sums."""
    there = sums > 0
    return jnp.where(there, jnp.log(jnp.where(there, sums, 1.0)) - jax.nn.logsumexp(logits, axis=axis), 0.0)


@partial(jax.custom_jvp, nondiff_argnums=(3,))
def _converged(
    logits: Float[Array, "n m"], rows: Float[Array, "n"], columns: Float[Array, "m"], iterations: int
) -> Float[Array, "n m"]:
    """As `_iterated`, with the derivative of the limit.

    f and g give back what a change of the logits L adds to any row or column. With a and b the sums of A,

        dA = A (dL + df 1^T + 1 dg^T),    a df + A dg = -(A dL) 1,    A^T df + b dg = -(A dL)^T 1.

    Without df, and in h = sqrt(b) dg, that is (1 - Q^T Q) h = ..., Q = A / sqrt(a b^T), symmetric and without
    negative eigenvalues. The second largest singular value s of Q decides how fast: the iterations gain s^2
    each, conjugate gradients (1 - sqrt(1 - s^2)) / (1 + sqrt(1 - s^2)), which is less. So as many are enough.
    """
    return _iterated(logits, rows, columns, iterations)


@_converged.defjvp
def _converged_jvp(iterations, primals, tangents):
    matching = _converged(*primals, iterations)
    moved = matching * tangents[0]
    a = jnp.where(primals[1] > 0, matching.sum(axis=1), 1.0)
    b = jnp.where(primals[2] > 0, matching.sum(axis=0), 1.0)
    root, dot = jnp.sqrt(b), partial(jnp.matmul, precision="highest")
    # A sharp matching is a permutation, Q^T Q = 1 but for rounding, of which this keeps h clear.
    rounding = 10 * jnp.finfo(matching.dtype).eps

    def system(h):
        return (1 + rounding) * h - dot(dot(matching, h / root) / a, matching) / root

    def solve(system, wanted):
        return jax.scipy.sparse.linalg.cg(system, wanted, tol=rounding, maxiter=iterations)[0]

    wanted = (dot(moved.sum(axis=1) / a, matching) - moved.sum(axis=0)) / root
    dg = jax.lax.custom_linear_solve(system, wanted, solve, symmetric=True) / root
    df = -(moved.sum(axis=1) + dot(matching, dg)) / a
    return matching, moved + matching * (df[:, None] + dg)
