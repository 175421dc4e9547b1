"""Which view a step sees, one view per step, and how large."""

import numpy as np


def shuffled_index(seed: int, step: int, count: int) -> int:
    """Index of the view of a step: epochs over all views, each in another random order.

    Args:
        seed: seed of the orders.
        step: index of the step.
        count: number of views.
    """
    epoch, place = divmod(step, count)
    return int(np.random.default_rng((seed, epoch)).permutation(count)[place])


def shrink_at(coarse_until: float, progress: float) -> int:
    """The factor by which pictures are downscaled: first 4, then 2, then 1.

    Args:
        coarse_until: share of the steps that see smaller pictures; with 0, none does.
        progress: position in the schedule, 0 to 1.
    """
    if progress >= coarse_until:
        return 1
    return 4 if progress < coarse_until / 3 else 2
