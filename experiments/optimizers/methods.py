"""The methods that are compared. Each starts from standing still and gives what it has found after 0, 1, 2, 4, ...
iterations, and what that takes; compilation is apart."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from time import perf_counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import optax
from one_update import Update
from scipy.spatial import cKDTree
from trimesh.registration import procrustes

from gsjax.geometry.cameras import pixel_grid, unproject
from gsjax.methods.object_tracker.align import align
from gsjax.methods.object_tracker.config import AlignConfig, RefineConfig
from gsjax.methods.object_tracker.motion import Motion
from gsjax.methods.object_tracker.points import sight_of
from gsjax.methods.object_tracker.refine import RefineBatch, refine_loss, refine_residual
from gsjax.methods.object_tracker.search import first_watch, search, widened
from gsjax.optim.compiler import host_options
from gsjax.optim.least_squares import least_squares_step

# Tuned on other recordings than those of the table (see docs/results-optimizers.md).
REFINE = RefineConfig(delta_rate=1e-4)
RATES = {"translation": (1.5e-3, 0.0), "SE(3)": (1.5e-3, 1.5e-2)}
DAMPING = 1.0
ICP_REACH, ICP_MARGIN = 0.03, 0.05
ALIGN = AlignConfig()


class Trace(NamedTuple):
    """What a method has found after so many iterations.

    Attributes:
        counts: iterations.
        motions: after each of these counts.
        ms: what it took from images in memory to there, milliseconds.
    """

    counts: tuple[int, ...]
    motions: list[Motion]
    ms: list[float]


def standing(update: Update) -> Motion:
    """No motion."""
    return Motion(jnp.zeros((len(update.batch.centers), 6)), jnp.zeros_like(update.batch.pose.means))


def compiled(function: Callable, *arguments: Any) -> Callable:
    return jax.jit(function, compiler_options=host_options() or None).lower(*arguments).compile()


def timed(function: Callable, *arguments: Any) -> tuple[Any, float]:
    """What the function gives, and milliseconds."""
    begun = perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return result, 1e3 * (perf_counter() - begun)


def adam(update: Update, rates: tuple[float, float], counts: tuple[int, ...], config=REFINE) -> Trace:
    """Adam as in `refine`, whose rates fall to a tenth by the last iteration, whichever that is."""
    optimizer = optax.scale_by_adam(b1=0.8, b2=0.95)
    rates = Motion(jnp.repeat(jnp.array(rates), 3), jnp.array(config.delta_rate))

    def iterate(motion: Motion, state: Any, batch: RefineBatch, rates: Motion):
        loss = partial(refine_loss, batch=batch, step=0, key=None, config=config)
        gradient, _ = jax.grad(loss, has_aux=True)(motion)
        change, state = optimizer.update(gradient, state)
        return jax.tree.map(lambda a, rate, by: a - rate * by, motion, rates, change), state

    start = standing(update)
    step = compiled(iterate, start, optimizer.init(start), update.batch, rates)
    motions, ms = [], []
    for count in counts:
        motion, state = start, optimizer.init(start)
        for i in range(count):
            falling = jax.tree.map(lambda rate, i=i, n=count: rate * 0.1 ** (i / n), rates)
            (motion, state), took = timed(step, motion, state, update.batch, falling)
            ms.append(took)
        motions.append(motion)
    return Trace(counts, motions, [count * float(np.median(ms)) for count in counts])


def levenberg_marquardt(update: Update, counts: tuple[int, ...], damping: float = DAMPING, block: int = 4, softness: float = 0.1) -> Trace:
    """All groups at once, on rendered residuals, with a dense Jacobian by columns."""
    batch = update.batch._replace(plan=replace(update.batch.plan, derivative="forward"))
    residual = partial(refine_residual, config=REFINE, softness=softness, block=block)
    step = least_squares_step(residual, jac="fwd", damping=damping)
    motions = jaxlie.SE3.identity((len(batch.centers),))
    state = step.init(motions)
    advance = compiled(lambda *of: step.update(*of, step=0, key=None), motions, state, batch)
    found, ms = {0: standing(update)}, []
    for i in range(max(counts)):
        (motions, state, _), took = timed(advance, motions, state, batch)
        ms.append(took)
        twists = jnp.concatenate([motions.translation(), motions.rotation().log()], axis=-1)
        found[i + 1] = Motion(twists, found[0].delta)
    return Trace(counts, [found[n] for n in counts], [n * float(np.median(ms)) for n in counts])


def icp(update: Update, counts: tuple[int, ...], reach: float = ICP_REACH) -> Trace:
    """Iterative closest points of each group, from its last pixels to all points that the depth cameras measure near it.

    Pairs further apart than `reach`, metres, do not count.
    """
    frame, centers = update.batch.frame, np.asarray(update.batch.centers, np.float64)
    grid = pixel_grid(frame.cameras.width, frame.cameras.height).reshape(-1, 2)
    depths = frame.depths.reshape(len(frame.depths), -1)
    views = (grid, depths, frame.cameras.viewmat, frame.cameras.K)
    lift = compiled(jax.vmap(unproject, in_axes=(None, 0, 0, 0)), *views)
    begun = perf_counter()
    measured = np.asarray(lift(*views))[np.asarray(depths) > 0]
    sources, trees = [], []
    for means, seen in zip(np.asarray(update.points.means), np.asarray(update.points.seen), strict=True):
        source = np.swapaxes(means, 1, 2)[seen > 0].astype(np.float64)
        low, high = (source.min(0) - ICP_MARGIN, source.max(0) + ICP_MARGIN) if len(source) else (0.0, 0.0)
        near = measured[((measured > low) & (measured < high)).all(1)]
        sources.append(source)
        trees.append(cKDTree(near) if len(near) else None)
    times = [1e3 * (perf_counter() - begun)]
    poses, found = [np.eye(4) for _ in sources], {0: standing(update)}
    for i in range(max(counts)):
        begun = perf_counter()
        for k, (source, tree) in enumerate(zip(sources, trees, strict=True)):
            if tree is None:
                continue
            moved = source @ poses[k][:3, :3].T + poses[k][:3, 3]
            distance, nearest = tree.query(moved)
            pairs = distance < reach
            if pairs.sum() >= 3:
                target = tree.data[nearest[pairs]]
                poses[k] = procrustes(moved[pairs], target, reflection=False, scale=False)[0] @ poses[k]
        times.append(1e3 * (perf_counter() - begun))
        turns = jaxlie.SO3.from_matrix(jnp.array([pose[:3, :3] for pose in poses]))
        shifts = [pose[:3, :3] @ c + pose[:3, 3] - c for pose, c in zip(poses, centers, strict=True)]
        twists = jnp.concatenate([jnp.array(shifts), turns.log()], axis=-1)
        found[i + 1] = Motion(twists, found[0].delta)
    each = float(np.median(times[1:]))
    return Trace(counts, [found[n] for n in counts], [times[0] + n * each for n in counts])


def direct(update: Update, counts: tuple[int, ...], calls: int = 5) -> Trace:
    """Direct alignment: half of the iterations with wide scales, half with narrow ones, as the tracker does it."""
    centers, start = update.batch.centers, standing(update)
    over_groups = jax.vmap(align, in_axes=(0, 0, 0, None, None))

    def aligned(points, frame, config):
        sight = sight_of(frame, config.shading)
        wide = over_groups(start.twists, points, centers, sight, widened(config))
        return over_groups(wide, points, centers, sight, config)

    configs = [replace(ALIGN, iterations=count // 2) for count in counts if count]
    return _traced(update, counts, [partial(aligned, config=config) for config in configs], calls)


def searched(update: Update, calls: int = 5) -> Trace:
    """Direct alignment as it comes, after which every group is looked for all around, too."""
    num_groups = len(update.batch.centers)
    watch, visible = first_watch(num_groups), jnp.ones(num_groups, bool)

    def found(points, frame):
        given = (jnp.zeros((1, num_groups, 6)), points, update.batch.centers, sight_of(frame, ALIGN.shading))
        return search(*given, ALIGN, watch, visible, jnp.int32(num_groups))[0].twists

    return _traced(update, (0, 2 * ALIGN.iterations), [found], calls)


def _traced(update: Update, counts: tuple[int, ...], finders: list[Callable], calls: int) -> Trace:
    """Each finder, called several times."""
    arguments = (update.points, update.batch.frame)
    motions, ms = [standing(update)], [0.0]
    for find in finders:
        find = compiled(find, *arguments)
        results = [timed(find, *arguments) for _ in range(calls)]
        motions.append(Motion(results[0][0], motions[0].delta))
        ms.append(float(np.median([took for _, took in results])))
    return Trace(counts, motions, ms)
