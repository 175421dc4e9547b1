"""Language queries: the object whose embedding has the largest cosine with that of the text (Object-Aware
Gaussian Splatting for Robotic Manipulation, section III-B)."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gsjax.methods.query import directions


class Match(NamedTuple):
    """The result of a query.

    Attributes:
        best: index of the object with the highest score; the first of several.
        scores: cosine of each object with the query; 0 for an object without embedding (all zeros).
        margin: difference between the two highest scores; infinite if there is only one object.
        found: whether the best score reaches `min_score`; if not, the query matches no object.
    """

    best: Int[Array, ""]
    scores: Float[Array, "k"]
    margin: Float[Array, ""]
    found: Bool[Array, ""]


def find_object(
    text_embedding: Float[Array, "size"], object_embeddings: Float[Array, "k d"], min_score: float = -1.0
) -> Match:
    """The object that matches a text best.

    Args:
        text_embedding, object_embeddings: embeddings from one `LanguageEncoder`, of any length.
        min_score: if the best score is below this, no object matches; encoders suggest a value.

    Raises:
        ValueError: there is no object, or the embeddings differ in dimension.
    """
    count, size = object_embeddings.shape
    if count == 0:
        raise ValueError("object_embeddings: expected at least one object, found none")
    if text_embedding.shape != (size,):
        found = text_embedding.shape
        raise ValueError(f"text_embedding: expected shape [{size}] as the objects', found {found}")
    scores = directions(object_embeddings) @ directions(text_embedding)
    best = jnp.argmax(scores)
    rest = jnp.where(jnp.arange(count) == best, -jnp.inf, scores)
    return Match(best, scores, scores[best] - rest.max(), scores[best] >= min_score)
