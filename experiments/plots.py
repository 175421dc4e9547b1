"""Figures of the experiments with a robot."""

from pathlib import Path


def draw_grasping(rows: list[dict], path: Path) -> None:
    from matplotlib.figure import Figure

    Figure().savefig(path)
