"""Edges of a spatiotemporal graph, and the affinity of the nodes they join (SurstSplat, section 2.3).

Nodes are points sampled from each frame (`gsjax.geometry.sampling`). All frames have the same number of nodes
and edges, with masks for absent ones. Edges lead to the nearest nodes of the same frame and to matching nodes
of other frames:

    edges = spatial_edges(positions, k=8) | temporal_edges(teacher, k=4, window=2)
    weights = edge_weights(positions, teacher, times, edges, tau_x=0.02, tau_t=0.5)
    wanted = edge_affinities(teacher, edges)

All of this comes from the teacher and is computed once; the losses in `gsjax.losses.graph` make trained
features agree with it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from itertools import groupby
from operator import or_

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from gsjax.losses.features import Likeness, cosine_error
from gsjax.losses.sinkhorn import Derivative, sinkhorn

Features = Float[Array, "t n d"]
NodeMask = Bool[Array, "t n"]

_LEAST = 1e-12  # squared length below which a feature has no direction


# -- edges ---------------------------------------------------------------------------------------------------


class Edges(eqx.Module):
    """The same number of edges from every node: edge e from frame t ends in frame t + offsets[e].

    `one | other` has the edges of both.
    """

    nodes: Int[Array, "t n e"]
    """Index of the node at the end of each edge, in its frame."""
    valid: Bool[Array, "t n e"]
    """False where there is no edge."""
    offsets: tuple[int, ...] = eqx.field(static=True)

    def __or__(self, other: "Edges") -> "Edges":
        nodes = jnp.concatenate([self.nodes, other.nodes], axis=2)
        valid = jnp.concatenate([self.valid, other.valid], axis=2)
        return Edges(nodes, valid, self.offsets + other.offsets)


@dataclass(frozen=True)
class Matching:
    """How features become affinities (eqs. 9 and 10); see `sinkhorn` for the meaning of each field."""

    temperature: float = 1.0
    """In units of sqrt(d), the standard deviation of the score of two random layer-normalised features."""
    slack: float | None = None
    """Score of being unmatched; scores of two features lie between -d and d."""
    iterations: int = 20
    derivative: Derivative = "unrolled"


def spatial_edges(positions: Float[Array, "t n c"], k: int, valid: NodeMask | None = None) -> Edges:
    """Edges from each node to its `k` nearest neighbours in the same frame.

    Args:
        positions: positions of n nodes in t frames, metres.
        k: edges from each node.
        valid: which nodes are present (default: all).
    """
    positions, there = present(positions, valid)
    return _strongest(lambda _: -_squared_distances(positions), there, k)


def temporal_edges(
    features: Features, k: int, window: int, valid: NodeMask | None = None, matching: Matching = Matching()
) -> Edges:
    """Edges from each node to the `k` nodes of highest affinity in each of the other frames at most `window`
    away (SurstSplat, Algorithm 1).

    One matrix serves both directions: rows rank nodes of the later frame, columns those of the earlier.

    Args:
        features: features of n nodes in t frames.
        k: edges from each node into each other frame.
        window: largest distance between frames.
        valid: which nodes are present (default: all).
        matching: how features become affinities.

    Raises:
        ValueError: `window` is below 1.
    """
    if window < 1:
        raise ValueError(f"window={window}: expected 1 frame or more; use spatial_edges within a frame")
    _, there = present(features, valid)
    return _strongest(lambda offset: affinities(features, offset, there, matching), there, k, window)


def similar_edges(features: Features, k: int, window: int = 0, valid: NodeMask | None = None) -> Edges:
    """Edges from each node to the `k` nodes of highest cosine similarity in its frame (GaussianClin, eq. 7),
    or with a `window` in each of the other frames at most that far away. Nodes whose features
    are zero have no edges.

    Args:
        features: features of n nodes in t frames.
        k: edges from each node into each frame.
        window: largest distance between frames; 0 for edges within a frame.
        valid: which nodes are present (default: all).
    """
    features, there = present(features, valid)
    squared = jnp.sum(features**2, axis=-1)
    there &= squared > _LEAST
    directions = features / jnp.sqrt(jnp.where(there, squared, 1.0))[..., None]
    return _strongest(lambda offset: _products(directions, offset), there, k, window)


def all_edges(valid: NodeMask, window: int = 0) -> Edges:
    """Edges from each node to every other node of its frame and of the frames at most `window` away."""
    frames, n = valid.shape
    window = min(window, frames - 1)
    runs = []
    for offset in range(-window, window + 1):
        pairs = _pairs(valid, abs(offset))
        ends = _framed(pairs if offset >= 0 else pairs.swapaxes(1, 2), offset)
        runs.append(Edges(jnp.broadcast_to(jnp.arange(n), ends.shape), ends, (offset,) * n))
    return reduce(or_, runs)


def edge_weights(
    positions: Float[Array, "t n c"],
    features: Features,
    times: Float[Array, "t"],
    edges: Edges,
    tau_x: Float[Array, ""] | float,
    tau_t: Float[Array, ""] | float,
) -> Float[Array, "t n e"]:
    """w_uv = exp(-|x_u - x_v|^2 / tau_x^2) max(0, cos(f_u, f_v)) exp(-|t_u - t_v| / tau_t) (eq. 8); 0 where
    there is no edge.

    Args:
        positions, tau_x: positions of the nodes and their length scale, metres.
        features: the teacher's features.
        times, tau_t: times of the frames and their time scale, seconds.
        edges: the nodes that each node is connected to.
    """
    positions, placed = present(positions)
    features, there = present(features)
    squared = jnp.sum((positions[:, :, None] - _at_ends(positions, edges)) ** 2, axis=-1)
    cosines, known = edge_cosines(features, edges, there & placed)
    apart = jnp.abs(times[:, None] - times[_end_frames(edges)])[:, None, :]
    weights = jnp.exp(-squared / tau_x**2 - apart / tau_t) * jnp.maximum(cosines, 0.0)
    return jnp.where(known, weights, 0.0)


# -- affinities ----------------------------------------------------------------------------------------------


def affinities(
    features: Features, offset: int, valid: NodeMask | None = None, matching: Matching = Matching()
) -> Float[Array, "s n n"]:
    """Affinity matrices A of frames 0 and `offset`, 1 and `offset` + 1, ... (eqs. 9 and 10): Sinkhorn of
    Phi_U Phi_V^T, with Phi the layer-normalised features, at temperature tau sqrt(d).

    No node is matched with itself: that score is the highest possible, and would take most of its row.

    Args:
        features: features of n nodes in t frames.
        offset: distance between the two frames that are matched, 0 or more.
        valid: which nodes are present (default: all).
        matching: temperature, slack and iterations.
    """
    features, there = present(features, valid)
    scores = _products(_layer_normalized(features), offset)
    if offset == 0:
        scores = jnp.where(jnp.eye(scores.shape[-1], dtype=bool), -jnp.inf, scores)

    def match(scores, rows, columns):
        return sinkhorn(
            scores,
            matching.temperature * features.shape[-1] ** 0.5,
            rows=rows,
            columns=columns,
            slack=matching.slack,
            iterations=matching.iterations,
            derivative=matching.derivative,
        )

    return jax.vmap(match)(scores, there[: len(scores)], there[offset:])


def edge_affinities(
    features: Features, edges: Edges, valid: NodeMask | None = None, matching: Matching = Matching()
) -> Float[Array, "t n e"]:
    """A of each edge times the number of nodes to which it could have led, so that chance gives 1.

    The factor is needed because rows of A sum to 1: with twice the nodes, its entries, and losses on them,
    would be half as large.

    Args:
        features: features of n nodes in t frames.
        edges: edges between the nodes.
        valid: which nodes are present (default: all).
        matching: how features become affinities.
    """
    _, there = present(features, valid)
    known = {reach: affinities(features, reach, there, matching) for reach in {*map(abs, edges.offsets)}}
    runs, first = [jnp.zeros((*there.shape, 0), features.dtype)], 0
    for offset, run in groupby(edges.offsets):
        last = first + len(tuple(run))
        starts = slice(max(-offset, 0), len(there) - max(offset, 0))
        matrix = known[abs(offset)] if offset >= 0 else known[-offset].swapaxes(1, 2)
        runs.append(_framed(jnp.take_along_axis(matrix, edges.nodes[starts, :, first:last], axis=2), offset))
        first = last
    choices = there.sum(axis=1)[_end_frames(edges)] - (np.array(edges.offsets) == 0)
    return jnp.concatenate(runs, axis=2) * choices[:, None]


# -- helpers, shared with the losses -------------------------------------------------------------------------


def present(
    values: Float[Array, "*n c"], valid: Bool[Array, "*n"] | None = None
) -> tuple[Float[Array, "*n c"], Bool[Array, "*n"]]:
    """Values with 0 where absent or not finite, because 0 times NaN would spread; and which are present."""
    there = jnp.isfinite(values).all(axis=-1)
    if valid is not None:
        there &= valid
    return jnp.where(there[..., None], values, 0.0), there


def _layer_normalized(features: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
    """Features normalised to mean 0 and variance 1 over the channels; 0, with zero gradient, if constant."""
    centred = features - features.mean(axis=-1, keepdims=True)
    variance = jnp.mean(centred**2, axis=-1, keepdims=True)
    varies = variance > _LEAST * (1 + jnp.mean(features**2, axis=-1, keepdims=True))
    return jnp.where(varies, centred / jnp.sqrt(jnp.where(varies, variance, 1.0)), 0.0)


def _products(features: Features, offset: int) -> Float[Array, "s n n"]:
    """Inner products of every node with every node `offset` frames later."""
    earlier, later = features[: len(features) - offset], features[offset:]
    return jnp.matmul(earlier, later.swapaxes(1, 2), precision="highest")


def _squared_distances(positions: Float[Array, "t n c"]) -> Float[Array, "t n n"]:
    """Squared distances within each frame, from differences: inner products would lose small distances."""
    return jnp.sum((positions[:, :, None] - positions[:, None]) ** 2, axis=-1)


def _pairs(there: NodeMask, offset: int) -> Bool[Array, "s n n"]:
    """Pairs of nodes that an edge may join: both present, and not a node with itself."""
    pairs = there[: len(there) - offset, :, None] & there[offset:, None, :]
    return pairs & ~jnp.eye(there.shape[1], dtype=bool) if offset == 0 else pairs


def _strongest(
    scores: Callable[[int], Float[Array, "s n n"]], there: NodeMask, k: int, window: int = 0
) -> Edges:
    """Edges to the `k` nodes of highest score in the same frame, or with a window in each other frame.

    Args:
        scores: frame offset -> scores of pairs of nodes.
        there: which nodes are present.
        k: edges from each node into each frame.
        window: largest distance between frames; 0 for edges within a frame.
    """
    edges = Edges(jnp.zeros((*there.shape, 0), jnp.int32), jnp.zeros((*there.shape, 0), bool), ())
    for offset in range(1, min(window, len(there) - 1) + 1) if window else (0,):
        ranked = jnp.where(_pairs(there, offset), scores(offset), -jnp.inf)
        edges |= _highest(ranked, k, offset)
        if offset:
            edges |= _highest(ranked.swapaxes(1, 2), k, -offset)
    return edges


def _highest(scores: Float[Array, "s n n"], k: int, offset: int) -> Edges:
    """Edges from rows to the columns of highest score; -inf marks pairs without an edge."""
    n = scores.shape[-1]
    highest, nodes = jax.lax.top_k(scores, min(k, n))
    valid = highest > -jnp.inf
    missing = [(0, 0), (0, 0), (0, max(k - n, 0))]
    nodes, valid = (_framed(jnp.pad(a, missing), offset) for a in (jnp.where(valid, nodes, 0), valid))
    return Edges(nodes, valid, (offset,) * k)


def _framed(values: Shaped[Array, "s ..."], offset: int) -> Shaped[Array, "t ..."]:
    """Values padded with zeros for the frames whose edges with this offset would lead out of the sequence."""
    return jnp.pad(values, [(max(-offset, 0), max(offset, 0))] + [(0, 0)] * (values.ndim - 1))


def _end_frames(edges: Edges) -> Int[Array, "t e"]:
    """Frame in which each edge ends, clipped to the existing frames."""
    frames = len(edges.nodes)
    ends = np.arange(frames)[:, None] + np.array(edges.offsets, int)
    return jnp.asarray(ends.clip(0, frames - 1))


def _at_ends(values: Shaped[Array, "t n ..."], edges: Edges) -> Shaped[Array, "t n e ..."]:
    """Values of the nodes at the ends of the edges."""
    return values[_end_frames(edges)[:, None], edges.nodes]


def live_edges(edges: Edges, there: NodeMask) -> Bool[Array, "t n e"]:
    """Which edges connect nodes that are present."""
    return edges.valid & there[:, :, None] & _at_ends(there, edges)


def edge_cosines(
    features: Features, edges: Edges, there: NodeMask
) -> tuple[Float[Array, "t n e"], Bool[Array, "t n e"]]:
    """Cosine of the two features that each edge connects, and where both are `there` and non-zero."""
    squared = jnp.sum(features**2, axis=-1)
    products = jnp.sum(features[:, :, None] * _at_ends(features, edges), axis=-1)
    one = jnp.broadcast_to(squared[:, :, None], products.shape)
    cosines = 1 - cosine_error(Likeness(one, products, _at_ends(squared, edges)))
    return cosines, live_edges(edges, there & (squared > _LEAST))
