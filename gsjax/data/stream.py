"""Live streams of frames: the consumer always gets the newest; frames that it is too slow for are dropped.

A source is any iterator of `Snapshot`s that blocks until one is available: a recording replayed in real time,
cameras read through OpenCV, or a user-defined iterator. `NewestSnapshots` reads it in a thread of its own.
"""

import itertools
import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from gsjax.scene.frame import Frame


class Snapshot(NamedTuple):
    """The images of all cameras at approximately the same time.

    Attributes:
        frame: images, depths and cameras.
        stamp: time by the source's clock, seconds.
        skew: time between its first and its last camera, seconds.
    """

    frame: Frame
    stamp: float
    skew: float = 0.0


class Arrival(NamedTuple):
    """A snapshot and its arrival time by `time.perf_counter`, seconds."""

    snapshot: Snapshot
    time: float


class StreamStalled(OSError):
    """A source delivered nothing within the timeout."""


@dataclass
class Counts:
    """Statistics of the snapshots that a source offered.

    Attributes:
        offered: all snapshots.
        used: those passed to the consumer.
        dropped: those replaced by a newer one before the consumer took them.
        out_of_order: those not newer than the one before.
        out_of_sync: those whose cameras were further apart in time than allowed.
        longest_gap_s: longest time between two consecutive snapshots, seconds.
    """

    offered: int = 0
    used: int = 0
    dropped: int = 0
    out_of_order: int = 0
    out_of_sync: int = 0
    longest_gap_s: float = 0.0


class NewestSnapshots:
    """Iterates over the newest snapshots of a source, each at most once, while a thread keeps reading.

    Args:
        source: the snapshots; an exception that it raises is re-raised in the consumer.
        max_skew: largest allowed time between the cameras of a snapshot, seconds.
        patience: longest wait for a snapshot, seconds; may be infinite.

    Raises:
        StreamStalled: while iterating, if no snapshot arrives within `patience`.
    """

    def __init__(self, source: Iterable[Snapshot], *, max_skew: float = 0.02, patience: float = 10.0):
        self.counts = Counts()
        self._source, self._max_skew = source, max_skew
        self._patience = min(patience, threading.TIMEOUT_MAX)  # locks take no more
        self._condition = threading.Condition()
        self._waiting: Arrival | None = None
        self._ended, self._error, self._closed = False, None, False

    def __iter__(self) -> Iterator[Arrival]:
        threading.Thread(target=self._read, name="stream", daemon=True).start()
        try:
            while (arrival := self._take()) is not None:
                self.counts.used += 1
                yield arrival
        finally:
            self._closed = True

    def _take(self) -> Arrival | None:
        """The newest arrival, or None if the source has ended."""
        with self._condition:
            ready = self._condition.wait_for(lambda: self._waiting or self._ended, self._patience)
            arrival, self._waiting = self._waiting, None
        if arrival is not None:
            return arrival
        if self._error is not None:
            raise self._error
        if not ready:
            counts = self.counts
            rejected = {"out of order": counts.out_of_order, "with cameras out of sync": counts.out_of_sync}
            details = "".join(f", {count} of them {why}" for why, count in rejected.items() if count)
            raise StreamStalled(
                f"the stream stalled: nothing for {self._patience:g} s after {counts.offered} frames{details}"
            )
        return None

    def _read(self) -> None:
        counts, newest, previous = self.counts, float("-inf"), None
        try:
            for snapshot in self._source:
                now = time.perf_counter()
                counts.offered += 1
                gap = 0.0 if previous is None else now - previous
                counts.longest_gap_s, previous = max(counts.longest_gap_s, gap), now
                if snapshot.stamp <= newest:
                    counts.out_of_order += 1
                elif snapshot.skew > self._max_skew:
                    counts.out_of_sync += 1
                else:
                    newest = snapshot.stamp
                    with self._condition:
                        counts.dropped += self._waiting is not None
                        self._waiting = Arrival(snapshot, now)
                        self._condition.notify()
                if self._closed:
                    break
        except BaseException as error:
            self._error = error
        finally:
            with self._condition:
                self._ended = True
                self._condition.notify()


def back_and_forth(length: int) -> Iterator[int]:
    """0, 1, ..., length-1, length-2, ..., 1, 0, 1, ...: endless playback without jumps."""
    while True:
        yield from range(length)
        yield from range(length - 2, 0, -1)


def replay(
    frames: Sequence[Frame],
    hz: float,
    seconds: float,
    *,
    now: Callable[[], float] = time.perf_counter,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[Snapshot]:
    """Play frames in memory back and forth in real time; the first comes one period after the start.

    Args:
        frames: the frames of a recording.
        hz: frames per second.
        seconds: duration; may be infinite.
        now, sleep: the clock.
    """
    start, length = now(), hz * seconds
    counts = itertools.count(1) if math.isinf(length) else range(1, round(length) + 1)
    for count, index in zip(counts, back_and_forth(len(frames)), strict=False):
        due = count / hz
        sleep(max(0.0, start + due - now()))
        yield Snapshot(frames[index], due)
