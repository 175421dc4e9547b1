"""Pictures and pages. matplotlib is loaded here first, whatever MPLBACKEND says.

A notebook hands its own backend to the programs that it starts, and matplotlib refuses to be imported where a
named backend is not installed. The plots of gsjax need none: they are drawn without pyplot.
"""

import os
import sys
from contextlib import suppress


def _load_matplotlib() -> None:
    """Import matplotlib, with the backend that MPLBACKEND names if it is there, else with its own choice."""
    name = os.environ.pop("MPLBACKEND", None)
    try:
        import matplotlib
    finally:
        if name is not None:
            os.environ["MPLBACKEND"] = name  # for the programs that this one starts
    if name:
        with suppress(ValueError):
            matplotlib.rcParams["backend"] = name


if "matplotlib" not in sys.modules:  # otherwise its backend is chosen already
    _load_matplotlib()
