"""Losses that ask nothing of the data."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def total_variation(
    image: Float[Array, "h w c"],
    above: Float[Array, "w c"] | None = None,
    inside: Bool[Array, "h"] | None = None,
) -> Float[Array, ""]:
    """Sum over neighbouring pixels and channels of |du| + |dv| (papers/002, eq. 7, before its division by
    H W C).

    A sum and not a mean, so that strips of an image can be added up.

    Args:
        image: of any channels.
        above: the row of pixels above the image; none at its top.
        inside: rows that count; all unless given.
    """
    before = jnp.concatenate([image[:1] if above is None else above[None], image[:-1]])
    rows = jnp.abs(jnp.diff(image, axis=1)).sum(axis=(1, 2)) + jnp.abs(image - before).sum(axis=(1, 2))
    return rows.sum() if inside is None else jnp.where(inside, rows, 0.0).sum()
