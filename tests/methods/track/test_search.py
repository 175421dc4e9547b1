"""Groups that jump are found by a search in all directions, the most urgent ones first."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsjax.methods.track.align import principal_axes
from gsjax.methods.track.lost import Confidence
from gsjax.methods.track.points import Points, carry, pixels_of_groups, tones
from gsjax.methods.track.recover import Relocation
from gsjax.methods.track.search import best_of, follow
from gsjax.methods.track.search import search as search_from
from gsjax.methods.track.watch import MIN_LEAD, SearchResult, first_watch
from tests.methods.track.carton import CONFIG, SIZE, error, gap, middle, see


# Compiled once for calls that differ in values alone.
@partial(jax.jit, static_argnums=(4, 9))
def search(starts, points, centers, images, config, watch, visible, everywhere, *elsewhere) -> SearchResult:
    """The result of following the groups and then searching for them."""
    given = (starts, points, centers, images, config, watch, visible, everywhere)
    return search_from(follow(*given), *given, *elsewhere)


carried = jax.jit(carry)
BRIEF = replace(CONFIG, iterations=3)


def of_several(points, center, count=3):
    """(points, centres) of several identical groups."""
    return jax.tree.map(lambda a: np.stack([a] * count), (points, center))


def search_one(points, center, images, config=BRIEF, everywhere=1) -> SearchResult:
    """A search for one group from a start at rest, beside two that no camera sees."""
    how = (config, first_watch(jnp.ones(3)), np.array([True, False, False]), np.int32(everywhere))
    return search(np.zeros((1, 3, 6), np.float32), *of_several(points, center), images, *how)


def look(*given):
    """The twist that a search for one group finds from a start at rest."""
    return np.asarray(search_one(*given).estimate.twists)[0]


@pytest.fixture(scope="module")
def jumped(moved, table):
    """(points of the carton before a shift by 40 mm, their middle, images after it, the shift)."""
    points = jax.device_get(moved[0])
    shift = np.float32([0.03, -0.025, 0.01])
    behind = points._replace(means=points.means - shift[:, None])
    return behind, middle(behind).astype(np.float32), see(table(8, 2, **SIZE)[1][6]), shift


@pytest.mark.thorough
def test_search_finds_a_jump_that_alignment_alone_misses(jumped):
    """There is no overlap at the start, and no prior on the shift."""
    *given, shift = jumped
    miss = [np.linalg.norm(look(*given, BRIEF, n)[:3] - shift) for n in (0, 1)]
    assert miss[0] > 5e-3
    assert miss[1] < 1e-3


@pytest.mark.slow
def test_search_finds_what_is_pushed_while_it_turns(moved):
    """It keeps rotating as before, but is 36 mm off its prediction: only shifts from there find it."""
    (points, center), images, then = jax.device_get(moved[:2]), *moved[2:4]
    middle_then = np.float32(center + (then - points.means).mean((0, 2)))
    expected = np.float32([0.02, 0.02, 0.02, 0.0, 0.0, 0.6])
    push = np.float32([0.03, -0.02, 0.0])
    true = expected + np.append(push, np.zeros(3, np.float32))
    turn = Rotation.from_rotvec(true[3:]).as_matrix()
    away = np.moveaxis(then, 1, -1) - middle_then
    before = points._replace(means=np.float32(np.moveaxis(away @ turn + middle_then - true[:3], -1, 1)))
    brief = replace(BRIEF, turns=())

    def twist(everywhere: int) -> np.ndarray:
        group = jax.tree.map(lambda a: a[None], before)
        starts = np.stack([0 * expected, expected])[:, None]
        how = (brief, first_watch(jnp.ones(1)), np.array([True]), np.int32(everywhere))
        found = search(starts, group, (middle_then - true[:3])[None], images, *how)
        return np.asarray(found.estimate.twists)[0]

    assert np.linalg.norm(twist(0)[:3] - true[:3]) > 0.01
    found = twist(1)
    np.testing.assert_allclose(found[:3], true[:3], atol=2e-3)
    np.testing.assert_allclose(found[3:], true[3:], atol=0.02)


@pytest.mark.thorough
def test_something_in_front_does_not_pull(moved):
    points, center, images, then, _ = moved
    row, column = np.argwhere(np.asarray(moved[4][0]) == 1).mean(0).astype(int)
    patch = (0, slice(row, row + 6), slice(column - 20, column + 20))
    pixels = np.array(images.pixels)
    pixels[patch] = np.append(tones(jnp.array([0.1, 0.9, 0.1]), CONFIG.shading), 0.4)
    found = look(points, center, images._replace(pixels=pixels))
    assert error(points, np.asarray(carried(points, found, center).means), then) < 2e-3


@pytest.mark.slow
def test_without_turns_only_translations_are_tried_and_found(moved):
    (points, center), images = jax.device_get(moved[:2]), moved[2]
    config = replace(CONFIG, max_turn=0.0)
    shift = np.float32([0.006, -0.004, 0.003])
    behind, start = points._replace(means=points.means - shift[:, None]), center - shift
    result = search_one(behind, start, images, config)
    twist = np.asarray(result.estimate.twists)[0]
    np.testing.assert_array_equal(twist[3:], 0)
    assert result.leads[0] == 1  # no other orientation is tried, so this one is known
    after = carried(behind, twist, start)
    behind = jax.tree.map(jnp.asarray, behind)
    assert gap(after, images, config) < gap(behind, images, config)


@pytest.fixture(scope="module")
def suspected(jumped):
    """suspected(**changes of the watch) -> the result of a search for a suspect group that jumped."""
    *given, _ = jumped
    points, centers = jax.tree.map(lambda a: a[None], given[:2])
    sure, yes = Confidence(jnp.float32(1), jnp.float32(1), jnp.array(True)), jnp.array([True])

    def relocate(group):
        return Relocation(jnp.ones(6), sure, sure)

    def searched(**changes) -> SearchResult:
        watch = first_watch(jnp.ones(1))._replace(**changes)
        how = (replace(CONFIG, iterations=3), watch, yes, jnp.int32(1), yes)
        return search(jnp.zeros((1, 1, 6)), points, centers, given[2], *how, relocate)

    return searched


@pytest.mark.slow
def test_a_suspect_that_jumps_is_followed_before_it_is_relocated(suspected, jumped):
    """Its pose before the jump may have been right. That of a lost group was not, and a group that agrees as
    usual has not jumped."""
    followed = suspected(usual=jnp.array([0.05]))
    np.testing.assert_allclose(followed.estimate.twists[0, :3], jumped[-1], atol=1e-3)
    assert not followed.relocation_tried[0]
    for changes in ({"usual": jnp.array([0.9])}, {"usual": jnp.array([0.05]), "lost": jnp.array([True])}):
        elsewhere = suspected(**changes)
        np.testing.assert_allclose(elsewhere.relocation.twists[0], 1.0)
        assert elsewhere.relocation_tried[0]


@pytest.mark.thorough
def test_what_shifts_and_turns_miss_is_relocated_in_the_same_frame(jumped):
    """The group was knocked out of reach of the shifts."""
    *given, _ = jumped
    far = given[0]._replace(means=given[0].means + np.float32([0.15, 0.0, 0.0])[:, None])
    points, centers = jax.tree.map(lambda a: a[None], (far, middle(far).astype(np.float32)))
    sure, yes = Confidence(jnp.float32(1), jnp.float32(1), jnp.array(True)), jnp.array([True])
    watch = first_watch(jnp.ones(1))._replace(usual=jnp.array([0.05]))
    given = (jnp.zeros((1, 1, 6)), points, centers, given[2], BRIEF, watch, yes)
    followed = jax.jit(follow, static_argnums=4)(*given, jnp.int32(1))
    assert followed.shifted[0]
    assert followed.missed[0]
    result = search(*given, jnp.int32(1), followed.missed, lambda _: Relocation(jnp.ones(6), sure, sure))
    assert result.searched[0]
    assert result.relocation_tried[0]
    assert not jax.jit(follow, static_argnums=4)(*given, jnp.int32(0)).shifted[0]


@pytest.mark.slow
def test_one_group_is_relocated_in_the_time_in_which_two_are_turned(jumped):
    """A relocation takes the time of two searches, but is done even if there is time for one alone."""
    *given, _ = jumped
    sure = Confidence(jnp.float32(1), jnp.float32(1), jnp.array(True))
    watch = first_watch(jnp.ones(3))._replace(waited=np.float32([3.0, 2.0, 1.0]))
    visible = np.array([True] * 3)

    def tried(everywhere, suspects):
        how = (BRIEF, watch, visible, np.int32(everywhere), np.array(suspects))
        start = (np.zeros((1, 3, 6), np.float32), *of_several(*given[:2]), given[2])
        result = search(*start, *how, nowhere)
        return result.searched.tolist(), result.relocation_tried.tolist()

    def nowhere(group):
        return Relocation(jnp.ones(6), sure, sure)

    watch = watch._replace(lost=np.array([True, False, False]))
    first, two = [True, False, False], [True, True, False]
    assert tried(1, first) == (first, first)
    assert tried(2, first) == (first, first)
    assert tried(3, first) == (two, first)


@pytest.mark.thorough
def test_groups_that_agree_worst_or_have_waited_longest_are_searched_for_first(jumped):
    """Of four identical groups that jumped, shifts find three. The fourth is searched for first, unless
    another was glimpsed elsewhere or has waited for long."""
    *given, shift = jumped
    visible, first = np.array([True] * 4), first_watch(jnp.ones(4))
    unusual = first._replace(usual=np.float32([0.3, 0.1, 0.3, 0.3]))
    watches = [
        (unusual, visible, [3]),
        (first._replace(waited=np.float32([300.0, 5.0, 0.0, 0.0])), visible, [0]),
        (unusual, np.array([True, False, False, False]), [0]),
        (unusual._replace(glimpsed=np.array([False, True, False, False])), visible, [1]),
    ]
    for watch, there, expected in watches:
        one = (BRIEF, watch, there, np.int32(1))
        result = search(np.zeros((1, 4, 6), np.float32), *of_several(*given[:2], 4), given[2], *one)
        np.testing.assert_array_equal(np.flatnonzero(result.searched), expected)
        np.testing.assert_array_equal(np.flatnonzero(np.isfinite(result.leads)), expected)
        right = np.linalg.norm(np.asarray(result.estimate.twists)[:, :3] - shift, axis=1) < 1e-3
        np.testing.assert_array_equal(right, there & [True, True, True, False])


@pytest.mark.parametrize("printed", [True, False])
def test_only_without_a_print_do_other_orientations_agree_as_well(table, printed):
    """A can at rest: its print determines its orientation, and nothing else does."""
    sequence, (frame, *_), _ = table(8, 2, **SIZE)
    can = sequence.truth.label_ids[sequence.truth.names.index("can")]
    mine = np.stack([sequence.mask(0, c) == can for c in range(2)])
    if not printed:
        images = np.asarray(frame.images)
        plain = np.where(mine[..., None], images[mine].mean(0), images)
        frame = replace(frame, images=jnp.asarray(plain))
    seen = see(frame)
    picked = jax.jit(pixels_of_groups, static_argnums=(3, 4))
    points = picked(seen, mine.astype(np.int32), frame.depths, 1, CONFIG)
    points = jax.tree.map(lambda a: np.asarray(a)[0], points)
    result = search_one(points, middle(points).astype(np.float32), seen)
    assert (float(result.leads[0]) > MIN_LEAD) == printed
    assert np.linalg.norm(np.asarray(result.estimate.twists)[0, :3]) < 1e-3


def test_principal_axes_are_those_of_a_rod():
    along = np.float32([0.6, 0.8, 0.0])[:, None] * np.linspace(-1, 1, 50, dtype=np.float32)
    points = Points(along[None], 0 * along[None], np.ones((1, 50), np.float32))
    axes = np.asarray(jax.jit(principal_axes)(points, np.zeros(3, np.float32)))
    np.testing.assert_allclose(np.abs(axes[2]), [0.6, 0.8, 0.0], atol=1e-4)


def test_the_best_finite_hypothesis_of_each_group_is_taken():
    residuals = np.float32([[0.3, np.nan, 0.5], [0.2, 0.9, 0.5]])
    twists = np.arange(36, dtype=np.float32).reshape(2, 3, 6)
    found = jax.jit(best_of)(residuals, twists)
    np.testing.assert_allclose(found.residuals, [0.2, 0.9, 0.5])
    np.testing.assert_allclose(found.twists, np.stack([twists[1, 0], twists[1, 1], twists[0, 2]]))
