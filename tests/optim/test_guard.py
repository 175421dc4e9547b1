"""The driver's guard, on descents small enough to follow by hand: it acts where it must, and only there."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsjax.engine.drive import drive
from gsjax.io.checkpoints import load_checkpoint, save_checkpoint
from gsjax.optim.guard import LEAST_WINDOW, new_guard, partial_step, window_of
from gsjax.optim.method import Run
from gsjax.optim.step import Step

SIZE = 4
RAISED = []


@dataclass(frozen=True)
class DescentConfig:
    steps: int = 1000
    seed: int = 0
    noise: float = 0.0  # standard deviation of the losses, relative
    steep_after: int = 10_000  # the step after which the rate is many times as large
    nan_after: int = 10_000  # the step after which parameters are NaN, but not skipped
    sick_after: int = 10_000  # the step after which all steps are skipped, as their losses are not finite
    raises_at: int = -1  # the step whose batch cannot be read, once
    anew_at: int = -1  # the step before which all parameters are replaced
    harder_after: int = 10_000  # the step from which the loss has another term; the guard is reset there


@dataclass(frozen=True)
class Descent:
    """Descent on |x|^2 + 1e-3, with the failures that its configuration asks for."""

    config: DescentConfig = DescentConfig()

    @property
    def step(self) -> Step:
        def update(params, state, batch, *, step, key):
            config = self.config
            rate = jnp.where(step > config.steep_after, 3.5, 0.02)  # beyond 2, it diverges
            params = params - rate * jnp.where(step > config.nan_after, jnp.nan, params)
            loss = jnp.square(params).sum() + 1e-3
            loss += jnp.where(step >= config.harder_after, 5.0, 0.0)
            loss *= 1 + config.noise * jax.random.normal(key)
            sick = step > config.sick_after
            loss, params = jnp.where(sick, jnp.inf, loss), jnp.where(sick, jnp.full(SIZE, 9.0), params)
            info = {"loss": loss, "skipped": sick, "overflow": jnp.asarray(False), "needed": jnp.int32(0)}
            return params, state + 1, info

        return Step(lambda params: jnp.int32(0), update)

    def start(self) -> tuple[None, Run]:
        params = jnp.ones(SIZE)
        return None, Run(params, self.step.init(params))

    def total(self, problem) -> int:
        return self.config.steps

    def period(self, problem) -> int:
        return 1

    def between(self, problem, run: Run, progress: float) -> Run:
        if run.step == self.config.harder_after:
            return run.having(guard=None)
        return run.having(params=3 * jnp.ones(SIZE)) if run.step == self.config.anew_at else run

    def batch(self, problem, run: Run, progress: float):
        if run.step == self.config.raises_at and self.config.raises_at not in RAISED:
            RAISED.append(run.step)
            raise OSError("a picture is gone")
        return None, ()

    def result(self, problem, run: Run) -> np.ndarray:
        return np.asarray(run.params)


def descended(**config):
    method = Descent(DescentConfig(**config))
    ticks = drive(method, *method.start())
    infos = [now.info for now in ticks]
    return ticks, infos


def loss_of(ticks) -> float:
    return float(np.square(ticks.result).sum() + 1e-3)


def test_a_descent_that_goes_well_is_left_alone_to_the_bit():
    ticks, _ = descended(steps=450)
    params, step = jnp.ones(SIZE), jax.jit(lambda params: params + -0.02 * params)
    for _ in range(450):
        params = step(params)
    np.testing.assert_array_equal(ticks.result, params)
    assert ticks.run.guard.returns == 0


@pytest.mark.thorough
def test_what_diverges_goes_back_to_its_best_with_smaller_steps():
    """The steps are beyond the edge of stability; steps half as long are not."""
    ticks, infos = descended(steep_after=430)
    assert max(float(info["loss"]) for info in infos[430:]) > 1  # it had diverged
    assert loss_of(ticks) < 1.001e-3
    assert ticks.run.guard.returns >= 1
    assert float(ticks.run.guard.share) <= 0.5


def test_a_run_ends_with_its_best_not_its_last():
    """It diverges in its last thirty steps, too few for a window. The loop's result and the last tick both
    hold the best parameters."""
    method = Descent(DescentConfig(steps=650, steep_after=620))
    ticks = drive(method, *method.start())
    *_, last = ticks
    assert float(last.info["loss"]) > 1.5e-3
    assert loss_of(ticks) < 1.001e-3
    np.testing.assert_array_equal(last.result, ticks.result)
    assert ticks.run.guard.returns == 0  # it ended, and does not go on with smaller steps


def test_one_that_is_ended_early_is_settled_by_whoever_ends_it():
    method = Descent(DescentConfig(steps=1000, steep_after=620))
    ticks = drive(method, *method.start())
    while next(ticks).step < 650:
        pass
    assert loss_of(ticks) > 1.5e-3
    ticks.settle()
    assert loss_of(ticks) < 1.001e-3
    np.testing.assert_array_equal(ticks.tick.result, ticks.result)
    before = ticks.run
    ticks.settle()
    assert ticks.run is before


@pytest.mark.thorough
def test_what_leaves_the_finite_unsaid_comes_back():
    """With a step that does not check its own results."""
    ticks, infos = descended(nan_after=777, steps=850)
    assert np.isnan(float(infos[-1]["loss"]))
    assert loss_of(ticks) < 1.001e-3


@pytest.mark.thorough
def test_where_no_step_can_be_taken_any_more_it_comes_back():
    """Each is skipped, because the loss of its parameters is not finite."""
    ticks, _ = descended(sick_after=777, steps=950)
    assert loss_of(ticks) < 1.001e-3
    assert ticks.run.guard.returns >= 1


@pytest.mark.parametrize("after", ["steep_after", "nan_after", "sick_after"])
def test_what_diverges_from_its_first_steps_goes_back_to_the_beginning(after):
    """There is no window to return to yet. In a run of 800 steps at 100 times the rates, 690 were skipped."""
    ticks, infos = descended(**{after: 10}, steps=430)
    assert not float(infos[99]["loss"]) < 4
    assert loss_of(ticks) <= SIZE + 1e-3
    assert ticks.run.guard.returns >= 1
    if after == "steep_after":  # steps half as long are not too large
        assert loss_of(ticks) < 1.001e-3


def test_steps_that_are_skipped_at_the_end_of_a_short_run_lose_nothing():
    """79 good steps and 11 skipped ones, before there was a window."""
    first, good = jnp.ones(SIZE), jnp.zeros(SIZE)
    guard = new_guard(first)
    for loss in [*np.linspace(4, 0.01, 79), *[np.nan] * 11]:
        guard, _ = guard.after_step(float(loss), good, LEAST_WINDOW)
    assert guard.at_end(good)[1] is good
    back = guard.at_end(jnp.full(SIZE, jnp.nan))[1]  # unless the parameters themselves are not finite
    np.testing.assert_array_equal(back, first)


def test_what_was_never_finite_is_left_alone():
    ticks, _ = descended(sick_after=-1, steps=230)
    assert ticks.run.guard.returns == 0


def test_steps_do_not_vanish_where_nothing_helps():
    ticks, _ = descended(sick_after=10, steps=430)
    assert float(ticks.run.guard.share) == pytest.approx(1e-3)


def test_after_an_error_in_a_new_stretch_the_old_best_does_not_return():
    """The new parameters may have other shapes."""
    method = Descent(DescentConfig(steps=900, anew_at=500, raises_at=500))
    RAISED.clear()
    ticks = drive(method, *method.start())
    with pytest.raises(OSError, match="a picture is gone"):
        for _ in ticks:
            pass
    ticks.settle()
    np.testing.assert_array_equal(ticks.run.params, 3 * np.ones(SIZE))
    assert ticks.run.guard.best is None
    np.testing.assert_array_equal(ticks.run.guard.beginning.params, 3 * np.ones(SIZE))


def test_thrown_by_the_last_step_of_a_window_it_is_not_thrown_again():
    """A loss is that of the parameters before its step, so no loss of a window is of those after its last."""
    good, bad = jnp.zeros(SIZE), jnp.ones(SIZE)
    guard = new_guard(good)
    now = good
    for step in range(1, 402):
        loss = 2.0 if now is bad else 1.0 / step
        now = bad if step == 300 else now
        guard, back = guard.after_step(loss, now, LEAST_WINDOW)
        now = now if back is now else good
        if step == 320:
            np.testing.assert_array_equal(guard.best.params, good)
    assert guard.returns == 1
    assert now is good


@pytest.mark.thorough
@pytest.mark.parametrize(
    "at", [200, 501, *(pytest.param(at, marks=pytest.mark.slow) for at in (433, 500, 750))]
)
def test_a_run_that_is_resumed_is_the_same_to_the_bit(tmp_path, at):
    whole, _ = descended(steep_after=430)
    method = Descent(DescentConfig(steep_after=430))
    ticks = drive(method, *method.start())
    while next(ticks).step < at:
        pass
    save_checkpoint(tmp_path / "run.npz", ticks.run)
    again = drive(method, None, load_checkpoint(tmp_path / "run.npz")[0])
    for _ in again:
        pass
    np.testing.assert_array_equal(again.result, whole.result)
    assert again.run.guard.returns == whole.run.guard.returns


@pytest.mark.thorough
def test_a_loss_that_becomes_another_begins_anew_and_returns_are_counted_on():
    ticks, infos = descended(harder_after=600)
    assert float(infos[-1]["loss"]) > 5
    assert ticks.run.guard.returns == 0
    again, _ = descended(harder_after=600, steep_after=430)
    assert again.run.guard.returns >= 1


def test_new_parameters_begin_anew():
    """A loss that rises because parameters were replaced has not diverged."""
    ticks, infos = descended(anew_at=500, steps=800)
    assert float(infos[500]["loss"]) > 30
    assert ticks.run.guard.returns == 0
    assert ticks.run.guard.steps == 300


STRETCHES = {
    "a fit of 200 photographs": (1500, 200, 300),
    "of 800 photographs": (7000, 800, 1050),
    "of 30,000 steps": (30_000, 200, 5000),
    "a scene of 12 frames that deforms": (4000, 12, 3000),
    "of 2,000 frames": (4000, 2000, 3000),
    "parts of 40 frames, as they are refined": (2740, 8, 400),
    "of 300 frames": (18_400, 8, 400),
    "distillation": (2000, 27, 1000),
}


@pytest.mark.parametrize("name", STRETCHES)
def test_long_stretches_of_usual_runs_are_guarded(name):
    """For (steps, views, steps of the last stretch): a stretch that ends far above its lowest loss returns to
    its best parameters."""
    total, views, stretch = STRETCHES[name]
    window, good, bad = window_of(total, views), jnp.zeros(SIZE), jnp.ones(SIZE)
    guard = new_guard(good)
    for step in range(stretch):
        late = step > 0.95 * stretch
        guard, _ = guard.after_step(9.0 if late else 1 / (1 + step), bad if late else good, window)
    settled, params = guard.at_end(bad)
    assert settled.is_settled or guard.returns
    np.testing.assert_array_equal(params if settled.is_settled else guard.best.params, good)


@pytest.mark.thorough
@settings(max_examples=10)
@given(seed=st.integers(0, 2**31 - 1), noise=st.sampled_from([0.03, 0.3]))
def test_noise_alone_is_no_loss(seed, noise):
    """Twenty windows without a trend: the lowest of twenty means is below the others by chance alone."""
    losses = 1 + noise * np.random.default_rng(seed).normal(size=20 * LEAST_WINDOW)
    params = jnp.zeros(SIZE)
    guard = new_guard(params)
    for loss in losses:
        guard, _ = guard.after_step(float(loss), params, LEAST_WINDOW)
    assert guard.returns == 0
    assert guard.at_end(params)[0] is guard


@pytest.mark.thorough
@settings(max_examples=8)
@given(seed=st.integers(0, 2**31 - 1), views=st.sampled_from([7, 150, 300, 500]))
def test_one_bad_photograph_is_no_loss(seed, views):
    """In passes over all photographs, one has 35 times the loss of the others, while the others improve."""
    random = np.random.default_rng(seed)
    params, window = jnp.zeros(SIZE), window_of(5000, views)
    guard = new_guard(params)
    for step in range(1, 5001):
        if (step - 1) % views == 0:
            order = random.permutation(views)
        loss = 0.7 if order[(step - 1) % views] == 0 else 0.02 + 0.01 * np.exp(-step / 2000)
        guard, _ = guard.after_step(loss * (1 + 0.02 * random.normal()), params, window)
    assert guard.returns == 0
    assert guard.at_end(params)[0] is guard


def test_half_a_step_is_half_of_each_array_and_integers_pass():
    old = {"a": jnp.zeros(3), "half": jnp.ones(2, jnp.bfloat16), "count": jnp.int32(1)}
    new = {"a": old["a"] + 3, "half": old["half"] + 1, "count": jnp.int32(2)}
    expected = {"a": old["a"] + 1.5, "half": old["half"] + 0.5, "count": new["count"]}
    for share, result in ((0.5, expected), (1.0, new)):
        found = partial_step(new, old, jnp.float32(share))
        jax.tree.map(np.testing.assert_array_equal, found, result)
        assert found["half"].dtype == jnp.bfloat16
