"""The order in which steps visit views, one view per step."""

import numpy as np


def shuffled_index(seed: int, step: int, count: int) -> int:
    """Index of the view of a step: epochs over all views, each in a new random order.

    Args:
        seed: seed of the orders.
        step: index of the step.
        count: number of views.
    """
    epoch, place = divmod(step, count)
    return int(np.random.default_rng((seed, epoch)).permutation(count)[place])
