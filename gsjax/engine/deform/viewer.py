"""A run of `gsjax deform` in the viewer, over time, with queries."""

import threading
from functools import cache
from pathlib import Path
from time import perf_counter

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from gsjax.data.ordered import open_as_sequence
from gsjax.engine.deform.file import NAME, read_deformation
from gsjax.engine.deform.pictures import probabilities_of
from gsjax.engine.files import reopen
from gsjax.engine.messages import Notes, describe
from gsjax.engine.selected import EXTRACTED, keep_part
from gsjax.methods.deform import DeformResult, Prompt, feature_prompt, text_prompt
from gsjax.methods.deform.query import most_likely
from gsjax.viz.viewer import Answer, Asking, Motion, Shots, Viewable

_AGAIN = "reconstruct it again with this version of gsjax"


def viewable_deformation(path: Path, notes: Notes, weights: Path | None = None) -> Viewable:
    """The scene of a run of `gsjax deform` over time, with its photographs where its recording still is; it
    can be asked if it knows what is what.

    Args:
        path: of the run.
        notes: receives what is odd.
        weights: of CLIP, where they are now.

    Raises:
        ValueError: the file of the scene is damaged, or there are weights that it has no use for.
    """
    result = read_deformation(path / NAME)
    kind = None if result.meaning is None else result.meaning.source.kind
    if weights is not None and kind in (None, "classes", "closed"):
        raise ValueError(f"--weights: {path} has learned nothing of CLIP; leave it out")
    first, labels, times = result.at(0.0), None, result.timeline.times
    if result.meaning is not None and first.features is not None:
        likely = probabilities_of(first.features, jnp.asarray(result.meaning.codebook, jnp.float32))
        labels = 1 + most_likely(np.asarray(likely))
    return Viewable(
        path.absolute().name,
        first,
        labels,
        dict(enumerate(result.names, 1)),
        motion=Motion(len(times), first.num, lambda frame: result.at(times[frame])),
        times=times * result.timeline.seconds,
        shots=_shots(path, result, notes),
        unit="m" if result.timeline.metric else "",
        asking=None if labels is None else asking_of(path, result, weights),
    )


def asking_of(path: Path, result: DeformResult, weights: Path | None = None) -> Asking:
    """How the page asks it; what it saves goes to `extracted/` in the run's folder. Where features change
    over time, an answer is of the frame that is looked at.

    Args:
        path: of the run.
        result: what it learned.
        weights: folder of CLIP's, where they are no longer where they were.
    """
    assert result.meaning is not None
    meaning = result.meaning

    def features_in(frame: int) -> jax.Array:
        features = result.at(result.timeline.times[frame] if result.meaning_changes else 0.0).features
        assert features is not None
        return features

    def answer(words: str, prompt: Prompt, features: Float[jax.Array, "n c"]) -> Answer:
        jax.block_until_ready(prompt.scores(features))  # what compiles is no answer's time
        begun = perf_counter()
        scores = np.asarray(prompt.scores(features))
        seconds = perf_counter() - begun
        return Answer(words, scores, *prompt.threshold(scores), seconds)

    one_by_one, encoder = threading.Lock(), cache(lambda: meaning.source.encoder(weights))

    def ask(text: str, frame: int) -> Answer:
        with one_by_one:  # several pages may ask before the encoder is loaded
            prompt = text_prompt(meaning, text, encoder=encoder)
        return answer(text, prompt, features_in(frame))

    def like(row: int, frame: int) -> Answer:
        features = features_in(frame)
        prompt = feature_prompt(meaning, np.asarray(features[row], np.float64))
        return answer(f"like Gaussian {row} ({prompt.name})", prompt, features)

    def save(selected: Bool[np.ndarray, "n"], name: str, frame: int) -> Path:
        timeline = result.timeline
        there, called = result.at(timeline.times[frame]), f"{name} frame {timeline.frame_ids[frame]}"
        return keep_part(path / EXTRACTED, called, there, selected)

    return Asking(meaning.hint(weights), ask, like, save)


def _shots(path: Path, result: DeformResult, notes: Notes) -> Shots:
    """The cameras of all frames, with what they saw if that is still there."""
    load = None
    try:
        sequence = reopen(path / "config.yml", _AGAIN, opened=open_as_sequence)[0].judged
        found = (sequence.num_frames, sequence.width, sequence.height)
        if found != (wanted := (len(result.timeline.times), *result.timeline.size)):
            raise ValueError(f"expected frames, width and height {wanted} as then, found {found}")
        load = lambda t, _: sequence.image(t, 0)  # noqa: E731
    except (ValueError, OSError) as error:
        notes.warn(f"its photographs are not shown: {describe(error)}")
    sizes = np.array([result.timeline.size])
    viewmats, Ks = result.timeline.viewmats[:, None], result.timeline.Ks[:, None]
    return Shots(("camera",), viewmats, Ks, sizes, load_image=load)
