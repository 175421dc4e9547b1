"""What settings may be."""

from typing import Any

import numpy as np

ABOVE_ZERO = (np.nextafter(0.0, 1.0), np.inf)
"""The range of what must be more than 0."""


def expect(config: Any, where: str = "", **ranges: tuple[float, float]) -> None:
    """Raises ValueError for the first field of a config that lies outside its range, or is NaN.

    Args:
        config: has the fields.
        where: what stands before their names, "rates." say.
        ranges: the least and the most that each may be.
    """
    for name, (low, high) in ranges.items():
        value = getattr(config, name)
        if not low <= value <= high:
            least = "more than 0" if low == ABOVE_ZERO[0] else f"at least {low:g}"
            most = "" if high == np.inf else f" and at most {high:g}"
            raise ValueError(f"{where}{name}: expected {least}{most}, found {value}")
