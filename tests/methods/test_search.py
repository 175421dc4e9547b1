"""Groups that jump are found by a search everywhere, the most urgent ones first."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from gsjax.methods.track.lost import Confidence
from gsjax.methods.track.points import Points, carry, pixels_of_groups, tones
from gsjax.methods.track.recover import Relocation
from gsjax.methods.track.search import (
    TURN_KNOWN,
    SearchResult,
    best_of,
    first_watch,
    principal_axes,
    search,
)
from tests.methods.carton import CONFIG, SIZE, error, gap, middle, see

# Compiled once for calls that differ in values alone.
search = jax.jit(search, static_argnums=(4, 9))


def look(points, center, images, config=CONFIG, everywhere=1):
    """The twist that a search of one group finds from standing still."""
    points = jax.tree.map(lambda a: a[None], points)
    how = (config, first_watch(jnp.ones(1)), jnp.array([True]), jnp.int32(everywhere))
    return search(jnp.zeros((1, 1, 6)), points, center[None], images, *how).estimate.twists[0]


@pytest.fixture(scope="module")
def jumped(moved, table):
    """(points of the carton before it was carried 40 mm, their middle, what is seen then, that shift)."""
    points = moved[0]
    shift = jnp.array([0.03, -0.025, 0.01])
    behind = points._replace(means=points.means - shift[:, None])
    return behind, middle(behind), see(table(8, 2, **SIZE)[1][6]), shift


def test_search_finds_a_jump_that_alignment_alone_misses(jumped):
    """There is no overlap at the start, and no hint how far it went."""
    *given, shift = jumped
    brief = replace(CONFIG, iterations=3)
    miss = [float(jnp.linalg.norm(look(*given, brief, n)[:3] - shift)) for n in (0, 1)]
    assert miss[0] > 5e-3
    assert miss[1] < 1e-3


def test_search_finds_what_is_pushed_while_it_turns(moved):
    """It keeps turning as before, but 36 mm further than expected: only a shift from there finds it."""
    points, center, images, then, _ = moved
    points = points._replace(means=jnp.asarray(then, jnp.float32))
    middle_then = center + (points.means - moved[0].means).mean((0, 2))
    expected = jnp.array([0.02, 0.02, 0.02, 0.0, 0.0, 0.6])
    push = jnp.array([0.03, -0.02, 0.0])
    true = expected.at[:3].add(push)
    turn = jaxlie.SO3.exp(true[3:])
    away = jnp.moveaxis(points.means, 1, -1) - middle_then
    before = points._replace(means=jnp.moveaxis(turn.inverse().apply(away) + middle_then - true[:3], -1, 1))
    brief = replace(CONFIG, iterations=3, turns=())

    def searched(everywhere: int) -> jax.Array:
        group = jax.tree.map(lambda a: a[None], before)
        starts = jnp.stack([jnp.zeros(6), expected])[:, None]
        how = (brief, first_watch(jnp.ones(1)), jnp.array([True]), jnp.int32(everywhere))
        return search(starts, group, (middle_then - true[:3])[None], images, *how).estimate.twists[0]

    assert jnp.linalg.norm(searched(0)[:3] - true[:3]) > 0.01
    np.testing.assert_allclose(searched(1)[:3], true[:3], atol=2e-3)
    np.testing.assert_allclose(searched(1)[3:], true[3:], atol=0.02)


def test_something_in_front_does_not_pull(moved):
    points, center, images, then, _ = moved
    row, column = np.argwhere(np.asarray(moved[4][0]) == 1).mean(0).astype(int)
    patch = (0, slice(row, row + 6), slice(column - 20, column + 20))
    green = jnp.append(tones(jnp.array([0.1, 0.9, 0.1]), CONFIG.shading), 0.4)
    hidden = images._replace(pixels=images.pixels.at[patch].set(green))
    found = look(points, center, hidden)
    assert error(points, np.asarray(carry(points, found, center).means), then) < 2e-3


def test_without_turns_only_translations_are_tried_and_found(moved):
    points, center, images, _, _ = moved
    config = replace(CONFIG, max_turn=0.0)
    shift = jnp.array([0.006, -0.004, 0.003])
    behind, start = points._replace(means=points.means - shift[:, None]), center - shift
    twist = look(behind, start, images, config)
    np.testing.assert_array_equal(twist[3:], 0)
    assert gap(carry(behind, twist, start), images, config) < gap(behind, images, config)


@pytest.mark.slow
def test_a_suspect_that_jumps_is_followed_before_it_is_relocated(jumped):
    """It may have been where it was believed to be. A lost one was not, and one that agrees as usual has not
    jumped."""
    *given, shift = jumped
    points, centers = jax.tree.map(lambda a: a[None], given[:2])
    sure, yes = Confidence(jnp.float32(1), jnp.float32(1), jnp.array(True)), jnp.array([True])

    def searched(**changes) -> SearchResult:
        watch = first_watch(jnp.ones(1))._replace(**changes)
        how = (replace(CONFIG, iterations=3), watch, yes, jnp.int32(1), yes)
        nowhere = Relocation(jnp.ones(6), sure, sure)
        return search(jnp.zeros((1, 1, 6)), points, centers, given[2], *how, lambda _: nowhere)

    followed = searched(usual=jnp.array([0.05]))
    np.testing.assert_allclose(followed.estimate.twists[0, :3], shift, atol=1e-3)
    assert not followed.relocation_tried[0]
    for changes in ({"usual": jnp.array([0.9])}, {"usual": jnp.array([0.05]), "lost": yes}):
        elsewhere = searched(**changes)
        np.testing.assert_allclose(elsewhere.relocation.twists[0], 1.0)
        assert elsewhere.relocation_tried[0]


def test_groups_that_agree_worst_or_have_waited_longest_are_searched_for_first(jumped):
    """Of three groups that jumped alike, only as many are found as may be searched for, by urgency."""
    *given, shift = jumped
    points, centers = jax.tree.map(lambda a: jnp.stack([a] * 3), given[:2])
    visible, first = jnp.array([True, True, True]), first_watch(jnp.ones(3))
    watches = [
        (first._replace(usual=jnp.array([0.3, 0.1, 0.3])), visible, [1]),
        (first._replace(waited=jnp.array([0.0, 5.0, 100.0])), visible, [2]),
        (first._replace(usual=jnp.array([0.3, 0.1, 0.3])), ~visible.at[0].set(False), [0]),
        (
            first._replace(usual=jnp.array([0.3, 0.1, 0.3]), glimpsed=jnp.array([False, False, True])),
            visible,
            [2],
        ),
    ]
    for watch, there, expected in watches:
        one = (replace(CONFIG, iterations=3), watch, there, jnp.int32(1))
        result = search(jnp.zeros((1, 3, 6)), points, centers, given[2], *one)
        np.testing.assert_array_equal(np.flatnonzero(result.searched), expected)
        np.testing.assert_array_equal(np.flatnonzero(jnp.isfinite(result.leads)), expected)
        right = jnp.linalg.norm(result.estimate.twists[:, :3] - shift, axis=1) < 1e-3
        np.testing.assert_array_equal(np.flatnonzero(right), expected)


@pytest.mark.parametrize("printed", [True, False])
def test_only_without_a_print_do_other_orientations_agree_as_well(table, printed):
    """A can at rest: its print determines its orientation, and nothing else does."""
    sequence, (frame, *_), _ = table(8, 2, **SIZE)
    can = sequence.truth.label_ids[sequence.truth.names.index("can")]
    mine = jnp.stack([sequence.mask(0, c) == can for c in range(2)])
    if not printed:
        plain = jnp.where(mine[..., None], frame.images[mine].mean(0), frame.images)
        frame = replace(frame, images=plain)
    seen = see(frame)
    points = pixels_of_groups(seen, mine.astype(jnp.int32), frame.depths, 1, CONFIG)
    center = middle(jax.tree.map(lambda a: a[0], points))
    how = (CONFIG, first_watch(jnp.ones(1)), jnp.array([True]), jnp.int32(1))
    result = search(jnp.zeros((1, 1, 6)), points, center[None], seen, *how)
    assert (float(result.leads[0]) > TURN_KNOWN) == printed
    assert float(jnp.linalg.norm(result.estimate.twists[0, :3])) < 1e-3


def test_principal_axes_are_those_of_a_rod():
    along = jnp.array([0.6, 0.8, 0.0])[:, None] * jnp.linspace(-1, 1, 50)
    points = Points(along[None], jnp.zeros((1, 3, 50)), jnp.ones((1, 50)))
    np.testing.assert_allclose(jnp.abs(principal_axes(points, jnp.zeros(3))[2]), [0.6, 0.8, 0.0], atol=1e-4)


def test_the_best_finite_hypothesis_of_each_group_is_taken():
    residuals = jnp.array([[0.3, jnp.nan, 0.5], [0.2, 0.9, 0.5]])
    twists = jnp.arange(36.0).reshape(2, 3, 6)
    found = best_of(residuals, twists)
    np.testing.assert_allclose(found.residuals, [0.2, 0.9, 0.5])
    np.testing.assert_allclose(found.twists, jnp.stack([twists[1, 0], twists[1, 1], twists[0, 2]]))
