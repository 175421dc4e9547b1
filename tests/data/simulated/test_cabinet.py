"""The built-in cabinet: two states, each seen by its own cameras, and their ground truth."""

import numpy as np
import pytest

from gsjax.data import open_sequence
from gsjax.data.simulated import cabinet

SMALL = {"width": 64, "height": 48, "cameras": 3}


def test_two_states_are_seen_by_cameras_of_their_own():
    sequence = cabinet(**SMALL)
    assert sequence.num_frames == 2
    assert sequence.has_depth
    assert sequence.has_masks
    apart = np.abs(sequence.viewmats[0] - sequence.viewmats[1]).max(axis=(1, 2))
    assert (apart > 0.01).all()


@pytest.mark.parametrize(("doors", "drawers"), [(1, 0), (0, 2), (3, 2)])
def test_each_part_moves_on_its_joint_and_out_of_the_cabinet(doors, drawers):
    sequence = cabinet(doors, drawers, **SMALL)
    truth = sequence.truth
    assert truth.names[:1] == (("door_1",) if doors else ("drawer_1",))
    assert [joint.kind for joint in truth.joints] == ["revolute"] * doors + ["prismatic"] * drawers
    for k, joint in enumerate(truth.joints):
        np.testing.assert_allclose(joint.motions(), truth.poses[:, k], atol=1e-9)
        assert (joint.values >= 0).all()
        assert np.ptp(joint.values) > 0.3 * (1.8 if joint.kind == "revolute" else 0.23)
        ahead = np.array([0.2, joint.point[1] - np.sign(joint.axis[2]) * 0.1, 0.1, 1.0])
        assert ((truth.poses[:, k] @ ahead)[:, 0] > 0.2 - 1e-9).all()  # open doors and drawers stand out


def test_it_is_the_same_for_a_seed_and_another_for_another():
    one, same, other = (cabinet(seed=seed, **SMALL) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.image(1, 0), same.image(1, 0))
    assert np.abs(one.truth.joints[0].values - other.truth.joints[0].values).max() > 1e-3


def test_by_its_name_and_with_too_few():
    assert open_sequence("simulated:cabinet?doors=2&width=16&height=12&cameras=1").name == "cabinet_2_1"
    with pytest.raises(ValueError, match="parts must be at least 1, got 0"):
        cabinet(0, 0, **SMALL)
    with pytest.raises(ValueError, match="doors, drawers: expected 0 or more of each, found -1 and 3"):
        cabinet(-1, 3, **SMALL)
