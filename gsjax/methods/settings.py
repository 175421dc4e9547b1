"""Validation of configurations."""

from typing import Any

import numpy as np

ABOVE_ZERO = (np.nextafter(0.0, 1.0), np.inf)
"""The range of values above 0."""


def expect(config: Any, where: str = "", **ranges: tuple[float, float]) -> None:
    """Check that fields of a config lie in their ranges and are not NaN.

    Args:
        config: the configuration.
        where: prefix of the names of its fields in the error, such as "rates.".
        ranges: smallest and largest value of each field.

    Raises:
        ValueError: a field is outside its range, or not a number.
    """
    for name, (low, high) in ranges.items():
        value = getattr(config, name)
        if np.shape(value) != () or not np.issubdtype(np.asarray(value).dtype, np.number):
            raise ValueError(f"{where}{name}: expected a number, found {value!r}")
        if not low <= value <= high:
            least = "more than 0" if low == ABOVE_ZERO[0] else f"at least {low:g}"
            most = "" if high == np.inf else f" and at most {high:g}"
            raise ValueError(f"{where}{name}: expected {least}{most}, found {value}")
