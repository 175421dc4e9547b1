"""Frames that come when they come: the newest is handed on, and what nobody took in time is dropped.

A source is any iterator of `Snapshot`s that waits until there is one: a recording replayed in real time,
cameras that OpenCV reads, or what you write. `Newest` reads it in a thread of its own.
"""

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from gsjax.scene.frame import Frame


class Snapshot(NamedTuple):
    """What all cameras saw at about one moment.

    Attributes:
        frame: images, depths and cameras.
        stamp: when, by the source's clock, seconds.
        skew: time between the first and the last of its cameras, seconds.
    """

    frame: Frame
    stamp: float
    skew: float = 0.0


class Arrival(NamedTuple):
    """A snapshot, and when it arrived by `time.perf_counter`."""

    snapshot: Snapshot
    time: float


class StreamStalled(OSError):
    """Nothing came from a source for longer than was to be waited."""


@dataclass
class Counts:
    """What became of the snapshots that a source offered.

    Attributes:
        offered: all of them.
        used: handed on.
        dropped: a newer one came before anybody took them.
        out_of_order: not newer than the one before.
        out_of_sync: their cameras were further apart than allowed.
        longest_gap_s: the longest wait between two of them.
    """

    offered: int = 0
    used: int = 0
    dropped: int = 0
    out_of_order: int = 0
    out_of_sync: int = 0
    longest_gap_s: float = 0.0


class Newest:
    """Iterates over a source's newest snapshots; each is read once, and the reading goes on meanwhile.

    Args:
        source: gives snapshots, and ends or raises as it likes; what it raises is raised here.
        max_skew: cameras may be so far apart, seconds.
        patience: how long to wait for a snapshot, seconds.

    Raises:
        StreamStalled: while iterating, where nothing has come for so long.
    """

    def __init__(self, source: Iterable[Snapshot], *, max_skew: float = 0.02, patience: float = 10.0):
        self.counts = Counts()
        self._source, self._max_skew, self._patience = source, max_skew, patience
        self._news = threading.Condition()
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
        """The newest, or None where the source has ended."""
        with self._news:
            there = self._news.wait_for(lambda: self._waiting or self._ended, self._patience)
            arrival, self._waiting = self._waiting, None
        if arrival is not None:
            return arrival
        if self._error is not None:
            raise self._error
        if not there:
            counts = self.counts
            left_out = {"out of order": counts.out_of_order, "with cameras out of sync": counts.out_of_sync}
            words = "".join(f", {count} of them {why}" for why, count in left_out.items() if count)
            raise StreamStalled(
                f"the stream stalled: nothing for {self._patience:g} s after {counts.offered} frames{words}"
            )
        return None

    def _read(self) -> None:
        counts, newest, before = self.counts, float("-inf"), None
        try:
            for snapshot in self._source:
                now = time.perf_counter()
                counts.offered += 1
                counts.longest_gap_s = max(counts.longest_gap_s, now - (now if before is None else before))
                before = now
                if snapshot.stamp <= newest:
                    counts.out_of_order += 1
                elif snapshot.skew > self._max_skew:
                    counts.out_of_sync += 1
                else:
                    newest = snapshot.stamp
                    with self._news:
                        counts.dropped += self._waiting is not None
                        self._waiting = Arrival(snapshot, now)
                        self._news.notify()
                if self._closed:
                    break
        except BaseException as error:
            self._error = error
        finally:
            with self._news:
                self._ended = True
                self._news.notify()


def back_and_forth(length: int) -> Iterator[int]:
    """0, 1, ..., length-1, length-2, ..., 1, 0, 1, ...: a recording without end, in which nothing jumps."""
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
    """Frames in memory, back and forth in real time; the first comes one period after the start.

    Args:
        frames: of a recording.
        hz: how many come a second.
        seconds: for how long.
        now, sleep: the clock.
    """
    begun = now()
    for count, index in zip(range(1, round(hz * seconds) + 1), back_and_forth(len(frames)), strict=False):
        due = count / hz
        sleep(max(0.0, begun + due - now()))
        yield Snapshot(frames[index], due)
