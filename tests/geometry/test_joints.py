"""Motions of joints, and joints recovered from motions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gsjax.geometry.joints import KINDS, Joint, fit_joint

seeds = st.integers(0, 10_000)
kinds = st.sampled_from(KINDS)


def made_up(kind, seed, frames=12):
    """A joint that opens by about half a metre or 1.5 radians, and points of a part near it."""
    rng = np.random.default_rng(seed)
    axis = Rotation.random(rng=rng).apply([0.0, 0.0, 1.0])
    values = np.cumsum(rng.uniform(0.0, 0.25, frames)) * (0.3 if kind == "prismatic" else 1.0)
    joint = Joint(kind, axis, rng.normal(size=3), values)
    return joint, joint.point + rng.uniform(-0.2, 0.2, (30, 3))


def shaken(motions, points, noise, seed):
    """The motions, each perturbed about the part's centroid by Gaussian noise with a standard deviation of
    `noise` metres and `noise` radians."""
    rng, middle = np.random.default_rng(seed), points.mean(0)
    turns = Rotation.from_rotvec(noise * rng.normal(size=(len(motions), 3))).as_matrix()
    steps = np.broadcast_to(np.eye(4), (len(motions), 4, 4)).copy()
    steps[:, :3, :3] = turns
    steps[:, :3, 3] = middle - turns @ middle + noise * rng.normal(size=(len(motions), 3))
    return motions @ steps


@given(seeds)
def test_motions_keep_the_axis_and_go_as_far_as_the_values_say(seed):
    rng = np.random.default_rng(seed)
    axis, point, values = (
        Rotation.random(rng=rng).apply([0.0, 0.0, 1.0]),
        rng.normal(size=3),
        rng.normal(size=4),
    )
    on_axis = np.append(point + 0.7 * axis, 1.0)
    turned, slid = (Joint(kind, axis, point, values).motions() for kind in ("revolute", "prismatic"))
    np.testing.assert_allclose(turned @ on_axis, np.tile(on_axis, (4, 1)), atol=1e-12)
    np.testing.assert_allclose(
        Rotation.from_matrix(turned[:, :3, :3]).as_rotvec(), values[:, None] * axis, atol=1e-9
    )
    np.testing.assert_allclose(slid[:, :3, 3], values[:, None] * axis, atol=1e-12)
    np.testing.assert_array_equal(slid[:, :3, :3], np.broadcast_to(np.eye(3), (4, 3, 3)))


def test_joints_that_are_none():
    x, nothing, values = np.array([1.0, 0.0, 0.0]), np.zeros(3), np.zeros(2)
    with pytest.raises(ValueError, match="kind: expected prismatic or revolute, found 'ball'"):
        Joint("ball", x, nothing, values)
    with pytest.raises(ValueError, match="axis: expected a direction of length 1, found length 2"):
        Joint("revolute", 2 * x, nothing, values)
    with pytest.raises(ValueError, match=r"point: expected shape \(3,\), found \(2,\)"):
        Joint("revolute", x, np.zeros(2), values)


@given(kinds, seeds)
def test_a_joint_is_found_exactly(kind, seed):
    joint, points = made_up(kind, seed)
    found = fit_joint(joint.motions(), points)
    assert found.kind == kind
    np.testing.assert_allclose(found.joint.axis, joint.axis, atol=1e-7)
    np.testing.assert_allclose(found.joint.values, joint.values, atol=1e-7)
    np.testing.assert_allclose(found.joint.motions(), joint.motions(), atol=1e-7)
    if kind == "revolute":  # any point on the axis is equivalent
        np.testing.assert_allclose(np.cross(found.joint.point - joint.point, joint.axis), 0, atol=1e-6)
    assert found.errors_m[kind] < 1e-7
    assert found.confidence > 0.99


@given(kinds, seeds)
def test_tracking_noise_costs_as_much_as_it_is(kind, seed):
    joint, points = made_up(kind, seed)
    found = fit_joint(shaken(joint.motions(), points, 1e-3, seed), points)
    assert found.kind == kind
    assert np.rad2deg(np.arccos(found.joint.axis @ joint.axis)) < 2
    assert np.abs(found.joint.values - joint.values).max() < 6e-3
    assert 0.5e-3 < found.errors_m[kind] < 3e-3


def test_the_path_of_a_short_handle_tells_its_axis():
    """The handle is 6 cm long and 6 cm from the axis; its noise is 3 degrees and 2 mm."""
    axis_deg, angle_deg, sure = [], [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        axis, aside = Rotation.random(rng=rng).as_matrix()[:2]
        joint = Joint("revolute", axis, rng.normal(size=3), np.sort(rng.uniform(0, 1.2, 12)))
        points = joint.point + 0.06 * aside + rng.uniform(-0.03, 0.03, (60, 3))
        steps, middle = np.tile(np.eye(4), (12, 1, 1)), points.mean(0)
        steps[:, :3, :3] = Rotation.from_rotvec(0.05 * rng.normal(size=(12, 3))).as_matrix()
        steps[:, :3, 3] = middle - steps[:, :3, :3] @ middle + 0.002 * rng.normal(size=(12, 3))
        found = fit_joint(joint.motions() @ steps, points, tolerance=0.15)
        assert found.kind == "revolute"
        axis_deg.append(np.rad2deg(np.arccos(found.joint.axis @ axis)))
        gaps = np.diff(found.joint.values) - np.diff(joint.values)
        angle_deg.append(np.rad2deg(np.abs(gaps).mean()))
        sure.append(found.confidence)
    assert np.median(axis_deg) < 1.4  # from rotations alone: 1.7, 3.0 and 0.3
    assert np.median(angle_deg) < 1.8
    assert np.median(sure) > 0.45


@pytest.mark.parametrize("frames", [1, 2, 12])
@pytest.mark.parametrize(
    "points",
    [
        np.zeros((1, 3)),
        np.zeros((9, 3)),
        np.outer(np.arange(9.0), [0, 0, 1]),
        np.outer(np.arange(-900.0, 900), [1, 2, 3]),
    ],
)
def test_points_without_extent_and_single_frames(points, frames):
    joint = Joint("revolute", np.array([0.0, 0.0, 1.0]), np.array([0.3, 0.0, 0.0]), np.linspace(0, 1, frames))
    found = fit_joint(joint.motions(), points)
    if frames == 1:
        assert found.kind == "fixed"
    assert np.isfinite(list(found.errors_m.values())).all()
    assert fit_joint(np.tile(np.eye(4), (frames, 1, 1)), points).kind == "fixed"


@given(seeds)
def test_where_the_world_is_seen_from_does_not_matter(seed):
    """A change of frame rotates the axis and moves the point, but changes no error."""
    joint, points = made_up("revolute", seed)
    motions = shaken(joint.motions(), points, 5e-4, seed)
    frame = np.eye(4)
    frame[:3, :3] = Rotation.random(rng=seed).as_matrix()
    frame[:3, 3] = np.random.default_rng(seed).normal(size=3)
    here = fit_joint(motions, points)
    there = fit_joint(frame @ motions @ np.linalg.inv(frame), points @ frame[:3, :3].T + frame[:3, 3])
    np.testing.assert_allclose(there.joint.axis, frame[:3, :3] @ here.joint.axis, atol=1e-6)
    np.testing.assert_allclose(there.joint.values, here.joint.values, atol=1e-7)
    assert there.errors_m == pytest.approx(here.errors_m)


def test_what_hardly_moves_is_fixed():
    points = made_up("revolute", 0)[1]
    still = shaken(np.tile(np.eye(4), (12, 1, 1)), points, 3e-4, 1)
    found = fit_joint(still, points)
    assert (found.kind, found.joint) == ("fixed", None)
    assert 0.5 < found.confidence <= 1


@pytest.mark.thorough
@given(seeds)
def test_what_slides_and_turns_is_free(seed):
    rng = np.random.default_rng(seed)
    turned, points = made_up("revolute", seed)
    shift = np.broadcast_to(np.eye(4), (12, 4, 4)).copy()
    shift[:, :3, 3] = 0.3 * np.linspace(0, 1, 12)[:, None] * turned.axis + 0.2 * np.sin(
        np.linspace(0, 9, 12)
    )[:, None] * np.cross(turned.axis, rng.normal(size=3))
    found = fit_joint(shift @ turned.motions(), points)
    assert (found.kind, found.joint) == ("free", None)
    assert 0 < found.confidence < 1


def turning_slide(seed, turn):
    """Motions of a 12 cm part that slides 25 cm along a line while it rotates steadily, and its points."""
    rng = np.random.default_rng(seed)
    share, way = np.linspace(0, 1, 16), np.append(rng.normal(size=2), 0.0)
    motions = np.tile(np.eye(4), (16, 1, 1))
    motions[:, :3, :3] = Rotation.from_rotvec(np.outer(turn * share, [0, 0, 1])).as_matrix()
    motions[:, :3, 3] = np.outer(0.25 * share, way / np.linalg.norm(way))
    return motions, rng.uniform(-0.06, 0.06, (40, 3))


@given(seeds, st.floats(0.5, 1.2))
def test_a_steady_slide_and_turn_is_no_hinge(seed, turn):
    """It is nearly a hinge about a distant axis: with the larger tolerance it was taken for one before a
    turning slide was fitted as well."""
    motions, points = turning_slide(seed, turn)
    for tolerance in (0.03, 0.15):
        found = fit_joint(motions, points, tolerance=tolerance)
        assert found.kind == "free"
        assert found.confidence > 0.3
        assert found.errors_m["turning slide"] < 0.2 * found.errors_m["revolute"]


def test_noise_lets_few_hinges_and_turning_slides_be_taken_for_each_other():
    kinds = {"hinge": [], "slide": []}
    for seed in range(20):
        joint, points = made_up("revolute", seed)
        for name, motions in (("hinge", joint.motions()), ("slide", turning_slide(seed, 0.8)[0])):
            mine = points if name == "hinge" else turning_slide(seed, 0.8)[1]
            kinds[name].append(fit_joint(shaken(motions, mine, 1e-3, seed), mine, tolerance=0.15).kind)
    assert kinds["hinge"].count("revolute") >= 19
    assert kinds["slide"].count("free") >= 18


def test_how_sure_it_is_falls_to_nothing_where_the_answer_becomes_another():
    """A hinge tracked with growing noise eventually becomes free; the larger the tolerance, the later."""
    joint, points = made_up("revolute", 4)
    found = {
        allowed: [
            fit_joint(shaken(joint.motions(), points, mm / 1000, 4), points, tolerance=allowed)
            for mm in (1, 4, 8, 12, 16, 20, 24, 28, 32)
        ]
        for allowed in (0.03, 0.06)
    }
    for each in found.values():
        kinds = [one.kind for one in each]
        hinges = kinds.count("revolute")
        assert 0 < hinges < len(kinds)
        assert kinds == ["revolute"] * hinges + ["free"] * (len(kinds) - hinges)
        sure = [one.confidence for one in each]
        assert sure[:hinges] == sorted(sure[:hinges], reverse=True)
        assert sure[hinges:] == sorted(sure[hinges:])
        assert min(sure) < 0.3
    counts = [sum(one.kind == "revolute" for one in each) for each in found.values()]
    assert counts[0] < counts[1]


def test_a_turn_too_small_to_tell_is_a_slide():
    far = Joint("revolute", np.array([0.0, 0.0, 1.0]), np.array([0.0, 8.0, 0.0]), np.linspace(0, 0.03, 9))
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (20, 3))
    assert fit_joint(far.motions(), points).kind == "prismatic"
    assert fit_joint(far.motions(), points, least_turn_rad=0.01).kind == "revolute"


def test_more_than_a_turn_is_followed():
    joint, points = made_up("revolute", 3)
    wheel = Joint("revolute", joint.axis, joint.point, np.linspace(0, 3 * np.pi, 25))
    np.testing.assert_allclose(np.ptp(fit_joint(wheel.motions(), points).joint.values), 3 * np.pi, atol=1e-6)
