"""Parts that are hard to find: their truth, their visibility, and invalid arguments."""

import numpy as np
import pytest

from gsjax.data import open_sequence
from gsjax.data.simulated import hard_parts
from gsjax.data.simulated.hard_parts import AMOUNTS
from gsjax.geometry.joints import fit_joint
from gsjax.metrics.tracking import relative_motion

SMALL = {"width": 64, "height": 48, "cameras": 3}


@pytest.mark.parametrize("case", AMOUNTS)
def test_its_joint_explains_its_motion(case):
    sequence = hard_parts(case, **SMALL)
    truth = sequence.truth
    assert truth.names == ("part", "box")
    motions = relative_motion(truth.poses[:, 0])
    points = truth.poses[0, 0, :3, 3] + np.random.default_rng(0).uniform(-0.1, 0.1, (50, 3))
    found, joint = fit_joint(motions, points, noise_m=1e-4), truth.joints[0]
    assert found.kind == joint.kind
    np.testing.assert_allclose(found.joint.values, joint.values, atol=1e-6)
    assert np.ptp(joint.values) == pytest.approx(
        {"wheel": np.deg2rad(80), "thin": np.deg2rad(80), "small": 0.1, "flush": 0.22}[case]
    )


@pytest.mark.parametrize("case", AMOUNTS)
def test_part_and_box_are_seen_to_move_and_the_rest_is_not(case):
    sequence = hard_parts(case, **SMALL)
    labels = [sequence.mask(t, 1) for t in (0, 15)]
    assert [set(np.unique(each)) for each in labels] == [{0, 1, 2}] * 2
    for label in (1, 2):
        assert ((labels[0] == label) != (labels[1] == label)).any()
    stays = (labels[0] == 0) & (labels[1] == 0)
    np.testing.assert_array_equal(*(sequence.depth(t, 1)[stays] for t in (0, 15)))


def test_the_amount_controls_the_difficulty():
    few, many = (hard_parts("wheel", spokes, width=160, height=120, cameras=3) for spokes in (3, 12))
    assert (many.mask(0, 1) == 1).sum() > 1.15 * (few.mask(0, 1) == 1).sum()
    thick, thin = (hard_parts("thin", wide, **SMALL) for wide in (0.04, 0.01))
    assert (thick.mask(0, 1) == 1).sum() > 2 * (thin.mask(0, 1) == 1).sum()
    assert hard_parts("small", 0.003, **SMALL).truth.joints[0].values[-1] == pytest.approx(0.003)
    near, far = (
        np.nanmean(np.where(flush.mask(0, 1) == 1, flush.depth(0, 1), np.nan))
        for flush in (hard_parts("flush", amount, **SMALL) for amount in (0.03, 0.001))
    )
    assert far - near > 0.015


def test_fewer_frames_are_the_beginning():
    long, short = hard_parts("flush", **SMALL), hard_parts("flush", frames=6, **SMALL)
    np.testing.assert_array_equal(short.truth.poses, long.truth.poses[:6])
    np.testing.assert_array_equal(short.image(5, 2), long.image(5, 2))


def test_it_is_opened_by_name():
    sequence = open_sequence(
        "simulated:hard_parts?case=thin&amount=0.01&frames=2&width=16&height=12&cameras=1"
    )
    assert sequence.name == "hard_parts_thin_0.01"
    with pytest.raises(ValueError, match="amount must be a number, got 'thick'"):
        open_sequence("simulated:hard_parts?amount=thick")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"case": "square"}, "case: expected one of wheel, small, thin, flush, found 'square'"),
        ({"case": "wheel", "amount": 1.0}, "amount: expected 2 or more spokes, found 1.0"),
        ({"case": "thin", "amount": -0.1}, "amount: expected more than 0 metres, found -0.1"),
        ({"cameras": 0}, "cameras must be at least 1, got 0"),
    ],
)
def test_invalid_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        hard_parts(**arguments)
