"""Labels of pixels lifted to Gaussians by majority vote: the baseline for a field.

A pixel's vote for a Gaussian has the Gaussian's compositing weight in that pixel. The rendered image F is
linear in the Gaussians' values, so the votes of a view are the gradient, with respect to these values, of the
sum over pixels p of F(p)[label of p].
"""

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.rasterize.frozen import FrozenView, paint_shown
from gsjax.rasterize.plan import Plan

_AT_ONCE = 32  # labels that are counted at once


@partial(jax.jit, static_argnames=("plan", "count"))
def label_votes(
    view: FrozenView, plan: Plan, ids: Int[Array, "height width"], count: int
) -> Float[Array, "seen count"]:
    """Total weight of each visible Gaussian, `view.rows`, in the pixels of each label.

    Args:
        view, plan: the frozen view and its plan.
        ids: label of each pixel, 0 to count - 1; a pixel with -1 has no vote.
        count: number of labels.
    """
    ballots = jax.nn.one_hot(ids, count)  # a row of zeros for -1
    nothing = jnp.zeros((view.opacities.shape[0], count), ballots.dtype)
    _, back = jax.vjp(lambda values: paint_shown(view, values, plan)[0], nothing)
    return back(ballots)[0]


def voted_labels(
    views: Sequence[tuple[FrozenView, Plan]], ids: Sequence[np.ndarray], count: int, num: int
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """The label with the most votes over all views, for each of `num` Gaussians, and the votes for all labels
    together, which are 0 where no pixel votes.

    Args:
        views: frozen views with their plans.
        ids: label of each pixel of each view, [H,W]; -1 for none.
        count: number of labels.
        num: number of Gaussians.
    """
    best, most, total = np.zeros(num, int), np.zeros(num), np.zeros(num)
    for first in range(0, count, _AT_ONCE):
        some = min(_AT_ONCE, count)  # one program for all
        votes = np.zeros((num, some))
        for (view, plan), pixels in zip(views, ids, strict=True):
            here = np.where((pixels >= first) & (pixels < first + some), pixels - first, -1)
            np.add.at(
                votes, np.asarray(view.rows), np.asarray(label_votes(view, plan, jnp.asarray(here), some))
            )
        better = votes.max(axis=1) > most
        best[better] = first + votes.argmax(axis=1)[better]
        most, total = np.maximum(most, votes.max(axis=1)), total + votes.sum(axis=1)
    return best, total
