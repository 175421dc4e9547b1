"""A field in the viewer: what the page asks it, and what it keeps."""

import re
import threading
from dataclasses import replace
from itertools import count
from pathlib import Path
from time import perf_counter

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from gsjax.cli.field_query import Question, select
from gsjax.cli.field_run import FieldRun
from gsjax.io.atomic import write_new
from gsjax.io.ply import write_ply
from gsjax.methods.feature_field import FeatureField, features_of, gaussian_cosines, threshold_for
from gsjax.perception.closed_vocabulary import COLORS, OUTLINES
from gsjax.scene.selection import only
from gsjax.viz.viewer import Asking, Found

FOLDER = "extracted"


def asking_of(run: FieldRun) -> Asking:
    """How the page asks a field; what it saves goes to `extracted/` in the field's folder."""
    grid, located = run.stored.at(run.gaussians.means)
    # Asked again and again: features are worked out once, and who reads texts is loaded once.
    field, one_by_one = FeatureField(features_of(grid, located), grid.lift), threading.Lock()
    run = replace(run, stored=replace(run.stored, field=field, rows=None))

    @jax.jit
    def likeness(row):
        vector = jnp.matmul(field.lift, field.encoding[row], precision="highest")
        return gaussian_cosines(field, None, vector[None])[:, 0]

    def ask(text: str) -> Found:
        with one_by_one:  # several pages may ask before the encoder is loaded
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
        stem = "_".join(re.findall(r"[^\W_]+", name.lower())) or "selection"
        names = (folder / (f"{stem}.ply" if number == 1 else f"{stem}_{number}.ply") for number in count(1))
        labels = None if run.labels is None else run.labels[selected]
        return write_new(names, lambda path: write_ply(path, only(run.gaussians, selected), labels=labels))

    return Asking(_hint(run), ask, like, save)


def _hint(run: FieldRun) -> str:
    """What can be asked for."""
    source = run.stored.source
    if source.kind == "classes":
        return "One of: " + ", ".join(sorted(source.names.values()))
    if source.kind == "closed":
        return "Colours and outlines: " + ", ".join((*COLORS, *OUTLINES, *source.names.values()))
    if source.kind == "files" and run.weights is None:
        return "No words (--weights, if these features are CLIP's): ask for what is picked"
    return "Any words"
