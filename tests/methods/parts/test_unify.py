"""Which parts are joined or cut, on motions for which the answer is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gsjax.methods.parts.unify import best_cut, extent, gap, scene_motions, unified

T = 6
seeds = st.integers(0, 10_000)


def motions(*bodies):
    """Motions of the background and then of each body, given as (rotation vectors [T,3], shifts [T,3])."""
    still = np.zeros((T, 3)), np.zeros((T, 3))
    turns, shifts = zip(still, *bodies, strict=True)
    rotations = np.stack([Rotation.from_rotvec(turn).as_matrix() for turn in turns], axis=1)
    return scene_motions(rotations, np.stack(shifts, axis=1), np.zeros((len(turns), 3)))


def ramp(*end):
    return np.linspace(0, 1, T)[:, None] * np.array(end, float)


def joined(found, points, labels, alive=None, since=None, noise_m=0.005, tolerance=0.15):
    count = found.rotations.shape[1]
    alive = np.ones(count, bool) if alive is None else alive
    since = np.zeros(count, int) if since is None else since
    return unified(found, points, labels, alive, since, noise_m=noise_m, tolerance=tolerance).tolist()


@pytest.fixture
def points():
    """(points of the background and of two halves of a bar along x, their labels)."""
    rng = np.random.default_rng(0)
    bar = rng.uniform([-0.1, -0.02, 0], [0.1, 0.02, 0.04], (60, 3))
    return np.concatenate([rng.uniform(-1, 1, (20, 3)), bar]), np.r_[np.zeros(20, int), 1 + (bar[:, 0] > 0)]


def test_two_halves_of_one_rigid_body_are_one(points):
    turning = ramp(0, 0, 0.8), ramp(0.05, 0, 0)
    assert joined(motions(turning, turning), *points) in ([0, 1, 1], [0, 2, 2])


def test_the_pivot_does_not_matter(points):
    """About two pivots, the same motion has two translations; compared by these, the halves would differ."""
    rotations = Rotation.from_rotvec(ramp(0, 0, 0.8)).as_matrix()
    centers = np.array([[0, 0, 0], [-0.05, 0, 0], [0.05, 0, 0]])
    shifts = np.stack([rotations @ c - c for c in centers], axis=1)
    every = np.stack([np.tile(np.eye(3), (T, 1, 1)), rotations, rotations], axis=1)
    found = scene_motions(every, shifts, centers)
    np.testing.assert_allclose(found.offsets, 0, atol=1e-12)
    assert np.abs(shifts[-1, 1] - shifts[-1, 2]).max() > 0.05
    assert len(set(joined(found, *points))) == 2


def test_a_hinge_is_two(points):
    assert joined(motions((ramp(0, 0, 0.8), ramp(0, 0, 0)), (ramp(0, 0, 0), ramp(0.05, 0, 0))), *points) == [
        0,
        1,
        2,
    ]


def test_parts_that_still_stand_are_not_one(points):
    """Parts that both stand still move alike, but one may start later."""
    still = np.zeros((T, 3)), np.zeros((T, 3))
    late = np.zeros((T, 3)), ramp(0.08, 0, 0) * (np.arange(T) > 3)[:, None]
    assert joined(motions(still, still), *points) == [0, 1, 2]
    assert joined(motions(late, still), *points) == [0, 1, 2]
    assert len(set(joined(motions(late, late), *points))) == 2


def test_one_that_moves_as_little_as_tracking_errs_waits(points):
    slow = np.zeros((T, 3)), ramp(0.004, 0, 0)
    assert joined(motions(slow, slow), *points) == [0, 1, 2]
    assert len(set(joined(motions(slow, slow), *points, noise_m=0.003))) == 2


def test_what_was_together_before_a_split_does_not_count(points):
    """Two that separate in the last frame moved alike before, but only because they were one part then."""
    together = ramp(0.2, 0, 0)
    apart = together + np.r_[np.zeros((T - 1, 3)), [[0, 0.05, 0]]]
    found = motions((np.zeros((T, 3)), together), (np.zeros((T, 3)), apart))
    assert len(set(joined(found, *points))) == 2
    assert joined(found, *points, since=np.array([0, 0, T - 1])) == [0, 1, 2]


def test_one_born_where_all_stands_again_is_none_of_them(points):
    """A new part has moved like the one that it was split from. Since then, it and another part have both
    been at their first poses, as may be in frames before the anchor: that they move alike says nothing."""
    there, elsewhere = np.zeros((T, 3)), np.zeros((T, 3))
    there[1:4], elsewhere[1:4] = [0.2, 0, 0], [0, 0.3, 0]
    found = motions((np.zeros((T, 3)), there), (np.zeros((T, 3)), elsewhere))
    assert joined(found, *points, since=np.array([0, 0, 4])) == [0, 1, 2]
    assert joined(found, *points, since=np.array([0, 0, T])) == [0, 1, 2]


def test_slots_without_a_part_join_nothing(points):
    turning = ramp(0, 0, 0.8), ramp(0, 0, 0)
    assert joined(motions(turning, turning), *points, alive=np.array([True, True, False])) == [0, 1, 2]


@given(seeds)
def test_three_that_move_alike_become_the_largest(seed):
    rng = np.random.default_rng(seed)
    turning = ramp(*rng.normal(size=3)), ramp(*rng.normal(size=3))
    sizes = rng.permutation([5, 9, 24])  # the two small ones together are smaller
    labels = np.repeat([1, 2, 3], sizes)
    into = joined(motions(turning, turning, turning), rng.normal(size=(38, 3)), labels)
    assert into == [0] + [1 + int(sizes.argmax())] * 3


@given(seeds)
def test_gaps_are_those_of_moved_points(seed):
    rng = np.random.default_rng(seed)
    found = motions(
        (rng.normal(size=(T, 3)), rng.normal(size=(T, 3))), (rng.normal(size=(T, 3)), rng.normal(size=(T, 3)))
    )
    some = rng.normal(size=(7, 3))
    moved = np.einsum("tpij,nj->tpni", found.rotations, some) + found.offsets[:, :, None]
    apart = np.linalg.norm(moved[:, 1] - moved[:, 2], axis=-1)
    assert gap(found, 1, 2, some) == pytest.approx(np.sqrt((apart**2).mean()))
    far = np.linalg.norm(moved[:, 1] - some, axis=-1)
    assert extent(found, 1, some) == pytest.approx(np.sqrt((far**2).mean(-1).max()))
    assert gap(found, 1, 1, some) == 0


@given(seeds)
def test_sides_that_are_pulled_apart_are_found(seed):
    rng = np.random.default_rng(seed)
    some = rng.uniform(-1, 1, (120, 3)) * [1.0, 0.3, 0.2]
    edge = rng.uniform(-0.4, 0.4)
    beyond = some[:, 0] > edge
    pulls = np.where(beyond[:, None], [0, 0, 1.0], [0, 0, -1.0]) + rng.normal(0, 1.0, (120, 3))
    turn = Rotation.random(rng=seed).as_matrix()
    cut = best_cut(some @ turn.T + 3, pulls @ turn.T)
    agree = (cut.beyond == beyond).mean()
    assert max(agree, 1 - agree) > 0.8
    assert cut.score > 5


@given(seeds)
def test_chance_pulls_no_part_apart(seed):
    rng = np.random.default_rng(seed)
    some, strengths = rng.normal(size=(150, 3)), np.exp(rng.normal(0, 1.5, (150, 1)))
    assert best_cut(some, rng.normal(size=(150, 3)) * strengths).score < 5


def test_too_few_points_are_not_cut():
    rng = np.random.default_rng(0)
    pulls = np.zeros((30, 3))
    pulls[:6] = [1, 0, 0]
    cut = best_cut(rng.normal(size=(30, 3)), pulls)
    assert (cut.score, cut.beyond.any()) == (0.0, False)
