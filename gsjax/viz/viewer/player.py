"""What goes on by itself until it is stopped."""

import threading
from collections.abc import Callable

import numpy as np

_MOST_HZ = 12.0  # frames a second


class Player:
    """Steps again and again, in a thread of its own.

    Args:
        step: what to do.
        pause: seconds before each step, asked anew each time.
        told: called with whether it plays, as soon as that changes.
    """

    def __init__(self, step: Callable[[], None], pause: Callable[[], float], told: Callable[[bool], None]):
        self._step, self._pause, self._told = step, pause, told
        self._lock = threading.Lock()
        self._stop: threading.Event | None = None  # of the run that plays: a later run has another
        self._closed = False

    def toggle(self) -> None:
        """Play, or stop if it plays."""
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
            self._told(self._stop is not None)

    def close(self) -> None:
        """Stop, and play no more."""
        with self._lock:
            self._closed = True
            if self._stop is not None:
                self._stop.set()

    def _run(self, stop: threading.Event) -> None:
        while not stop.wait(self._pause()):
            self._step()


def frame_pause(times: np.ndarray | None) -> float:
    """Seconds between frames when playing: as they were taken, but not faster than a browser follows."""
    step = 0.0 if times is None or len(times) < 2 else float(np.median(np.diff(times)))
    return float(np.clip(step, 1 / _MOST_HZ, 1.0))
