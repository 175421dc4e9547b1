"""The record of each group: its usual residual, and whether it is lost, glimpsed elsewhere, or turned."""

import jax.numpy as jnp
import numpy as np

from gsjax.methods.track.lost import Confidence
from gsjax.methods.track.recover import Relocation
from gsjax.methods.track.search import TURN_KNOWN, Estimate, SearchResult, first_watch


def test_a_watch_records_usual_residuals_and_waiting_times():
    watch = first_watch(jnp.ones(2))
    for t in range(60):
        shown = jnp.array([t, 60.0 - t])
        sure = Confidence(jnp.array([0.9, 0.2]), jnp.array([0.8, 0.1]), jnp.array([True, t > 0]))
        watch = watch.after(jnp.array([0.4, 0.0]), empty_result([False, True]), shown, sure, *2 * [shown < 0])
        np.testing.assert_array_equal(watch.lost, [False, t > 0])  # inconclusive: unchanged
    np.testing.assert_allclose(watch.usual, [0.4, 0.02], rtol=1e-2)
    np.testing.assert_allclose(watch.waited, [60, 0])
    np.testing.assert_allclose(watch.largest, [59, 60])
    np.testing.assert_allclose(watch.agrees, [0.9, 0.2])


def empty_result(searched, leads=jnp.inf):
    """A search result with nothing but the searched groups and the leads of their orientations."""
    still = jnp.zeros((len(searched), 6))
    estimate, none = Estimate(still, still[:, 0]), still[:, 0]
    sure = Confidence(none, none, none > 0)
    leads = jnp.broadcast_to(jnp.asarray(leads), len(still))
    return SearchResult(estimate, jnp.array(searched), Relocation(still, sure, sure), none > 0, leads)


def test_a_lost_group_is_found_only_when_enough_of_it_shows():
    """Behind an occluder, the little that is visible may agree, and the group is still lost. Half of the
    points that faced a camera were visible at first, and no more need be visible now."""
    watch, none, one = first_watch(jnp.array([0.5])), jnp.zeros(1), jnp.array([True])
    cases = [
        (0.2, 0.2, True),
        (0.9, 0.2, True),  # too little of it shows
        (0.5, 0.4, True),  # what shows hardly agrees
        (0.9, 0.35, False),
        (0.4, 0.1, False),
        (0.3, 0.3, True),
    ]
    for agrees, shows, lost in cases:
        sure = Confidence(jnp.array([agrees]), jnp.array([shows]), one)
        watch = watch.after(none, empty_result([True]), none, sure, ~one, ~one)
        assert bool(watch.lost[0]) == lost, (agrees, shows)


def test_what_is_found_elsewhere_once_is_glimpsed_and_checked_in_the_next_frame():
    """A can that came out of a garage was found in one frame, and not searched for in the next four."""
    watch, none, one = first_watch(jnp.ones(1)), jnp.zeros(1), jnp.array([True])
    unsure = Confidence(none + 0.4, none + 0.3, one)
    cases = [
        (0.9, one, ~one, True),
        (0.9, one, one, False),  # found twice, so it is moved there
        (0.9, one, ~one, True),
        (0.9, one, ~one, False),  # checked, but no better than in its own place: others may be searched
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
    assert not watch.after(none, result, none, certain, one, ~one).glimpsed[0]


def test_an_orientation_stays_unknown_until_its_group_is_found_as_at_first():
    watch, none, one = first_watch(jnp.ones(1)), jnp.zeros(1), jnp.array([True])
    cases = [
        (0.8, 0.2, True),  # agreement, lead, whether the orientation is known then
        (0.8, TURN_KNOWN - 0.01, False),
        (0.9, 0.2, False),  # it may have turned in between
        (0.2, 0.2, False),  # lost
        (0.62, 0.2, False),  # found, but hardly as at first
        (0.2, 0.2, False),
        (0.9, 0.2, True),
        (0.9, jnp.inf, True),  # not searched for
    ]
    for agrees, lead, known in cases:
        sure = Confidence(jnp.array([agrees]), jnp.array([agrees]), one)
        watch = watch.after(none, empty_result([True], lead), none, sure, ~one, ~one)
        assert bool(watch.turn_known[0]) == known, (agrees, lead)
    for agrees, known in ((0.9, True), (0.62, False)):  # relocated, though it was not lost
        sure = Confidence(jnp.array([agrees]), jnp.array([agrees]), one)
        watch = watch.after(none, empty_result([True]), none, sure, one, one)
        assert bool(watch.turn_known[0]) == known, agrees
