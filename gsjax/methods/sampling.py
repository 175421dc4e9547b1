"""Which view a step has, where each step has one."""

import numpy as np


def shuffled_index(seed: int, step: int, count: int) -> int:
    """All views in a random order, and then in another; the same for the same seed and step.

    Args:
        seed: of the orders.
        step: 0 and up.
        count: how many views.
    """
    epoch, place = divmod(step, count)
    return int(np.random.default_rng((seed, epoch)).permutation(count)[place])
