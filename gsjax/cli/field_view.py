"""A field in the viewer: what the page asks it, and what it keeps."""

import re
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from gsjax.cli.field_query import Question, select
from gsjax.cli.field_run import FieldRun
from gsjax.cli.field_source import Source
from gsjax.io.ply import write_ply
from gsjax.methods.feature_field import FeatureField, features_of, gaussian_cosines, threshold_for
from gsjax.perception.closed_vocabulary import COLORS, OUTLINES
from gsjax.scene.gaussians import take
from gsjax.viz.viewer import Asking, Found

FOLDER = "extracted"


def asking_of(run: FieldRun) -> Asking:
    """How the page asks a field; what it saves goes to `extracted/` in the field's folder."""
    grid, located = run.stored.at(run.gaussians.means)
    # Asked again and again: features are worked out once.
    field = FeatureField(features_of(grid, located), grid.lift)
    run = replace(run, stored=replace(run.stored, field=field, rows=None))

    @jax.jit
    def likeness(row):
        vector = jnp.matmul(field.lift, field.encoding[row], precision="highest")
        return gaussian_cosines(field, None, vector[None])[:, 0]

    def ask(text: str) -> Found:
        found = select(run, Question(text=text))
        return Found(text, found.scores, found.threshold.value, found.threshold.rule, found.seconds)

    def like(row: int) -> Found:
        jax.block_until_ready(likeness(jnp.asarray(row)))  # what compiles is no answer's time
        begun = perf_counter()
        scores = np.asarray(likeness(jnp.asarray(row)))
        threshold = threshold_for(scores, False)
        seconds = perf_counter() - begun
        return Found(f"like Gaussian {row}", scores, threshold.value, threshold.rule, seconds)

    def save(selected: Bool[np.ndarray, "n"], name: str) -> Path:
        folder = run.path / FOLDER
        folder.mkdir(exist_ok=True)
        path = _free(folder, "_".join(re.findall(r"[^\W_]+", name.lower())) or "selection")
        write_ply(path, take(run.gaussians, selected))
        return path

    return Asking(_hint(run.stored.source), ask, like, save)


def _hint(source: Source) -> str:
    if source.kind == "classes":
        return "One of: " + ", ".join(sorted(source.names.values()))
    if source.kind == "closed":
        return "Colours and outlines: " + ", ".join((*COLORS, *OUTLINES, *source.names.values()))
    return "Any words" if source.kind in ("clip", "maskclip") else "No words: ask for what is picked"


def _free(folder: Path, name: str) -> Path:
    """A path of that name that nothing has; a file is put there at once."""
    number = 1
    while True:
        path = folder / (f"{name}.ply" if number == 1 else f"{name}_{number}.ply")
        try:
            path.open("x").close()
            return path
        except FileExistsError:
            number += 1
