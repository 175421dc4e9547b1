"""A field in the viewer: queries, and what is kept of their results."""

import threading
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gsjax.engine.distill.query import Question, select, timed_scores
from gsjax.engine.distill.saved import FieldRun
from gsjax.engine.selected import EXTRACTED, keep_part
from gsjax.methods.distill import FeatureField, threshold_for
from gsjax.viz.viewer import Answer, Asking


def asking_of(run: FieldRun) -> Asking:
    """Queries of a field for the viewer's page, which saves to `extracted/` in the field's folder."""
    # Many queries follow: features are computed once, and the encoder of texts is loaded once.
    field = FeatureField(run.stored.features(), run.stored.field.lift)
    one_by_one, run = threading.Lock(), replace(run, stored=replace(run.stored, field=field, rows=None))

    def similarity(row: int) -> Float[Array, "n"]:
        vector = jnp.matmul(field.lift, field.encoding[row], precision="highest")
        return run.stored.scores(vector[None])

    def ask(text: str, frame: int) -> Answer:
        with one_by_one:  # several pages may query before the encoder is loaded
            found = select(run, Question(text=text))
        return Answer(text, found.scores, found.threshold.value, found.threshold.rule, found.seconds)

    def like(row: int, frame: int) -> Answer:
        scores, seconds = timed_scores(lambda: similarity(row))
        threshold = threshold_for(scores, False)
        return Answer(f"like Gaussian {row}", scores, threshold.value, threshold.rule, seconds)

    def save(selected: Bool[np.ndarray, "n"], name: str, frame: int) -> Path:
        return keep_part(run.path / EXTRACTED, name, run.gaussians, selected, run.labels)

    return Asking(run.stored.source.hint(run.weights), ask, like, save)
