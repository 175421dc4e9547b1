"""Queries of a run from the viewer's page."""

import threading
from itertools import count
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from gsjax.engine.query import Queryable, Question, select, write_part
from gsjax.io.atomic import write_new
from gsjax.methods.query import Prompt
from gsjax.perception.codebook import plain_name
from gsjax.viz.viewer import Answer, Asking

_EXTRACTED = "extracted"  # folder, within the run's, of the parts that the viewer saved


def asking_of(run: Queryable) -> Asking:
    """The queries that the viewer's page offers for a run; it saves to `extracted/` in the run's folder."""
    one_by_one = threading.Lock()

    def answered(words: str, question: Question, frame: int, prompt: Prompt) -> Answer:
        found = select(run, question, frame, prompt)
        on = "" if prompt.level is None else f" on level {prompt.level}"
        return Answer(words + on, found.scores, *found.threshold, found.seconds)

    def ask(text: str, frame: int, level: str | None = None) -> Answer:
        question = Question(text=text, level=level)
        with one_by_one:  # several pages may query before the encoder is loaded
            run.refresh()
            prompt = run.prompt(question, frame)
        return answered(text, question, frame, prompt)

    def like(row: int, frame: int, level: str | None = None) -> Answer:
        with one_by_one:
            run.refresh()
        prompt = run.like(row, frame, level)
        meant = "" if prompt.name is None else f" ({prompt.name})"
        return answered(f"like Gaussian {row}{meant}", Question(), frame, prompt)

    def save(selected: Bool[np.ndarray, "n"], name: str, frame: int) -> Path:
        folder = run.path / _EXTRACTED
        folder.mkdir(exist_ok=True)
        called = name if run.frame_ids is None else f"{name} frame {run.frame_ids[frame]}"
        stem = plain_name(called).replace(" ", "_") or "selection"
        files = (folder / (f"{stem}.ply" if number == 1 else f"{stem}_{number}.ply") for number in count(1))
        gaussians = run.at(frame)
        return write_new(files, lambda path: write_part(path, run, gaussians, selected))

    return Asking(run.hint, ask, like, save, run.levels)
