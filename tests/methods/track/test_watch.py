"""The record of each group: its usual residual, whether it is lost or glimpsed elsewhere, and whether its
orientation is known."""

import jax.numpy as jnp
import numpy as np

from gsjax.methods.track.lost import Confidence
from gsjax.methods.track.recover import Relocation
from gsjax.methods.track.watch import MIN_LEAD, Estimate, SearchResult, first_watch


def test_a_watch_records_usual_residuals_and_waiting_times():
    watch = first_watch(jnp.ones(2))
    for t in range(60):
        shown = jnp.array([t, 60.0 - t])
        sure = Confidence(jnp.array([0.9, 0.2]), jnp.array([0.8, 0.1]), jnp.array([True, t > 0]))
        result = empty_result([False, True], confirmed=[True, False])
        watch = watch.after(jnp.array([0.4, 0.0]), result, shown, sure, *2 * [shown < 0])
        np.testing.assert_array_equal(watch.lost, [False, t > 0])  # inconclusive: unchanged
    np.testing.assert_allclose(watch.usual, [0.4, 0.02], rtol=1e-2)
    np.testing.assert_allclose(watch.waited, [60, 0])
    np.testing.assert_allclose(watch.largest, [59, 60])
    np.testing.assert_allclose(watch.agrees, [0.9, 0.2])


def test_what_lags_does_not_become_usual():
    """Regression test: the residual of a cereal box that lagged by 6 mm soon became its usual one, so
    that it was not searched for."""
    watch, none, one = first_watch(jnp.ones(1)), jnp.zeros(1), jnp.array([True])
    sure = Confidence(none + 0.9, none + 0.9, one)
    for confirmed, usual in ((False, 0.1), (True, 0.8 * 0.1 + 0.2 * 0.3)):
        after = watch.after(none + 0.3, empty_result([True], confirmed=[confirmed]), none, sure, ~one, ~one)
        np.testing.assert_allclose(after.usual, usual, rtol=1e-5)
    after = watch.after(none + 0.05, empty_result([False]), none, sure, ~one, ~one)
    np.testing.assert_allclose(after.usual, 0.8 * 0.1 + 0.2 * 0.05, rtol=1e-5)


def empty_result(searched, leads=jnp.inf, confirmed=None, elsewhere=False):
    """A search result without motion: which groups were searched for, confirmed and searched for elsewhere,
    and the leads of their orientations."""
    still = jnp.zeros((len(searched), 6))
    estimate, none = Estimate(still, still[:, 0]), still[:, 0]
    sure = Confidence(none, none, none > 0)
    leads = jnp.broadcast_to(jnp.asarray(leads), len(still))
    searched = jnp.array(searched)
    confirmed = jnp.zeros_like(searched) if confirmed is None else jnp.array(confirmed)
    tried = jnp.broadcast_to(jnp.asarray(elsewhere), searched.shape)
    return SearchResult(estimate, searched, confirmed, Relocation(still, sure, sure), tried, leads)


def test_a_group_is_lost_at_once_if_its_agreement_drops_while_its_residual_rises():
    """From one frame to the next; the usual residual is 0.1."""
    none, one = jnp.zeros(1), jnp.array([True])
    for residual, agreement, lost in ((0.25, 0.5, True), (0.15, 0.5, False), (0.25, 0.6, False)):
        watch = first_watch(jnp.ones(1))._replace(agrees=none + 0.9)
        sure = Confidence(none + agreement, none + agreement, one)
        watch = watch.after(none + residual, empty_result([False]), none, sure, ~one, ~one)
        assert bool(watch.lost[0]) == lost, (residual, agreement)


def test_what_agrees_as_usual_and_has_a_known_turn_is_lost_only_when_little_is_left():
    """Regression test: a box whose orientation was off by 149 degrees agreed in 0.36 of its points, and was
    not reported lost."""
    none, one = jnp.zeros(1), jnp.array([True])
    cases = [(0.1, True, 0.3, False), (0.1, True, 0.2, True), (0.1, False, 0.3, True), (0.2, True, 0.3, True)]
    for residual, known, agreement, lost in cases:
        watch = first_watch(jnp.ones(1))._replace(agrees=none + 0.4, turn_known=jnp.array([known]))
        sure = Confidence(none + agreement, none + agreement, one)
        watch = watch.after(none + residual, empty_result([False]), none, sure, ~one, ~one)
        assert bool(watch.lost[0]) == lost, (residual, known, agreement)


def test_what_hardly_looks_found_is_found_after_several_frames_in_a_row():
    none, one = jnp.zeros(1), jnp.array([True])
    watch = first_watch(jnp.ones(1))._replace(lost=one)
    for agreement, lost in ((0.65, True), (0.5, True), *[(0.65, True)] * 3, (0.65, False)):
        sure = Confidence(none + agreement, none + 0.9, one)
        watch = watch.after(none, empty_result([False]), none, sure, ~one, ~one)
        assert bool(watch.lost[0]) == lost


def test_what_was_found_is_on_probation_until_searches_find_nothing_better_and_tell_its_turn():
    none, one = jnp.zeros(1), jnp.array([True])
    lost = first_watch(jnp.ones(1))._replace(lost=one, turn_known=~one)

    def after(watch, agreement=0.9, better=False, **searched):
        sure = Confidence(none + agreement, none + agreement, one)
        better = jnp.array([better])
        return watch.after(none, empty_result([bool(searched)], **searched), none, sure, better, ~one)

    watch = found = after(lost)
    for _ in range(4):
        assert watch.doubtful[0]
        assert not watch.turn_known[0]
        np.testing.assert_array_equal(after(watch).probation, watch.probation)  # no search
        np.testing.assert_array_equal(after(watch, better=True, elsewhere=True).probation, watch.probation)
        watch = after(watch, elsewhere=True)
    assert not watch.doubtful[0]
    assert not watch.turn_known[0]
    told = after(watch, leads=0.2)
    assert told.turn_known[0]
    assert told.probation[0] == 0
    unknown = after(watch, leads=MIN_LEAD - 0.01)
    assert not unknown.turn_known[0]
    assert not after(unknown, leads=0.2).turn_known[0]  # it may have turned in between
    assert after(found, agreement=0.55).lost[0]
    assert not after(told, agreement=0.55).lost[0]


def test_where_nothing_can_be_searched_for_elsewhere_probation_ends_once_the_turn_is_told():
    """Regression test: without depth, probation never ended, and groups that agreed in half of their points
    were lost again and again."""
    none, one = jnp.zeros(1), jnp.array([True])
    sure, watch = Confidence(none + 0.9, none + 0.9, one), first_watch(jnp.ones(1))._replace(lost=one)
    for result in (empty_result([False]), empty_result([True], leads=0.2)):
        watch = watch.after(none, result, none, sure, ~one, ~one, searches=0)
        assert bool(watch.turn_known[0]) == bool(watch.probation[0] == 0) == bool(result.searched[0])


def test_a_lost_group_is_found_only_when_enough_of_it_shows():
    """If the little that is visible beside an occluder agrees, the group may still be lost. Here, half of the
    points that faced a camera were visible at first, and no more need be visible now."""
    watch, none, one = first_watch(jnp.array([0.5])), jnp.zeros(1), jnp.array([True])
    cases = [
        (0.2, 0.2, True),
        (0.9, 0.2, True),  # too little of it shows
        (0.5, 0.4, True),  # what shows hardly agrees
        (0.9, 0.35, False),
        (0.65, 0.35, False),
        (0.3, 0.3, True),
    ]
    for agrees, shows, lost in cases:
        sure = Confidence(jnp.array([agrees]), jnp.array([shows]), one)
        watch = watch.after(none, empty_result([True]), none, sure, ~one, ~one)
        assert bool(watch.lost[0]) == lost, (agrees, shows)


def test_what_is_found_elsewhere_once_is_glimpsed_and_checked_in_the_next_frame():
    """Regression test: a can that came out of a garage was found in one frame, and not searched for in the
    next four."""
    watch, none, one = first_watch(jnp.ones(1)), jnp.zeros(1), jnp.array([True])
    unsure = Confidence(none + 0.4, none + 0.3, one)
    cases = [
        (0.9, one, ~one, True),
        (0.9, one, one, False),  # found twice, so it is moved there
        (0.9, one, ~one, True),
        (0.9, one, ~one, False),  # checked, but no better than in its own place: it is the turn of others
        (0.9, one, ~one, True),
        (0.4, one, ~one, False),  # not there
        (0.9, ~one, ~one, False),  # not searched for, or no better than in its own place
    ]
    for agrees, elsewhere, relocated, glimpsed in cases:
        there = Confidence(none + agrees, none + agrees, one)
        result = empty_result([True])
        result = result._replace(relocation=result.relocation._replace(confidence=there))
        watch = watch.after(none, result, none, unsure, elsewhere, relocated)
        assert bool(watch.glimpsed[0]) == bool(glimpsed)
    certain = Confidence(none + 0.8, none + 0.7, one)  # so not searched for elsewhere in the next frame
    assert not first_watch(jnp.ones(1)).after(none, result, none, certain, one, ~one).glimpsed[0]


def test_an_orientation_stays_unknown_until_its_group_is_lost_and_found():
    watch, none, one = first_watch(jnp.ones(1)), jnp.zeros(1), jnp.array([True])
    cases = [
        (0.8, 0.2, True),  # agreement, lead, whether the orientation is known then
        (0.8, MIN_LEAD - 0.01, False),
        (0.9, 0.2, False),  # it may have turned in between
        (0.2, 0.2, False),  # lost
        (0.9, 0.2, False),  # found, but by chance?
        (0.9, jnp.inf, False),  # not searched for
    ]
    for agrees, lead, known in cases:
        sure = Confidence(jnp.array([agrees]), jnp.array([agrees]), one)
        watch = watch.after(none, empty_result([True], lead), none, sure, ~one, ~one)
        assert bool(watch.turn_known[0]) == known, (agrees, lead)
    sure = Confidence(none + 0.9, none + 0.9, one)  # relocated, though it was not lost
    watch = first_watch(jnp.ones(1)).after(none, empty_result([True]), none, sure, one, one)
    assert not watch.turn_known[0]
    assert watch.probation[0] > 1
