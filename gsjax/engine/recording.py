"""The part of a recording that a run uses, and the cameras that it holds out."""

import itertools
import os
import warnings
from collections.abc import Callable, Iterable, Iterator
from collections.abc import Sequence as Indices
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from time import perf_counter
from typing import Any, Generic, TypeVar

from rich.console import Console
from rich.progress import track

from gsjax.data import ReadOptions, Sequence, open_sequence
from gsjax.data.consistency import check_recording
from gsjax.data.errors import DataWarning
from gsjax.data.open import SIMULATED_PREFIX
from gsjax.engine.options import OfRecording

Opener = Callable[[str, ReadOptions | None], Sequence]
_LEAST_SIDE = 8  # of a downscaled picture, pixels

Loaded = TypeVar("Loaded")


@dataclass(frozen=True, eq=False)
class Recording:
    """The chosen frames of a recording.

    Attributes:
        tracked: the cameras that methods see; the others' files are not even opened for them.
        judged: the same frames, with the held-out cameras after the tracked ones.
        frames_in_data: number of frames in the data.
        simulated: whether pictures are rendered on demand, which is slower than reading them, and cached.
    """

    tracked: Sequence
    judged: Sequence
    frames_in_data: int
    simulated: bool = False

    @property
    def held_out(self) -> tuple[int, ...]:
        """Ids of the held-out cameras."""
        return self.judged.camera_ids[self.tracked.num_cameras :]


def absolute_path(dataset: str) -> str:
    """The absolute path of a dataset, by which a run finds it again from elsewhere; for a built-in scene, its
    name."""
    return dataset if dataset.startswith(SIMULATED_PREFIX) else os.path.abspath(dataset)


def chosen_recording(options: OfRecording) -> Recording:
    """The recording of a command's options, checked for mistakes. Raises: as `open_recording`."""
    cameras = (options.cameras, options.eval_cameras)
    recording = open_recording(options.dataset, *cameras, options.frames, options.read, options.scale)
    check_recording(recording.judged)
    return recording


def open_recording(
    dataset: str,
    cameras: Indices[int],
    eval_cameras: Indices[int],
    frames: str,
    read: ReadOptions | None = None,
    scale: float = 1.0,
    opened: Opener | None = None,
) -> Recording:
    """Open a dataset and select frames and cameras.

    Args:
        dataset: a folder, or a built-in scene.
        cameras: ids of the cameras to use; if empty, all that are not held out.
        eval_cameras: ids of the held-out cameras.
        frames: START:STOP[:STEP].
        read: details that the layout leaves open.
        scale: size of the pictures relative to the original.
        opened: opens the whole dataset (default: `open_sequence`).

    Raises:
        ValueError: a camera does not exist, is named twice or is in both lists; no frame is selected; or
            pictures would be too small.
        DataError: the dataset cannot be read.
    """
    sequence = (opened or open_sequence)(dataset, read)
    known = list(sequence.camera_ids)
    chosen = [c for c in known if c not in eval_cameras] if not cameras else list(cameras)
    for option, ids in (("--cameras", chosen), ("--eval-cameras", list(eval_cameras))):
        unknown = [c for c in ids if c not in known]
        if unknown:
            raise ValueError(f"{option}: {sequence.name} has no camera {unknown[0]}; it has {known}.")
        twice = [c for c in ids if ids.count(c) > 1]
        if twice:
            raise ValueError(f"{option}: camera {twice[0]} is named twice.")
    both = [c for c in chosen if c in eval_cameras]
    if both:
        raise ValueError(f"--eval-cameras: camera {both[0]} is in --cameras too; it cannot be held out.")
    if not chosen:
        raise ValueError(
            f"--cameras: expected at least one that is not held out, found none; {sequence.name} has {known}."
        )
    total = sequence.num_frames
    chosen_frames = parse_frames(frames)
    if not range(total)[chosen_frames]:
        raise ValueError(
            f"--frames: {frames} selects no frame of {sequence.name}, which has 0 to {total - 1}."
        )
    if (chosen_frames.stop or 0) > total:
        message = f"--frames: {frames} goes beyond the last frame of {sequence.name}, {total - 1}"
        warnings.warn(message, DataWarning, stacklevel=2)
    whole = sequence.select(frames=chosen_frames)
    sequence = whole.scaled(scale)
    sizes = (whole.width, whole.height), (sequence.width, sequence.height)
    expect_enough_left(scale, "pictures", *sizes)
    simulated = dataset.startswith(SIMULATED_PREFIX)
    if simulated:
        sequence = remembered(sequence)
    return Recording(
        tracked=sequence.select(cameras=chosen),
        judged=sequence.select(cameras=[*chosen, *eval_cameras]),
        frames_in_data=total,
        simulated=simulated,
    )


def expect_enough_left(scale: float, what: str, before: tuple[int, int], after: tuple[int, int]) -> None:
    """Raises ValueError if --scale makes pictures too small.

    Args:
        scale: the option's value.
        what: what is scaled, in words.
        before, after: its (width, height).
    """
    if scale < 1 and min(after) < _LEAST_SIDE:
        raise ValueError(
            f"--scale {scale:g}: {what} of {before[0]}x{before[1]} would be {after[0]}x{after[1]}; expected "
            f"{_LEAST_SIDE} pixels or more a side"
        )


def parse_frames(text: str) -> slice:
    """The slice of a text such as "0:60", "0:60:2", ":30" or ":".

    Raises:
        ValueError: it is no slice, or its step is below 1.
    """
    try:
        parts = [int(part) if part.strip() else None for part in text.split(":")]
    except ValueError:
        parts = []
    if not 2 <= len(parts) <= 3:
        found = f"found {text!r}; :4 is the first four, 4:5 the fifth alone"
        raise ValueError(f"--frames: expected START:STOP or START:STOP:STEP, as in 0:60, {found}.")
    if len(parts) == 3 and parts[2] is not None and parts[2] < 1:
        raise ValueError(f"--frames: frames go forwards; found the step {parts[2]}.")
    return slice(*parts)


def remembered(sequence: Sequence) -> Sequence:
    """The same sequence, with loaded pictures cached in memory: simulated ones are slow to render."""

    def kept(loader: Callable | None) -> Callable | None:
        return None if loader is None else cache(loader)

    return replace(sequence, load_image=kept(sequence.load_image), load_depth=kept(sequence.load_depth))


def draw_ahead(recording: Recording, console: Console) -> None:
    """Render the tracked pictures of a simulated recording, so that updates need not share the processor."""
    if views := _views_to_draw(recording):
        draw = recording.tracked.image
        in_threads(lambda view: draw(*view), views, "drawing the simulated scene", console)


@contextmanager
def drawing_ahead(recording: Recording) -> Iterator[None]:
    """While this context lasts, another thread renders the pictures that `draw_ahead` will need."""
    executor = ThreadPoolExecutor(1, thread_name_prefix="drawing")
    for view in _views_to_draw(recording):
        executor.submit(recording.tracked.image, *view)
    try:
        yield
    finally:
        executor.shutdown(cancel_futures=True)


def _views_to_draw(recording: Recording) -> list[tuple[int, int]]:
    """Frame and camera of each tracked picture of a simulated recording; empty for others."""
    sequence = recording.tracked
    pairs = itertools.product(range(sequence.num_frames), range(sequence.num_cameras))
    return list(pairs) if recording.simulated else []


def in_threads(
    load: Callable[[Any], Loaded], items: Iterable[Any], words: str, console: Console
) -> list[Loaded]:
    """The result of `load` for each item, by two threads, with a progress bar. An exception or Ctrl-C cancels
    the rest.

    Args:
        load: item -> result.
        items: what to load.
        words: what is being done.
        console: shows the bar.
    """
    with ThreadPoolExecutor(2) as executor:
        jobs = [executor.submit(load, item) for item in items]
        try:
            return [job.result() for job in track(jobs, words, console=console, transient=True)]
        except BaseException:
            executor.shutdown(cancel_futures=True)
            raise


class Prefetched(Generic[Loaded]):
    """Iterates over `load(index)`, loaded by a thread up to `ahead` items before they are used.

    Attributes:
        waited: seconds that the iteration has waited for loads so far.
    """

    def __init__(self, load: Callable[[int], Loaded], indices: Indices[int], ahead: int = 2):
        self._load, self._indices, self._ahead = load, indices, ahead
        self.waited = 0.0

    def __iter__(self):
        executor = ThreadPoolExecutor(1, thread_name_prefix="prefetch")
        pending: list[Future] = []
        try:
            rest = iter(self._indices)
            for index in rest:
                pending.append(executor.submit(self._load, index))
                if len(pending) > self._ahead:
                    yield self._take(pending)
            while pending:
                yield self._take(pending)
        finally:
            executor.shutdown(wait=False, cancel_futures=True)

    def _take(self, pending: list[Future]) -> Loaded:
        begun = perf_counter()
        try:
            return pending.pop(0).result()
        finally:
            self.waited += perf_counter() - begun
