"""The graph over a moving scene: the teacher's features at nodes, and losses between them and the scene's
features.

Nodes are Gaussians far from each other, the same in all frames. A node is valid in a frame if it is visible
there: it projects to a pixel that counts, at the depth of that pixel. A step has the graph of its frame and
the frames around it. If all frames are known, it is made once, on the host (`frame_graphs`); if they arrive
one by one, within the step (`seen_ids`, `graph_of`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.cameras import Camera, pixels_of, project
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

_NEAR = 0.05  # relative difference in depth between a node and its pixel, for it to be visible there


@dataclass(frozen=True)
class GraphConfig:
    """Nodes, edges and loss weights of the graph; only SurstSplat's weights of losses, 0.1, are printed
    (section 3)."""

    kind: Literal["matching", "similarity", "none"] = "matching"
    """SurstSplat's node and structure losses (eqs. 11 and 12), GaussianClin's similar pairs (eq. 8), or no
    graph."""
    after: float = 0.5
    """Share of the joint steps after which the graph is made, from the nodes' motion so far."""
    nodes: int = 256
    """Number of nodes."""
    neighbors: int = 8
    """Number of edges from each node to others of its frame."""
    matches: int = 4
    """Number of edges from each node to each of the other frames in the window."""
    window: int = 2
    """Number of frames on either side of a step's frame."""
    tau_x: float = 0.1
    """Length scale of the edges' weights (SurstSplat, eq. 8), in radii of the scene."""
    tau_t: float = 0.5
    """Time scale of the edges' weights, as a share of the window."""
    node: float = 0.1
    """Weight of SurstSplat's node loss."""
    structure: float = 0.1
    """Weight of SurstSplat's structure loss."""
    spatial: float = 0.1
    """Weight of GaussianClin's loss on pairs within a frame."""
    temporal: float = 0.1
    """Weight of GaussianClin's loss on pairs across frames."""

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
    """The graph of a frame and those around it, T in all.

    Attributes:
        nodes: rows of the Gaussians that are nodes.
        times: times of the frames, 0 to 1.
        teacher: the teacher's features at nodes, in the scene's channels.
        valid: whether there is one, for a node that is visible in the frame.
        edges: spatial and temporal edges; for a matching, the union of both.
        affinities: the teacher's affinities of edges; None without a matching.
        weights: weights of edges; None without a matching.
    """

    nodes: Int[Array, "n"]
    times: Float[Array, "T"]
    teacher: Float[Array, "T n c"]
    valid: Bool[Array, "T n"]
    edges: tuple[Edges, ...]
    affinities: Float[Array, "T n e"] | None
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
        places: deformed positions of the nodes in each frame, metres.
        nodes: rows of the Gaussians that are nodes.
        frames: frames of one camera over time.
        ids, codebook: the teacher's labels, as in `Lesson`.
        config: configuration of the graph.
        radius: radius of the scene, metres.
    """
    labelled = [_features_at_nodes(*one, codebook) for one in zip(places, frames, ids, strict=True)]
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
        config: configuration of the graph.
        radius: radius of the scene, metres.
        nodes, times, teacher, valid: as in `FrameGraph`.
        places: positions of the nodes in each frame, metres.
    """
    if config.kind == "similarity":
        edges = (
            similar_edges(teacher, config.neighbors, 0, valid),
            similar_edges(teacher, config.matches, config.window, valid),
        )
        return FrameGraph(nodes, times, teacher, valid, edges, None, None)
    both = spatial_edges(places, config.neighbors, valid)
    both |= temporal_edges(teacher, config.matches, config.window, valid, _MATCHING)
    affinities = edge_affinities(teacher, both, valid, _MATCHING)
    span = jnp.maximum(times[-1] - times[0], 1e-6)
    weights = edge_weights(places, teacher, times, both, config.tau_x * radius, config.tau_t * span)
    return FrameGraph(nodes, times, teacher, valid, (both,), affinities, weights)


def seen_ids(
    places: Float[Array, "n 3"],
    cameras: Camera,
    ids: Int[Array, "C h w"],
    depths: Float[Array, "C height width"],
) -> Int[Array, "n"]:
    """The teacher's label of each place in the first of C cameras that sees it; -1 where none does. A pure
    function of its arrays, for use within a step; on the host, `frame_graphs` does the same.

    Args:
        places: positions, metres.
        cameras: viewmat [C,4,4] and K [C,3,3].
        ids: row of the codebook of each of the teacher's pixels, a grid of any size over each image; -1 for
            none.
        depths: depths of the images, metres; 0 where unknown; there, no place counts as occluded.
    """
    (high, wide), (height, width) = ids.shape[1:], depths.shape[1:]

    def one(viewmat, K, ids, depth):
        pixels, z = project(places, viewmat, K)
        x, y = pixels.T
        inside = (z > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        column, row = (jnp.where(inside, axis, 0).astype(jnp.int32) for axis in (x, y))
        seen = depth[row, column]
        unoccluded = (seen == 0) | (jnp.abs(seen - z) < _NEAR * seen)
        return jnp.where(inside & unoccluded, ids[row * high // height, column * wide // width], -1)

    found = jax.vmap(one)(cameras.viewmat, cameras.K, ids, depths)
    return jnp.take_along_axis(found, jnp.argmax(found >= 0, axis=0)[None], axis=0)[0]


def graph_loss(
    features: Float[Array, "N c"] | Float[Array, "T n c"], graph: FrameGraph, config: GraphConfig
) -> dict[str, Array]:
    """Weighted losses on the nodes' features, by name.

    Args:
        features: features of all Gaussians, constant over time; or of the nodes at the graph's times.
        graph: graph of a frame.
        config: configuration of the graph.
    """
    ours = features
    if features.ndim == 2:
        one = features[graph.nodes]
        ours = jnp.broadcast_to(one, (len(graph.times), *one.shape))
    if config.kind == "matching":
        assert graph.affinities is not None
        (edges,) = graph.edges
        return {
            "node": config.node * node_loss(ours, graph.teacher, graph.valid),
            "structure": config.structure
            * structure_loss(ours, graph.affinities, edges, graph.weights, graph.valid, _MATCHING),
        }
    spatial, temporal = graph.edges
    return {
        "spatial": config.spatial * similarity_loss(ours, spatial, graph.valid),
        "temporal": config.temporal * similarity_loss(ours, temporal, graph.valid),
    }


_MATCHING = Matching(derivative="implicit")  # row sums are off by 3e-7 at this temperature


def _features_at_nodes(
    places: Float[np.ndarray, "n 3"],
    frame: Frame,
    ids: Int[np.ndarray, "h w"],
    codebook: Float[np.ndarray, "k c"],
) -> tuple[Float[np.ndarray, "n c"], Bool[np.ndarray, "n"]]:
    """The teacher's features at places in a frame, and whether there is one and the place is visible."""
    camera = frame.cameras
    column, row, z, inside = pixels_of(places, camera.viewmat[0], camera.K[0], camera.width, camera.height)
    depth = known_depth(frame)[row, column]
    unoccluded = (depth == 0) | (np.abs(depth - z) < _NEAR * depth)
    counted = np.ones(len(z), bool) if frame.masks is None else frame.masks[0][row, column]
    high, wide = ids.shape
    here = ids[row * high // camera.height, column * wide // camera.width]
    return codebook[np.maximum(here, 0)], inside & counted & unoccluded & (here >= 0)
