"""The host loop of a deforming scene: which frame is next, in the warm-up or with the deformation."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from time import perf_counter
from typing import Any, NamedTuple

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.geometry.cameras import Camera
from gsjax.losses.extra import ExtraLosses, named_losses
from gsjax.methods.deform.config import DeformConfig
from gsjax.methods.deform.graph import FrameGraph, frame_graphs, graph_nodes
from gsjax.methods.deform.nodes import nodes_of
from gsjax.methods.deform.poses import refined_looks
from gsjax.methods.deform.start import Look, begins, known_depth, on_plane, start_gaussians
from gsjax.methods.deform.update import Batch, DeformingScene, Moving, deform_step
from gsjax.methods.sampling import shuffled_index
from gsjax.optim.compiler import host_options
from gsjax.rasterize.plan import Plan
from gsjax.scene.deformation import init_deformation
from gsjax.scene.gaussians import Gaussians, cull_invalid
from gsjax.scene.render import plan_render

_HEADROOM = 1.3
_OUTSIDE = 0.005  # of the Gaussians, that may lie beyond either end of an axis
_GATE_AFTER = 0.25  # of the steps with deformation: until then it is seen who moves
_THIN = 0.2  # radii: a scene is taken to reach so far along an axis at least, as a plane's does not
_NEARLY = 0.95  # of the pixels of a teacher's cell: it counts
_MARGIN = 0.05  # of the field's box around the scene, as a share of its edges: what moves stays inside


class DeformProblem(NamedTuple):
    """What does not change during a reconstruction.

    Attributes:
        looks: what was seen.
        codebook: what the teacher says, in the scene's channels; None without.
        batches: one a look, without what a state holds.
        first: the look that the canonical scene is like.
        config: how.
        radius: of the scene, metres; the unit of rates.
        bounds: of the deformation field, around the first Gaussians, metres.
        plan: that views are drawn with, as large as the first Gaussians need it.
    """

    looks: Sequence[Look]
    codebook: Float[np.ndarray, "k channels"] | None
    batches: list[Batch]
    first: int
    config: DeformConfig
    radius: float
    bounds: Float[np.ndarray, "2 3"]
    plan: Plan

    def plan_for(self, state: "DeformState") -> Plan:
        """That views of a state are drawn with."""
        return replace(self.plan, capacity=max(self.plan.capacity, state.capacity))


class DeformState(eqx.Module):
    """What a reconstruction goes on from, to the same bits.

    Attributes:
        scene: what trains.
        optimizer: what the step carries along.
        moving: what the field is asked about.
        graphs: of each look, once they were made.
        step: how many steps were made.
        capacity: that the plan has grown to.
    """

    scene: DeformingScene
    optimizer: Any
    moving: Moving
    graphs: list[FrameGraph] | None
    step: int
    capacity: int


class Advanced(NamedTuple):
    """A reconstruction after one more step.

    Attributes:
        state: to go on from. Its arrays are given away in the next step: copy what is to be kept.
        info: losses of this step, on the device.
        seconds: that it took, without what compiled.
        compile_seconds: that compiling took in it.
    """

    state: DeformState
    info: dict[str, Array]
    seconds: float
    compile_seconds: float


def begin_deform(
    looks: Sequence[Look],
    config: DeformConfig,
    codebook: Float[np.ndarray, "k channels"] | None = None,
    first: int | None = None,
    gaussians: Gaussians | None = None,
) -> tuple[DeformProblem, DeformState]:
    """A reconstruction before its first step.

    Args:
        looks: what a camera saw over time, all of one size. Where none has depth, it begins on a plane.
        config: how.
        codebook: what the teacher says of the rows that looks name, in `config.channels` numbers.
        first: the look that the canonical scene is like; unless given the first with depth where a pixel
            counts, or where one counts if none has depth.
        gaussians: canonical scene to begin with, less what cannot be drawn; made of depth, or on the plane,
            unless given.

    Raises:
        ValueError: looks differ in size, no pixel counts, depth is nowhere known, or the teacher says what
            the codebook has not.
    """
    _check(looks, config, codebook)
    if first is None:
        first = next((i for i, look in enumerate(looks) if begins(look, looks)), 0)
    if gaussians is None:
        flat = all(look.depth is None for look in looks)
        seen = on_plane(looks, first, config.plane_depth) if flat else looks
        gaussians = start_gaussians(seen, first, config.start_pixels)
    twists = jnp.zeros((len(looks), 6)) if config.refine_poses else None
    gaussians, _ = cull_invalid(gaussians)
    if not gaussians.num:
        raise ValueError("gaussians: expected some that can be drawn, found none")
    own = jax.tree.map(jnp.array, gaussians)  # copies, for steps give buffers away
    scene = DeformingScene(own, None, twists)
    if codebook is not None:
        features = jnp.zeros((scene.gaussians.num, config.channels))
        scene = eqx.tree_at(
            lambda s: s.gaussians.features, scene, features, is_leaf=lambda leaf: leaf is None
        )
    means = np.asarray(scene.gaussians.means)
    middle = np.median(means, axis=0)
    radius = float(np.quantile(np.linalg.norm(means - middle, axis=1), 0.9))
    if not radius > 0:
        raise ValueError("depth: expected a scene of some extent, found all of its points at one place")
    shared = None if codebook is None else jnp.asarray(codebook, jnp.result_type(float))
    batches = [_batch(look, shared) for look in looks]
    if config.refine_poses:
        rows = (-1 if i == first else i for i in range(len(looks)))
        batches = [
            batch._replace(look=jnp.asarray(row, jnp.int32)) for batch, row in zip(batches, rows, strict=True)
        ]
    plan = _plan_of(scene.gaussians, batches)
    low, high = np.quantile(means.astype(np.float64), (_OUTSIDE, 1 - _OUTSIDE), axis=0)
    room = _MARGIN * np.maximum(high - low, _THIN * radius)
    bounds = np.stack([low - room, high + room])
    problem = DeformProblem(looks, codebook, batches, first, config, radius, bounds, plan)
    state = DeformState(scene, deform_step(config, radius).init(scene), None, None, 0, plan.capacity)
    return problem, state


def reconstruct(
    problem: DeformProblem, state: DeformState, *, extra_losses: ExtraLosses = ()
) -> Iterator[Advanced]:
    """Step by step, until all is done: the canonical scene alone, then with its deformation. The same state
    and problem give the same bits, wherever the reconstruction was begun or resumed.

    Args:
        problem: from `begin_deform`.
        state: likewise, or that of an earlier `Advanced`. Its arrays are given away in the first step.
        extra_losses: functions `loss(scene, rendered, frame)` (`gsjax.losses.extra`) of one's own, whose
            scene is a `DeformingScene`. `info["extra"]` has their values.
    """
    config = problem.config
    named_losses(extra_losses)  # before it is a key, which a list cannot be
    advance = compiled_step(config, problem.radius, extra_losses)
    key = jax.random.key(config.seed)
    scene, optimizer, moving, graphs = state.scene, state.optimizer, state.moving, state.graphs
    plan = problem.plan_for(state)
    for i in range(state.step, config.warmup + config.iterations):
        if i == config.warmup and scene.field is None:
            scene, optimizer, moving = with_field(problem, scene)
        if i == _gate_from(config) and config.moving_share < 1 and moving is None:
            moving = farthest_moved(scene, problem.batches, config.moving_share)
        if i == _graph_from(config) and graphs is None:
            graphs = _graphs(problem, scene, moving)
        begun, programs = perf_counter(), advance._cache_size()
        while True:
            look = _turn(problem, i)
            graph = None if graphs is None else graphs[look]
            batch = problem.batches[look]._replace(moving=moving, graph=graph, plan=plan)
            scene, optimizer, info = advance(
                scene, optimizer, batch, jnp.asarray(i), jax.random.fold_in(key, i)
            )
            if not bool(info["overflow"]):
                break
            plan = plan.grown(int(info["needed"]), _HEADROOM)
        seconds, new = perf_counter() - begun, advance._cache_size() > programs
        now = DeformState(scene, optimizer, moving, graphs, i + 1, plan.capacity)
        yield Advanced(now, info, 0.0 if new else seconds, seconds if new else 0.0)


def of_step(problem: DeformProblem, state: DeformState, step: int) -> DeformState:
    """A state of the form that one after so many steps has, to be filled with what was saved of that.

    Args:
        state: from `begin_deform`.
    """
    if step > problem.config.warmup:
        scene, optimizer, moving = with_field(problem, state.scene)
        if step > _gate_from(problem.config) and problem.config.moving_share < 1:
            moving = jnp.arange(_share(scene.gaussians.num, problem.config.moving_share), dtype=jnp.int32)
        graphs = _graphs(problem, scene, moving) if step > _graph_from(problem.config) else None
        state = DeformState(scene, optimizer, moving, graphs, step, state.capacity)
    return state


def _graph_from(config: DeformConfig) -> int:
    """The step before which the graph is made."""
    return config.warmup + round(config.graph.after * config.iterations)


def _gate_from(config: DeformConfig) -> int:
    """The step before which it is settled who deforms."""
    return config.warmup + round(_GATE_AFTER * config.iterations)


def farthest_moved(scene: DeformingScene, batches: Sequence[Batch], share: float) -> Int[Array, "M"]:
    """Rows of the Gaussians that are farthest from where the canonical scene has them, at any look's time.

    Args:
        scene: canonical, and how it deforms.
        batches: of all looks.
        share: of the Gaussians, 0 to 1.
    """
    at = jax.jit(lambda scene, time: jnp.linalg.norm(scene.at(time).means - scene.gaussians.means, axis=-1))
    farthest = np.max([np.asarray(at(scene, batch.time)) for batch in batches], axis=0)
    order = np.argsort(-farthest, kind="stable")
    return jnp.asarray(np.sort(order[: _share(len(farthest), share)]), jnp.int32)


def _share(count: int, share: float) -> int:
    return max(1, round(share * count))


def with_field(problem: DeformProblem, scene: DeformingScene) -> tuple[DeformingScene, Any, Moving]:
    """The scene with a field that moves nothing yet, an optimizer that knows nothing yet, and what the field
    is asked about."""
    config, gaussians = problem.config, scene.gaussians
    size = 0 if gaussians.features is None else gaussians.features.shape[1]
    key = jax.random.fold_in(jax.random.key(config.seed), config.warmup)
    field = init_deformation(key, config.deformation, problem.bounds, size)
    scene = DeformingScene(gaussians, field, scene.twists)
    moving = nodes_of(gaussians, config.nodes) if config.nodes else None
    return scene, deform_step(config, problem.radius).init(scene), moving


def _graphs(problem: DeformProblem, scene: DeformingScene, moving: Moving) -> list[FrameGraph] | None:
    """Of each look, with nodes where the scene has them now."""
    config = problem.config.graph
    if config.kind == "none" or problem.codebook is None:
        return None
    nodes = graph_nodes(scene.gaussians.means, config.nodes)
    at = jax.jit(lambda scene, time: scene.at(time, moving).means[nodes])
    places = np.stack([np.asarray(at(scene, batch.time)) for batch in problem.batches])
    looks = problem.looks
    if scene.twists is not None:
        looks = refined_looks(looks, scene.twists, problem.radius)
    return frame_graphs(places, nodes, looks, problem.codebook, config, problem.radius)


@lru_cache(maxsize=4)
def compiled_step(config: DeformConfig, radius: float, extra_losses: ExtraLosses = ()) -> Callable:
    """The jitted step: scene, optimizer, batch, number, key. Buffers that it replaces are given away.

    Args:
        config: of the reconstruction.
        radius: of the scene, metres.
        extra_losses: of one's own.
    """
    step = deform_step(config, radius, extra_losses)

    @partial(jax.jit, compiler_options=host_options(), donate_argnums=(0, 1))
    def advance(scene, optimizer, batch, i, key):
        return step.update(scene, optimizer, batch, step=i, key=key)

    return advance


def _turn(problem: DeformProblem, step: int) -> int:
    """Which look a step has: all of them in a random order, and then in another."""
    if step < problem.config.warmup and problem.config.warmup_frames == "first":
        return problem.first
    return shuffled_index(problem.config.seed, step, len(problem.batches))


def counted_ids(look: Look) -> Int[np.ndarray, "h w"]:
    """What the teacher says of pixels that count, and of cells of its grid of which nearly all do: what is
    behind a tool is not to learn that it is one."""
    assert look.ids is not None
    if look.counts is None:
        return look.ids
    high, wide = look.ids.shape
    share = cv2.resize(look.counts.astype(np.float32), (wide, high), interpolation=cv2.INTER_AREA)
    return np.where(share > _NEARLY, look.ids, -1)


def _batch(look: Look, codebook: Array | None) -> Batch:
    """A look on the device."""
    dtype = jnp.result_type(float)
    height, width = look.image.shape[:2]
    viewmat, K = (jnp.asarray(a, dtype)[None] for a in (look.viewmat, look.K))
    counts = np.ones((height, width), bool) if look.counts is None else look.counts
    ids = None if look.ids is None else counted_ids(look)
    taught = codebook is not None and ids is not None
    return Batch(
        jnp.asarray(look.image)[None],
        jnp.asarray(counts)[None],
        None if look.depth is None else jnp.asarray(known_depth(look), dtype)[None],
        Camera(viewmat, K, width, height, look.near),
        jnp.asarray(look.time, dtype),
        jnp.asarray(ids, jnp.int32) if taught else None,
        codebook if taught else None,
        None,
        None,
        Plan(width, height, 0),
    )


def _plan_of(gaussians: Gaussians, batches: list[Batch]) -> Plan:
    """A plan for the scene in all cameras."""
    cameras = [batch.camera for batch in batches]
    viewmats, Ks = (jnp.concatenate([getattr(c, name) for c in cameras]) for name in ("viewmat", "K"))
    together = Camera(viewmats, Ks, cameras[0].width, cameras[0].height, cameras[0].near)
    return plan_render(gaussians, together, headroom=_HEADROOM)


def _check(looks: Sequence[Look], config: DeformConfig, codebook: np.ndarray | None) -> None:
    if not looks:
        raise ValueError("looks: expected at least one, found none")
    shape = looks[0].image.shape
    for i, look in enumerate(looks):
        if look.image.shape != shape:
            raise ValueError(
                f"looks: expected pictures {shape} as the first, found {look.image.shape} in {i}"
            )
        for name in ("counts", "depth"):
            value = getattr(look, name)
            if value is not None and value.shape != shape[:2]:
                raise ValueError(
                    f"looks: expected {name} of {shape[:2]} pixels like pictures, found {value.shape} in {i}"
                )
        if codebook is not None and (look.ids is None or look.ids.max(initial=-1) >= len(codebook)):
            found = "none" if look.ids is None else f"{look.ids.max()}"
            raise ValueError(
                f"looks: expected ids of {len(codebook)} rows of the codebook, or -1, found {found} in {i}"
            )
    if not any(look.counts is None or look.counts.any() for look in looks):
        raise ValueError("masks: in no look does any pixel count; are they inverted?")
    if codebook is not None and codebook.shape[1] != config.channels:
        raise ValueError(f"codebook: expected rows of {config.channels} numbers, found {codebook.shape[1]}")
