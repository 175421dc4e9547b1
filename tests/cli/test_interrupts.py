import gc
import os
import signal
import time

import pytest

from gsjax.cli.interrupts import heard_interrupts, undisturbed

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals")


def interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def test_an_interrupt_is_raised_at_once():
    with pytest.raises(KeyboardInterrupt), heard_interrupts():
        interrupt()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_interrupt_in_a_callback_that_drops_exceptions_is_raised_after_it():
    calls = []

    def _xla_gc_callback(phase, info):  # the name that JAX's has
        if not calls:
            calls.append(phase)
            interrupt()
            time.sleep(0.05)

    gc.callbacks.append(_xla_gc_callback)
    try:
        with pytest.raises(KeyboardInterrupt), heard_interrupts():
            collect_and_wait()
    finally:
        gc.callbacks.remove(_xla_gc_callback)
    assert calls


def collect_and_wait() -> None:
    gc.collect()
    time.sleep(5)


def test_what_must_not_be_disturbed_ends_before_an_interrupt_is_raised():
    done = []

    def step(amount):
        interrupt()
        time.sleep(0.05)
        done.append(amount)
        return amount

    def step_and_wait():
        done.append(undisturbed(step, 3))
        time.sleep(5)

    with pytest.raises(KeyboardInterrupt), heard_interrupts():
        step_and_wait()
    assert done[0] == 3


def test_somebody_elses_handler_stays():
    heard = []
    before = signal.signal(signal.SIGINT, lambda *_: heard.append(1))
    try:
        with heard_interrupts():
            interrupt()
    finally:
        signal.signal(signal.SIGINT, before)
    assert heard
