"""Completion of a teacher on several levels: where a view lacks a mask on a level, other views may have one.

A segmenter misses masks, so in each view some pixels have none on a level and were given that of another
level (`Teacher.filled`). Taken at face value, such a view teaches that a drawer is a cabinet. So the views
vote first: on each level, a Gaussian takes the majority kind of those of its pixels that have a mask there
or, if hardly any has one, its kind on the next larger level or, without one, the next smaller. Rendering
these Gaussians then gives the kind of each filled pixel.
"""

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.methods.distill.teacher import Teacher
from gsjax.methods.distill.votes import voted_labels
from gsjax.rasterize.frozen import FrozenView, paint
from gsjax.rasterize.plan import Plan

_KINDS = 256  # largest number of kinds of embeddings, on all levels together
_LEAST = 0.1  # share of a Gaussian's pixels that must have a mask of a level for it to have a kind there
_SEED, _ITERATIONS = 0, 10  # of clustering
_AT_ONCE = 32  # kinds that are rendered at once


def complete_teacher(teacher: Teacher, views: Sequence[tuple[FrozenView, Plan]], num: int) -> Teacher:
    """The teacher with the votes of all views in place of what was filled in from other levels.

    Args:
        teacher: a teacher of masks on levels, with `filled`.
        views: its frozen views, with their plans.
        num: number of Gaussians.
    """
    assert teacher.codebook is not None
    assert teacher.filled is not None
    levels = teacher.filled[0].shape[-1]
    embeddings, place = np.unique(
        teacher.codebook.reshape(len(teacher.codebook) * levels, -1), axis=0, return_inverse=True
    )
    place, (kinds, centers) = place.reshape(-1, levels), _kinds(embeddings)
    of_gaussians = _kinds_of_gaussians(teacher, views, kinds[place], len(centers), num)
    rows = []  # of each pixel on each level, into the embeddings followed by the centres
    for (view, plan), ids, filled in zip(views, teacher.ids, teacher.filled, strict=True):
        voted = np.stack([_majority_kind(view, plan, each, len(centers)) for each in of_gaussians], axis=-1)
        row = np.where(filled & (voted >= 0), len(embeddings) + voted, place[np.maximum(ids, 0)])
        rows.append(np.where((ids >= 0)[..., None], row, -1))
    return _with_rows(teacher, rows, np.concatenate([embeddings, centers]))


def _kinds(embeddings: Float[np.ndarray, "u d"]) -> tuple[Int[np.ndarray, "u"], Float[np.ndarray, "k d"]]:
    """The kind of each embedding, and the mean embedding of each kind. A kind is a single embedding if they
    are few, else a cluster."""
    if len(embeddings) <= _KINDS:
        return np.arange(len(embeddings)), embeddings
    from scipy.cluster.vq import kmeans2  # slow to import

    units = embeddings / np.maximum(np.linalg.norm(embeddings, axis=1, keepdims=True), 1e-12)
    _, kinds = kmeans2(units, _KINDS, iter=_ITERATIONS, minit="++", rng=_SEED)
    there, kinds = np.unique(kinds, return_inverse=True)
    return kinds, np.stack([embeddings[kinds == kind].mean(axis=0) for kind in range(len(there))])


def _kinds_of_gaussians(
    teacher: Teacher,
    views: Sequence[tuple[FrozenView, Plan]],
    kinds: Int[np.ndarray, "rows levels"],
    count: int,
    num: int,
) -> Int[np.ndarray, "levels n"]:
    """The kind with the most votes for each Gaussian on each level; where too few pixels have a mask of a
    level, the kind on the next larger level or, failing that, the next smaller; -1 where there is none."""
    levels, filled_of = kinds.shape[1], teacher.filled or []
    _, every = voted_labels(views, [np.where(ids >= 0, 0, -1) for ids in teacher.ids], 1, num)
    best = np.full((levels, num), -1)
    for level in range(levels):
        of_level = [
            np.where((ids >= 0) & ~filled[..., level], kinds[np.maximum(ids, 0), level], -1)
            for ids, filled in zip(teacher.ids, filled_of, strict=True)
        ]
        kind, total = voted_labels(views, of_level, count, num)
        best[level] = np.where(total > _LEAST * every, kind, -1)
    filled_in = best.copy()
    for level, row in enumerate(filled_in):
        for other in (*range(level + 1, levels), *range(level)[::-1]):
            np.copyto(row, best[other], where=row < 0)
    return filled_in


def _majority_kind(
    view: FrozenView, plan: Plan, kinds: Int[np.ndarray, "n"], count: int
) -> Int[np.ndarray, "h w"]:
    """The kind of Gaussians that contributes most to each pixel; -1 where none does."""
    best, most = np.full((plan.height, plan.width), -1), np.zeros((plan.height, plan.width))
    some = min(_AT_ONCE, count)
    for first in range(0, count, _AT_ONCE):
        image = np.asarray(_painted(view, plan, jnp.asarray(kinds - first), some))
        better = image.max(axis=-1) > most
        best[better] = first + image.argmax(axis=-1)[better]
        most = np.maximum(most, image.max(axis=-1))
    return best


@partial(jax.jit, static_argnames=("plan", "count"))
def _painted(view: FrozenView, plan: Plan, kinds: Int[Array, "n"], count: int):
    return paint(view, jax.nn.one_hot(kinds, count), plan)[0]


def _with_rows(teacher: Teacher, rows: list[np.ndarray], embeddings: Float[np.ndarray, "u d"]) -> Teacher:
    """The teacher with other rows of embeddings for each pixel on each level; -1 where unknown."""
    flat = np.concatenate([row.reshape(-1, row.shape[-1]) for row in rows])
    key = np.zeros(len(flat), np.int64)  # a number for each combination
    for of_level in flat.T:
        key = key * (len(embeddings) + 1) + of_level + 1
    combined, first, place = np.unique(key, return_index=True, return_inverse=True)
    unknown = int(combined[0] == 0)
    ends = np.cumsum([row.shape[0] * row.shape[1] for row in rows])[:-1]
    parts = zip(np.split(place - unknown, ends), rows, strict=True)
    ids = [part.reshape(row.shape[:2]).astype(np.int32) for part, row in parts]
    codebook = embeddings[flat[first[unknown:]]].reshape(len(combined) - unknown, -1)
    return teacher._replace(ids=ids, codebook=codebook.astype(np.float32), filled=None)
