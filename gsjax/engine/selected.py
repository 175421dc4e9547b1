"""What is done with the Gaussians that a query means, and what it leaves of them in files."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from gsjax.io.atomic import write_new, write_npz
from gsjax.io.ply import write_ply
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.selection import only, shifted, tinted

EXTRACTED = "extracted"
"""Where parts of a scene are kept, in the folder of what was asked."""


@dataclass(frozen=True)
class Changes:
    """What is done with what was found.

    Attributes:
        color: RGB, 0 to 1, that it has in recolored.ply.
        move: metres by which it is moved in moved.ply; None writes none.
    """

    color: tuple[float, float, float]
    move: tuple[float, float, float] | None = None

    def of(self, gaussians: Gaussians, selected: Bool[np.ndarray, "n"]) -> dict[str, Gaussians]:
        """Scenes with the selected ones changed, by the names of their files."""
        there = jnp.asarray(selected)
        scenes = {"recolored": jax.jit(tinted)(gaussians, there, jnp.asarray(self.color))}
        if self.move is not None:
            scenes["moved"] = jax.jit(shifted)(gaussians, there, jnp.asarray(self.move))
        return scenes


def write_selection(
    path: Path,
    gaussians: Gaussians,
    selected: Bool[np.ndarray, "n"],
    scores: Float[np.ndarray, "n"],
    rows: Int[np.ndarray, "n"],
    num_rows: int,
) -> None:
    """Writes selection.npz, by rows of the scene's file.

    Args:
        path: of the file.
        gaussians: the scene.
        selected: what was found.
        scores: of all.
        rows: which of the file's rows they are.
        num_rows: that the file has.
    """
    all_scores = np.full(num_rows, np.nan, np.float32)
    all_scores[rows] = scores
    arrays = {
        "indices": rows[selected],
        "scores": scores[selected].astype(np.float32),
        "means": np.asarray(gaussians.means)[selected],
        "all_scores": all_scores,
    }
    write_npz(path, arrays)


def write_scenes(
    folder: Path,
    gaussians: Gaussians,
    selected: Bool[np.ndarray, "n"],
    scenes: Mapping[str, Gaussians],
    labels: Int[np.ndarray, "n"] | None = None,
) -> None:
    """Writes PLY files of what was found, of the rest, and of the changed scenes, with labels where there are
    any.

    Args:
        folder: for them.
        gaussians: the scene.
        selected: which were found.
        scenes: changed ones, by their files' names.
        labels: of the Gaussians, or None.
    """
    for name, kept in (("object", selected), ("without", ~selected)):
        if kept.any():
            part = None if labels is None else labels[kept]
            write_ply(folder / f"{name}.ply", only(gaussians, kept), labels=part)
    for name, scene in scenes.items():
        write_ply(folder / f"{name}.ply", scene, labels=labels)


def keep_part(
    folder: Path,
    name: str,
    gaussians: Gaussians,
    selected: Bool[np.ndarray, "n"],
    labels: Int[np.ndarray, "n"] | None = None,
) -> Path:
    """Writes some Gaussians as a PLY file that is called about like `name`; returns which. None is written
    over.

    Args:
        folder: for it.
        name: what it is.
        gaussians: the scene.
        selected: which are written.
        labels: of the Gaussians, or None.
    """
    folder.mkdir(exist_ok=True)
    stem = "_".join(re.findall(r"[^\W_]+", name.lower())) or "selection"
    names = (folder / (f"{stem}.ply" if number == 1 else f"{stem}_{number}.ply") for number in count(1))
    part = None if labels is None else labels[selected]
    return write_new(names, lambda path: write_ply(path, only(gaussians, selected), labels=part))
