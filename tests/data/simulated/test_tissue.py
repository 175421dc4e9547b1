"""A sheet deformed by bumps: properties of its map, ray intersections, and the built-in tissue scene."""

import warnings

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import binary_dilation

from gsjax.data import open_sequence
from gsjax.data.simulated import tissue
from gsjax.data.simulated.sheet import Sheet
from tests.data.scene_helpers import interpolate, project_points

seeds = st.integers(0, 10_000)
TOOL = 1


def some_sheet(seed):
    """A random sheet with gentle bumps, and the random generator."""
    rng = np.random.default_rng(seed)
    places, widths = rng.uniform(-0.05, 0.05, (3, 2)), rng.uniform(0.02, 0.04, (3, 1))
    shifts = rng.uniform(-1, 1, (3, 3)) * widths * [0.25, 0.25, 0.3]
    return Sheet(tuple(np.concatenate([places, widths, shifts], axis=1).ravel())), rng


def flat_points(rng, count=100):
    points = rng.uniform(-0.1, 0.1, (3, count))
    points[2] = 0
    return points


# The sheet


def test_one_bump_is_its_formula():
    sheet = Sheet((0.01, 0.02, 0.03, 0.004, -0.005, 0.006))
    middle, one_width_off = [0.01, 0.02, 0.0], [0.01, 0.05, 0.1]
    found = sheet.deform(np.array([middle, one_width_off]).T).T
    shift = np.array([0.004, -0.005, 0.006])
    np.testing.assert_allclose(found, [middle + shift, one_width_off + shift * np.exp(-0.5)], rtol=1e-12)


@given(seeds)
def test_there_and_back(seed):
    sheet, rng = some_sheet(seed)
    points = rng.uniform(-0.1, 0.1, (3, 100))
    np.testing.assert_allclose(sheet.undo(sheet.deform(points)), points, atol=1e-9)


@given(seeds)
def test_normals_are_perpendicular_to_the_surface(seed):
    sheet, rng = some_sheet(seed)
    rest = flat_points(rng)
    normals = sheet.normals(rest)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=0), 1)
    assert (normals[2] > 0).all()
    for axis in np.eye(3)[:2]:
        along = (sheet.deform(rest + 1e-6 * axis[:, None]) - sheet.deform(rest - 1e-6 * axis[:, None])) / 2e-6
        np.testing.assert_allclose(np.sum(normals * along, axis=0), 0, atol=1e-8)


@given(seeds)
def test_rays_meet_the_surface_and_nothing_before(seed):
    sheet, rng = some_sheet(seed)
    eye = np.array([*rng.uniform(-0.02, 0.02, 2), 0.12])
    rays = np.stack([*rng.uniform(-0.6, 0.6, (2, 50)), np.full(50, -1.0)])
    s = sheet.enter(eye, rays)
    np.testing.assert_allclose(sheet.undo(eye[:, None] + s * rays)[2], 0, atol=1e-9)
    before = eye[:, None, None] + np.linspace(0, 0.999, 60)[:, None] * (s * rays)[:, None]
    assert (sheet.undo(before.reshape(3, -1))[2] > 0).all()


def test_rays_meet_the_first_side_of_a_steep_bump():
    """Newton's method alone finds a later crossing of some rays, and none of others."""
    sheet = Sheet((0.0, 0.0, 0.019, 0.01, 0.008, 0.05))
    eye = np.array([-0.006, -0.022, 0.105])
    rays = np.stack([*np.meshgrid(np.linspace(-0.6, 0.6, 30), np.linspace(-0.6, 1, 30)), -np.ones((30, 30))])
    rays = rays.reshape(3, -1)
    s = sheet.enter(eye, rays)
    np.testing.assert_allclose(sheet.undo(eye[:, None] + s * rays)[2], 0, atol=1e-9)
    before = eye[:, None, None] + np.linspace(0, 0.999, 100)[:, None] * (s * rays)[:, None]
    assert (sheet.undo(before.reshape(3, -1))[2] > -1e-4).all()


def test_rays_that_rise_meet_nothing():
    sheet, _ = some_sheet(0)
    rays = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, -1.0]])
    assert np.isinf(sheet.enter(np.array([0.0, 0.0, 0.1]), rays)).tolist() == [True, True, False]


@pytest.mark.parametrize("bumps", [(0.0,) * 6, (0.0, 0.0, -1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)])
def test_invalid_bumps_are_refused(bumps):
    with pytest.raises(ValueError, match="bumps must be x, y, a width above 0 and a shift each, got"):
        Sheet(bumps)


# The built-in scene


@pytest.fixture(scope="module")
def scene():
    return tissue(width=160, height=128)


def only_tissue_around(sequence, t, c, pixels):
    """Whether a position is in the image and no pixel within two of it shows the tool."""
    inside = ((pixels > 2) & (pixels < [sequence.width - 2, sequence.height - 2])).all(1)
    tool = binary_dilation(sequence.mask(t, c) == TOOL, np.ones((5, 5)))
    return inside & (interpolate(tool, pixels) == 0)


def seen_pixels(sequence, t, c):
    """Rows, columns and world points of the tissue that a camera sees."""
    y, x = np.nonzero(sequence.mask(t, c) == 0)
    pixels = np.stack([x + 0.5, y + 0.5, np.ones(len(x))])
    local = np.linalg.inv(sequence.Ks[t, c]) @ pixels * sequence.depth(t, c)[y, x]
    view = sequence.viewmats[t, c]
    return y, x, (view[:3, :3].T @ (local - view[:3, 3:])).T


def test_it_is_as_documented(scene):
    assert (scene.num_frames, scene.camera_ids) == (40, (0, 1))
    np.testing.assert_allclose(np.diff(scene.times), 1 / 15)
    assert (scene.truth.names, scene.truth.label_ids.tolist()) == (("tool",), [TOOL])
    assert scene.truth.tracks.shape == (40, 841, 3)
    to_right = np.linalg.inv(scene.viewmats[:, 0]) @ [*np.zeros(3), 1] - (
        np.linalg.inv(scene.viewmats[:, 1]) @ [*np.zeros(3), 1]
    )
    np.testing.assert_allclose(np.linalg.norm(to_right, axis=1), 0.0045)
    eyes = np.linalg.inv(scene.viewmats[:, 0])[:, :3, 3]
    assert 0.003 < np.linalg.norm(eyes - eyes[0], axis=1).max() < 0.008
    for t in (0, 14, 39):
        share = np.mean(scene.mask(t, 0) == TOOL)
        assert 0.01 < share < 0.2
        assert (scene.depth(t, 0) > 0).all()


@pytest.mark.parametrize(("t", "c"), [(0, 0), (14, 1), (22, 0)])
def test_depth_agrees_with_tracks(scene, t, c):
    pixels, depths = project_points(scene, t, c, scene.truth.tracks[t])
    shown = only_tissue_around(scene, t, c, pixels)
    assert shown.sum() > 250
    np.testing.assert_allclose(interpolate(scene.depth(t, c), pixels)[shown], depths[shown], atol=1e-4)


def test_flow_agrees_with_tracks(scene):
    t, c = 8, 1
    (now, _), (then, _) = (project_points(scene, u, c, scene.truth.tracks[u]) for u in (t, t + 1))
    shown = only_tissue_around(scene, t, c, now)
    flow = np.stack([interpolate(scene.flow(t, c)[..., i], now) for i in range(2)], 1)
    moved = then - now
    assert np.linalg.norm(moved[shown], axis=1).max() > 1
    np.testing.assert_allclose(flow[shown], moved[shown], atol=0.05)


def test_the_pattern_sticks_to_the_tissue(scene):
    """Brightness moves with the flow, which explains it far better than no motion."""
    t = 8
    first, second = (scene.image(u, 0).astype(float).mean(-1) for u in (t, t + 1))
    places = scene.flow(t, 0) + np.stack(np.meshgrid(np.arange(160), np.arange(128)), -1) + 0.5
    shown = (scene.mask(t, 0) == 0) & (binary_dilation(scene.mask(t + 1, 0) == TOOL, iterations=4) == 0)
    moves = shown & (np.linalg.norm(scene.flow(t, 0), axis=-1) > 0.7)
    assert moves.sum() > 500
    explained = np.abs(interpolate(second, places[moves]) - first[moves]).mean()
    assert explained < 0.4 * np.abs(second[moves] - first[moves]).mean()


def test_both_eyes_see_the_same_tissue(scene):
    """Points seen by the left eye have the same colour where their depth places them in the right one."""
    t = 14
    y, x, points = seen_pixels(scene, t, 0)
    pixels, depths = project_points(scene, t, 1, points)
    both = only_tissue_around(scene, t, 1, pixels)
    np.testing.assert_allclose(interpolate(scene.depth(t, 1), pixels)[both], depths[both], atol=2e-4)
    left, right = (scene.image(t, c).astype(float).mean(-1) for c in (0, 1))
    explained = np.abs(interpolate(right, pixels[both]) - left[y, x][both]).mean()
    assert explained < 0.3 * np.abs(right[y, x][both] - left[y, x][both]).mean()


def test_it_has_fine_detail(scene):
    """Its finest lines are a pixel or two wide: a blur of two pixels removes much of the contrast."""
    image = scene.image(0, 0).astype(np.float64)
    fine = image - cv2.GaussianBlur(image, (0, 0), 2)
    assert fine[scene.mask(0, 0) == 0].std() > 5


@pytest.mark.parametrize("seed", range(6))
def test_tissue_moves_as_far_as_promised_and_faces_the_endoscope(seed):
    sequence = tissue(seed, width=40, height=32)
    tracks = sequence.truth.tracks
    rises = (tracks - tracks[0])[..., 2].max(1)
    assert 0.012 < rises[14] < 0.024
    assert rises[38] < 0.004
    assert np.linalg.norm(np.diff(tracks, axis=0), axis=-1).max() < 0.004  # metres a frame
    tip = sequence.truth.poses[:, 0, :3, 3]
    near = np.linalg.norm(tracks - tip[:, None], axis=-1).min(1)
    assert near[3:28].max() < 0.004  # it holds the tissue, whose points are 4 mm apart
    assert near[39] > 0.015
    for t in (0, 14):  # so that rays meet it only once
        y, x, points = seen_pixels(sequence, t, 0)
        grid = np.full((32, 40, 3), np.nan)
        grid[y, x] = points
        across, down = grid[1:, 1:] - grid[1:, :-1], grid[1:, 1:] - grid[:-1, 1:]
        eye = np.linalg.inv(sequence.viewmats[t, 0])[:3, 3]
        facing = np.sum(np.cross(down, across) * (eye - grid[1:, 1:]), axis=-1)
        assert (facing[np.isfinite(facing)] > 0).all()


def test_seeds_decide_and_fewer_frames_are_the_beginning(scene):
    short = tissue(frames=8, width=160, height=128)
    np.testing.assert_array_equal(short.truth.tracks, scene.truth.tracks[:8])
    np.testing.assert_array_equal(short.image(7, 1), scene.image(7, 1))
    assert np.abs(tissue(1).truth.tracks[14] - scene.truth.tracks[14]).max() > 0.005


def test_still_is_still():
    still = tissue(frames=6, width=40, height=32, still=True)
    np.testing.assert_array_equal(still.image(5, 0), still.image(0, 0))
    np.testing.assert_array_equal(still.truth.tracks[5], still.truth.tracks[0])
    np.testing.assert_array_equal(still.viewmats[5], still.viewmats[0])


def test_it_is_opened_by_name():
    sequence = open_sequence("simulated:tissue?seed=2&frames=3&width=40&height=32")
    assert (sequence.name, sequence.num_frames, sequence.num_cameras) == ("tissue_seed2", 3, 2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert sequence.depth(2, 1).shape == (32, 40)


def test_a_stronger_pull_moves_it_as_much_farther(scene):
    """Displacements scale with the pull, apart from those of breathing, which do not depend on it."""
    far = tissue(pull=2.0, frames=15, width=40, height=32).truth.tracks[14]
    none = tissue(pull=0.0, frames=15, width=40, height=32).truth.tracks[14]
    np.testing.assert_allclose(far - none, 2 * (scene.truth.tracks[14] - none), atol=1e-9)


def test_nothing_is_missed_however_far_it_is_pulled():
    assert (tissue(pull=3.0, frames=15, width=48, height=38).depth(14, 0) > 0).all()


def test_patterns_differ_in_looks_alone():
    looks = ("noise", "checker", "stripes", "label", "vessels")
    scenes = [tissue(pattern=name, frames=1, width=40, height=32) for name in looks]
    assert len({scene.image(0, 0).tobytes() for scene in scenes}) == 5
    assert len({scene.depth(0, 0).tobytes() for scene in scenes}) == 1
    np.testing.assert_array_equal(scenes[-1].image(0, 0), tissue(frames=1, width=40, height=32).image(0, 0))


@pytest.mark.parametrize(("wrong", "match"), [({"pull": 4.0}, "pull"), ({"pattern": "tartan"}, "pattern")])
def test_other_pulls_and_patterns_are_refused(as_users_run, wrong, match):
    with pytest.raises(ValueError, match=f"{match}: expected"):
        tissue(**wrong)


@pytest.mark.parametrize("name", ["frames", "width", "height"])
def test_counts_must_be_positive(name):
    with pytest.raises(ValueError, match=f"{name} must be at least 1, got 0"):
        tissue(**{name: 0})
