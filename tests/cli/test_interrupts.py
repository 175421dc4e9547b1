import gc
import os
import signal
import sys
import time
import weakref

import pytest

from gsjax.engine.interrupts import handled_interrupts, raise_if_interrupted, shielded
from gsjax.engine.messages import reason

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals")


def interrupt(number: int = signal.SIGINT) -> None:
    os.kill(os.getpid(), number)


def test_an_interrupt_is_raised_at_once():
    with pytest.raises(KeyboardInterrupt), handled_interrupts():
        interrupt()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_signal_that_would_end_the_program_stops_it_as_ctrl_c_does(name):
    number = signal.Signals[name]
    with pytest.raises(KeyboardInterrupt) as stopped, handled_interrupts():
        interrupt(number)
    assert (str(stopped.value), reason(stopped.value)) == (name, name)
    assert signal.getsignal(number) is signal.SIG_DFL
    assert reason(KeyboardInterrupt()) == reason(KeyboardInterrupt("SIGINT")) == "Ctrl-C"


def test_what_nohup_ignores_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with handled_interrupts():
            interrupt(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


def in_the_garbage_collector():
    def callback(phase, info):
        gc.callbacks.remove(callback)
        interrupt()

    gc.callbacks.append(callback)
    gc.collect()


def in_a_finalizer():
    class Finalized:
        def __del__(self):
            interrupt()

    Finalized()


def of_a_weak_reference():
    class Referred: ...

    referred = Referred()
    reference = weakref.ref(referred, lambda _: interrupt())
    del referred
    assert reference() is None


@pytest.mark.parametrize("callback", [in_the_garbage_collector, in_a_finalizer, of_a_weak_reference])
def test_an_interrupt_that_a_callback_drops_is_raised_again(callback):
    def call_and_wait():
        callback()
        time.sleep(5)

    before = sys.unraisablehook
    with pytest.raises(KeyboardInterrupt), handled_interrupts():
        call_and_wait()
    assert sys.unraisablehook is before


def test_other_exceptions_that_are_dropped_are_printed_as_before(monkeypatch):
    printed = []
    monkeypatch.setattr(sys, "unraisablehook", printed.append)

    class Faulty:
        def __del__(self):
            raise ValueError

    with handled_interrupts():
        Faulty()
    assert [each.exc_type for each in printed] == [ValueError]


def test_what_must_not_be_disturbed_ends_before_an_interrupt_is_raised():
    done = []

    def step(amount):
        interrupt()
        time.sleep(0.05)
        done.append(amount)
        return amount

    def step_and_wait():
        done.append(shielded(step, 3))
        time.sleep(5)

    with pytest.raises(KeyboardInterrupt), handled_interrupts():
        step_and_wait()
    assert done == [3, 3]


def test_nothing_stands_between_an_undisturbed_call_and_who_made_it():
    # A type check of results used to wrap it, and an interrupt within the check lost the call's result.
    assert not hasattr(shielded, "__wrapped__")


def test_between_undisturbed_steps_an_interrupt_is_heard_at_once():
    steps = []

    def step(first):
        if first:
            interrupt()
        time.sleep(0.03)

    def walk():
        for _ in range(100):
            steps.append(shielded(step, not steps))
            raise_if_interrupted()

    with handled_interrupts():
        with pytest.raises(KeyboardInterrupt):
            walk()
        time.sleep(0.03)  # nothing is raised a second time
        raise_if_interrupted()
    assert len(steps) == 1


def test_somebody_elses_handler_stays():
    heard = []
    before = signal.signal(signal.SIGINT, lambda *_: heard.append(1))
    try:
        with handled_interrupts():
            interrupt()
    finally:
        signal.signal(signal.SIGINT, before)
    assert heard
