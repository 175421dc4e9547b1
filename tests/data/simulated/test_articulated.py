"""Furniture that opens, and its joints."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gsjax.data import DataError, Truth, open_sequence, read_panoptic, write_panoptic
from gsjax.data.simulated import articulated, tabletop
from gsjax.geometry.joints import Joint, fit_joint
from gsjax.io.atomic import write_json, write_npz

NAMES = ("drawer", "door", "lid", "box", "shut door")
seeds = st.integers(0, 10_000)


@pytest.fixture(scope="module")
def scene():
    return articulated(width=160, height=120)


def test_joints_that_do_not_fit_their_objects():
    poses, joint = np.tile(np.eye(4), (3, 1, 1, 1)), Joint("revolute", np.eye(3)[0], np.zeros(3), np.zeros(2))
    with pytest.raises(ValueError, match="values of the joint of lid"):
        Truth(("lid",), np.array([1]), poses, joints=(joint,))
    with pytest.raises(ValueError, match="joints"):
        Truth(("lid",), np.array([1]), poses, joints=(None, None))


@pytest.mark.parametrize("seed", [0, 3, 11])
def test_parts_move_as_their_joints_say(seed):
    truth = articulated(seed, width=8, height=6, cameras=1).truth
    assert truth.names == NAMES
    for k, joint in enumerate(truth.joints):
        if joint is not None:
            assert joint.values[0] == 0.0
            np.testing.assert_allclose(joint.motions() @ truth.poses[0, k], truth.poses[:, k], atol=1e-12)
    drawer, door, lid, box, shut = truth.joints
    assert box is None
    assert (drawer.kind, door.kind, lid.kind) == ("prismatic", "revolute", "revolute")
    assert drawer.values[-1] >= 0.16
    assert np.rad2deg([door.values[-1], lid.values[-1]]).min() >= 55
    assert not shut.values.any()
    assert lid.motions()[-1, 2, 0] > 0  # its front, which is at +x, goes up


@given(seeds)
def test_not_all_begin_at_once_and_steps_are_small(seed):
    truth = articulated(seed, width=8, height=6, cameras=1).truth
    moves = np.linalg.norm(np.diff(truth.poses, axis=0), axis=(2, 3))  # [T-1, parts]
    begins = [int(np.argmax(moves[:, k] > 1e-6)) for k in range(4)]
    assert sorted(begins) == [0, 4, 9, 16]
    assert not moves[:, 4].any()
    assert not moves[36:].any()
    steps = Rotation.from_matrix(
        (truth.poses[1:, :, :3, :3] @ truth.poses[:-1, :, :3, :3].swapaxes(2, 3)).reshape(-1, 3, 3)
    )
    assert np.rad2deg(steps.magnitude()).max() < 11
    assert np.linalg.norm(np.diff(truth.poses[..., :3, 3], axis=0), axis=-1).max() < 0.04


@pytest.mark.parametrize("t", [0, 39])
def test_depth_labels_and_poses_agree(scene, t):
    """Visible points of a part, mapped back to its own frame, lie within its extent."""
    seen = set()
    for c in range(0, scene.num_cameras, 3):
        camera, mask, depth = scene.camera(t, c), scene.mask(t, c), scene.depth(t, c)
        y, x = np.nonzero(mask > 0)
        rays = np.stack([x + 0.5, y + 0.5, np.ones(len(x))], 1) @ np.linalg.inv(np.asarray(camera.K)).T
        points = np.concatenate([rays * depth[y, x, None], np.ones((len(x), 1))], 1)
        world = points @ np.linalg.inv(np.asarray(camera.viewmat, np.float64)).T
        for k in range(len(NAMES)):
            of_part = mask[y, x] == scene.truth.label_ids[k]
            local = world[of_part] @ np.linalg.inv(scene.truth.poses[t, k]).T
            if of_part.any():
                seen.add(NAMES[k])
                assert np.abs(local[:, :3]).max() < 0.27
        assert {6, 7} & set(np.unique(mask))
    assert seen == set(NAMES)


def test_parts_are_where_their_furniture_is(scene):
    """The box stays in front of the furniture, and the door's hinge stays beside the chest."""
    truth = scene.truth
    box = truth.poses[:, 3, :3, 3]
    assert (box[:, 0] > 0.16 + 0.05).all()  # in front of the furniture
    assert (np.abs(truth.poses[0, :3, 1, 3] - [-0.22, -0.09, 0.36]) < 1e-9).all()


@pytest.mark.parametrize("seed", range(4))
def test_the_joints_are_found_in_the_motions(seed):
    truth = articulated(seed, width=8, height=6, cameras=1).truth
    rng = np.random.default_rng(seed)
    for k, joint in enumerate(truth.joints):
        motions = truth.poses[:, k] @ np.linalg.inv(truth.poses[0, k])
        points = truth.poses[0, k, :3, 3] + rng.uniform(-0.1, 0.1, (20, 3))
        found = fit_joint(motions, points)
        if joint is None or not joint.values.any():
            assert found.kind == ("free" if joint is None else "fixed")
            assert found.joint is None
        else:
            assert found.kind == joint.kind
            assert found.joint.axis @ joint.axis > 1 - 1e-9
            np.testing.assert_allclose(found.joint.values, joint.values, atol=1e-9)
            assert found.confidence > 0.99


def test_a_selection_keeps_its_joints():
    some = articulated(width=8, height=6, cameras=1).select(slice(10, 30, 5))
    assert [joint and len(joint.values) for joint in some.truth.joints] == [4, 4, 4, None, 4]


def test_fewer_frames_are_the_beginning_and_still_is_still():
    long, short = articulated(2, width=32, height=24), articulated(2, frames=8, width=32, height=24)
    np.testing.assert_array_equal(short.truth.poses, long.truth.poses[:8])
    np.testing.assert_array_equal(short.image(7, 3), long.image(7, 3))
    still = articulated(frames=3, width=16, height=12, still=True)
    np.testing.assert_array_equal(still.truth.poses[2], still.truth.poses[0])


def test_it_is_opened_by_name():
    sequence = open_sequence("simulated:articulated?seed=1&frames=2&width=16&height=12&cameras=4")
    assert (sequence.num_frames, sequence.num_cameras) == (2, 4)
    with pytest.raises(ValueError, match="cameras must be at least 1, got 0"):
        articulated(cameras=0)


@pytest.fixture
def saved(tmp_path):
    """A Panoptic folder whose truth has parts, one of them with a joint."""
    frames, recording = 4, tmp_path / "door"
    write_panoptic(tabletop(frames=frames, width=16, height=12, cameras=1), recording)
    how = {"type": "hinge", "axis_world": [0.0, 0.0, 1.0], "point_world": [1.0, 0.0, 0.0]}
    write_json(recording / "meta.json", {"parts": ["door", "box"], "joints": {"door": how}})
    poses = np.tile(np.eye(4), (frames, 2, 1, 1))
    write_npz(recording / "truth.npz", {"T_wp": poses, "q": 0.1 * np.arange(frames)[:, None]})
    return recording


def test_joints_are_read(saved):
    door, box = read_panoptic(saved).truth.joints
    assert box is None
    assert door.kind == "revolute"
    np.testing.assert_allclose(door.values, 0.1 * np.arange(len(door.values)))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"type": "ball"}, "joints with type (slide or hinge), axis_world and point_world"),
        ({"axis_world": [0.0, 0.0, 3.0]}, "length 3"),
        ({"point_world": "here"}, "joints with type"),
    ],
)
def test_joints_that_cannot_be_read(saved, change, says):
    how = {"type": "hinge", "axis_world": [0.0, 0.0, 1.0], "point_world": [1.0, 0.0, 0.0]} | change
    write_json(saved / "meta.json", {"parts": ["door", "box"], "joints": {"door": how}})
    with pytest.raises(DataError) as caught:
        read_panoptic(saved)
    assert says in str(caught.value)
    assert "meta.json" in str(caught.value)


def test_values_of_another_length(saved):
    write_npz(saved / "truth.npz", {"T_wp": np.tile(np.eye(4), (4, 2, 1, 1)), "q": np.zeros((4, 3))})
    with pytest.raises(DataError, match=r"q of shape \(4, 1\)"):
        read_panoptic(saved)
