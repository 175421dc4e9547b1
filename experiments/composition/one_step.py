"""Three methods as one jitted step: the tracker of Object-Aware Gaussian Splatting for Robotic Manipulation,
a teacher's features distilled into what is tracked (FD-3DGS, SurstSplat, GaussianClin), and the graph of
SurstSplat or GaussianClin over them. docs/composition.md has `composed` as it stands here."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from gsjax.methods.deform import feature_loss, graph_loss, graph_of, seen_ids
from gsjax.methods.track import TrackBatch
from gsjax.optim.step import gradient_step
from gsjax.scene.render import render


class Memory(NamedTuple):
    """The last T frames: their times, the nodes' places, and the teacher's ids of nodes (-1: none)."""

    times: Float[Array, "T"]
    places: Float[Array, "T n 3"]
    ids: Int[Array, "T n"]


def empty_memory(frames: int, nodes: int) -> Memory:
    """The memory before the first frame."""
    return Memory(jnp.zeros(frames), jnp.zeros((frames, nodes, 3)), jnp.full((frames, nodes), -1, jnp.int32))


def composed(tracker, nodes, codebook, radius, optimizer, config, plan):
    """The losses of a frame, the optimizer's first state, and the step.

    Args:
        tracker: a `Step`, from `gsjax.methods.track.step`.
        nodes: Gaussians with features, from which the others blend theirs (`nodes_of`).
        codebook: the teacher's feature of each class, a row a class.
        radius: radius of the scene, metres.
        optimizer: optimizer of the features.
        config: `GraphConfig`.
        plan: plan for rendering features.
    """

    def spread(features):
        return jnp.einsum("nk,nkc->nc", nodes.weights, features[nodes.indices])

    def loss(features, batch, *, step, key):
        gaussians, views, ids, graph = batch
        drawn = render(gaussians, views, plan, features=spread(features))
        of_views = jax.vmap(feature_loss, (0, None, 0))(drawn.features, codebook, ids)
        terms = {"feature": of_views.mean()}
        if graph is not None:
            terms |= graph_loss(spread(features), graph, config)
        return sum(terms.values()), terms | {"overflow": drawn.meta.overflow.any()}

    learner = gradient_step(loss, optimizer)

    def step(state, batch: TrackBatch, views, ids, time, key):
        tracked, tracking, features, learning, memory = state
        tracked, tracking, followed = tracker.update(tracked, tracking, batch, step=0, key=key)
        gaussians, graph = tracked.gaussians(), None
        if config.kind != "none":
            places = gaussians.means[nodes.rows]
            new = Memory(time, places, seen_ids(places, batch.frame.cameras, ids, batch.frame.depths))
            memory = jax.tree.map(lambda old, new: jnp.concatenate([old[1:], new[None]]), memory, new)
            taught = codebook[jnp.maximum(memory.ids, 0)]
            graph = graph_of(config, radius, nodes.rows, *memory[:2], taught, memory.ids >= 0)
        given = gaussians, views, ids, graph
        features, learning, info = learner.update(features, learning, given, step=0, key=None)
        info |= {"tracker": followed["residual"], "lost": followed["lost"]}
        info["overflow"] |= followed["overflow"]
        return (tracked, tracking, features, learning, memory), info

    return loss, learner.init, step
