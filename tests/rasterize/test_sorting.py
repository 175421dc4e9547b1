"""The host's sorts and sums equal XLA's: same results, under every transformation and on one core."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsjax.rasterize import host, sorting
from gsjax.rasterize.sorting import argsort_keys, lists, repeat, running_sum

SORTS = ("host", "device")

argsorted = jax.jit(argsort_keys, static_argnames="where")
summed = jax.jit(running_sum, static_argnames="where")
repeated = jax.jit(repeat, static_argnames=("length", "where"))
listed_by = jax.jit(lists, static_argnames=("num_items", "num_lists", "length", "where"))


def test_the_host_sort_is_there():
    # If XLA's interface changes, everything still works, but slower: an upgrade of JAX should reveal it.
    assert sorting._AVAILABLE


@given(st.integers(0, 2**32), st.sampled_from([0, 1, 2, 17, 1000]), st.sampled_from([2, 2**31, 2**32]))
def test_both_ways_sort_as_numpy_does(seed, length, top):
    keys = np.random.default_rng(seed).integers(0, top, length, dtype=np.uint32)
    for where in SORTS:
        order = argsorted(keys, where)
        assert order.dtype == jnp.int32
        np.testing.assert_array_equal(order, np.argsort(keys, kind="stable"))


@pytest.mark.thorough
@given(st.integers(0, 2**32), st.sampled_from([0, 1, 2, 17, 1000]), st.sampled_from([1, 3, 2**32]))
def test_both_ways_sum_and_repeat_as_numpy_does(seed, length, top):
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, min(top, 5), length).astype(np.int32)
    values = rng.integers(0, top, length, dtype=np.uint32)
    ends = np.cumsum(counts, dtype=np.int32)
    want = np.repeat(values, counts)
    for where in SORTS:
        np.testing.assert_array_equal(summed(counts, where), ends)
        for room in (0, 10, 1000, 5000):  # too little and too much
            got = np.asarray(repeated(values, ends - counts, room, where))
            assert got.dtype == np.uint32
            np.testing.assert_array_equal(got[: len(want)], want[:room])


def test_sums_wrap_alike():
    counts = jnp.full(5, 2**30, jnp.int32)
    np.testing.assert_array_equal(running_sum(counts), running_sum(counts, "device"))


def entries(seed, length, num_lists):
    """Entries in random ranges of lists, some of them empty, and as many unused slots after them."""
    rng = np.random.default_rng(seed)
    firsts = rng.integers(0, num_lists, length)
    counts = rng.integers(0, np.minimum(num_lists - firsts, 4) + 1)
    items = np.sort(rng.integers(0, length + 1, length))
    unused = np.zeros(length, int)
    return [np.append(a, unused).astype(np.int32) for a in (items, firsts, counts)]


@given(st.integers(0, 2**32), st.sampled_from([0, 1, 17, 300]), st.sampled_from([0, 2**30]))
def test_both_ways_list_what_a_loop_lists(seed, length, more_items):
    """Also where the indices of an item and a list do not fit into 32 bits together."""
    items, firsts, counts = entries(seed, length, 7)
    which = np.concatenate([np.arange(f, f + c) for f, c in zip(firsts, counts, strict=True)] or [[]])
    want = np.repeat(items, counts)[np.argsort(which, kind="stable")]
    for where in SORTS:
        found = listed_by(items, firsts, counts, length + 1 + more_items, 7, 1500, where)
        listed, edges = map(np.asarray, found)
        assert listed.dtype == edges.dtype == np.int32
        np.testing.assert_array_equal(listed[: len(want)], want)
        assert ((listed >= 0) & (listed <= length)).all()
        np.testing.assert_array_equal(np.diff(edges), np.bincount(which.astype(int), minlength=7))
        assert (edges[0], edges[-1]) == (0, len(want))


def test_vmap_and_loops_sort_every_row():
    rows = jax.random.bits(jax.random.key(0), (3, 4, 50), jnp.uint32) % 20
    want = [[argsorted(row) for row in some] for some in np.asarray(rows)]
    np.testing.assert_array_equal(jax.jit(jax.vmap(jax.vmap(argsort_keys)))(rows), want)
    _, scanned = jax.lax.scan(lambda c, some: (c, jax.vmap(argsort_keys)(some)), None, rows)
    np.testing.assert_array_equal(scanned, want)


def test_vmap_lists_every_row():
    rows = [entries(seed, 30, 9) for seed in range(3)]
    got = jax.jit(jax.vmap(lambda *row: lists(*row, 31, 9, 200)))(*map(np.stack, zip(*rows, strict=True)))
    for i, row in enumerate(rows):
        want = listed_by(*row, 31, 9, 200)
        jax.tree.map(np.testing.assert_array_equal, [np.asarray(a)[i] for a in got], list(want))


def test_vmap_repeats_every_row():
    rng = np.random.default_rng(0)
    values = rng.integers(0, 2**32, (3, 50), dtype=np.uint32)
    starts = np.sort(rng.integers(0, 40, (3, 50), dtype=np.int32), axis=1)
    got = jax.jit(jax.vmap(lambda v, s: repeat(v, s, 40)))(values, starts)
    np.testing.assert_array_equal(got, [repeated(v, s, 40) for v, s in zip(values, starts, strict=True)])
    one_for_all = jax.jit(jax.vmap(lambda s: repeat(jnp.asarray(values[0]), s, 40)))(starts)
    np.testing.assert_array_equal(one_for_all[1], repeated(values[0], starts[1], 40))


@pytest.mark.parametrize("error", [MemoryError("no room"), KeyboardInterrupt("no room")])
def test_a_failure_on_the_host_is_an_error_with_its_message(error):
    """Also Ctrl-C: an exception in a C callback is printed and lost, so the result would be garbage."""

    def fail(keys, out):
        raise error

    name = f"gsjax_{type(error).__name__}"
    assert host.register(name, fail)
    keys = jnp.zeros(3, jnp.uint32)
    with pytest.raises(Exception, match=f"fail on the host failed: {type(error).__name__}: no room"):
        jax.block_until_ready(host.call(name, jax.ShapeDtypeStruct((3,), jnp.uint32), keys))


def test_without_the_interface_xla_sorts(monkeypatch):
    def refuse(*args, **kwargs):
        raise RuntimeError("unknown version")

    monkeypatch.setattr(jax.ffi, "register_ffi_target", refuse)
    with pytest.warns(UserWarning, match="gsjax sorts without numpy.*gsjax_argsort: unknown version"):
        assert not host.register("gsjax_argsort", sorting._argsort_into)
    monkeypatch.setattr(sorting, "_AVAILABLE", False)
    np.testing.assert_array_equal(argsort_keys(jnp.array([3, 1, 2], jnp.uint32)), [1, 2, 0])


@pytest.mark.thorough
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores cannot be chosen on this system")
def test_one_core_does_not_hang():
    # jax.pure_callback would: its only worker waits for a copy that the same worker would have to make.
    program = (
        "import os; os.sched_setaffinity(0, list(os.sched_getaffinity(0))[:1])\n"
        "import jax, jax.numpy as jnp\n"
        "from gsjax.rasterize.sorting import argsort_keys\n"
        "keys = jnp.arange(2_000_000, dtype=jnp.uint32)\n"
        "step = lambda i, k: argsort_keys(k * jnp.uint32(747796405) + 1).astype(jnp.uint32)\n"
        "run = jax.jit(lambda k: jax.lax.fori_loop(0, 3, step, k))\n"
        "jax.block_until_ready([run(keys + i) for i in range(3)])\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)


@pytest.mark.thorough
def test_a_program_may_end_while_a_call_is_under_way():
    # The work on the host needs the interpreter, which is gone by then unless the exit waits for it.
    program = (
        "import jax, jax.numpy as jnp\n"
        "from gsjax.rasterize.sorting import argsort_keys\n"
        "keys = jnp.arange(2_000_000, dtype=jnp.uint32)\n"
        "step = lambda i, k: argsort_keys(k * jnp.uint32(747796405) + 1).astype(jnp.uint32)\n"
        "run = jax.jit(lambda k: jax.lax.fori_loop(0, 20, step, k))\n"
        "run.lower(keys).compile()(keys)\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)


@pytest.mark.thorough
def test_a_checkpoint_may_repeat_the_call():
    def last(x):
        return x * argsort_keys((x * 7919).astype(jnp.uint32) % 101)[-1].astype(x.dtype)

    x = jnp.arange(50.0)
    wanted = jax.grad(lambda x: last(x).sum())(x)
    np.testing.assert_array_equal(jax.jit(jax.grad(jax.checkpoint(lambda x: last(x).sum())))(x), wanted)
