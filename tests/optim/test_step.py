"""Steps descend, skip what is not finite or overflows, and work under scan and vmap."""

import subprocess
import sys
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jaxtyping import Array, Float

from gsjax import host_options
from gsjax.optim.step import all_finite, gradient_step, keep_if, per_field_adam, steady_adam


class Params(eqx.Module):
    a: Float[Array, "n"]
    b: Float[Array, "n"]


def quadratic(params, batch, *, step, key):
    """Squared distance to the target; `poison` multiplies it, `overflow` is passed on."""
    value = jnp.sum((params.a - batch["target"]) ** 2) + jnp.sum(params.b**2)
    return value * batch["poison"], {"overflow": batch["overflow"], "first": params.a[0]}


def batch(**changes):
    plain = {"target": jnp.array([1.0, -2.0]), "poison": jnp.array(1.0), "overflow": jnp.zeros(2, bool)}
    return plain | changes


@pytest.fixture
def params():
    return Params(jnp.array([3.0, 4.0]), jnp.array([-1.0, 2.0]))


def assert_same(new, old):
    jax.tree.map(np.testing.assert_array_equal, new, old)


def test_it_descends_and_names_its_losses(params):
    step = gradient_step(quadratic, optax.sgd(0.1))
    state, values = step.init(params), []
    for i in range(50):
        params, state, info = step.update(params, state, batch(), step=i, key=None)
        values.append(float(info["loss"]))
    assert values[-1] < 1e-6
    assert np.all(np.diff(values) < 0)
    assert set(info) == {"loss", "skipped", "overflow", "needed", "first"}
    assert not info["skipped"]
    np.testing.assert_allclose(params.a, [1.0, -2.0], atol=1e-3)


@pytest.mark.parametrize(
    "bad",
    [
        {"poison": jnp.array(jnp.nan)},
        {"poison": jnp.array(jnp.inf)},
        {"overflow": jnp.array([False, True])},
    ],
    ids=["nan", "inf", "overflow"],
)
def test_an_unsound_step_changes_no_bit_and_says_skipped(params, bad):
    step = gradient_step(quadratic, optax.adam(0.1))
    params, state, _ = step.update(params, step.init(params), batch(), step=0, key=None)
    new, new_state, info = jax.jit(step.update)(params, state, batch(**bad), step=1, key=None)
    assert info["skipped"]
    assert_same(new, params)
    assert_same(new_state, state)


def test_a_gradient_that_is_not_finite_is_refused_though_its_loss_is(params):
    def loss(params, batch, *, step, key):
        return jnp.sum(jnp.sqrt(params.a)), {}  # at 0 its slope is infinite

    step = gradient_step(loss, optax.sgd(0.1))
    zero = Params(jnp.zeros(2), params.b)
    new, _, info = step.update(zero, step.init(zero), None, step=0, key=None)
    assert info["loss"] == 0
    assert info["skipped"]
    assert_same(new, zero)


def test_a_gradient_too_large_to_be_squared_freezes_nothing(params):
    """Its second moment would be infinite and every later update 0, though the gradient itself is finite."""
    step = gradient_step(
        lambda p, batch, *, step, key: (jnp.sum(p.a * batch), {}), per_field_adam({"a": 0.1})
    )
    state, key = step.init(params), jax.random.key(0)
    after, state, info = step.update(params, state, jnp.float32(1e20), step=0, key=key)
    assert bool(info["skipped"])
    assert_same(after, params)
    assert (step.update(after, state, jnp.float32(1), step=1, key=key)[0].a < params.a).all()


def test_after_a_skipped_step_it_goes_on_as_if_nothing_had_been(params):
    step = gradient_step(quadratic, optax.adam(0.1))

    def run(batches):
        now, state = params, step.init(params)
        for i, given in enumerate(batches):
            now, state, _ = step.update(now, state, given, step=i, key=None)
        return now

    bad = batch(poison=jnp.array(jnp.nan))
    assert_same(run([batch(), bad, batch()]), run([batch(), batch()]))


def test_a_scan_of_steps_is_the_loop_and_traces_once(params):
    traces = []

    def counted(params, batch, *, step, key):
        traces.append(1)
        return quadratic(params, batch, step=step, key=key)

    step = gradient_step(counted, optax.adam(0.05))
    update = jax.jit(step.update)
    looped, state = params, step.init(params)
    for i in range(5):
        looped, state, _ = update(looped, state, batch(), step=i, key=None)
    assert len(traces) == 1

    def body(carry, i):
        *carry, info = step.update(*carry, batch(), step=i, key=None)
        return tuple(carry), info

    (scanned, _), infos = jax.lax.scan(body, (params, step.init(params)), jnp.arange(5))
    assert infos["loss"].shape == (5,)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), scanned, looped)


def test_vmap_of_steps_is_the_loop_and_skips_one_alone(params):
    step = gradient_step(quadratic, optax.adam(0.1))
    many = jax.tree.map(lambda a: jnp.stack([a, 2 * a, -a]), params)
    poison = jnp.array([1.0, jnp.nan, 0.5])
    states = jax.vmap(step.init)(many)

    def update(params, state, poison):
        return step.update(params, state, batch(poison=poison), step=0, key=None)

    new, _, info = jax.vmap(update)(many, states, poison)
    np.testing.assert_array_equal(info["skipped"], [False, True, False])
    for i in range(3):
        row = jax.tree.map(lambda a, i=i: a[i], many)
        alone, _, _ = update(row, step.init(row), poison[i])
        jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a[i], b, rtol=1e-6), new, alone)


def test_fields_without_a_rate_stand_still(params):
    step = gradient_step(quadratic, per_field_adam({"a": 0.1}))
    state, start = step.init(params), params
    for i in range(3):
        params, state, info = step.update(params, state, batch(), step=i, key=None)
    assert not info["skipped"]
    np.testing.assert_array_equal(params.b, start.b)
    np.testing.assert_allclose(params.a, start.a - 0.3, atol=2e-2)  # Adam's steps are as long as its rate


def test_each_field_moves_at_its_own_rate_and_the_rest_stays(params):
    first = gradient_step(quadratic, per_field_adam({"a": 0.1, "b": 0.01}))
    new, _, _ = first.update(params, first.init(params), batch(), step=0, key=None)
    np.testing.assert_allclose(jnp.abs(new.a - params.a), 0.1, rtol=1e-4)
    np.testing.assert_allclose(jnp.abs(new.b - params.b), 0.01, rtol=1e-3)
    second = gradient_step(quadratic, per_field_adam({"a": 0.1}))
    new, _, _ = second.update(params, second.init(params), batch(), step=0, key=None)
    np.testing.assert_array_equal(new.b, params.b)


def test_a_rate_for_a_field_that_is_not_there_is_refused(params):
    with pytest.raises(ValueError, match="has no field 'means'"):
        per_field_adam({"means": 0.1}).init(params)


def moved_by(optimizer, gradients):
    """The updates of a parameter for a sequence of gradients, and the optimizer state after them."""

    def body(state, gradient):
        move, state = optimizer.update(gradient, state, jnp.zeros(()))
        return state, move

    state, moves = jax.lax.scan(body, optimizer.init(jnp.zeros(())), gradients)
    return np.asarray(moves), state


@pytest.mark.parametrize("decay", [0.0, 1e-2])
def test_the_steady_adam_is_adam_where_no_gradient_stands_out(decay):
    gradients = jax.random.normal(jax.random.key(0), (500,))
    ours, state = moved_by(steady_adam(1e-2, decay=decay), gradients)
    plain, other = moved_by(optax.adamw(1e-2, eps=1e-15, weight_decay=decay), gradients)
    np.testing.assert_allclose(ours, plain, rtol=1e-5, atol=1e-8)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6), state[0], other[0])


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e9])
def test_one_gradient_moves_a_parameter_by_ten_rates_and_by_31_in_adam(size):
    quiet = 1e-6 * (-1.0) ** jnp.arange(3000)
    gradients = jnp.concatenate([quiet, jnp.array([size]), jnp.zeros(300)])
    after = {of: moved_by(of(1.0, eps=1e-15), gradients)[0][3000:].sum() for of in (steady_adam, optax.adam)}
    assert -after[optax.adam] == pytest.approx(31, rel=0.01)
    assert -after[steady_adam] == pytest.approx(10, rel=0.01)


def test_what_is_seen_in_one_step_of_a_hundred_is_not_limited():
    gradients = jnp.where(jnp.arange(5000) % 97 == 0, 1.0, 0.0)
    ours, plain = (moved_by(of(1.0, eps=1e-15), gradients)[0] for of in (steady_adam, optax.adam))
    np.testing.assert_allclose(ours, plain, rtol=1e-5)


def test_all_finite_looks_into_every_leaf_and_keep_if_chooses_whole_trees():
    sound = {"a": jnp.ones(3), "b": jnp.zeros(())}
    assert all_finite(sound)
    assert not all_finite(sound | {"b": jnp.array(jnp.inf)})
    other = {"a": jnp.full(3, jnp.nan), "b": jnp.ones(())}
    assert_same(keep_if(jnp.array(True), sound, other), sound)
    assert_same(keep_if(jnp.array(False), other, sound), sound)


def test_memory_is_kept_between_calls():
    """In a process of its own, because the thresholds of malloc stay set until it ends."""
    program = (
        "import resource, numpy as np\n"
        "from gsjax import keep_freed_memory\n"
        "faults = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt\n"
        "def a_call():\n"
        "    for _ in range(3): np.ones(2**23)\n"
        "    before = faults()\n"
        "    for _ in range(5): np.ones(2**23)\n"
        "    return (faults() - before) / 5\n"
        "print(a_call(), keep_freed_memory(), a_call())\n"
    )
    out = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout
    before, kept, after = out.split()
    if kept == "False":
        pytest.skip("this C library is no glibc of 2.35 or later")
    assert float(after) < 0.2 * float(before), out


def test_host_options_are_taken_by_an_outermost_jit():
    options = host_options()
    assert isinstance(options, dict)
    assert jax.jit(lambda x: 2 * x, compiler_options=options)(3.0) == 6.0
    assert jax.jit(lambda x: x + 1).lower(1.0).compile(options)(1.0) == 2.0
