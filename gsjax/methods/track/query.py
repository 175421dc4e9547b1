"""The object that a text means (section III-B): its embedding is nearest to the text's by cosine."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gsjax.methods.query import directions


class Match(NamedTuple):
    """The object that a query found.

    Attributes:
        best: row of the object with the highest score; the first of several.
        scores: the cosine of each object with the query; 0 for one without an embedding (all zeros).
        margin: difference of the best score and the next; infinite for one object only.
        found: whether the best score reaches `min_score`; if not, the query means none of them.
    """

    best: Int[Array, ""]
    scores: Float[Array, "k"]
    margin: Float[Array, ""]
    found: Bool[Array, ""]


def find_object(
    text_embedding: Float[Array, "size"], object_embeddings: Float[Array, "k d"], min_score: float = -1.0
) -> Match:
    """The object that a text means.

    Args:
        text_embedding, object_embeddings: of any length, from one `LanguageEncoder`.
        min_score: a best score below this means none of the objects; encoders suggest one.

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
