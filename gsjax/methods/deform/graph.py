"""The graph over a scene that moves: the teacher's features at nodes, and the losses that tie the scene's
features to them.

Nodes are Gaussians far from each other, the same in all frames, for the scene is one and moves. In a frame a
node is valid if the frame shows it: it falls on a pixel that counts, at the depth that is seen there.
A step has the graph of its frame and of those around it. Where all frames are known it is made once, on the
host (`frame_graphs`); where they come one by one, within the step (`seen_ids`, `graph_of`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.cameras import Camera, pixels_of, project
from gsjax.geometry.sampling import farthest_points
from gsjax.losses.edges import (
    Edges,
    Matching,
    edge_affinities,
    edge_weights,
    similar_edges,
    spatial_edges,
    temporal_edges,
)
from gsjax.losses.graph import node_loss, similarity_loss, structure_loss
from gsjax.methods.deform.poses import times_of
from gsjax.methods.deform.start import known_depth
from gsjax.methods.settings import expect
from gsjax.scene.frame import Frame

_NEAR = 0.05  # share of the depth by which what is seen may lie before or behind a node


@dataclass(frozen=True)
class GraphConfig:
    """Nodes, edges, and weights of the losses; the defaults are SurstSplat's (section 3)."""

    kind: Literal["matching", "similarity", "none"] = "matching"
    """SurstSplat's node and structure losses (eqs. 11 and 12), GaussianClin's similar pairs (eq. 8), or no
    graph."""
    after: float = 0.5
    """Share of the steps with deformation before the graph is made, which needs to know how nodes move."""
    nodes: int = 256
    """Number of nodes."""
    neighbors: int = 8
    """Edges from a node within its frame."""
    matches: int = 4
    """Edges from a node to each other frame of the window."""
    window: int = 2
    """Frames to either side."""
    tau_x: float = 0.1
    """Distance over which edges lose weight (SurstSplat, eq. 8), in radii of the scene."""
    tau_t: float = 0.5
    """Time over which edges lose weight, as a share of the window."""
    node: float = 0.1
    """Weight of SurstSplat's node loss."""
    structure: float = 0.1
    """Weight of SurstSplat's structure loss."""
    spatial: float = 0.1
    """Weight of GaussianClin's pairs within a frame."""
    temporal: float = 0.1
    """Weight of GaussianClin's pairs across frames."""

    def __post_init__(self):
        expect(
            self,
            "graph.",
            after=(0, 1),
            nodes=(2, 4096),
            neighbors=(1, np.inf),
            matches=(1, np.inf),
            window=(1, np.inf),
            tau_x=(1e-6, np.inf),
            tau_t=(1e-6, np.inf),
            **dict.fromkeys(("node", "structure", "spatial", "temporal"), (0, np.inf)),
        )


class FrameGraph(NamedTuple):
    """The graph of a frame and of those around it, T of them.

    Attributes:
        nodes: rows of the Gaussians that are nodes.
        times: of the frames, 0 to 1.
        teacher: its features at nodes, in the scene's channels.
        valid: where it has one.
        edges: of each kind, spatial and temporal together for a matching, else one after the other.
        wanted: the teacher's affinities of edges; None without a matching.
        weights: of edges; None without a matching.
    """

    nodes: Int[Array, "n"]
    times: Float[Array, "T"]
    teacher: Float[Array, "T n c"]
    valid: Bool[Array, "T n"]
    edges: tuple[Edges, ...]
    wanted: Float[Array, "T n e"] | None
    weights: Float[Array, "T n e"] | None


def frame_graphs(
    places: Float[np.ndarray, "frames n 3"],
    nodes: Int[np.ndarray, "n"],
    frames: Sequence[Frame],
    ids: Sequence[Int[np.ndarray, "h w"]],
    codebook: Float[np.ndarray, "k c"],
    config: GraphConfig,
    radius: float,
) -> list[FrameGraph]:
    """The graph of each frame.

    Args:
        places: of nodes, deformed as in each frame, metres.
        nodes: rows of the Gaussians that are nodes.
        frames: of one camera each, over time.
        ids: row of the codebook of each of the teacher's pixels, for each frame; -1 for none.
        codebook: the teacher's features, in the scene's channels.
        config: of the graph.
        radius: of the scene, metres.
    """
    labelled = [_labelled(*one, codebook) for one in zip(places, frames, ids, strict=True)]
    teacher, valid = (np.stack(column) for column in zip(*labelled, strict=True))
    times = times_of(frames)
    width = min(2 * config.window + 1, len(frames))
    build = jax.jit(graph_of, static_argnums=(0, 1))
    graphs = []
    for i in range(len(frames)):
        first = int(np.clip(i - config.window, 0, len(frames) - width))
        there = slice(first, first + width)
        arrays = (nodes, times[there], places[there], teacher[there], valid[there])
        given = (jnp.asarray(nodes), *(jnp.asarray(a, jnp.result_type(float)) for a in arrays[1:4]))
        graphs.append(build(config, radius, *given, jnp.asarray(valid[there])))
    return graphs


def graph_of(
    config: GraphConfig,
    radius: float,
    nodes: Int[Array, "n"],
    times: Float[Array, "T"],
    places: Float[Array, "T n 3"],
    teacher: Float[Array, "T n c"],
    valid: Bool[Array, "T n"],
) -> FrameGraph:
    """The graph of T frames; a pure function of its arrays.

    Args:
        config: of the graph.
        radius: of the scene, metres.
        nodes, times, teacher, valid: as in `FrameGraph`.
        places: of nodes in each frame, metres.
    """
    if config.kind == "similarity":
        edges = (
            similar_edges(teacher, config.neighbors, 0, valid),
            similar_edges(teacher, config.matches, config.window, valid),
        )
        return FrameGraph(nodes, times, teacher, valid, edges, None, None)
    both = spatial_edges(places, config.neighbors, valid)
    both |= temporal_edges(teacher, config.matches, config.window, valid, _MATCHING)
    wanted = edge_affinities(teacher, both, valid, _MATCHING)
    span = jnp.maximum(times[-1] - times[0], 1e-6)
    weights = edge_weights(places, teacher, times, both, config.tau_x * radius, config.tau_t * span)
    return FrameGraph(nodes, times, teacher, valid, (both,), wanted, weights)


def seen_ids(
    places: Float[Array, "n 3"],
    cameras: Camera,
    ids: Int[Array, "C h w"],
    depths: Float[Array, "C height width"],
) -> Int[Array, "n"]:
    """The row of the codebook that the teacher gives each place, in the first of C cameras that sees it; -1
    where none does. A pure function of its arrays, for within a step; `frame_graphs` does it on the host.

    Args:
        places: metres.
        cameras: that look at them, viewmat [C,4,4] and K [C,3,3].
        ids: of the teacher's pixels, a grid of any size over each picture; -1 for none.
        depths: what is seen, metres; 0 where unknown, and there nothing hides a place.
    """
    (high, wide), (height, width) = ids.shape[1:], depths.shape[1:]

    def one(viewmat, K, ids, depth):
        pixels, z = project(places, viewmat, K)
        x, y = pixels.T
        inside = (z > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        column, row = (jnp.where(inside, axis, 0).astype(jnp.int32) for axis in (x, y))
        seen = depth[row, column]
        unhidden = (seen == 0) | (jnp.abs(seen - z) < _NEAR * seen)
        return jnp.where(inside & unhidden, ids[row * high // height, column * wide // width], -1)

    found = jax.vmap(one)(cameras.viewmat, cameras.K, ids, depths)
    return jnp.take_along_axis(found, jnp.argmax(found >= 0, axis=0)[None], axis=0)[0]


def graph_nodes(means: Float[Array, "n 3"], count: int) -> Int[np.ndarray, "count"]:
    """Rows of Gaussians that lie far from each other."""
    sample = jax.jit(farthest_points, static_argnums=1)(means, min(count, len(means)))
    return np.asarray(sample.indices)[np.asarray(sample.valid)]


def graph_loss(
    features: Float[Array, "N c"] | Float[Array, "T n c"], graph: FrameGraph, config: GraphConfig
) -> dict[str, Array]:
    """Losses on the nodes' features, by name; each times its weight.

    Args:
        features: of all Gaussians, the same at all times; or of the nodes at the graph's times, where they
            change (`features_at`).
        graph: of a frame.
        config: of the graph.
    """
    ours = features
    if features.ndim == 2:
        one = features[graph.nodes]
        ours = jnp.broadcast_to(one, (len(graph.times), *one.shape))
    if config.kind == "matching":
        assert graph.wanted is not None
        (edges,) = graph.edges
        return {
            "node": config.node * node_loss(ours, graph.teacher, graph.valid),
            "structure": config.structure
            * structure_loss(ours, graph.wanted, edges, graph.weights, graph.valid, _MATCHING),
        }
    spatial, temporal = graph.edges
    return {
        "spatial": config.spatial * similarity_loss(ours, spatial, graph.valid),
        "temporal": config.temporal * similarity_loss(ours, temporal, graph.valid),
    }


_MATCHING = Matching(derivative="implicit")  # rows are off by 3e-7 at this temperature


def _labelled(
    places: Float[np.ndarray, "n 3"],
    frame: Frame,
    ids: Int[np.ndarray, "h w"],
    codebook: Float[np.ndarray, "k c"],
) -> tuple[Float[np.ndarray, "n c"], Bool[np.ndarray, "n"]]:
    """The teacher's features at places in a frame, and where it has one of them and not of what is before or
    behind them."""
    camera = frame.cameras
    column, row, z, inside = pixels_of(places, camera.viewmat[0], camera.K[0], camera.width, camera.height)
    depth = known_depth(frame)[row, column]
    unhidden = (depth == 0) | (np.abs(depth - z) < _NEAR * depth)
    counted = np.ones(len(z), bool) if frame.masks is None else frame.masks[0][row, column]
    high, wide = ids.shape
    here = ids[row * high // camera.height, column * wide // camera.width]
    return codebook[np.maximum(here, 0)], inside & counted & unhidden & (here >= 0)
