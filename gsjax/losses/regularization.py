"""Losses that do not depend on data."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


def total_variation(
    image: Float[Array, "h w c"],
    above: Float[Array, "w c"] | None = None,
    inside: Bool[Array, "h"] | None = None,
) -> Float[Array, ""]:
    """Sum over neighbouring pixels and channels of |du| + |dv| (FD-3DGS, eq. 7, before its division by
    H W C).

    A sum and not a mean, so that the values of strips of an image can be added.

    Args:
        image: an image with any number of channels.
        above: the row of pixels above a strip; None for the top of the image.
        inside: rows that count (default: all).
    """
    before = jnp.concatenate([image[:1] if above is None else above[None], image[:-1]])
    rows = jnp.abs(jnp.diff(image, axis=1)).sum(axis=(1, 2)) + jnp.abs(image - before).sum(axis=(1, 2))
    return rows.sum() if inside is None else jnp.where(inside, rows, 0.0).sum()


def plane_variation(planes: Float[Array, "p h w c"]) -> Float[Array, ""]:
    """Mean squared difference between neighbours on planes along both axes (4DGS, Wu et al. 2023; K-Planes,
    Fridovich-Keil et al. 2023, eq. 4)."""
    return jnp.square(jnp.diff(planes, axis=1)).mean() + jnp.square(jnp.diff(planes, axis=2)).mean()


def second_differences(planes: Float[Array, "p t w c"]) -> Float[Array, ""]:
    """Mean squared second difference of planes along their first axis, time: uniform motion costs nothing
    (K-Planes, eq. 5). 0 for fewer than three times."""
    if planes.shape[1] < 3:
        return jnp.zeros((), planes.dtype)
    return jnp.square(jnp.diff(planes, n=2, axis=1)).mean()


def local_strain(
    rest: Float[Array, "M 3"],
    moved: Float[Array, "M 3"],
    turns: Float[Array, "M 3 3"],
    neighbors: Int[Array, "M k"],
) -> Float[Array, "M k"]:
    """Squared strain between each point and its neighbours: how much the vector between them changes beyond
    the given rotation, relative to its length at rest (as-rigid-as-possible, Sorkine and Alexa 2007, eq. 1,
    with rotations of the field, as in SC-GS, Huang et al. 2024). 0 for neighbours in the same place.

    Args:
        rest, moved: points before and after the deformation.
        turns: rotation of each point's surroundings.
        neighbors: rows of the points around each.
    """
    apart = rest[neighbors] - rest[:, None]
    turned = jnp.einsum("mij,mkj->mki", turns, apart, precision="highest")
    left = moved[neighbors] - moved[:, None] - turned
    squared = jnp.square(apart).sum(-1)
    return jnp.where(squared > 0, jnp.square(left).sum(-1) / jnp.where(squared > 0, squared, 1.0), 0.0)


def pseudo_huber(squared: Float[Array, "*n"], tolerance: float) -> Float[Array, "*n"]:
    """A smooth penalty on a length: quadratic below a tolerance and linear above.

    Args:
        squared: the length, squared.
        tolerance: length at which the penalty becomes linear.
    """
    return jnp.sqrt(squared + tolerance**2) - tolerance
