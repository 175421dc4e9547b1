"""Labelings against brute force over pairs and permutations; joints perturbed by known errors."""

import math
from itertools import combinations, permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gsjax.geometry.joints import KINDS, Joint
from gsjax.metrics.parts import adjusted_rand_index, joint_error, match_parts

seeds = st.integers(0, 10_000)
kinds = st.sampled_from(KINDS)


def labelings(seed, count=14, found=4, true=3, unknown=True):
    rng = np.random.default_rng(seed)
    low = -1 if unknown else 0
    return rng.integers(0, found, count), rng.integers(low, true, count)


@given(seeds)
def test_the_rand_index_is_that_of_all_pairs(seed):
    """Counts pairs that are together in both, one or neither, and applies the definition."""
    predicted, true = labelings(seed)
    known = np.flatnonzero(true != -1)
    pairs = list(combinations(known, 2))
    together = [(predicted[i] == predicted[j], true[i] == true[j]) for i, j in pairs]
    both, found, real = (sum(map(rule, together)) for rule in (all, lambda t: t[0], lambda t: t[1]))
    expected = found * real / len(pairs)
    if (found + real) / 2 == expected:
        assert adjusted_rand_index(predicted, true) == 1
    else:
        value = (both - expected) / ((found + real) / 2 - expected)
        assert adjusted_rand_index(predicted, true) == pytest.approx(value)


@given(seeds)
def test_names_and_order_do_not_matter(seed):
    rng = np.random.default_rng(seed)
    predicted, true = labelings(seed)
    index, match = adjusted_rand_index(predicted, true), match_parts(predicted, true)
    names, order = rng.permutation(50)[:4], rng.permutation(len(true))
    assert adjusted_rand_index(names[predicted][order], true[order]) == pytest.approx(index)
    renamed = match_parts(names[predicted][order], true[order])
    assert sum(renamed.ious.values()) == pytest.approx(sum(match.ious.values()))
    known = true != -1
    assert adjusted_rand_index(true[known], predicted[known]) == pytest.approx(index)  # symmetric


def test_the_same_division_is_one_and_chance_is_zero():
    rng = np.random.default_rng(0)
    true = rng.integers(0, 5, 4000)
    assert adjusted_rand_index((true + 3) % 5, true) == 1
    assert abs(adjusted_rand_index(rng.integers(0, 5, 4000), true)) < 0.005
    chance = [adjusted_rand_index(rng.permutation(true[:30]), true[:30]) for _ in range(400)]
    assert abs(np.mean(chance)) < 3 * np.std(chance) / 20
    assert min(chance) < 0


def test_the_rand_index_at_its_ends():
    assert adjusted_rand_index(np.zeros(5, int), np.zeros(5, int)) == 1
    assert adjusted_rand_index(np.arange(5), np.arange(5)[::-1]) == 1
    assert adjusted_rand_index(np.zeros(5, int), np.arange(5)) == 0
    assert adjusted_rand_index(np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])) == pytest.approx(-0.5)
    assert math.isnan(adjusted_rand_index(np.zeros(3, int), np.array([2, -1, -1])))
    many = np.repeat(np.arange(4), 500_000)  # products of its pair counts exceed 64 bits
    assert adjusted_rand_index(many, many) == 1
    with pytest.raises(ValueError, match=r"predicted: expected shape \(4,\) to match true, found \(3,\)"):
        adjusted_rand_index(many[:3], many[:4])


@given(seeds)
def test_no_other_matching_overlaps_more(seed):
    predicted, true = labelings(seed)
    known = true != -1

    def iou(found, real):
        p, t = predicted[known] == found, true[known] == real
        return np.sum(p & t) / max(np.sum(p | t), 1)

    best = max(
        sum(iou(f, r) for f, r in zip(chosen, range(3), strict=True)) for chosen in permutations(range(4), 3)
    )
    match = match_parts(predicted, true)
    assert sum(match.ious.values()) == pytest.approx(best)
    for real, found in match.found.items():
        assert match.ious[real] == pytest.approx(iou(found, real))
        assert match.ious[real] > 0
    assert set(match.found.values()) | set(match.surplus) == set(predicted[known].tolist())
    assert not set(match.found.values()) & set(match.surplus)


def test_parts_are_found_under_other_names():
    true = np.repeat([0, 1, 2, 3, -1], [50, 20, 10, 5, 7])
    predicted = np.repeat([0, 7, 5, 7, 4], [50, 20, 10, 5, 7])  # 3 was taken for a piece of 1
    predicted[:2] = 9
    match = match_parts(predicted.reshape(4, 23), true.reshape(4, 23))
    assert match.found == {0: 0, 1: 7, 2: 5}
    assert match.ious == {0: 48 / 50, 1: 20 / 25, 2: 1.0, 3: 0.0}
    assert match.surplus == (9,)
    assert match.mean_iou([1, 2, 3]) == pytest.approx(0.6)
    assert match.mean_iou([1, 8]) == pytest.approx(0.8)
    assert match.mean_iou() == pytest.approx((0.96 + 0.8 + 1 + 0) / 4)
    nothing = match_parts(np.zeros(2, int), np.full(2, -1))
    assert (nothing.found, nothing.surplus) == ({}, ())
    assert math.isnan(nothing.mean_iou())


def made_up(kind, seed):
    rng = np.random.default_rng(seed)
    axis = Rotation.random(rng=rng).apply([0.0, 0.0, 1.0])
    return Joint(kind, axis, rng.normal(size=3), rng.uniform(0, 1, 6)), rng.normal(size=3), rng


def across(axis, rng):
    """A random direction perpendicular to an axis."""
    side = np.cross(axis, rng.normal(size=3))
    return side / np.linalg.norm(side)


@given(kinds, seeds)
def test_an_equivalent_joint_has_no_error(kind, seed):
    """Axis and values of opposite sign, another point on the axis, another zero."""
    joint, middle, rng = made_up(kind, seed)
    same = Joint(kind, -joint.axis, joint.point + rng.normal() * joint.axis, 0.4 - joint.values)
    error = joint_error(same, joint, middle, anchor=int(rng.integers(6)))
    assert error.same_kind
    known = [error.axis_deg, *((error.line_mm, error.value_deg) if kind == "revolute" else (error.value_mm,))]
    np.testing.assert_allclose(known, 0, atol=1e-9)
    unknown = (error.value_mm,) if kind == "revolute" else (error.line_mm, error.value_deg)
    assert np.isnan(unknown).all()


@given(kinds, seeds, st.floats(0, 89))
def test_a_tilted_axis_is_off_by_the_tilt(kind, seed, degrees):
    joint, middle, rng = made_up(kind, seed)
    tilt = Rotation.from_rotvec(np.radians(degrees) * across(joint.axis, rng))
    tilted = Joint(kind, tilt.apply(joint.axis), joint.point, joint.values)
    assert joint_error(tilted, joint, middle).axis_deg == pytest.approx(degrees, abs=1e-6)


@given(seeds, st.floats(0, 0.3), st.floats(-1, 1))
def test_the_distance_of_an_axis_is_measured_next_to_the_part(seed, metres, radians):
    """A parallel axis is off by its offset; one tilted about its point nearest to the part, not at all."""
    joint, middle, rng = made_up("revolute", seed)
    beside = joint.point + (middle - joint.point) @ joint.axis * joint.axis
    moved = Joint("revolute", joint.axis, joint.point + metres * across(joint.axis, rng), joint.values)
    assert joint_error(moved, joint, middle).line_mm == pytest.approx(1000 * metres, abs=1e-9)
    tilt = Rotation.from_rotvec(radians * across(joint.axis, rng)).apply(joint.axis)
    assert joint_error(Joint("revolute", tilt, beside, joint.values), joint, middle).line_mm < 1e-6


def test_lines_that_meet_far_away_are_not_near():
    true = Joint("revolute", np.array([0.0, 0.0, 1.0]), np.zeros(3), np.zeros(2))
    axis = np.array([-0.05, 0.0, 50.0]) / math.hypot(0.05, 50)  # it meets the true axis 50 m farther up
    found = Joint("revolute", axis, np.array([0.05, 0.0, 0.0]), np.zeros(2))
    assert joint_error(found, true, np.array([0.3, 0.3, 0.0])).line_mm == pytest.approx(50, abs=1e-3)


def test_values_are_compared_since_the_anchor():
    x, values = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.1, 0.3])
    true, half = (Joint("prismatic", x, np.zeros(3), v) for v in (values, values / 2))
    assert joint_error(half, true, np.zeros(3)).value_mm == pytest.approx((0 + 50 + 150) / 3)
    assert joint_error(half, true, np.zeros(3), anchor=2).value_mm == pytest.approx((150 + 100 + 0) / 3)
    hinge, other_way = (Joint("revolute", x, np.zeros(3), v) for v in (values, -values))
    error = joint_error(other_way, hinge, np.zeros(3))  # the same axis, opening to the wrong side
    assert error.value_deg == pytest.approx(np.degrees(2 * 0.4 / 3))


def test_a_hinge_is_no_drawer():
    hinge, middle, _ = made_up("revolute", 0)
    drawer = Joint("prismatic", hinge.axis, hinge.point, hinge.values)
    error = joint_error(drawer, hinge, middle)
    assert (error.same_kind, error.axis_deg) == (False, pytest.approx(0))
    assert np.isnan([error.line_mm, error.value_deg, error.value_mm]).all()
    with pytest.raises(ValueError, match="found: expected 6 values like the true joint, found 5"):
        joint_error(Joint("revolute", hinge.axis, hinge.point, hinge.values[1:]), hinge, middle)
