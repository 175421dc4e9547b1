"""The methods compared: the motion that each finds after 0, 1, 2, 4, ... iterations, and its time.

All start from no motion. Times begin with images in memory and are medians of warm calls.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from time import perf_counter
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import optax
from scipy.spatial import cKDTree
from trimesh.registration import procrustes

from experiments.shared.one_update import Update
from experiments.shared.timing import jitted, median_ms, timed
from gsjax.geometry.cameras import pixel_grid, unproject
from gsjax.methods.track.config import PRESETS, RefineConfig
from gsjax.methods.track.motion import Motion, place
from gsjax.methods.track.points import tone_images
from gsjax.methods.track.refine import refine_loss, refine_residual
from gsjax.methods.track.search import align_groups, follow, search
from gsjax.methods.track.watch import first_watch
from gsjax.optim.least_squares import least_squares_step
from gsjax.optim.step import Step
from gsjax.scene.render import render

ALIGN, REFINE = PRESETS["accurate"].align, RefineConfig(delta_rate=3e-5)
# Tuned on updates other than those of the table: see docs/results-optimizers.md.
TRANSLATION_RATE, ROTATION_RATE = 6e-3, 3e-2  # Adam's at first, metres and radians
BLOCKS, SOFTNESS = (8,) * 6 + (4,) * 4, 0.3  # Levenberg-Marquardt's, iteration by iteration
ICP_REACH, ICP_MARGIN = 0.03, 0.05  # metres; pairs and points farther apart do not count


class Trace(NamedTuple):
    """The result of a method.

    Attributes:
        counts: numbers of iterations.
        motions: the motion after each of them.
        ms: milliseconds until then.
    """

    counts: list[int]
    motions: list[Motion]
    ms: list[float]


def standing(update: Update) -> Motion:
    """No motion."""
    return Motion(jnp.zeros((len(update.batch.centers), 6)), jnp.zeros_like(update.batch.pose.means))


draw = jitted(lambda batch: render(place(batch.scene, batch.pose), batch.frame.cameras, batch.plan).colors)
"""The reference for times: all that may move with its surroundings, rendered once in all cameras."""

ADAM = optax.scale_by_adam(b1=0.8, b2=0.95)  # as in `refine`


@partial(jitted, static_argnames="config")
def adam_step(motion, state, batch, rates, config=REFINE):
    """One iteration on the loss of `refine`, with a rate for each number of a twist and one for delta."""
    loss = partial(refine_loss, batch=batch, step=0, key=None, config=config)
    change, state = ADAM.update(jax.grad(loss, has_aux=True)(motion)[0], state)
    return jax.tree.map(lambda a, rate, by: a - rate * by, motion, rates, change), state


def descend(start: Motion, batch, rates: Motion, count: int, config=REFINE) -> Motion:
    """`count` iterations of Adam with rates that fall to a tenth, as in `refine`."""
    motion, state = start, ADAM.init(start)
    for i in range(count):
        falling = jax.tree.map(lambda rate, i=i: rate * 0.1 ** (i / count), rates)
        motion, state = adam_step(motion, state, batch, falling, config=config)
    return motion


def adam(
    update: Update,
    counts: list[int],
    rotation_rate: float = ROTATION_RATE,
    delta_rate: float = REFINE.delta_rate,
) -> Trace:
    """Adam on D_k and delta_i; every count is a separate run with its own schedule."""
    start, batch = standing(update), update.batch
    rates = Motion(jnp.repeat(jnp.array([TRANSLATION_RATE, rotation_rate]), 3), jnp.array(delta_rate))
    each = median_ms(adam_step, start, ADAM.init(start), batch, rates)
    motions = [descend(start, batch, rates, count) for count in counts]
    return Trace(counts, motions, [count * each for count in counts])


def rigid_step(block: int) -> Step:
    return least_squares_step(
        partial(refine_residual, config=REFINE, block=block, softness=SOFTNESS), jac="fwd"
    )


@partial(jitted, static_argnames="block")
def least_squares(motions, state, batch, block):
    """One iteration of Levenberg-Marquardt on all groups at once."""
    return rigid_step(block).update(motions, state, batch, step=0, key=None)[:2]


def levenberg_marquardt(update: Update, counts: list[int]) -> Trace:
    """Levenberg-Marquardt on rendered residuals of rigid groups, coarse to fine, with a dense Jacobian by
    columns."""
    batch = update.batch._replace(plan=replace(update.batch.plan, derivative="forward"))
    motions, found, ms = jaxlie.SE3.identity((len(batch.centers),)), [standing(update)], []
    state, last = None, None
    for block in BLOCKS[: max(counts)]:
        if block != last:  # a new problem from here on
            state, last = rigid_step(block).init(motions), block
            timed(least_squares, motions, state, batch, block)  # compiles
        (motions, state), took = timed(least_squares, motions, state, batch, block)
        ms.append(took)
        twists = jnp.concatenate([motions.translation(), motions.rotation().log()], axis=-1)
        found.append(Motion(twists, found[0].delta))
    return Trace(counts, [found[n] for n in counts], [n * float(np.median(ms)) for n in counts])


lift = jitted(jax.vmap(unproject, in_axes=(None, 0, 0, 0)))


def icp(update: Update, counts: list[int], reach: float = ICP_REACH) -> Trace:
    """Iterative closest points: the pixels that showed a group against all measured points near it."""
    frame, centers = update.batch.frame, np.asarray(update.batch.centers, np.float64)
    grid = pixel_grid(frame.cameras.width, frame.cameras.height).reshape(-1, 2)
    depths = frame.depths.reshape(len(frame.depths), -1)
    views = (grid, depths, frame.cameras.viewmat, frame.cameras.K)
    lift(*views)
    begun = perf_counter()
    measured = np.asarray(lift(*views), np.float64)[np.asarray(depths) > 0]
    sources, trees = [], []
    for means, seen in zip(np.asarray(update.points.means), np.asarray(update.points.seen), strict=True):
        source = np.swapaxes(means, 1, 2)[seen > 0].astype(np.float64)
        inside = np.zeros(len(measured), bool)
        if len(source):
            low, high = source.min(0) - ICP_MARGIN, source.max(0) + ICP_MARGIN
            inside = ((measured > low) & (measured < high)).all(1)
        sources.append(source)
        trees.append(cKDTree(measured[inside]) if inside.any() else None)
    times, poses, found = [1e3 * (perf_counter() - begun)], np.tile(np.eye(4), (len(sources), 1, 1)), []
    for _ in range(max(counts) + 1):
        turns = jaxlie.SO3.from_matrix(jnp.asarray(poses[:, :3, :3], jnp.float32)).log()
        shifts = np.einsum("kij,kj->ki", poses[:, :3, :3], centers) + poses[:, :3, 3] - centers
        twists = jnp.concatenate([jnp.asarray(shifts, jnp.float32), turns], axis=-1)
        found.append(Motion(twists, jnp.zeros_like(update.batch.pose.means)))
        begun = perf_counter()
        for k, (source, tree) in enumerate(zip(sources, trees, strict=True)):
            moved = source @ poses[k, :3, :3].T + poses[k, :3, 3]
            distance, nearest = (np.inf, 0) if tree is None else tree.query(moved)
            pairs = np.broadcast_to(distance < reach, len(moved))
            if pairs.sum() >= 3:
                target = tree.data[nearest[pairs]]
                poses[k] = procrustes(moved[pairs], target, reflection=False, scale=False)[0] @ poses[k]
        times.append(1e3 * (perf_counter() - begun))
    each = float(np.median(times[1:]))
    return Trace(counts, [found[n] for n in counts], [times[0] + n * each if n else 0.0 for n in counts])


@partial(jitted, static_argnames="config")
def aligned(start, points, centers, frame, config=ALIGN):
    """Wide scales first, then narrow ones, as in `search`."""
    images = tone_images(frame, config.shading)
    return align_groups(start, points, centers, images, config)


@partial(jitted, static_argnames="config")
def searched(start, points, centers, frame, config=ALIGN):
    """Alignment followed by a search for every group in all directions."""
    images, count = tone_images(frame, config.shading), len(centers)
    seen = (config, first_watch(jnp.ones(count)), jnp.ones(count, bool), jnp.int32(count))
    given = (start[None], points, centers, images, *seen)
    return search(follow(*given), *given).estimate.twists


def direct(update: Update, counts: list[int], find: Callable = aligned) -> Trace:
    """Direct alignment of pixels, half of the iterations wide and half narrow; 0 is no motion."""
    start, ms = standing(update), [0.0]
    given = (start.twists, update.points, update.batch.centers, update.batch.frame)
    motions = [start]
    for count in counts[1:]:
        config = replace(ALIGN, iterations=count // 2)
        ms.append(median_ms(find, *given, config=config))
        motions.append(Motion(find(*given, config=config), start.delta))
    return Trace(counts, motions, ms)
