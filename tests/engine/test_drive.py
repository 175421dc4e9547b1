"""The loop that drives every method, and what it guarantees, on a method small enough to follow by hand."""

import signal
import threading
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gsjax
from gsjax.engine import interrupts
from gsjax.engine.drive import Drive, drive
from gsjax.engine.verbs import _continued as going_on
from gsjax.io.checkpoints import CheckpointError, load_checkpoint, save_checkpoint
from gsjax.methods.fit import Fit
from gsjax.optim.method import Run
from gsjax.optim.step import Step
from gsjax.rasterize.plan import Plan
from tests.engine.cases import FIT, fit_problem

TRACES = []


@dataclass(frozen=True)
class WalkConfig:
    steps: int = 8
    seed: int = 0
    needs: tuple[int, ...] = ()  # the capacity that each step needs
    sick: int = -1  # the step whose numbers are not finite


class WalkBatch(NamedTuple):
    need: int
    sick: bool
    plan: Plan


@dataclass(frozen=True)
class Walk:
    """A random walk that grows by one number every four steps."""

    config: WalkConfig = WalkConfig()

    @property
    def step(self) -> Step:
        def update(params, state, batch, *, step, key):
            TRACES.append(1)
            moved = params + jax.random.normal(key, params.shape)
            overflow = batch.need > batch.plan.capacity
            sound = ~overflow & ~jnp.asarray(batch.sick)
            params = jnp.where(sound, moved, params)
            info = {"loss": params.sum(), "skipped": ~sound, "overflow": overflow, "needed": batch.need}
            return params, state + sound, info

        return Step(lambda params: jnp.int32(0), update)

    def start(self) -> tuple[None, Run]:
        params = jnp.zeros(2)
        return None, Run(params, self.step.init(params), plans={"only": Plan(8, 8, 4096)})

    def total(self, problem) -> int:
        return self.config.steps

    def period(self, problem) -> int:
        return 1

    def between(self, problem, run: Run, progress: float) -> Run:
        if run.step and run.step % 4 == 0:
            return run.having(params=jnp.append(run.params, 0.0))
        return run

    def batch(self, problem, run: Run, progress: float):
        needs = dict(enumerate(self.config.needs))
        batch = WalkBatch(needs.get(run.step, 0), run.step == self.config.sick, run.plans["only"])
        return batch, ("only",)

    def result(self, problem, run: Run) -> np.ndarray:
        return np.asarray(run.params)


def walked(config: WalkConfig = WalkConfig(), **options):
    method = Walk(config)
    return drive(method, *method.start(), **options)


def test_a_tick_a_step_until_all_is_done():
    ticks = list(ticking := walked())
    assert [now.step for now in ticks] == list(range(1, 9))
    assert [now.progress for now in ticks] == [i / 8 for i in range(8)]
    assert ticking.run.step == 8
    assert len(ticking.result) == 3
    np.testing.assert_array_equal(ticks[-1].result, ticking.result)
    assert list(walked(WalkConfig(steps=0))) == []


def test_a_run_that_is_resumed_anywhere_is_the_same_to_the_bit(tmp_path):
    whole = list(walked())[-1].result
    for at in (1, 4, 5):
        ticks = walked()
        for now in ticks:
            if now.step == at:
                break
        save_checkpoint(tmp_path / "run.npz", now.run)
        again, _ = load_checkpoint(tmp_path / "run.npz")
        assert again.step == at
        *_, last = drive(Walk(), None, again)
        np.testing.assert_array_equal(last.result, whole)


def test_seeds_differ_and_one_seed_does_not():
    one, same, other = (list(walked(WalkConfig(seed=seed)))[-1].result for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, same)
    assert not np.allclose(one, other)


def test_losses_of_other_settings_are_not_compared_with_those_before():
    now = next(walked())
    assert going_on(now, Walk()).guard is now.run.guard
    assert going_on(now, Walk(WalkConfig(seed=5))).guard is None


def test_what_overflows_is_done_again_with_room_and_to_the_same_bits():
    roomy = list(walked())[-1].result
    ticks = list(walked(WalkConfig(needs=(0, 5000, 0, 20_000))))
    np.testing.assert_array_equal(ticks[-1].result, roomy)
    assert not any(bool(now.info["overflow"]) for now in ticks)
    assert [now.run.plans["only"].capacity for now in ticks[:4]] == sorted(
        now.run.plans["only"].capacity for now in ticks[:4]
    )
    assert ticks[-1].run.plans["only"].capacity >= 20_000


def test_a_step_that_is_not_finite_is_skipped_and_counted_as_a_step():
    ticks = list(walked(WalkConfig(sick=2)))
    assert [bool(now.info["skipped"]) for now in ticks] == [i == 2 for i in range(8)]
    assert int(ticks[-1].run.state) == 7


def test_programs_are_compiled_once_for_each_shape_and_their_time_stands_apart():
    list(walked())
    TRACES.clear()
    ticks = list(walked())
    assert TRACES == []  # an equal method reuses what was compiled for the first
    ticks = list(walked(WalkConfig(steps=9, seed=11)))
    compiled = [now.step for now in ticks if now.compile_seconds > 0]
    assert {1, 5, 9} <= set(compiled) | {9}
    assert len(TRACES) == 3
    assert all(now.seconds >= 0 for now in ticks)


def test_progress_of_ones_own_ends_it():
    assert len(list(walked(progress=lambda step: step / 3))) == 3


def test_buffers_are_given_away():
    method = Walk()
    problem, run = method.start()
    ticks = drive(method, problem, run)
    first = next(ticks).run.params
    next(ticks)
    assert run.params.is_deleted()
    assert first.is_deleted()
    assert not ticks.run.params.is_deleted()


@pytest.mark.parametrize("handled", [interrupts.handled_interrupts, nullcontext])
def test_ctrl_c_waits_for_the_end_of_a_step(handled):
    asked = []

    def progress(step):  # first asked for a step at the end of the one before
        asked.append(step)
        if asked.count(4) == 1 and step == 4:
            signal.raise_signal(signal.SIGINT)
        return step / 8

    if threading.current_thread() is not threading.main_thread():
        pytest.skip("signals reach the main thread")
    ticks, taken = walked(progress=progress), []
    with handled(), pytest.raises(KeyboardInterrupt):
        taken.extend(ticks)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert ticks.tick is not None
    assert ticks.tick.step == ticks.run.step == 4
    assert handled is interrupts.handled_interrupts or taken[-1] is ticks.tick
    assert len(ticks.result) == 2
    *_, last = Drive(Walk(), None, ticks.run)
    np.testing.assert_array_equal(last.result, list(walked())[-1].result)


@pytest.mark.thorough
def test_a_fit_is_saved_and_loaded_without_a_template(tmp_path):
    method, problem, run = fit_problem(replace(FIT, steps=3, exposure=True, refine_poses=True))
    *_, now = drive(method, problem, run)
    gsjax.save(tmp_path / "fit.npz", now)
    again = gsjax.load(tmp_path / "fit.npz")
    assert isinstance(again.method, Fit)
    assert again.method == method
    assert eqx.tree_equal(again.run, now.run)
    assert again.run.plans == now.run.plans
    assert eqx.tree_equal(again.result, now.result)
    assert float(again.info["loss"]) == float(now.info["loss"])


def test_another_checkpoint_is_no_saved_tick(tmp_path):
    save_checkpoint(tmp_path / "a.npz", {"a": jnp.ones(2)})
    with pytest.raises(CheckpointError, match=r"a\.npz: expected what gsjax\.save writes"):
        gsjax.load(tmp_path / "a.npz")
