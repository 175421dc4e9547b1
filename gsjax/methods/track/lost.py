"""Detection of lost objects.

Residuals of the alignment rise while a group is being lost, but not afterwards: pixels of the last frame are
taken from where the group was believed to be, and agree with whatever is there now. The Gaussians of the
first frame do not: if the group is elsewhere, cameras see past them, or see other colours. So these Gaussians
decide whether a group is lost, and whether it is found again (see `recover`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gsjax.methods.track.points import Points, ToneImages, rotated, sum_of_three

COLOR_SCALE = 0.15
"""Scale of the difference of tones, which allows for rotations and shadows since the first frame."""
MIN_POINTS = 6
"""Fewer visible points are not conclusive."""
_FLAT = 0.9  # a group with more than this fraction of its points in the background's surface lies flat on it

LOST, DOUBTFUL, FOUND = 0.35, 0.6, 0.6
"""Thresholds of `Confidence.agreement`: below the first a group is lost, below the second it may be
elsewhere, above the third it may be found. docs/results-hard-cases.md has measured values."""
SURELY_LOST, SURELY_FOUND = 0.25, 0.7
"""The same for a group whose residual and orientation are not in doubt, which may have turned to sides that
look different; and for a group that is found without confirmation by further frames."""
SUDDEN = 0.6
"""A group is lost at once if its agreement drops by this factor from one frame to the next."""
FOUND_FRAMES = 4
"""Frames in a row in which a group has to look found, unless it surely is: agreement by chance does not
persist."""
PROBATION = 4
"""Searches that must find no better place for a group that was found, which has to keep looking found."""


class Confidence(NamedTuple):
    """How well the images agree with where each group is believed to be."""

    agreement: Float[Array, "k"]  # fraction of the visible points that look as at first, 0 to 1
    coverage: Float[Array, "k"]  # the same as a share of all points: hidden and outside ones do not agree
    conclusive: Bool[Array, "k"]  # whether enough points were visible


def group_confidence(
    centers: Points,
    images: ToneImages,
    gap: float,
    background: Float[Array, "c h w"] | None = None,
    others: Float[Array, "c h w"] | None = None,
) -> Confidence:
    """Compare the images with each group's Gaussians of the first frame, where they should be now.

    Args:
        centers: centres of the Gaussians of each group with their first tones; `seen` is 1 in cameras that
            should see them.
        images: the new frame.
        gap: tolerance of measured depth, metres. A camera that measures more sees past the group, which
            counts as disagreement; less means that the group is occluded, which does not count.
        background: depth of the background, metres, 0 if unknown; of every n-th pixel. A camera that measures
            the background itself does not see the group, however near it is; otherwise, a group that slipped
            into a wall would agree with the wall. A card that lies flat on the background is exempt.
        others: the same of other groups, without the exemption.
    """
    height, width = images.pixels.shape[1:3]

    def one(means, tones, seen, viewmat, K, image, measures, background, others):
        local = rotated(viewmat[:3, :3], means) + viewmat[:3, 3:]
        z = local[2]
        column, row, _ = jnp.floor(rotated(K, local) / jnp.maximum(z, 1e-6)).astype(jnp.int32)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (z > 1e-3)
        row, column = jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)
        pixel = image[row, column]
        squared = sum_of_three((pixel[:, :3].T - tones) ** 2, axis=0) / (3 * COLOR_SCALE**2)
        expected = seen > 0
        alike, hidden, known = 1 / (1 + squared), jnp.zeros_like(inside), inside & expected
        of_a_card, flat = alike, jnp.zeros_like(inside)

        def lies_in(depth, surface):
            stride = -(-width // surface.shape[1])
            there = surface[row // stride, column // stride]
            return (there > 0) & (jnp.abs(depth - there) < gap / 3)

        if images.depths is not None:
            difference = pixel[:, 3] - z
            hidden, known = difference < -gap, known & (pixel[:, 3] > 0)
            expected &= measures  # a camera that failed does not count
            alike = jnp.where(difference > gap, 0.0, alike)
            if others is not None:
                alike = jnp.where(lies_in(pixel[:, 3], others), 0.0, alike)
            of_a_card = alike
            if background is not None:
                alike = jnp.where(lies_in(pixel[:, 3], background), 0.0, alike)
                flat = lies_in(z, background)
        clear = known & ~hidden
        return clear * alike, clear * of_a_card, clear & flat, clear, expected

    optional = (images.measures, background, others)
    over_cameras = jax.vmap(one, in_axes=(0,) * 6 + tuple(None if a is None else 0 for a in optional))
    over_groups = jax.vmap(over_cameras, in_axes=(0,) * 3 + (None,) * 6)
    views = (images.cameras.viewmat, images.cameras.K, images.pixels, *optional)
    sums = (a.sum((1, 2), dtype=float) for a in over_groups(*centers, *views))
    alike, of_a_card, flat, clear, expected = sums
    alike = jnp.where(flat > _FLAT * clear, of_a_card, alike)
    return Confidence(alike / jnp.maximum(clear, 1), alike / jnp.maximum(expected, 1), clear >= MIN_POINTS)


def is_found(confidence: Confidence, showed: Float[Array, "k"]) -> Bool[Array, "k"]:
    """Whether a lost group is in a place, by the `confidence` there; `showed` is its coverage in the first
    frame."""
    enough = confidence.coverage > FOUND * showed
    return confidence.conclusive & (confidence.agreement > FOUND) & enough
