"""Solution for the vectors of Gaussians by linear least squares, in place of gradient descent.

Rendering is linear in the vectors x_i of Gaussians, so minimising L_rec (FD-3DGS, eq. 4) over them is a
linear least-squares problem. With the weight w_pi of Gaussian i in pixel p, the pixel's alpha, its teacher's
feature e_p, and m_p = 1 where there is one,

    min_x  sum_p m_p |sum_i w_pi x_i - alpha_p e_p|^2  +  lambda sum_(i,j) |x_i - x_j|^2

over pairs (i, j) of neighbours in space; the second term gives Gaussians that few pixels show the vectors
around them. The matrix of the normal equations (W^T M W + lambda L) x = W^T M alpha e is the same for each
channel, and W is never formed: W x renders a view, and W^T is the backward pass of that rendering. Rows of
W^T M W sum to D = W^T M alpha, so that D^-1 (W^T M W) has no eigenvalue above 1, and conjugate gradients with
D as the preconditioner converge in a few passes.

Each step processes one view, and the sums of a pass over all views make an iteration. The first pass gives
the right-hand side and D, whose quotient is the initial guess. That is a vote: each Gaussian has the mean of
the features of the pixels that show it, as in Occam's LGS (Cheng et al. 2024) and LUDVIG (Marrie et al.
2024). The second pass gives the residual, and each further one an iteration.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.methods.distill.config import DistillConfig
from gsjax.methods.distill.field import FeatureField
from gsjax.methods.distill.teacher import Teacher
from gsjax.methods.distill.views import Batch, resized_rows
from gsjax.optim.conjugate_gradients import Conjugate, advanced, turned
from gsjax.optim.step import Step, all_finite
from gsjax.rasterize.frozen import paint_shown, rows_within, strip_of

_LEAST = 1e-12
_TAUGHT = 0.05  # share of a Gaussian's pixels that must have a teacher
_SPREAD = 64  # most rings of neighbours over which vectors spread to Gaussians that no pixel shows


class SolveBatch(NamedTuple):
    """The input of a step.

    Attributes:
        view: a view and its teacher, in the channels of the field (`gsjax.methods.distill.views.in_basis`).
        neighbors: the nearest neighbours of each Gaussian.
        turn: index of the pass over the views; the first is the vote.
        is_last: whether the view is the last of its pass.
    """

    view: Batch
    neighbors: Int[Array, "n k"]
    turn: Int[Array, ""] | int
    is_last: Bool[Array, ""] | bool


class SolveState(NamedTuple):
    """The sums of the current pass, and what the iterations need of earlier ones, for r channels.

    Attributes:
        total: the sums of the current pass over the views.
        rhs: the right-hand side.
        mass: D, how much of each Gaussian is shown by pixels that have a teacher.
        shown: how much of it is shown by all pixels.
        tie: lambda.
        conjugate: the state of the iterations; None for a vote.
        target: sum of the squared targets, sum_p m_p |alpha_p e_p|^2.
        pixels: sum of m_p.
        loss: the objective after the latest pass, per pixel.
    """

    total: Float[Array, "n r"]
    rhs: Float[Array, "n r"]
    mass: Float[Array, "n"]
    shown: Float[Array, "n"]
    tie: Float[Array, ""]
    conjugate: Conjugate | None
    target: Float[Array, ""]
    pixels: Float[Array, ""]
    loss: Float[Array, ""]


class _Sums(NamedTuple):
    """What a view adds to the sums of a pass: to its Gaussians' rows of `total`, `mass` and `shown`, and to
    `target` and `pixels`."""

    rows: Float[Array, "seen r"]
    mass: Float[Array, "seen"]
    shown: Float[Array, "seen"]
    target: Float[Array, ""]
    pixels: Float[Array, ""]


def solve_step(config: DistillConfig) -> Step:
    """Processes one view of a pass, a `SolveBatch`, for a `FeatureField` with a vector for each Gaussian,
    whose `lift` has orthonormal columns and stays fixed. Neither `step` nor `key` is used.

    The loss is the objective after the latest complete pass, a mean over pixels; until the second pass has
    evaluated the vote, it is that of vectors of zeros. `info` also has `rec`, the loss as a mean over the
    teacher's channels like L_rec, NaN while the loss is that of zeros. A view whose sums are not finite adds
    nothing, but the pass goes on.

    Args:
        config: settings of the solution, and the memory of a strip.
    """

    def init(field: FeatureField) -> SolveState:
        empty = jnp.zeros_like(field.encoding)
        zero = jnp.zeros((), empty.dtype)
        each = jnp.zeros(len(empty), empty.dtype)
        nothing = Conjugate(empty, empty, jnp.zeros(empty.shape[1], empty.dtype))
        nothing = None if config.start == "vote" else nothing
        return SolveState(empty, empty, each, each, zero, nothing, zero, zero, zero)

    def update(field: FeatureField, state: SolveState, batch: SolveBatch, *, step: Any, key: Any):
        turn, rows = jnp.asarray(batch.turn), batch.view.view.rows
        if (known := state.conjugate) is None:
            found = _right_hand_side(batch.view, config)
        else:
            found = jax.lax.cond(
                turn == 0,
                lambda: _right_hand_side(batch.view, config),
                lambda: _product(jnp.where(turn == 1, field.encoding, known.direction), batch.view, config),
            )
        sound = all_finite(found)
        found = jax.tree.map(lambda a: jnp.where(sound, a, 0.0), found)
        target, pixels = state.target + found.target, state.pixels + found.pixels
        summed = state._replace(
            total=state.total.at[rows].add(found.rows),
            mass=state.mass.at[rows].add(found.mass),
            shown=state.shown.at[rows].add(found.shown),
            target=target,
            pixels=pixels,
            loss=jnp.where(turn == 0, target / jnp.maximum(pixels, 1.0), state.loss),
        )
        field, state = jax.lax.cond(
            batch.is_last,
            lambda: _after_pass(field, summed, batch, config),
            lambda: (field, summed),
        )
        is_known = (turn > 1) | ((turn == 1) & jnp.asarray(batch.is_last))
        rec = jnp.where(is_known, state.loss / field.dimension, jnp.nan)
        info = {"rec": rec, "loss": state.loss, "skipped": ~sound}
        return field, state, info | {"overflow": jnp.asarray(False), "needed": jnp.int32(0)}

    return Step(init, update)


def num_passes(config: DistillConfig) -> int:
    """The number of passes over the views: one for the vote, one for its residual, one for each iteration.

    Args:
        config: settings of the solution.
    """
    return {"random": 0, "vote": 1, "solve": 2 + config.solve.iterations}[config.start]


def zero_field(teacher: Teacher, means: Float[Array, "n 3"], config: DistillConfig) -> FeatureField:
    """The field before its first step: vectors of zeros, in a basis that retains `solve.energy` of the
    squared length of the teacher's features.

    Args:
        teacher: the teacher's features.
        means: centres of the Gaussians, which also set the field's precision, single at least.
        config: the energy, and the largest number of channels.
    """
    basis = jnp.asarray(basis_of(teacher, config), jnp.promote_types(means.dtype, jnp.float32))
    return FeatureField(jnp.zeros((len(means), basis.shape[1]), basis.dtype), basis)


def basis_of(teacher: Teacher, config: DistillConfig) -> Float[np.ndarray, "d r"]:
    """Orthonormal columns that span the teacher's features, the most important first. On the host.

    Args:
        teacher: the teacher's features; each row of its codebook counts as much as a whole map.
        config: the energy that is kept, and the largest number of channels.
    """
    gram = np.zeros((teacher.dimension, teacher.dimension))
    if teacher.codebook is not None:
        gram += np.asarray(teacher.codebook.T @ teacher.codebook, np.float64)
    for features in teacher.maps or ():
        flat = np.asarray(features, np.float32).reshape(-1, teacher.dimension)
        gram += (flat.T @ flat) / len(flat)
    values, vectors = np.linalg.eigh(gram)
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    kept = np.cumsum(values) / max(values.sum(), _LEAST)
    rank = int(np.searchsorted(kept, config.solve.energy)) + 1
    return np.ascontiguousarray(vectors[:, : min(rank, config.channels, teacher.dimension)])


def _right_hand_side(batch: Batch, config: DistillConfig) -> _Sums:
    """W^T M alpha e, W^T M alpha and W^T alpha of a view."""
    features = batch.map if batch.codebook is None else batch.codebook
    assert features is not None
    empty = jnp.zeros((len(batch.view.rows), features.shape[-1] + 2), features.dtype)

    def cotangent(first, inside, image, alphas):
        targets, weights = _targets(batch, first, inside, config.weights.map, alphas.dtype)
        shown = alphas[..., None] * targets
        squares = jnp.where(weights > 0, jnp.sum(shown**2, axis=-1) / jnp.maximum(weights, _LEAST), 0.0)
        every = inside[:, None] * alphas
        joined = jnp.concatenate([shown, jnp.stack([weights * alphas, every], axis=-1)], axis=-1)
        return joined, squares.sum(), weights.sum()

    back, target, pixels = _backprojected(empty, batch, config, cotangent)
    return _Sums(back[:, :-2], back[:, -2], back[:, -1], target, pixels)


def _product(values: Float[Array, "n r"], batch: Batch, config: DistillConfig) -> _Sums:
    """W^T M W values, of a view."""

    def cotangent(first, inside, image, alphas):
        zero = jnp.zeros((), image.dtype)
        weights = _weights(batch, first, inside, config.weights.map, image.dtype)
        return weights[..., None] * image, zero, zero

    back, target, pixels = _backprojected(values[batch.view.rows], batch, config, cotangent)
    nothing = jnp.zeros(len(back), back.dtype)
    return _Sums(back, nothing, nothing, target, pixels)


def _backprojected(values: Float[Array, "seen c"], batch: Batch, config: DistillConfig, cotangent):
    """Renders the values strip by strip and pulls the first output of `cotangent(first_row, inside, image,
    alphas)` back to the Gaussians, summed over strips; its other two outputs, numbers, are summed as well."""
    plan = batch.plan
    rows = rows_within(config.strip_megabytes, 3 * values.shape[1], plan)
    high = rows * plan.tile_size

    def strip(carry, number):
        view, strip_plan = strip_of(batch.view, plan, number * rows, rows)
        (image, alphas), back = jax.vjp(lambda some: paint_shown(view, some, strip_plan), values)
        inside = number * high + jnp.arange(high) < plan.height
        pixels, *numbers = cotangent(number * high, inside, image, alphas)
        (found,) = back((pixels, jnp.zeros_like(alphas)))
        return jax.tree.map(jnp.add, carry, (found, *numbers)), None

    zero = jnp.zeros((), values.dtype)
    begin, strips = (jnp.zeros_like(values), zero, zero), -(-plan.tiles_y // rows)
    if strips == 1:
        return strip(begin, 0)[0]
    return jax.lax.scan(strip, begin, jnp.arange(strips))[0]


def _weights(batch: Batch, first, inside, map_weight: float, dtype) -> Float[Array, "high width"]:
    """m_p in the rows of a strip. A pixel of a map has `map_weight` if there are masks too."""
    weights = jnp.zeros((len(inside), batch.plan.width), dtype)
    if batch.codebook is not None:
        weights += _ids(batch, first, len(inside)) >= 0
    if batch.map is not None:
        weights += inside[:, None] * (1.0 if batch.codebook is None else map_weight)
    return weights


def _targets(batch: Batch, first, inside, map_weight: float, dtype):
    """m_p e_p and m_p in the rows of a strip."""
    targets: Any = 0.0
    if batch.codebook is not None:
        ids = _ids(batch, first, len(inside))
        targets += jnp.where((ids >= 0)[..., None], batch.codebook[jnp.maximum(ids, 0)], 0.0)
    if batch.map is not None:
        weight = inside[:, None] * (1.0 if batch.codebook is None else map_weight)
        targets += weight[..., None] * resized_rows(batch.map, first, len(inside), batch.plan)
    return targets.astype(dtype), _weights(batch, first, inside, map_weight, dtype)


def _ids(batch: Batch, first, high: int) -> Int[Array, "high width"]:
    """Rows of the codebook in the rows of a strip; -1 below the image."""
    padded = jnp.pad(batch.ids, ((0, high), (0, 0)), constant_values=-1)
    return jax.lax.dynamic_slice_in_dim(padded, first, high)


def _after_pass(field: FeatureField, state: SolveState, batch: SolveBatch, config: DistillConfig):
    """The field and the state after the last view of a pass."""
    branches = [partial(_after_vote, smoothness=config.solve.smoothness)]
    branches += [] if state.conjugate is None else [_first_residual, _cg_step]
    turn = jnp.clip(jnp.asarray(batch.turn), 0, len(branches) - 1)
    given = field, state, batch.neighbors
    field, state = jax.lax.switch(turn, [lambda f=f: f(*given) for f in branches])
    return field, state._replace(total=jnp.zeros_like(state.total))


def _after_vote(field: FeatureField, state: SolveState, neighbors, smoothness: float):
    """After the vote, which is the initial guess. Gaussians that no pixel shows get the mean of their
    neighbours; those of whose pixels hardly any has a teacher get zeros, as they lie beside objects but
    belong to none."""
    seen = state.mass > _LEAST
    votes = jnp.where(seen[:, None], state.total / jnp.maximum(state.mass, _LEAST)[:, None], 0.0)
    votes = _zero_unlabelled(votes, state)
    tie = smoothness * state.mass.sum() / jnp.maximum(seen.sum(), 1)
    found = _spread(votes, seen | _unlabelled(state), neighbors)
    field = eqx.tree_at(lambda f: f.encoding, field, found)
    return field, state._replace(rhs=state.total, tie=tie)


def _first_residual(field: FeatureField, state: SolveState, neighbors):
    """After the product with the initial guess: the residual, which gives the first search direction."""
    x = field.encoding
    residual = _zero_unlabelled(state.rhs - state.total - state.tie * _laplacian(x, neighbors), state)
    assert state.conjugate is not None
    first = turned(state.conjugate, residual, _preconditioner(state, neighbors))
    return field, state._replace(conjugate=first, loss=_objective(x, residual, state))


def _cg_step(field: FeatureField, state: SolveState, neighbors):
    """After the product with a search direction: an iteration of conjugate gradients."""
    assert state.conjugate is not None
    product = state.total + state.tie * _laplacian(state.conjugate.direction, neighbors)
    product = _zero_unlabelled(product, state)  # they are no unknowns: their residual stays zero, too
    scale = _preconditioner(state, neighbors)
    x, after = advanced(field.encoding, state.conjugate, product, scale)
    field = eqx.tree_at(lambda f: f.encoding, field, x)
    return field, state._replace(conjugate=after, loss=_objective(x, after.residual, state))


def _unlabelled(state: SolveState) -> Bool[Array, "n"]:
    """The Gaussians that pixels show, but hardly any pixel that has a teacher."""
    return (state.shown > _LEAST) & (state.mass <= _TAUGHT * state.shown)


def _zero_unlabelled(x: Float[Array, "n r"], state: SolveState) -> Float[Array, "n r"]:
    """The rows, zero for unlabelled Gaussians, whose vectors are fixed at zero."""
    return jnp.where(_unlabelled(state)[:, None], 0.0, x)


def _preconditioner(state: SolveState, neighbors: Int[Array, "n k"]) -> Float[Array, "n"]:
    num, count = neighbors.shape
    pairs = count + jnp.zeros(num, state.mass.dtype).at[neighbors.ravel()].add(1.0)
    return state.mass + state.tie * pairs + _LEAST


def _objective(x: Float[Array, "n r"], residual: Float[Array, "n r"], state: SolveState) -> Float[Array, ""]:
    """The objective per pixel: x.Ax - 2 b.x + target, with Ax = b - residual."""
    return (state.target - jnp.sum(x * (state.rhs + residual))) / jnp.maximum(state.pixels, 1.0)


def _laplacian(x: Float[Array, "n r"], neighbors: Int[Array, "n k"]) -> Float[Array, "n r"]:
    """L x: the gradient of half of sum_(i,j) |x_i - x_j|^2 over the pairs of neighbours."""

    def one(total, others):  # one neighbour at a time, as there may be hundreds of channels
        apart = x - x[others]
        return (total + apart).at[others].add(-apart), None

    return jax.lax.scan(one, jnp.zeros_like(x), neighbors.T)[0]


def _spread(votes: Float[Array, "n r"], seen: Bool[Array, "n"], neighbors: Int[Array, "n k"]):
    """The votes, with those that are missing filled in from neighbours, ring after ring."""

    def ring(carry):
        values, known, rings = carry
        near = known[neighbors].sum(1)
        total, _ = jax.lax.scan(
            lambda sums, others: (sums + known[others, None] * values[others], None),
            jnp.zeros_like(values),
            neighbors.T,
        )
        mean = total / jnp.maximum(near, 1)[:, None]
        return jnp.where(known[:, None], values, mean), known | (near > 0), rings + 1

    def is_unfinished(carry):
        _, known, rings = carry
        return (rings < _SPREAD) & ~known.all()

    return jax.lax.while_loop(is_unfinished, ring, (votes, seen, jnp.asarray(0)))[0]
