"""What is lost: telling that it is, and where to look for it.

Residuals of the alignment say when a group gets lost, but not that it is: pixels of the last frame are taken
from where the group was believed to be, and agree again with whatever stands there. The Gaussians of the
first frame do not: where the group is not, cameras see past them, or other colours. So they decide whether it
is lost, and whether it is found again; it is looked for near by, and at pixels that no group explains.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from gsjax.methods.object_tracker.layers import Shown
from gsjax.methods.object_tracker.points import Points, Sight, join, rotated

_COLOR_SCALE = 0.15  # a difference of tones that is large, after turns and shadows since the first frame
_FEWEST = 6.0  # points that can tell
_FLAT = 0.9  # share of a group's points that lie in the background's surface where it is a card upon it
LARGEST_TURN = 2.0  # radians; a camera that looks for a point has seldom lost it from sight by less

LOST, FOUND = 0.35, 0.5
"""Below the one a group is lost, and above the other a lost one is found: see `Confidence`.
docs/results-hard-cases.md has where sound and lost ones lie."""


class Confidence(NamedTuple):
    """What the cameras say of where each group is believed to be."""

    agrees: Float[Array, "k"]  # share of what can be seen of it that looks as at first, 0 to 1
    shows: Float[Array, "k"]  # the same of all of it: what is hidden or out of the picture is missing
    tells: Bool[Array, "k"]  # whether there was enough to see


def confidence(
    centers: Points, sight: Sight, gap: float, background: Float[Array, "c h w"] | None = None
) -> Confidence:
    """Compare each group's Gaussians of the first frame, where they should be now, with what is seen there.

    Args:
        centers: of each group, with the tones that they had; `seen` is 1 in cameras that look for them.
        sight: what the cameras see now.
        gap: measured depth may differ by so much, metres. What is further is seen past the group, which
            disagrees; what is nearer hides it, and says nothing.
        background: its depth where it is known, metres, else 0; of every so-manieth pixel. Where a camera
            measures just that, it does not see the group, however near: what slips into a wall would agree
            with the wall. Of a card that lies flat on it with all it has, that says nothing.
    """
    height, width = sight.pixels.shape[1:3]

    def one(means, tones, seen, viewmat, K, image, background):
        local = rotated(viewmat[:3, :3], means) + viewmat[:3, 3:]
        z = local[2]
        column, row, _ = jnp.floor(rotated(K, local) / jnp.maximum(z, 1e-6)).astype(jnp.int32)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (z > 1e-3)
        row, column = jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)
        found = image[row, column]
        squared = jnp.mean((found[:, :3].T - tones) ** 2, axis=0) / _COLOR_SCALE**2
        asked = seen > 0
        alike, hidden, known = 1 / (1 + squared), jnp.zeros_like(inside), inside & asked
        of_a_card, flat = alike, jnp.zeros_like(inside)
        if sight.depths is not None:
            off = found[:, 3] - z
            hidden, known = off < -gap, known & (found[:, 3] > 0)
            asked &= (image[..., 3] > 0).any()  # a camera that failed is not asked
            of_a_card = alike = jnp.where(off > gap, 0.0, alike)
            if background is not None:
                stride = -(-width // background.shape[1])
                behind = background[row // stride, column // stride]
                shows_it = (behind > 0) & (jnp.abs(found[:, 3] - behind) < gap / 3)
                alike = jnp.where(shows_it, 0.0, alike)
                flat = (behind > 0) & (jnp.abs(z - behind) < gap / 3)
        clear = known & ~hidden
        return clear * alike, clear * of_a_card, clear & flat, clear, asked

    over_cameras = jax.vmap(one, in_axes=(0, 0, 0, 0, 0, 0, None if background is None else 0))
    over_groups = jax.vmap(over_cameras, in_axes=(0, 0, 0, None, None, None, None))
    views = (sight.cameras.viewmat, sight.cameras.K, sight.pixels, background)
    alike, of_a_card, flat, clear, asked = (a.sum((1, 2), dtype=float) for a in over_groups(*centers, *views))
    alike = jnp.where(flat > _FLAT * clear, of_a_card, alike)
    return Confidence(alike / jnp.maximum(clear, 1), alike / jnp.maximum(asked, 1), clear >= _FEWEST)


class Missing(NamedTuple):
    """What a lost group is looked for with."""

    centers: Points  # of each group: its Gaussians of the first frame
    strangers: Points  # pixels of the last frame that no group explains
    count: Int[Array, ""]  # frames so far, from which chance is drawn: a recording gives the same run again


def alone(centers: Points, points: Points) -> Points:
    """As many as `points`, of which only the centres count: pixels show what a lost group was taken for.

    The centres stand where every fourth or every other point is chosen first.
    """
    others = jax.tree.map(lambda a: a[..., centers.seen.shape[-1] :], points)
    both = join(centers, others._replace(seen=jnp.zeros_like(others.seen)))
    count = both.seen.shape[-1]
    places = np.concatenate([np.arange(0, count, 4), np.arange(2, count, 4), np.arange(1, count, 2)])
    return jax.tree.map(lambda a: a[..., np.argsort(places)], both)


def with_strangers(
    shown: Shown, sight: Sight, num_groups: int, gap: float, thickness: float, coarseness: int
) -> Shown:
    """`shown`, where pixels that no group explains have the label num_groups + 1 and their measured depth.

    Args:
        gap: what is measured this much nearer than the background is not explained by it, metres ...
        thickness: ... and this much nearer than a group, metres.
        coarseness: `shown` has every so-manieth pixel.
    """
    if sight.depths is None:
        return shown
    measured = sight.depths[:, ::coarseness, ::coarseness]
    nearest = shown.depths - jnp.where(shown.labels > 0, thickness, gap)
    strange = (measured > 0) & shown.covered & (measured < nearest)
    labels = jnp.where(strange, num_groups + 1, shown.labels)
    return shown._replace(labels=labels, depths=jnp.where(strange, measured, shown.depths))


def guesses(
    key: Key[Array, ""],
    shifts: Float[Array, "h 6"],
    points: Points,
    center: Float[Array, "3"],
    strangers: Points,
    max_turn: float = LARGEST_TURN,
) -> Float[Array, "h 6"]:
    """Where a lost group may be: turned at random, every other time near by, and else at strange pixels.

    Args:
        shifts: what is tried near by.
        points: of the group; those that count nothing are left out. Those of about a pixel's colour are
            brought to it.
        center: what the group turns about.
        strangers: pixels that no group explains, as each camera sees them.
        max_turn: radians.
    """
    count = len(shifts)
    place, pair, axis, angle = jax.random.split(key, 4)
    to, colors, there = _of_all_cameras(strangers)
    own, tones, seen = _of_all_cameras(points)
    chosen = jax.random.categorical(place, jnp.where(there > 0, 0.0, -jnp.inf), shape=(count,))
    apart = jnp.sum((colors[:, chosen, None] - tones[:, None]) ** 2, axis=0) / _COLOR_SCALE**2
    paired = jax.random.categorical(pair, jnp.where(seen > 0, -apart, -jnp.inf))
    turns = jax.random.normal(axis, (count, 3))
    turns /= jnp.linalg.norm(turns, axis=1, keepdims=True)
    turns *= max_turn * jax.random.uniform(angle, (count, 1))
    offsets = own[:, paired].T - center
    away = to[:, chosen].T - center - jaxlie.SO3.exp(turns).apply(offsets)
    strange = (jnp.arange(count) % 2 == 1) & (there.sum() > 0)
    return jnp.concatenate([jnp.where(strange[:, None], away, shifts[:, :3]), turns], axis=1)


def _of_all_cameras(points: Points) -> Points:
    """One group's points in one row: [3, c p], and `seen` [c p]."""
    return jax.tree.map(lambda a: jnp.moveaxis(a, 0, -2).reshape(*a.shape[1:-1], -1), points)
