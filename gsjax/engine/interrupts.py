"""Makes sure that Ctrl-C is not lost, and that other signals end a run as Ctrl-C does.

Python raises KeyboardInterrupt wherever it happens to be. In a finalizer, or a callback of the garbage
collector (JAX has one) or of a weak reference, the exception is printed and dropped, and the program goes on.
Here Ctrl-C is raised again until it gets through. SIGTERM, sent by schedulers and `kill`, and SIGHUP, sent by
a closing terminal, are treated the same way, so that results computed so far are written.
"""

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn, no_type_check

UNINTERRUPTIBLE = frozenset({"called_by_xla", "shielded"})
"""Functions that Ctrl-C waits for: callbacks of XLA, which drops exceptions, and `shielded` calls."""
RETRY_S = 0.01
_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")
_waiting = threading.Event()  # one per process, as signals are
_newest = ["SIGINT"]
_raised: list[str] = []  # the signal of each KeyboardInterrupt so far


@no_type_check  # a type-checking wrapper could be interrupted after the call has ended
def shielded(call: Callable[..., Any], *arguments: Any) -> Any:
    """The result of `call`. Ctrl-C waits until it has returned, and is raised by `raise_if_interrupted` at
    the latest. It is for steps that donate the buffers they replace: an interrupt in the middle of one would
    lose both the old and the new."""
    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return call(*arguments)  # in `handled_interrupts`, or Ctrl-C is the business of something else
    signal.signal(signal.SIGINT, lambda *_: _waiting.set())
    try:
        return call(*arguments)
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def raise_if_interrupted() -> None:
    """Raises KeyboardInterrupt if Ctrl-C is pending: the gaps between shielded calls are too short for the
    timer, and outside of `handled_interrupts` there is none."""
    if _waiting.is_set():
        _raise()


def _raise() -> NoReturn:
    """Raises KeyboardInterrupt with the name of the newest signal."""
    _clear()
    _raised.append(*_newest)
    raise KeyboardInterrupt(*_newest)


@contextmanager
def raised_again() -> Iterator[None]:
    """Raises KeyboardInterrupt at the end of the block if one was raised in it, even if it was caught there,
    as a run does to write what it has."""
    before = len(_raised)
    try:
        yield
    finally:
        if len(_raised) > before:
            raise KeyboardInterrupt(_raised[-1])


def _clear() -> None:
    """Clear what is pending: once raised, Ctrl-C must not be raised again during the clean-up."""
    signal.setitimer(signal.ITIMER_REAL, 0)
    _waiting.clear()


def is_uninterruptible(frame: FrameType | None) -> bool:
    """Whether an exception raised in `frame` would be dropped, or do harm."""
    while frame is not None:
        if frame.f_code.co_name in UNINTERRUPTIBLE:
            return True
        frame = frame.f_back
    return False


@contextmanager
def handled_interrupts() -> Iterator[None]:
    """While the block runs, Ctrl-C, SIGTERM and SIGHUP raise KeyboardInterrupt with the signal's name, if
    necessary delayed until it gets through.

    A signal that is ignored (`nohup`) or handled by something else stays so. On systems without timers,
    nothing changes.
    """
    heard = [signal.Signals[name] for name in _SIGNALS if name in signal.Signals.__members__]
    usual = (signal.default_int_handler, signal.SIG_DFL)
    before = {number: handler for number in heard if (handler := signal.getsignal(number)) in usual}
    main = threading.current_thread() is threading.main_thread()
    if not main or not before or not hasattr(signal, "setitimer"):
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        if number != signal.SIGALRM:
            _newest[0] = signal.Signals(number).name
        if is_uninterruptible(frame):
            try_again()
        else:
            _raise()

    def try_again() -> None:
        _waiting.set()
        signal.setitimer(signal.ITIMER_REAL, RETRY_S)

    def dropped(unraisable: Any) -> None:
        if unraisable.exc_type is KeyboardInterrupt:
            try_again()
        else:
            print_dropped(unraisable)

    print_dropped, sys.unraisablehook = sys.unraisablehook, dropped
    before[signal.SIGALRM] = signal.getsignal(signal.SIGALRM)
    for number in before:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        _clear()
        for number, handler in before.items():
            signal.signal(number, handler)
        sys.unraisablehook = print_dropped
