"""Ctrl-C that is not lost.

Python raises KeyboardInterrupt wherever it happens to be. In a finalizer, or a callback of the garbage
collector (JAX has one) or of a weak reference, the exception is printed and dropped, and the program goes on
as if nobody had asked. Here Ctrl-C is raised again until it is heard.
"""

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, no_type_check

DEAF = frozenset({"called_by_xla", "undisturbed"})
"""Functions that Ctrl-C waits for: callbacks of XLA, which drops exceptions; what is not to be disturbed."""
RETRY_S = 0.01
_waiting = threading.Event()  # signals are the process's, and so is whether one waits


@no_type_check  # a wrapper that checks types would be disturbed between the call's end and its own
def undisturbed(call: Callable[..., Any], *arguments: Any) -> Any:
    """What `call` gives; Ctrl-C waits for its end and for `hear`. It is for steps that give away the buffers
    they replace: to stop in the middle of one would lose both the old and the new."""
    return call(*arguments)


def hear() -> None:
    """Raises KeyboardInterrupt where Ctrl-C waits: between undisturbed calls is too little time for it."""
    if _waiting.is_set():
        _forget()
        raise KeyboardInterrupt


def _forget() -> None:
    """Nothing waits: who hears Ctrl-C once must not be disturbed by it while tidying up."""
    signal.setitimer(signal.ITIMER_REAL, 0)
    _waiting.clear()


def is_deaf(frame: FrameType | None) -> bool:
    """Whether an exception raised in `frame` would be dropped, or do harm."""
    while frame is not None:
        if frame.f_code.co_name in DEAF:
            return True
        frame = frame.f_back
    return False


@contextmanager
def heard_interrupts() -> Iterator[None]:
    """While the block runs, Ctrl-C raises KeyboardInterrupt where it will be heard, if a little later.

    Where SIGINT is ignored or handled by somebody else, or there are no timers, nothing changes.
    """
    main = threading.current_thread() is threading.main_thread()
    usual = main and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not usual or not hasattr(signal, "setitimer"):
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        if is_deaf(frame):
            try_again()
        else:
            _forget()
            raise KeyboardInterrupt

    def try_again() -> None:
        _waiting.set()
        signal.setitimer(signal.ITIMER_REAL, RETRY_S)

    def dropped(unraisable: Any) -> None:
        if unraisable.exc_type is KeyboardInterrupt:
            try_again()
        else:
            print_dropped(unraisable)

    print_dropped, sys.unraisablehook = sys.unraisablehook, dropped
    before = signal.signal(signal.SIGALRM, interrupt)
    signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        _forget()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGALRM, before)
        sys.unraisablehook = print_dropped
