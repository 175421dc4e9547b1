"""Playback: a step repeated in a thread until it is stopped."""

import threading
from collections.abc import Callable

import numpy as np

_MOST_HZ = 12.0  # frames a second


class Player:
    """Repeats a step in its own thread.

    Args:
        step: the step.
        pause: returns the seconds to wait before the next step.
        on_change: called with True when playback starts and False when it stops.
    """

    def __init__(
        self, step: Callable[[], None], pause: Callable[[], float], on_change: Callable[[bool], None]
    ):
        self._step, self._pause, self._on_change = step, pause, on_change
        self._lock = threading.Lock()
        self._stop: threading.Event | None = None  # stops the current thread; each thread has its own
        self._closed = False

    def toggle(self) -> None:
        """Start playback, or stop it if it is running."""
        with self._lock:
            if self._closed:
                return
            if self._stop is None:
                self._stop = threading.Event()
                threading.Thread(
                    target=self._run, args=(self._stop,), name="gsjax playing", daemon=True
                ).start()
            else:
                self._stop.set()
                self._stop = None
            self._on_change(self._stop is not None)

    def close(self) -> None:
        """Stop for good."""
        with self._lock:
            self._closed = True
            if self._stop is not None:
                self._stop.set()

    def _run(self, stop: threading.Event) -> None:
        while not stop.wait(self._pause()):
            self._step()


def frame_pause(times: np.ndarray | None) -> float:
    """Seconds between frames in playback: as recorded, but no faster than a browser can follow."""
    step = 0.0 if times is None or len(times) < 2 else float(np.median(np.diff(times)))
    return float(np.clip(step, 1 / _MOST_HZ, 1.0))
