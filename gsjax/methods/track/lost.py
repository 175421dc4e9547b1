"""Detect lost objects.

Residuals of the alignment rise when a group gets lost, but not while it is: pixels of the last frame are
taken from where the group was believed to be, and agree again with whatever stands there. The Gaussians of
the first frame do not: where the group is not, cameras see past them, or other colours. So they decide
whether it is lost, and whether it is found again (see `recover`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gsjax.methods.track.points import Points, Sight, rotated, sum_of_three

COLOR_SCALE = 0.15  # a difference of tones that is large, after turns and shadows since the first frame
_FEWEST = 6.0  # points that decide
_FLAT = 0.9  # share of a group's points that lie in the background's surface where it is a card upon it

LOST, DOUBTFUL, FOUND = 0.35, 0.6, 0.6
"""Shares of what can be seen of a group that look as at first: below the first it is lost, below the second
it may be elsewhere, above the third it is found there. docs/results-hard-cases.md has where they lie."""


class Confidence(NamedTuple):
    """How well what the cameras see agrees with where each group is believed to be."""

    agrees: Float[Array, "k"]  # share of what can be seen of it that looks as at first, 0 to 1
    shows: Float[Array, "k"]  # the same of all of it: what is hidden or out of the picture is missing
    tells: Bool[Array, "k"]  # whether there was enough to see


def confidence(
    centers: Points,
    sight: Sight,
    gap: float,
    background: Float[Array, "c h w"] | None = None,
    others: Float[Array, "c h w"] | None = None,
) -> Confidence:
    """Compare each group's Gaussians of the first frame, where they should be now, with what is seen there.

    Args:
        centers: of each group, with the tones that they had; `seen` is 1 in cameras that look for them.
        sight: what the cameras see now.
        gap: how far measured depth may be off, metres. Depth beyond that is seen past the group, which
            disagrees; nearer depth hides it, and counts as nothing.
        background: its depth where it is known, metres, else 0; of every n-th pixel. Where a camera
            measures just that, it does not see the group, however near: what slips into a wall would agree
            with the wall. A card that lies flat on it is exempt.
        others: the same of other groups, on which nothing lies like a card.
    """
    height, width = sight.pixels.shape[1:3]

    def one(means, tones, seen, viewmat, K, image, measures, background, others):
        local = rotated(viewmat[:3, :3], means) + viewmat[:3, 3:]
        z = local[2]
        column, row, _ = jnp.floor(rotated(K, local) / jnp.maximum(z, 1e-6)).astype(jnp.int32)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (z > 1e-3)
        row, column = jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)
        found = image[row, column]
        squared = sum_of_three((found[:, :3].T - tones) ** 2, axis=0) / (3 * COLOR_SCALE**2)
        asked = seen > 0
        alike, hidden, known = 1 / (1 + squared), jnp.zeros_like(inside), inside & asked
        of_a_card, flat = alike, jnp.zeros_like(inside)

        def lies_in(depth, surface):
            stride = -(-width // surface.shape[1])
            there = surface[row // stride, column // stride]
            return (there > 0) & (jnp.abs(depth - there) < gap / 3)

        if sight.depths is not None:
            off = found[:, 3] - z
            hidden, known = off < -gap, known & (found[:, 3] > 0)
            asked &= measures  # a camera that failed is not asked
            alike = jnp.where(off > gap, 0.0, alike)
            if others is not None:
                alike = jnp.where(lies_in(found[:, 3], others), 0.0, alike)
            of_a_card = alike
            if background is not None:
                alike = jnp.where(lies_in(found[:, 3], background), 0.0, alike)
                flat = lies_in(z, background)
        clear = known & ~hidden
        return clear * alike, clear * of_a_card, clear & flat, clear, asked

    maybe = (sight.measures, background, others)
    over_cameras = jax.vmap(one, in_axes=(0,) * 6 + tuple(None if a is None else 0 for a in maybe))
    over_groups = jax.vmap(over_cameras, in_axes=(0,) * 3 + (None,) * 6)
    views = (sight.cameras.viewmat, sight.cameras.K, sight.pixels, *maybe)
    alike, of_a_card, flat, clear, asked = (a.sum((1, 2), dtype=float) for a in over_groups(*centers, *views))
    alike = jnp.where(flat > _FLAT * clear, of_a_card, alike)
    return Confidence(alike / jnp.maximum(clear, 1), alike / jnp.maximum(asked, 1), clear >= _FEWEST)


def is_found(sure: Confidence, showed: Float[Array, "k"]) -> Bool[Array, "k"]:
    """Whether a lost group is where `sure` is of; `showed` is its `shows` of the first frame."""
    return sure.tells & (sure.agrees > FOUND) & (sure.shows > FOUND * showed)
