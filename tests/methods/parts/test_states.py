"""Parts from two states: unobserved motions and unlabelled parts are recovered."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import gsjax
from gsjax.engine.parts.start import detect_motion, has_two_states
from gsjax.engine.scores import true_labels_at
from gsjax.methods.parts import DiscoverConfig, PartsConfig
from gsjax.methods.parts.states import states_of
from gsjax.methods.parts.states.labels import connections, labels_of
from gsjax.methods.parts.states.registration import (
    Target,
    axes_of,
    guesses,
    likeness,
    matched,
    moved,
    registered,
    rotated_normals,
)
from gsjax.methods.parts.states.surfaces import (
    Surface,
    around,
    color_distance,
    denoised,
    evidence,
    pixel_width,
    surface_of,
)
from gsjax.metrics.tracking import relative_motion
from gsjax.scene.initialize import gaussians_from_points

SMALL = "width=96&height=72&cameras=12"


@pytest.fixture(scope="module")
def cabinet():
    return gsjax.open_sequence(f"simulated:cabinet?{SMALL}")


@pytest.fixture(scope="module")
def found(cabinet):
    return states_of(cabinet.frame(0), cabinet.frame(1))


def true_motions(sequence, anchor=0):
    """True motions from one state to the other, of each part."""
    return [relative_motion(sequence.truth.poses[:, k], anchor)[1 - anchor] for k in range(2)]


def gap(one, other, points):
    """Mean distance between points after two motions, metres."""
    return np.linalg.norm(moved(one, points) - moved(other, points), axis=-1).mean()


@pytest.mark.thorough
def test_a_door_and_a_drawer_are_found_to_a_fifth_of_a_pixel(cabinet, found):
    pixel, points = pixel_width(cabinet.frame(0)), found.surface.points
    assert len(found.motions) == 3
    for true in true_motions(cabinet):
        best = min(
            gap(motion, true, points[found.labels == k]) for k, motion in enumerate(found.motions) if k
        )
        assert best < 0.2 * pixel


@pytest.mark.thorough
def test_points_follow_the_motion_of_what_they_are_on(cabinet, found):
    labels = true_labels_at(cabinet, 0, found.surface.points)
    matches = [(found.labels == k) & (labels == label) for k in (1, 2) for label in (1, 2)]
    right = max(matches[0].sum() + matches[3].sum(), matches[1].sum() + matches[2].sum())
    assert right > 0.85 * (labels > 0).sum()
    assert (found.labels[labels == 0] == 0).mean() > 0.98


def worst_gap(found, sequence, anchor=0):
    """Mean distance of a part's points between its true motion and the nearest one found, pixels; the largest
    of all parts."""
    points, labels = found.surface.points, true_labels_at(sequence, anchor, found.surface.points)
    gaps = []
    for k, label in enumerate(sequence.truth.label_ids):
        true = relative_motion(sequence.truth.poses[:, k], anchor)[1 - anchor]
        gaps.append(min(gap(motion, true, points[labels == label]) for motion in found.motions[1:]))
    return max(gaps) / pixel_width(sequence.frame(anchor))


@pytest.mark.slow
def test_backwards_the_motions_are_the_inverse(cabinet):
    """Regression test: plates were off by pixels within their plane. Edges and patterns prevent that."""
    found = states_of(cabinet.frame(1), cabinet.frame(0))
    assert worst_gap(found, cabinet, anchor=1) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize(
    "parts", ["doors=3&drawers=0&width=160&height=120", "doors=0&drawers=2&width=200&height=150"]
)
def test_parts_that_look_alike_are_not_mistaken_for_each_other(parts):
    """Doors whose edges are hidden by their neighbours, and drawers that fit into each other's places."""
    sequence = gsjax.open_sequence(f"simulated:cabinet?{parts}")
    found = states_of(sequence.frame(0), sequence.frame(1))
    assert worst_gap(found, sequence) < 0.5


@pytest.mark.slow
def test_depth_may_be_noisy(cabinet):
    """Regression test: with noise of half a percent, no part was found."""
    random = np.random.default_rng(0)

    def noisy(frame):
        factors = 1 + 0.005 * random.normal(size=frame.depths.shape)
        return replace(frame, depths=(np.asarray(frame.depths) * factors).astype(np.float32))

    frames = [noisy(cabinet.frame(t)) for t in (0, 1)]
    found = states_of(*frames)
    assert len(found.motions) == 3
    assert worst_gap(found, cabinet) < 0.5
    steady, exact = np.asarray(denoised(frames[0]).depths), np.asarray(cabinet.frame(0).depths)
    off = [
        np.median(np.abs(depths[exact > 0] / exact[exact > 0] - 1)) for depths in (steady, frames[0].depths)
    ]
    assert off[0] < 0.7 * off[1]
    np.testing.assert_array_equal(denoised(cabinet.frame(0)).depths, exact)


def test_where_nothing_has_moved_that_is_said(cabinet):
    with pytest.raises(ValueError, match="expected parts that moved between two states, found 0 points gone"):
        states_of(cabinet.frame(0), cabinet.frame(0))


def test_two_states_without_depth_are_refused(cabinet):
    frames = [cabinet.frame(t) for t in (0, 1)]
    frames[1] = replace(frames[1], depths=np.zeros_like(frames[1].depths))
    with pytest.raises(ValueError, match="expected depth in both states"):
        states_of(*frames)


def test_what_is_lit_otherwise_after_its_motion_is_as_like_as_before(corner):
    """After the motion, one side is lit and another in shadow."""
    random = np.random.default_rng(0)
    colors = random.uniform(0.2, 0.4, corner.points.shape)
    part = corner._replace(colors=colors, brightness=colors.mean(-1))
    lit = np.array([2.0, 1.0, 0.5])[np.abs(corner.normals).argmax(-1)]
    after = part._replace(colors=lit[:, None] * colors, brightness=lit * part.brightness)
    target = Target(after, 0.005, after.points.min(0) - 0.1, after.points.max(0) + 0.1)
    assert np.median(matched(np.eye(4), part, target, 0.01).color_distance) < 0.01
    assert np.median(color_distance(part.colors, after.colors)) > 0.1


def test_edges_tell_where_a_plain_plate_lies_within_its_plane(corner):
    """Its plane and its uniform colour do not determine that."""
    count = len(corner.points) // 3
    face = Surface(*(values[:count] for values in corner))
    face = face._replace(outward=around(face.points, face.normals, face.colors, 0.015)[0])
    target = Target(face, 0.005, face.points.min(0) - 0.1, face.points.max(0) + 0.1)
    guess = np.eye(4)
    guess[1:3, 3] = 0.012, -0.009  # within the plane
    assert np.linalg.norm(registered(guess, face, target, 0.05, 0.01, 20)[:3, 3]) < 2e-3
    blind = Target(
        face._replace(outward=np.zeros_like(face.outward)),
        0.005,
        face.points.min(0) - 0.1,
        face.points.max(0) + 0.1,
    )
    assert np.linalg.norm(registered(guess, face, blind, 0.05, 0.01, 20)[:3, 3]) > 8e-3


@pytest.mark.thorough
def test_the_run_of_two_states_has_joints_and_is_refined(cabinet):
    """Without a fit: the points measured by the cameras serve as Gaussians."""
    surface = surface_of(cabinet.frame(0), 2 * pixel_width(cabinet.frame(0)))
    gaussians = gaussians_from_points(surface.points, surface.colors)
    config = PartsConfig()
    config = replace(config, refine=replace(config.refine, iterations=4))
    ticks = gsjax.parts(cabinet, config, anchor=0, gaussians=gaussians)
    assert [now.step for now in ticks] == [1, 2, 3, 4]
    result = ticks.result
    assert result.done.all()
    joints = [result.joints()[k].joint for k in (1, 2)]
    assert sorted(joint.kind for joint in joints) == ["prismatic", "revolute"]
    for true in cabinet.truth.joints:
        mine = next(joint for joint in joints if joint.kind == true.kind)
        assert abs(mine.axis @ true.axis) > np.cos(np.radians(0.5))
        assert abs(np.ptp(mine.values) - np.ptp(true.values)) < 5e-3
    going_on = gsjax.parts(cabinet, config, after=ticks.tick)
    assert next(going_on, None) is None


def test_an_anchor_that_is_neither_state_is_refused(cabinet):
    with pytest.raises(ValueError, match="anchor: expected a frame from 0 to 1, found 2"):
        gsjax.parts(cabinet, anchor=2)


@pytest.fixture(scope="module")
def corner():
    """Points on three faces of a box, which determine its motion."""
    flat = np.stack(np.meshgrid(np.linspace(0, 0.3, 21), np.linspace(0, 0.2, 15)), -1).reshape(-1, 2)
    points, normals = [], []
    for axis in range(3):
        points.append(np.insert(flat, axis, 0.0, axis=1))
        normals.append(np.tile(-np.eye(3)[axis], (len(flat), 1)))
    points, normals = np.concatenate(points), np.concatenate(normals)
    nothing, bright = np.zeros_like(points), np.full(len(points), 0.5)
    return Surface(points, normals, np.full_like(points, 0.5), nothing, bright, nothing)


@pytest.mark.thorough
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31 - 1))
def test_a_motion_near_a_guess_is_found(corner, seed):
    random = np.random.default_rng(seed)
    true, off = (np.eye(4) for _ in range(2))
    true[:3, :3] = Rotation.from_rotvec(random.normal(size=3)).as_matrix()
    true[:3, 3] = random.normal(size=3)
    off[:3, :3] = Rotation.from_rotvec(0.03 * random.normal(size=3)).as_matrix()
    off[:3, 3] = 0.01 * random.normal(size=3)
    after = corner._replace(points=moved(true, corner.points), normals=rotated_normals(true, corner.normals))
    target = Target(after, 0.005, after.points.min(0) - 0.1, after.points.max(0) + 0.1)
    result = registered(true @ off, corner, target, 0.05, 0.01, rounds=25)
    assert gap(result, true, corner.points) < 1.5e-3


def test_a_plate_that_may_slide_along_its_hinge_does_not(corner):
    """A plane determines neither the position within it nor a translation along a hinge that lies in it."""
    face = Surface(*(values[: len(values) // 3] for values in corner))
    true, guess = np.eye(4), np.eye(4)
    true[:3, :3] = Rotation.from_rotvec([0, 0, 1.0]).as_matrix()
    guess[:3, :3], guess[:3, 3] = true[:3, :3], (0, 0, 0.03)
    after = face._replace(points=moved(true, face.points), normals=rotated_normals(true, face.normals))
    target = Target(after, 0.005, after.points.min(0) - 0.1, after.points.max(0) + 0.1)
    assert abs(registered(guess, face, target, 0.05, 0.01, rounds=30)[2, 3]) < 2e-3


def test_guesses_are_rigid_and_the_axes_those_of_the_normals(corner):
    axes = axes_of(np.concatenate([corner.normals, -corner.normals]))
    np.testing.assert_allclose(np.abs(axes @ np.eye(3)).max(1), 1, atol=1e-6)
    motions = guesses(corner.points, axes, 1.0)
    rotations = motions[:, :3, :3]
    np.testing.assert_allclose(
        rotations @ np.swapaxes(rotations, 1, 2), np.tile(np.eye(3), (len(motions), 1, 1)), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1)
    for few in (np.zeros((0, 3)), np.tile([[0.0, 0.0, 1.0]], (9, 1))):  # no normals, or a single direction
        np.testing.assert_allclose(axes_of(few) @ axes_of(few).T, np.eye(3), atol=1e-9)


def test_a_surface_knows_its_edges_and_the_slope_of_its_brightness(cabinet):
    """On a sheet whose brightness increases along x."""
    flat = np.stack(np.meshgrid(np.arange(0, 0.4, 0.01), np.arange(0, 0.2, 0.01), indexing="ij"), -1)
    points = np.insert(flat.reshape(-1, 2), 2, 0.0, axis=1)
    normals, colors = np.tile([0, 0, 1.0], (len(points), 1)), np.tile(0.2 + points[:, :1], 3)
    outward, brightness, slope = around(points, normals, colors, 0.01)
    ends = outward.any(-1)
    border = ((flat < 0.005) | (flat > flat.max((0, 1)) - 0.005)).any(-1).ravel()
    assert ends[border].all()
    assert not ends[((flat > 0.025) & (flat < flat.max((0, 1)) - 0.025)).all(-1).ravel()].any()
    left = (points[:, 0] == 0) & (points[:, 1] > 0.05) & (points[:, 1] < 0.15)
    np.testing.assert_allclose(outward[left], np.tile([-1.0, 0, 0], (left.sum(), 1)), atol=0.1)
    np.testing.assert_allclose(brightness, colors[:, 0], atol=2e-3)
    np.testing.assert_allclose(slope[~ends], np.tile([1.0, 0, 0], ((~ends).sum(), 1)), atol=0.05)


def test_cameras_see_surfaces_see_through_points_before_them_and_nothing_behind(cabinet):
    frame = cabinet.frame(0)
    pixel = pixel_width(frame)
    surface = surface_of(frame, 2 * pixel)
    there = evidence(surface.points, surface.normals, frame, 2 * pixel)
    assert (there.there > 0).mean() > 0.95
    assert there.share.mean() < 0.02
    before = evidence(surface.points + 6 * pixel * surface.normals, None, frame, 2 * pixel)
    assert np.median(before.share) > 0.7
    below = surface.points[np.abs(surface.points[:, 2]) < pixel] - (0, 0, 0.2)
    assert not evidence(below, None, frame, 2 * pixel).seen.any()


def test_what_nothing_is_known_of_takes_the_label_around_it(corner):
    links = connections(corner, 0.015)
    assert abs(links - links.T).max() < 1e-12
    costs = np.full((len(corner.points), 2), 0.4)
    costs[: len(costs) // 3 : 5, 0], costs[len(costs) // 3 :: 5, 1] = 0.0, 0.0
    motions = [np.eye(4), slide(9.0, 0)]
    labels = labels_of(costs, links, corner, motions, 0.015)
    assert (labels[: len(costs) // 3] == 0).mean() > 0.9
    assert (labels[len(costs) // 3 :] == 1).mean() > 0.9


@pytest.mark.parametrize("slides", [False, True])
def test_a_hidden_wall_does_not_follow_what_slides_along_it(slides):
    """Regression test: a wall behind a drawer was labelled as sliding, as its hidden points fit that, too."""
    along, up = np.meshgrid(np.arange(0, 1, 0.01), np.arange(0, 0.2, 0.01), indexing="ij")
    points = np.stack([along.ravel(), up.ravel(), np.zeros(along.size)], -1)
    plain = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    wall = Surface(points, plain, np.full_like(points, 0.5), *around(points, plain, plain, 0.01))
    x, costs = points[:, 0], np.zeros((len(points), 2))
    costs[x < 0.4, 0] = 0.4  # hidden
    costs[x < 0.1, 1] = 0.4  # would be hidden
    costs[x >= 0.7, 1] = 0.0 if slides else 1.0  # would stick out
    costs[:, 0] += slides * (x < 0.4) * 0.6  # seen through instead
    motions = [np.eye(4), slide(0.3, 0)]
    labels = labels_of(costs, connections(wall, 0.01), wall, motions, 0.015)
    assert (labels[(x > 0.05) & (x < 0.35)] == slides).all()


@pytest.mark.parametrize(("off", "worth"), [(0.0, 1.0), (0.01, 0.75), (0.018, 0.19)])
def test_a_point_counts_less_the_farther_off_the_plane_it_comes(off, worth):
    """Regression test: drawers that moved five pixels more and less than their mean were found as one."""
    flat = np.stack(np.meshgrid(np.arange(0, 0.4, 0.01), np.arange(0, 0.2, 0.01), indexing="ij"), -1)
    points = np.insert(flat.reshape(-1, 2), 2, 0.0, axis=1)
    normals, colors = np.tile([0, 0, 1.0], (len(points), 1)), np.full_like(points, 0.5)
    sheet = Surface(points, normals, colors, *around(points, normals, colors, 0.01))
    target = Target(sheet, 0.002, points.min(0) - 0.05, points.max(0) + 0.05)
    found = likeness(slide(off, 2), sheet, target, 0.02, 0.15)
    np.testing.assert_allclose(found, worth, atol=1e-6)


def slide(by, axis):
    motion = np.eye(4)
    motion[axis, 3] = by
    return motion


@pytest.mark.thorough
def test_two_states_without_depth_are_refused_unless_all_may_move(cabinet):
    alone = replace(cabinet, load_depth=None)
    assert not has_two_states(alone)
    with pytest.raises(ValueError, match="expected depth of two frames by cameras that stand elsewhere"):
        detect_motion(alone, PartsConfig(), None)
    free = PartsConfig(discover=DiscoverConfig(difference=False))
    assert detect_motion(alone, free, None)[1] is not None
    stands = replace(cabinet, viewmats=np.stack([cabinet.viewmats[0]] * 2))
    assert not has_two_states(stands)
