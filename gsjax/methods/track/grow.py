"""Growth: surfaces that the first frame did not show join the object that they continue.

A box that rotates shows its back, and a gripper that leaves reveals what it hid. A measured pixel that the
model does not explain, because it lies in front of what is drawn there or nothing is drawn, is compared with
the scene's Gaussians in position and colour together. If the nearest belongs to an object, the pixel becomes
a Gaussian of that object. Array shapes are static, so new Gaussians take slots that were reserved for them.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.cameras import unproject
from gsjax.geometry.spherical_harmonics import SH_C0, rgb_to_sh0
from gsjax.methods.track.config import GrowConfig
from gsjax.methods.track.layers import Shown
from gsjax.methods.track.motion import Pose
from gsjax.methods.track.scene import TrackedScene, emptied
from gsjax.rasterize.lanes import LANES, columns_in_lanes, in_lanes
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians, take

_LOGIT = 2.0  # opacity logit of a new Gaussian


def with_slots(scene: TrackedScene, slots: int) -> TrackedScene:
    """The scene with empty slots after its moving Gaussians. Their label, K+1, is that of no object. On the
    host."""
    count, moving = scene.gaussians.num, scene.num_moving
    rows = np.concatenate([np.arange(moving), np.zeros(slots, int), np.arange(moving, count)])
    empty = (np.arange(count + slots) >= moving) & (np.arange(count + slots) < moving + slots)
    labels = np.where(empty, scene.num_objects + 1, np.asarray(scene.labels)[rows])
    return TrackedScene(
        gaussians=emptied(take(scene.gaussians, rows), jnp.asarray(empty)),
        normals=jnp.asarray(np.pad(scene.normals, ((0, slots), (0, 0)))),
        labels=jnp.asarray(labels, scene.labels.dtype),
        label_ids=scene.label_ids,
        num_moving=moving + slots,
    )


def empty_slots(scene: TrackedScene) -> Bool[Array, "m"]:
    """Which rows of the moving Gaussians are empty slots."""
    return scene.groups > scene.num_objects


def unexplained(shown: Shown, measured: Float[Array, "c h w"], config: GrowConfig) -> Bool[Array, "c h w"]:
    """Pixels whose measured depth lies in front of the model, or where the model covers nothing."""
    in_front = shown.covered & (shown.depths - measured > config.min_gap)
    return (measured > 0) & (in_front | ~shown.covered)


def grow(
    scene: TrackedScene,
    pose: Pose,
    shown: Shown,
    frame: Frame,
    step: Int[Array, ""],
    config: GrowConfig,
    coarseness: int = 1,
    lost: Bool[Array, "k"] | None = None,
) -> tuple[TrackedScene, Pose]:
    """Fill empty slots with pixels that continue an object.

    Args:
        scene, pose: the scene, with slots (see `with_slots`).
        shown: what they show in the frame's cameras.
        frame: the frame at this pose, with depth.
        step: a number that differs from frame to frame, and selects which pixels are examined.
        coarseness: n, if `shown` has every n-th pixel.
        lost: objects that nothing may join, because they are not where they are believed to be.
    """
    assert frame.depths is not None
    # Only pixels near an object can continue it; others wait until one comes by.
    near, width = shown.labels > 0, 2 * (config.reach // coarseness) + 1
    for reach in ((1, width, 1), (1, 1, width)):
        near = jax.lax.reduce_window(near, False, jnp.logical_or, reach, (1, 1, 1), "SAME")
    # Every second pixel along each axis, or the pixels of `shown` if they are fewer.
    lattice = max(2, coarseness)
    chosen = unexplained(shown, frame.depths[:, ::coarseness, ::coarseness], config) & near
    chosen = chosen[:, :: lattice // coarseness, :: lattice // coarseness]
    places, real = _draw(chosen.ravel(), step, config.candidates)
    camera, row, column = jnp.unravel_index(places, chosen.shape)
    row, column = lattice * row, lattice * column
    depth, color = frame.depths[camera, row, column], frame.images[camera, row, column]
    pixels = jnp.stack([column, row], axis=-1) + 0.5
    views = (frame.cameras.viewmat[camera], frame.cameras.K[camera])
    points = jax.vmap(unproject)(pixels, depth, *views)
    label, distance = _nearest(points, color, scene, pose, config)
    wanted = real & (label > 0) & (distance < 1.0)
    if lost is not None:
        wanted &= ~lost[label - 1]

    # The n-th wanted pixel takes the n-th empty slot.
    slots = jnp.nonzero(empty_slots(scene), size=config.candidates, fill_value=scene.num_moving)[0]
    rank = jnp.cumsum(wanted) - 1
    target = jnp.where(wanted, slots[jnp.maximum(rank, 0)], scene.gaussians.num)
    target = jnp.where(target < scene.num_moving, target, scene.gaussians.num)  # dropped if none is left
    scale = 0.55 * lattice * depth / frame.cameras.K[camera, 0, 0]
    new = Gaussians(
        means=points,
        quats=jnp.zeros((config.candidates, 4), points.dtype).at[:, 0].set(1.0),
        log_scales=jnp.log(jnp.maximum(scale, 1e-6))[:, None] * jnp.ones(3, points.dtype),
        logit_opacities=jnp.full(config.candidates, _LOGIT, points.dtype),
        sh0=rgb_to_sh0(color)[:, None],
        shN=None
        if scene.gaussians.shN is None
        else jnp.zeros((config.candidates, *scene.gaussians.shN.shape[1:]), points.dtype),
    )
    gaussians = jax.tree.map(lambda a, b: a.at[target].set(b, mode="drop"), scene.gaussians, new)
    labels = scene.labels.at[target].set(label, mode="drop")
    scene = TrackedScene(gaussians, scene.normals, labels, scene.label_ids, scene.num_moving)
    pose = Pose(
        pose.means.at[target].set(new.means, mode="drop"), pose.quats.at[target].set(new.quats, mode="drop")
    )
    return scene, pose


def _draw(
    chosen: Bool[Array, "n"], step: Int[Array, ""], count: int
) -> tuple[Int[Array, "count"], Bool[Array, "count"]]:
    """Indices of up to `count` chosen places, drawn at random in each step, and which of them are real.

    All places are dealt at random to 4 `count` hands, once and for all. Starting from a random round and a
    random hand, each hand contributes the chosen place that is first in it; the hands with the earliest ones
    win. On a CPU this takes a fraction of the time of sorting all places.
    """
    size, hands = chosen.shape[0], 4 * count
    rounds = -(-size // hands)
    dealt = np.random.default_rng(2).permutation(rounds * hands).reshape(rounds, hands)
    chosen = jnp.pad(chosen, (0, rounds * hands - size))
    key = jax.random.fold_in(jax.random.key(2), step)
    first, turn = jax.random.randint(key, (2,), 0, jnp.array([rounds, hands]))
    waits = (jnp.arange(rounds, dtype=jnp.int32) - first) % rounds
    wait = jnp.where(chosen[dealt], waits[:, None], rounds).min(0)
    _, hand = jax.lax.top_k(-(wait * hands + (jnp.arange(hands) - turn) % hands), count)
    places = jnp.asarray(dealt)[(first + wait[hand]) % rounds, hand]
    return jnp.minimum(places, size - 1), wait[hand] < rounds


def _nearest(
    points: Float[Array, "p 3"],
    colors: Float[Array, "p 3"],
    scene: TrackedScene,
    pose: Pose,
    config: GrowConfig,
) -> tuple[Int[Array, "p"], Float[Array, "p"]]:
    """Label of the nearest Gaussian in position and colour, and its distance in units of `config.distance`
    and `config.color`."""
    means = jnp.concatenate([pose.means, scene.gaussians.means[scene.num_moving :]])
    own = (means / config.distance, (scene.gaussians.sh0[:, 0] * SH_C0 + 0.5) / config.color)
    columns = [column for array in own for column in columns_in_lanes(array)]
    queries = jnp.concatenate([points / config.distance, colors / config.color], axis=1)
    taken = (scene.labels <= scene.num_objects).at[: scene.num_moving].min(~empty_slots(scene))
    squared = sum((a - b[:, None, None]) ** 2 for a, b in zip(columns, queries.T, strict=True))
    squared = jnp.where(in_lanes(taken), squared, jnp.inf)
    # XLA:CPU's argmin is slow over many numbers: first the lane of the minimum, then its row.
    lane = jnp.argmin(squared.min(1), axis=1)
    rows = jnp.take_along_axis(squared, lane[:, None, None], axis=2)[..., 0]
    row = jnp.argmin(rows, axis=1)
    best = row * LANES + lane
    return scene.labels[best], jnp.sqrt(rows.min(1))
