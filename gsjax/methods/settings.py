"""What settings may be."""

from typing import Any

import numpy as np


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
            most = "" if high == np.inf else f" and at most {high:g}"
            raise ValueError(f"{where}{name}: expected at least {low:g}{most}, found {value}")
