"""Direct alignment finds a known motion of a textured object, and keeps away from what is not there."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsjax.methods.object_tracker.align import (
    _normal_equations,
    _residuals,
    align,
    ball,
    bilinear,
    disagreement,
    spot,
    turned,
)
from gsjax.methods.object_tracker.config import AlignConfig
from gsjax.methods.object_tracker.lost import Confidence
from gsjax.methods.object_tracker.points import (
    Points,
    carry,
    carry_keyframe,
    faded,
    first_keyframe,
    first_members,
    join,
    pixels_of_groups,
    renewed,
    sight_of,
    tones,
)
from gsjax.methods.object_tracker.recover import Elsewhere
from gsjax.methods.object_tracker.search import (
    TELLS_TURN,
    Found,
    Sought,
    first_watch,
    least,
    principal_axes,
    search,
)

CONFIG = AlignConfig(iterations=12)
# Compiled once for calls that differ in values alone.
search = jax.jit(search, static_argnums=(4, 9))
found_by = jax.jit(align, static_argnums=4)
CARTON = 2
SIZE = {"width": 160, "height": 120}


@pytest.fixture(scope="module")
def moved(table):
    """(points of the carton in frame 6, its centre, frame 7, where the points are then)."""
    sequence, frames, _ = table(8, 2, **SIZE)
    labels = np.stack([sequence.mask(6, c) for c in range(2)])
    labels = jnp.asarray(np.where(labels == CARTON, 1, 0), jnp.int32)
    points = pixels_of_groups(see(frames[6]), labels, frames[6].depths, 1, CONFIG)
    k = sequence.truth.names.index("carton")
    motion = sequence.truth.poses[7, k] @ np.linalg.inv(sequence.truth.poses[6, k])
    one = jax.tree.map(lambda a: a[0], points)
    then = np.einsum("ij,cjp->cip", motion[:3, :3], np.asarray(one.means, np.float64)) + motion[:3, 3:]
    return one, middle(one), see(frames[7]), then, labels


def see(frame):
    return sight_of(frame, CONFIG.shading)


def middle(points):
    """The mean of the points that count."""
    return (points.means * (points.seen[:, None] > 0)).sum((0, 2)) / (points.seen > 0).sum()


def run(points, center, sight, config=CONFIG):
    """(the twist found from standing still, where it carries the points)."""
    found = found_by(jnp.zeros(6), points, center, sight, config)
    return found, np.asarray(carry(points, found, center).means)


def look(points, center, sight, config=CONFIG, everywhere=1):
    """The twist that a search of one group finds from standing still."""
    points = jax.tree.map(lambda a: a[None], points)
    how = (config, first_watch(jnp.ones(1)), jnp.array([True]), jnp.int32(everywhere))
    return search(jnp.zeros((1, 1, 6)), points, center[None], sight, *how).found.twists[0]


def gap(points, sight, config=CONFIG):
    """How badly points agree where they are."""
    return float(disagreement(jnp.zeros(6), points, jnp.zeros(3), sight, config))


def error(points, means, then):
    seen = np.asarray(points.seen) > 0
    return np.linalg.norm(means - then, axis=1)[seen].mean()


def without_depth(sight):
    return sight._replace(pixels=sight.tones)


def test_a_known_motion_is_found_and_agrees_better(moved):
    points, center, sight, then, _ = moved
    before = error(points, np.asarray(points.means), then)
    _, means = run(points, center, sight)
    assert error(points, means, then) < min(1.5e-3, before), before
    assert gap(points._replace(means=jnp.asarray(means)), sight) < gap(points, sight)


def test_colour_alone_finds_it_too(moved):
    points, center, sight, then, _ = moved
    _, means = run(points, center, without_depth(sight))
    assert error(points, means, then) < 4e-3


def test_something_in_front_does_not_pull(moved):
    points, center, sight, then, _ = moved
    row, column = np.argwhere(np.asarray(moved[4][0]) == 1).mean(0).astype(int)
    patch = (0, slice(row, row + 6), slice(column - 20, column + 20))
    green = jnp.append(tones(jnp.array([0.1, 0.9, 0.1]), CONFIG.shading), 0.4)
    hidden = sight._replace(pixels=sight.pixels.at[patch].set(green))
    found = look(points, center, hidden)
    assert error(points, np.asarray(carry(points, found, center).means), then) < 2e-3


@pytest.mark.parametrize("depth", [True, False])
def test_a_group_that_nobody_sees_stands_still(moved, depth):
    points, center, sight, _, _ = moved
    unseen = points._replace(seen=jnp.zeros_like(points.seen))
    found, _ = run(unseen, center, sight if depth else without_depth(sight))
    np.testing.assert_allclose(found, 0, atol=1e-6)
    assert gap(unseen, sight) == 0


def test_disagreement_is_nothing_for_a_perfect_fit_and_half_outside_the_picture(moved, table):
    points = moved[0]
    _, frames, _ = table(8, 2, **SIZE)
    assert gap(points, see(frames[6])) < 1e-3
    away = points._replace(means=points.means + jnp.array([0.0, 50.0, 0.0])[:, None])
    np.testing.assert_allclose(gap(away, see(frames[6])), 0.5, atol=1e-6)


def test_only_pixels_of_the_group_are_picked(moved, table):
    points, labels = moved[0], np.asarray(moved[4])
    _, frames, _ = table(8, 2, **SIZE)
    for c in range(2):
        chosen = np.asarray(points.seen[c]) > 0
        assert chosen.sum() == min(CONFIG.pixels, (labels[c] == 1).sum())
        theirs = np.asarray(see(frames[6]).tones[c])[labels[c] == 1]
        found = np.asarray(points.tones[c]).T[chosen]
        assert {tuple(row) for row in found} <= {tuple(row) for row in theirs}
        assert len(np.unique(np.asarray(points.means[c]).T[chosen], axis=0)) == chosen.sum()  # none twice


@given(st.lists(st.integers(-1, 6), min_size=1, max_size=300), st.integers(1, 5), st.integers(1, 40))
def test_the_first_members_of_a_group_are_distinct_members_and_as_many_as_there_are(groups, num, per_group):
    rows, real = map(np.asarray, first_members(jnp.asarray(groups), num, per_group))
    assert rows.shape == real.shape == (num, per_group)
    for group in range(1, num + 1):
        found = rows[group - 1][real[group - 1]]
        assert len(set(found)) == len(found) == min(per_group, groups.count(group))
        assert all(groups[row] == group for row in found)


def test_without_turns_only_translation_is_sought_and_found(moved):
    points, center, sight, _, _ = moved
    config = replace(CONFIG, max_turn=0.0)
    shift = jnp.array([0.006, -0.004, 0.003])
    behind, start = points._replace(means=points.means - shift[:, None]), center - shift
    twist = look(behind, start, sight, config)
    np.testing.assert_array_equal(twist[3:], 0)
    assert gap(carry(behind, twist, start), sight, config) < gap(behind, sight, config)


def test_a_camera_without_depth_gives_pixels_at_the_models_depth(moved, table):
    _, frames, _ = table(8, 2, **SIZE)
    labels = moved[4]
    blind = eqx.tree_at(lambda f: f.depths, frames[6], frames[6].depths.at[1].set(0.0))
    points = pixels_of_groups(see(blind), labels, frames[6].depths, 1, CONFIG)
    np.testing.assert_array_equal(points.seen[0], moved[0].seen)
    np.testing.assert_allclose(points.means[0], moved[0].means)


def test_join_holds_the_points_of_both(moved):
    points = moved[0]
    both = join(points, points._replace(means=points.means + 1))
    count = points.seen.shape[-1]
    assert both.seen.shape == (2, 2 * count)
    np.testing.assert_array_equal(both.means[..., :count] + 1, both.means[..., count:])


def test_a_keyframe_is_carried_and_renewed_where_a_group_has_turned():
    def pixels(value):
        return Points(jnp.full((2, 1, 3, 3), value), jnp.full((2, 1, 3, 3), value), jnp.ones((2, 1, 3)))

    keyframe, centers = first_keyframe(pixels(1.0)), jnp.ones((2, 3))
    twists = jnp.zeros((2, 6)).at[:, 0].set(0.1).at[0, 5].set(0.3)  # the first group turns by 0.3
    for turn, expected in ((0.3, [1.0, 1.0]), (0.6, [2.0, 1.0])):
        keyframe = renewed(carry_keyframe(keyframe, twists, centers), pixels(2.0), 0.5)
        np.testing.assert_allclose(keyframe.points.tones[:, 0, 0, 0], expected, err_msg=str(turn))
        count = faded(keyframe, 0.5).seen[:, 0, 0]
        np.testing.assert_allclose(count, [0.4 if turn == 0.3 else 1.0, 1.0], rtol=1e-5)
    # Not renewed, so carried twice; renewed, so new, and unturned.
    np.testing.assert_allclose(keyframe.points.means[1, 0, :, 0], [1.2, 1.0, 1.0], rtol=1e-6)
    np.testing.assert_allclose(keyframe.points.means[0, 0, :, 0], [2.0, 2.0, 2.0])
    np.testing.assert_allclose(keyframe.turned, [[1, 0, 0, 0], [1, 0, 0, 0]], atol=1e-6)


def test_bilinear_reads_between_pixel_centres_and_knows_its_slope():
    image = jnp.asarray(np.mgrid[0:4, 0:5].transpose(1, 2, 0) + 0.5, jnp.float32)  # (row, column) of centres
    places = jnp.array([[2.3, 1.7], [0.5, 0.5], [4.5, 3.5]])
    read = bilinear(image, spot(*places.T, 5, 4))
    np.testing.assert_allclose(read.values.T, places[:, ::-1], atol=2e-3)
    np.testing.assert_allclose(read.slopes, np.tile([[[0], [1]], [[1], [0]]], 3), atol=1e-6)
    np.testing.assert_allclose(read.nearest.T, [[1.5, 2.5], [0.5, 0.5], [3.5, 4.5]])


def test_tones_forget_the_light_and_keep_the_colour():
    red, white = jnp.array([0.8, 0.2, 0.2]), jnp.array([0.7, 0.7, 0.7])
    gap = lambda a, b, shading: float(jnp.abs(tones(a, shading) - tones(b, shading)).mean())  # noqa: E731
    assert gap(red, 0.7 * red, 0.3) < 0.5 * gap(red, 0.7 * red, 1.0)
    assert gap(red, white, 0.3) > 4 * gap(red, 0.7 * red, 0.3)
    assert np.isfinite(np.asarray(tones(jnp.array([0.0, -1.0, 1e6]), 0.3))).all()


@pytest.mark.parametrize("depth", [True, False])
def test_gradients_of_residuals_are_those_of_finite_differences(moved, depth):
    points, _, sight, _, _ = moved
    sight = sight if depth else without_depth(sight)
    # Off the centres of pixels, where a bilinear image has its kinks.
    one = Points(points.means[..., :20] + 1.3e-3, points.tones[..., :20], points.seen[..., :20])
    found = _residuals(one, sight, CONFIG)
    small = 2e-5
    for axis in range(3):
        step = small * jnp.eye(3)[axis][:, None]
        ahead, behind = (
            _residuals(one._replace(means=one.means + s * step), sight, CONFIG).values for s in (1, -1)
        )
        slope = np.asarray(ahead - behind, np.float64) / (2 * small)
        # A depth edge is a jump: few points sit on one.
        close = np.isclose(slope, found.gradients[:, axis], rtol=0.05, atol=2.0)
        assert close.mean() > 0.9


@pytest.mark.parametrize("depth", [True, False])
def test_normal_equations_are_those_of_differentiation(moved, depth):
    """J^T W J and J^T W r, put together by hand, against the Jacobian that forward mode has."""
    points, center, sight, _, _ = moved
    sight = sight if depth else without_depth(sight)
    fit = _normal_equations(jnp.zeros(6), points, center, sight, CONFIG)

    def values(twist):
        return _residuals(carry(points, twist, center), sight, CONFIG).values

    jacobian, base = jax.jacfwd(values)(jnp.zeros(6)), _residuals(points, sight, CONFIG)
    squared = base.values**2
    squared = squared.at[:, :3].set(squared[:, :3].mean(1, keepdims=True))
    counts = base.counts[:, [0, 0, 0, 1][: squared.shape[1]]]  # the channels of colour share theirs
    weights = points.seen[:, None] * counts / (1 + squared) ** 2
    expected = jnp.einsum("cdpi,cdp,cdpj->ij", jacobian, weights, jacobian)
    np.testing.assert_allclose(fit.hessian, expected, rtol=1e-3, atol=1e-3 * float(jnp.abs(expected).max()))
    expected = jnp.einsum("cdpi,cdp,cdp->i", jacobian, weights, base.values)
    np.testing.assert_allclose(fit.gradient, expected, rtol=1e-3, atol=1e-3 * float(jnp.abs(expected).max()))


def test_many_starts_at_once_are_each_alone(moved):
    points, center, sight, _, _ = moved
    starts = 0.004 * jax.random.normal(jax.random.key(0), (3, 6))
    together = jax.vmap(align, in_axes=(0, None, None, None, None))(starts, points, center, sight, CONFIG)
    alone = jnp.stack([align(start, points, center, sight, CONFIG) for start in starts])
    np.testing.assert_allclose(together, alone, atol=2e-4)


def test_a_ball_holds_the_origin_and_nothing_outside():
    grid = ball(0.045, 0.015)
    assert (np.linalg.norm(grid, axis=1) <= 0.045).all()
    assert (np.abs(grid).sum(1) == 0).sum() == 1
    assert len(grid) == 123


def test_turned_holds_the_start_and_turns_about_its_own_axes():
    twist = jnp.array([0.1, 0.2, 0.3, 0.0, 0.0, 0.4])
    hypotheses = turned(twist, jnp.eye(3), (0.2, 0.6))
    assert hypotheses.shape == (13, 6)
    np.testing.assert_allclose(hypotheses[0], twist, atol=1e-6)
    np.testing.assert_allclose(hypotheses[:, :3], jnp.tile(twist[:3], (13, 1)))
    about_z = [float(h[5]) for h in hypotheses if np.allclose(h[3:5], 0, atol=1e-6)]
    np.testing.assert_allclose(sorted(about_z), [-0.2, 0.2, 0.4, 0.6, 1.0], atol=1e-5)


def test_principal_axes_are_those_of_a_rod():
    along = jnp.array([0.6, 0.8, 0.0])[:, None] * jnp.linspace(-1, 1, 50)
    points = Points(along[None], jnp.zeros((1, 3, 50)), jnp.ones((1, 50)))
    np.testing.assert_allclose(jnp.abs(principal_axes(points, jnp.zeros(3))[2]), [0.6, 0.8, 0.0], atol=1e-4)


def test_the_least_is_taken_of_each_group_and_nothing_that_is_not_finite():
    residuals = jnp.array([[0.3, jnp.nan, 0.5], [0.2, 0.9, 0.5]])
    twists = jnp.arange(36.0).reshape(2, 3, 6)
    found = least(residuals, twists)
    np.testing.assert_allclose(found.residuals, [0.2, 0.9, 0.5])
    np.testing.assert_allclose(found.twists, jnp.stack([twists[1, 0], twists[1, 1], twists[0, 2]]))


@pytest.fixture(scope="module")
def jumped(moved, table):
    """(points of the carton before it was carried 40 mm, their middle, what is seen then, that shift)."""
    points = moved[0]
    shift = jnp.array([0.03, -0.025, 0.01])
    behind = points._replace(means=points.means - shift[:, None])
    return behind, middle(behind), see(table(8, 2, **SIZE)[1][6]), shift


def test_search_finds_a_jump_that_alignment_alone_misses(jumped):
    """Nothing overlaps where it starts, and nobody tells how far it went."""
    *given, shift = jumped
    brief = replace(CONFIG, iterations=3)
    miss = [float(jnp.linalg.norm(look(*given, brief, n)[:3] - shift)) for n in (0, 1)]
    assert miss[0] > 5e-3
    assert miss[1] < 1e-3


def test_search_finds_what_is_pushed_while_it_turns(moved):
    """It goes on turning as before, but 36 mm further than expected: only a shift from there finds it."""
    points, center, sight, then, _ = moved
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
        return search(starts, group, (middle_then - true[:3])[None], sight, *how).found.twists[0]

    assert jnp.linalg.norm(searched(0)[:3] - true[:3]) > 0.01
    np.testing.assert_allclose(searched(1)[:3], true[:3], atol=2e-3)
    np.testing.assert_allclose(searched(1)[3:], true[3:], atol=0.02)


def test_what_may_be_elsewhere_is_followed_first_when_it_jumps(jumped):
    """It may be where it was believed to be. What is lost is not, and what agrees as ever has not jumped."""
    *given, shift = jumped
    points, centers = jax.tree.map(lambda a: a[None], given[:2])
    sure, yes = Confidence(jnp.float32(1), jnp.float32(1), jnp.array(True)), jnp.array([True])

    def searched(**changes) -> Sought:
        watch = first_watch(jnp.ones(1))._replace(**changes)
        how = (replace(CONFIG, iterations=3), watch, yes, jnp.int32(1), yes)
        nowhere = Elsewhere(jnp.ones(6), sure, sure)
        return search(jnp.zeros((1, 1, 6)), points, centers, given[2], *how, lambda _: nowhere)

    followed = searched(usual=jnp.array([0.05]))
    np.testing.assert_allclose(followed.found.twists[0, :3], shift, atol=1e-3)
    assert not followed.recovered[0]
    for changes in ({"usual": jnp.array([0.9])}, {"usual": jnp.array([0.05]), "lost": yes}):
        elsewhere = searched(**changes)
        np.testing.assert_allclose(elsewhere.again.twists[0], 1.0)
        assert elsewhere.recovered[0]


def test_those_are_looked_for_first_that_agree_worst_or_have_waited_longest(jumped):
    """Three groups that jumped alike: only as many are found as may be looked for, the most urgent ones."""
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
        sought = search(jnp.zeros((1, 3, 6)), points, centers, given[2], *one)
        np.testing.assert_array_equal(np.flatnonzero(sought.looked_for), expected)
        np.testing.assert_array_equal(np.flatnonzero(jnp.isfinite(sought.leads)), expected)
        right = jnp.linalg.norm(sought.found.twists[:, :3] - shift, axis=1) < 1e-3
        np.testing.assert_array_equal(np.flatnonzero(right), expected)


@pytest.mark.parametrize("printed", [True, False])
def test_other_turns_agree_as_well_only_with_what_has_no_print(table, printed):
    """A can that stands still: its print tells how it is turned, and without it nothing does."""
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
    sought = search(jnp.zeros((1, 1, 6)), points, center[None], seen, *how)
    assert (float(sought.leads[0]) > TELLS_TURN) == printed
    assert float(jnp.linalg.norm(sought.found.twists[0, :3])) < 1e-3


def test_a_watch_knows_what_is_usual_and_who_waits():
    watch = first_watch(jnp.ones(2))
    for t in range(60):
        shown = jnp.array([t, 60.0 - t])
        sure = Confidence(jnp.array([0.9, 0.2]), jnp.array([0.8, 0.1]), jnp.array([True, t > 0]))
        watch = watch.after(jnp.array([0.4, 0.0]), nothing_of([False, True]), shown, sure, *2 * [shown < 0])
        np.testing.assert_array_equal(watch.lost, [False, t > 0])  # where nothing tells, all is as before
    np.testing.assert_allclose(watch.usual, [0.4, 0.02], rtol=1e-2)
    np.testing.assert_allclose(watch.waited, [60, 0])
    np.testing.assert_allclose(watch.largest, [59, 60])
    np.testing.assert_allclose(watch.agrees, [0.9, 0.2])


def nothing_of(looked_for, leads=jnp.inf):
    """A search that says just which groups were looked for, and what their turns agree better by."""
    still = jnp.zeros((len(looked_for), 6))
    found, none = Found(still, still[:, 0]), still[:, 0]
    sure = Confidence(none, none, none > 0)
    leads = jnp.broadcast_to(jnp.asarray(leads), len(still))
    return Sought(found, jnp.array(looked_for), Elsewhere(still, sure, sure), none > 0, leads)


def test_what_is_lost_is_found_only_when_it_shows_itself():
    """Hidden by something nearer it may agree in the little that is seen, and is still lost. Half of what
    faced a camera was seen at first, and more need not show now."""
    watch, none, one = first_watch(jnp.array([0.5])), jnp.zeros(1), jnp.array([True])
    told = [
        (0.2, 0.2, True),
        (0.9, 0.2, True),  # too little of it shows
        (0.5, 0.4, True),  # what shows is hardly it
        (0.9, 0.35, False),
        (0.4, 0.1, False),
        (0.3, 0.3, True),
    ]
    for agrees, shows, lost in told:
        sure = Confidence(jnp.array([agrees]), jnp.array([shows]), one)
        watch = watch.after(none, nothing_of([True]), none, sure, ~one, ~one)
        assert bool(watch.lost[0]) == lost, (agrees, shows)


def test_what_is_found_elsewhere_once_is_glimpsed_and_checked_in_the_next_frame():
    """A can that came out of a garage was found in one frame, and not looked for in the next four."""
    watch, none, one = first_watch(jnp.ones(1)), jnp.zeros(1), jnp.array([True])
    unsure = Confidence(none + 0.4, none + 0.3, one)
    told = [
        (0.9, one, ~one, True),
        (0.9, one, one, False),  # found twice, and so moved there
        (0.9, one, ~one, True),
        (0.9, one, ~one, False),  # checked, but no better than where it is believed to be: others may look
        (0.9, one, ~one, True),
        (0.4, one, ~one, False),  # not there
        (0.9, ~one, ~one, False),  # not looked for, or no better than in its place
    ]
    for agrees, elsewhere, retaken, glimpsed in told:
        there = Confidence(none + agrees, none + agrees, one)
        sought = nothing_of([True])
        sought = sought._replace(again=sought.again._replace(sure=there))
        watch = watch.after(none, sought, none, unsure, elsewhere, retaken)
        assert bool(watch.glimpsed[0]) == bool(glimpsed)
    certain = Confidence(none + 0.8, none + 0.7, one)  # and so not looked for elsewhere in the next frame
    assert not watch.after(none, sought, none, certain, one, ~one).glimpsed[0]


def test_a_turn_stays_unknown_until_its_group_is_found_as_it_was_at_first():
    watch, none, one = first_watch(jnp.ones(1)), jnp.zeros(1), jnp.array([True])
    told = [
        (0.8, 0.2, True),  # agrees, lead of its turn, whether its turn is known then
        (0.8, TELLS_TURN - 0.01, False),
        (0.9, 0.2, False),  # it may have been turned in between
        (0.2, 0.2, False),  # lost
        (0.62, 0.2, False),  # found, but hardly as it was
        (0.2, 0.2, False),
        (0.9, 0.2, True),
        (0.9, jnp.inf, True),  # not looked for
    ]
    for agrees, lead, known in told:
        sure = Confidence(jnp.array([agrees]), jnp.array([agrees]), one)
        watch = watch.after(none, nothing_of([True], lead), none, sure, ~one, ~one)
        assert bool(watch.turn_known[0]) == known, (agrees, lead)
    for agrees, known in ((0.9, True), (0.62, False)):  # moved to where it was found, though it was not lost
        sure = Confidence(jnp.array([agrees]), jnp.array([agrees]), one)
        watch = watch.after(none, nothing_of([True]), none, sure, one, one)
        assert bool(watch.turn_known[0]) == known, agrees
