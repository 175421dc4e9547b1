"""Pictures, plots and pages. matplotlib is first imported here, regardless of MPLBACKEND.

A notebook passes its own backend on to the programs that it starts, and matplotlib cannot be imported if the
named backend is not installed. The plots of gsjax need no backend: they are drawn without pyplot.
"""

import os
import sys
from contextlib import suppress


def _load_matplotlib() -> None:
    """Import matplotlib, with the backend that MPLBACKEND names if available, else with its own choice."""
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
