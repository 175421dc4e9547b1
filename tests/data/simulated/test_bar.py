"""The built-in scene of a bar that twists and bends: images, depth, flow and tracks agree."""

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from gsjax.data import Truth, open_sequence
from gsjax.data.simulated import bar
from tests.data.scene_helpers import interpolate, project_points

BAR, BASE, BLOCK = 1, 2, 3


@pytest.fixture(scope="module")
def scene():
    return bar()


def only_bar_around(sequence, t, c, pixels):
    """Whether all pixels within two of each position show the bar."""
    other = binary_dilation(sequence.mask(t, c) != BAR, np.ones((5, 5)))
    return interpolate(other, pixels) == 0


def test_it_is_as_documented(scene):
    assert (scene.num_frames, scene.num_cameras, scene.width, scene.height) == (30, 8, 320, 240)
    np.testing.assert_allclose(np.diff(scene.times), 1 / 15)
    assert scene.truth.names == ("base", "block")
    assert scene.truth.label_ids.tolist() == [BASE, BLOCK]
    assert scene.truth.tracks.shape == (30, 470, 3)
    assert scene.truth.tracks.dtype == np.float64
    base, block = scene.truth.poses[:, 0], scene.truth.poses[:, 1]
    assert (base == base[0]).all()
    assert np.linalg.norm(block[-1, :3, 3] - block[0, :3, 3]) > 0.19
    for c in range(8):
        for t in (0, 29):
            mask = scene.mask(t, c)
            assert (mask == BAR).sum() > 1500
            border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
            assert not border.any()  # nothing that moves leaves the picture


@pytest.mark.parametrize("t", [0, 29])
def test_depth_agrees_with_tracks(scene, t):
    """The bar's depth never lies behind its tracked points, almost all of which are seen by some camera."""
    seen = np.zeros(scene.truth.tracks.shape[1], bool)
    for c in range(8):
        pixels, depths = project_points(scene, t, c, scene.truth.tracks[t])
        behind = interpolate(scene.depth(t, c), pixels) - depths
        inner = only_bar_around(scene, t, c, pixels)
        assert inner.mean() > 0.35
        assert behind[inner].max() < 1e-3
        at = np.abs(behind) < 1e-3
        assert (at & inner).mean() > 0.1
        seen |= at
    assert seen.mean() > (0.99 if t == 0 else 0.8)  # the lower side of the bent bar faces the floor


@pytest.mark.parametrize(("t", "c"), [(10, 1), (16, 4), (20, 6)])
def test_flow_agrees_with_tracks(scene, t, c):
    (now, depths), (then, _) = (project_points(scene, u, c, scene.truth.tracks[u]) for u in (t, t + 1))
    at = np.abs(interpolate(scene.depth(t, c), now) - depths) < 5e-4
    at &= only_bar_around(scene, t, c, now)
    assert at.sum() > 50
    flow = np.stack([interpolate(scene.flow(t, c)[..., i], now) for i in range(2)], 1)
    assert np.linalg.norm((then - now)[at], axis=1).max() > 1
    error = np.linalg.norm(flow - (then - now), axis=1)[at]
    assert np.median(error) < 0.01
    assert error.max() < 0.15


@pytest.mark.thorough
def test_the_pattern_sticks_to_the_bar(scene):
    """Brightness moves with the flow, which explains it far better than no motion."""
    t, c = 12, 1
    first, second = scene.image(t, c).astype(float).mean(-1), scene.image(t + 1, c).astype(float).mean(-1)
    y, x = np.nonzero((scene.mask(t, c) == BAR) & (scene.mask(t + 1, c) == BAR))
    places = np.stack([x + 0.5, y + 0.5], 1)
    warped = np.abs(interpolate(second, places + scene.flow(t, c)[y, x]) - first[y, x])
    unmoved = np.abs(second[y, x] - first[y, x])
    assert np.mean(warped) < 0.35 * np.mean(unmoved)


@pytest.mark.parametrize("seed", range(6))
def test_tracks_move_as_far_as_promised(seed):
    tracks = bar(seed, width=8, height=6, cameras=1).truth.tracks
    straight = tracks[0] - [0, 0, 0.31]
    assert np.abs(straight).max(0) == pytest.approx([0.05, 0.036, 0.25], abs=1e-9)
    assert np.linalg.norm(np.diff(tracks, axis=0), axis=-1).max() < 0.03  # metres a frame
    np.testing.assert_array_equal(tracks[28], tracks[29])
    low = straight[:, 2] < -0.24
    assert np.abs(tracks[:, low] - tracks[0, low]).max() < 0.005  # the foot is held
    top = tracks[:, np.isclose(straight[:, 2], 0.25)]
    up = np.cross(top[:, 1] - top[:, 0], top[:, -1] - top[:, 0])
    lean = np.degrees(np.arccos(np.abs(up[:, 2]) / np.linalg.norm(up, axis=1)))
    assert 45 <= lean[-1] <= 70
    assert (np.diff(lean) > -1e-4).all()


def test_seeds_decide_and_fewer_frames_are_the_beginning():
    long, short = bar(2, width=48, height=36), bar(2, frames=8, width=48, height=36)
    np.testing.assert_array_equal(short.truth.tracks, long.truth.tracks[:8])
    np.testing.assert_array_equal(short.truth.poses, long.truth.poses[:8])
    np.testing.assert_array_equal(short.image(7, 3), long.image(7, 3))
    other = bar(3, width=8, height=6)
    assert np.abs(other.truth.tracks[29] - long.truth.tracks[29]).max() > 0.02
    np.testing.assert_allclose(other.truth.tracks[0], long.truth.tracks[0], atol=1e-9)


def test_still_is_still_and_selections_keep_their_tracks():
    still = bar(frames=6, width=48, height=36, still=True)
    np.testing.assert_array_equal(still.image(5, 0), still.image(0, 0))
    np.testing.assert_allclose(still.flow(4, 0), 0, atol=1e-6)
    np.testing.assert_array_equal(still.truth.tracks[5], still.truth.tracks[0])
    some = bar(frames=9, width=8, height=6, cameras=1).select(slice(2, 9, 3))
    np.testing.assert_array_equal(some.truth.tracks, bar(frames=9).truth.tracks[[2, 5, 8]])


def test_it_is_opened_by_name():
    sequence = open_sequence("simulated:bar?seed=1&frames=2&width=16&height=12&cameras=4&still=true")
    assert (sequence.name, sequence.num_frames, sequence.num_cameras) == ("bar_seed1", 2, 4)
    assert open_sequence("simulated:bar").num_frames == 30


@pytest.mark.parametrize("name", ["frames", "width", "height", "cameras"])
def test_counts_must_be_positive(name):
    with pytest.raises(ValueError, match=f"{name} must be at least 1, got 0"):
        bar(**{name: 0})


@pytest.mark.parametrize("shape", [(2, 5, 3), (3, 5, 2), (3, 5), (3,)])
def test_tracks_that_do_not_fit_their_poses(shape):
    poses = np.tile(np.eye(4), (3, 0, 1, 1))
    Truth((), np.zeros(0, int), poses, tracks=np.zeros((3, 5, 3)))
    with pytest.raises(ValueError, match=r"tracks must have shape \(3, "):
        Truth((), np.zeros(0, int), poses, tracks=np.zeros(shape))
