"""A field in the viewer: what the page asks it, and what it keeps."""

import threading
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from gsjax.engine.distill.query import Question, select
from gsjax.engine.distill.saved import FieldRun
from gsjax.engine.selected import EXTRACTED, keep_part
from gsjax.methods.distill import FeatureField, features_of, gaussian_cosines, threshold_for
from gsjax.viz.viewer import Answer, Asking


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

    def ask(text: str, frame: int) -> Answer:
        with one_by_one:  # several pages may ask before the encoder is loaded
            found = select(run, Question(text=text))
        return Answer(text, found.scores, found.threshold.value, found.threshold.rule, found.seconds)

    def like(row: int, frame: int) -> Answer:
        jax.block_until_ready(likeness(jnp.asarray(row)))  # what compiles is no answer's time
        begun = perf_counter()
        scores = np.asarray(likeness(jnp.asarray(row)))
        threshold = threshold_for(scores, False)
        seconds = perf_counter() - begun
        return Answer(f"like Gaussian {row}", scores, threshold.value, threshold.rule, seconds)

    def save(selected: Bool[np.ndarray, "n"], name: str, frame: int) -> Path:
        return keep_part(run.path / EXTRACTED, name, run.gaussians, selected, run.labels)

    return Asking(run.stored.source.hint(run.weights), ask, like, save)
