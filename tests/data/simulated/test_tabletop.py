"""The built-in tabletop scene: images, depth, labels and flow agree with its poses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsjax.data.simulated import Light, Primitive, Scene, simulated_sequence, tabletop
from gsjax.data.simulated.motion import rigid
from gsjax.geometry.cameras import intrinsics, look_at
from tests.data.simulated.test_raycaster import GREY, HEIGHT, SOLIDS, WIDTH, outside, single

SLOW = pytest.mark.slow


@pytest.fixture(scope="module")
def scene():
    return tabletop(seed=0, frames=60, width=160, height=120)


def world_points(sequence, t, c, mask):
    y, x = np.nonzero(mask)
    pixels = np.stack([x + 0.5, y + 0.5, np.ones(len(x))])
    view = sequence.viewmats[t, c]
    local = np.linalg.inv(sequence.Ks[t, c]) @ pixels * sequence.depth(t, c)[y, x].astype(np.float64)
    return view[:3, :3].T @ (local - view[:3, 3:]), x, y


def test_it_is_as_documented(scene):
    assert scene.truth.names == ("carton", "can", "ball", "block")
    assert scene.truth.label_ids.tolist() == [2, 3, 4, 5]
    assert scene.truth.robot == 1
    assert (scene.num_frames, scene.num_cameras) == (60, 3)
    np.testing.assert_allclose(np.diff(scene.times), 1 / 30)
    for c in range(3):
        assert set(np.unique(scene.mask(0, c))) == {0, 1, 2, 3, 4, 5}
    assert scene.image(0, 0).std() > 20


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=SLOW) for seed in range(2, 8))])
@pytest.mark.parametrize("option", [None, "hide"])
def test_objects_move_as_far_as_promised(seed, option):
    poses = tabletop(seed=seed, width=32, height=24, **({option: True} if option else {})).truth.poses
    steps = np.linalg.norm(np.diff(poses[..., :3, 3], axis=0), axis=-1).max(0)
    turns = np.swapaxes(poses[:-1, :, :3, :3], -1, -2) @ poses[1:, :, :3, :3]
    angles = np.degrees(Rotation.from_matrix(turns.reshape(-1, 3, 3)).magnitude()).reshape(59, 4).max(0)
    assert (steps <= 0.0301).all()
    assert (angles <= 15).all()
    assert (steps[:3] > 0.004).all()
    assert (angles[:3] > 2).all()
    assert steps[3] == 0
    assert poses[:, 0, 2, 3].max() - poses[0, 0, 2, 3] > 0.15  # lifted


@pytest.mark.parametrize("name", ["carton", "can", "ball", "block"])
def test_depth_labels_and_poses_agree(scene, name):
    """Pixels of an object, mapped back to its own frame, lie on its surface in every frame."""
    k = scene.truth.names.index(name)
    solids = {
        "carton": [Primitive("box", (0.045, 0.028, 0.065), GREY)],
        "can": [Primitive("cylinder", (0.034, 0.049), GREY), Primitive("cylinder", (0.030, 0.055), GREY)],
        "ball": [Primitive("sphere", (0.036,), GREY)],
        "block": [Primitive("box", (0.034, 0.034, 0.030), GREY)],
    }[name]
    for t, c in ((0, 0), (10, 1), (22, 2), (59, 1)):
        points, _, _ = world_points(scene, t, c, scene.mask(t, c) == scene.truth.label_ids[k])
        pose = scene.truth.poses[t, k]
        local = pose[:3, :3].T @ (points - pose[:3, 3:])
        distance = np.min([np.abs(outside(solid, local)) for solid in solids], axis=0)
        assert distance.size > 20
        assert distance.max() < 1e-6


def flow_by_poses(sequence, t, c, k):
    """Displacement in pixels of object k from frame t to the next, from its depth and poses."""
    points, x, y = world_points(sequence, t, c, sequence.mask(t, c) == sequence.truth.label_ids[k])
    motion = sequence.truth.poses[t + 1, k] @ np.linalg.inv(sequence.truth.poses[t, k])
    view = sequence.viewmats[t + 1, c] @ motion
    image = sequence.Ks[t + 1, c] @ (view[:3, :3] @ points + view[:3, 3:])
    return (image[:2] / image[2]).T - np.stack([x + 0.5, y + 0.5], 1)


@pytest.mark.parametrize("moving", [False, True])
def test_flow_moves_points_by_their_poses(moving):
    scene = tabletop(seed=2, frames=14, width=160, height=120, moving_cameras=moving)
    for t, c in ((2, 0), (12, 1)):
        flow = scene.flow(t, c)
        for k, label in enumerate(scene.truth.label_ids):
            expected = flow_by_poses(scene, t, c, k)
            np.testing.assert_allclose(flow[scene.mask(t, c) == label], expected, atol=1e-4)
        still = np.abs(flow[scene.mask(t, c) == 0]).max()
        assert (still > 0.1) == moving


def test_flow_of_a_selection_spans_the_frames_left_out(scene):
    part = scene.select([0, 10, 20])
    flow = part.flow(0, 0)[part.mask(0, 0) == 3]
    np.testing.assert_allclose(flow, flow_by_poses(part, 0, 0, k=1), atol=1e-4)
    assert np.linalg.norm(flow, axis=1).min() > 5


def test_flow_warps_one_image_onto_the_next(scene):
    """Brightness is preserved, except where shadows move."""
    first, second = scene.image(4, 1).astype(float).mean(-1), scene.image(5, 1).astype(float).mean(-1)
    can = scene.mask(4, 1) == 3
    y, x = np.nonzero(can)
    target = np.floor(np.stack([x, y], 1) + 0.5 + scene.flow(4, 1)[can]).astype(int)
    kept = scene.mask(5, 1)[target[:, 1], target[:, 0]] == 3
    warped = np.abs(second[target[kept, 1], target[kept, 0]] - first[y[kept], x[kept]])
    unmoved = np.abs(second[y[kept], x[kept]] - first[y[kept], x[kept]])
    assert np.mean(warped) < 0.6 * np.mean(unmoved)


def test_pixels_that_see_nothing():
    sequence = single(SOLIDS[1], rigid(None, [0.0, 0.0, 3.0]))
    scene = Scene(
        primitives=(SOLIDS[1],),
        labels=np.array([1]),
        poses=np.tile(rigid(None, [0.0, 0.0, 3.0]), (2, 1, 1, 1)),
        light=Light((1.0, 0.0, 0.0)),
        Ks=np.tile(intrinsics(WIDTH, WIDTH, HEIGHT), (2, 1, 1, 1)),
        viewmats=np.tile(np.eye(4), (2, 1, 1, 1)),
        width=WIDTH,
        height=HEIGHT,
    )
    moving = simulated_sequence("two frames", scene, np.arange(2.0), {"ball": 0})
    empty = sequence.mask(0, 0) == 0
    assert (sequence.depth(0, 0)[empty] == 0).all()
    assert (sequence.image(0, 0)[0, 0] == 0).all()
    flow = moving.flow(0, 0)
    np.testing.assert_array_equal(np.isnan(flow[..., 0]), empty)
    np.testing.assert_allclose(flow[~empty], 0, atol=1e-9)


def test_seeds_decide_and_fewer_frames_are_the_beginning(scene):
    short = tabletop(seed=0, frames=3, width=160, height=120)
    np.testing.assert_array_equal(short.truth.poses, scene.truth.poses[:3])
    np.testing.assert_array_equal(short.image(2, 1), scene.image(2, 1))
    assert not np.array_equal(tabletop(seed=1, frames=1).truth.poses[0], scene.truth.poses[0])


def test_one_frame_one_camera_one_pixel():
    sequence = tabletop(frames=1, cameras=1, width=1, height=1)
    assert sequence.depth(0, 0).shape == (1, 1)


def test_a_still_scene():
    sequence = tabletop(frames=20, width=64, height=48, still=True)
    np.testing.assert_array_equal(sequence.image(0, 0), sequence.image(19, 0))
    np.testing.assert_allclose(sequence.flow(0, 0), 0, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_the_can_leaves_all_views(seed):
    sequence = tabletop(seed=seed, frames=60, width=160, height=120, leave=True)
    seen = [[(sequence.mask(t, c) == 3).any() for c in range(3)] for t in (0, 59)]
    assert seen == [[True] * 3, [False] * 3]


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=SLOW) for seed in (1, 2))])
def test_the_can_is_hidden_and_comes_back(seed):
    sequence = tabletop(seed=seed, frames=60, width=160, height=120, hide=True)
    seen = [[(sequence.mask(t, c) == 3).any() for c in range(3)] for t in (0, 20, 59)]
    assert seen == [[True] * 3, [False] * 3, [True] * 3]


def test_cameras_may_move():
    sequence = tabletop(frames=10, width=64, height=48, moving_cameras=True)
    assert not np.allclose(sequence.viewmats[0], sequence.viewmats[9])
    assert np.allclose(tabletop(frames=2, width=64, height=48).viewmats[0], sequence.viewmats[0])


def test_the_caller_may_write_into_an_image(scene):
    before = scene.image(0, 0)
    before[:] = 0
    assert scene.image(0, 0).any()


@pytest.mark.parametrize("name", ["frames", "width", "height", "cameras"])
def test_counts_must_be_positive(name):
    with pytest.raises(ValueError, match=f"{name} must be at least 1, got 0"):
        tabletop(**{name: 0})


def test_cameras_look_at_the_table(scene):
    eye = -scene.viewmats[0, 0, :3, :3].T @ scene.viewmats[0, 0, :3, 3]
    np.testing.assert_allclose(look_at(eye, np.array([-0.03, 0.0, 0.04])), scene.viewmats[0, 0], atol=1e-12)
