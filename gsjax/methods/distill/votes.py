"""Labels of pixels lifted to Gaussians by majority vote: the baseline of a field.

A pixel votes for a Gaussian with the weight of the Gaussian in the pixel. So the votes of a view are the
gradient of the sum over pixels p of F(p)[label of p] with respect to the Gaussians' values, in which F is
linear.
"""

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.rasterize.frozen import FrozenView, paint_shown
from gsjax.rasterize.plan import Plan


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


def majority_labels(
    views: Sequence[tuple[FrozenView, Plan]], ids: Sequence[np.ndarray], count: int, num: int
) -> Int[np.ndarray, "n"]:
    """The label with the most votes over all views, for each of `num` Gaussians; -1 for one without votes.

    Args:
        views: frozen views with their plans.
        ids: label of each pixel of each view, [H,W]; -1 for none.
        count: number of labels.
        num: number of Gaussians.
    """
    votes = np.zeros((num, count))
    for (view, plan), one in zip(views, ids, strict=True):
        np.add.at(votes, np.asarray(view.rows), np.asarray(label_votes(view, plan, jnp.asarray(one), count)))
    return np.where(votes.max(axis=1) > 0, votes.argmax(axis=1), -1)
