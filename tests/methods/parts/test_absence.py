"""Parts that leave or have yet to appear, on boxes with full ground truth."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsjax.engine.drive import drive
from gsjax.methods.parts import RefineConfig
from gsjax.methods.parts.absence import without_blips
from tests.methods.parts.moving_boxes import Box, MovingBoxes, linear
from tests.methods.parts.test_follow import CONFIG, begun

FRAMES = 7
GONE = (4, 5, 6)


def boxes(gone, anchor=0):
    """A box that turns, and one that slides and is absent from some frames; both start from the anchor,
    which is the first or the last frame."""
    order = slice(None, None, -1 if anchor else 1)
    still, turns, there, back = (
        linear(FRAMES, to)[order] for to in ((0, 0, 0), (0, 0, 0.4), (0, 0.08, 0), (0, -0.1, 0))
    )
    first = Box((-0.12, 0, 0.05), (0.12, 0.08, 0.1), turns, there)
    return MovingBoxes([first, Box((0.14, -0.02, 0.04), (0.08, 0.1, 0.08), still, back, gone=gone)])


def found(views, anchor=0, **changes):
    """The result, and the label that the second box has in it."""
    config = replace(CONFIG, refine=RefineConfig(iterations=6), **changes)
    following = drive(*begun(views, views.bodies, config, anchor))
    assert all(bool(np.isfinite(now.info["loss"])) for now in following)
    labels = np.asarray(following.result.scene.labels)
    return following.result, int(np.bincount(labels[views.bodies == 2]).argmax())


@pytest.mark.thorough
@pytest.mark.parametrize(("anchor", "gone"), [(0, GONE), pytest.param(6, (0, 1, 2), marks=pytest.mark.slow)])
def test_a_part_that_leaves_or_is_yet_to_come_is_hidden(anchor, gone):
    views = boxes(gone, anchor)
    result, box = found(views, anchor)
    shown = np.asarray(result.trajectory.opacities)
    true = np.ones(FRAMES)
    true[list(gone)] = 0
    np.testing.assert_array_equal(shown[:, box], true)
    np.testing.assert_array_equal(np.delete(shown, box, 1), 1)
    # It rests where it was last seen, or is first seen; its joint is that of the frames that show it.
    near = 3
    for t in gone:
        np.testing.assert_array_equal(result.poses(t).translations[box], result.poses(near).translations[box])
    joint = result.joints()[box]
    assert joint.kind == "prismatic"
    assert np.ptp(joint.joint.values) == pytest.approx(0.1 * 3 / 6, abs=0.012)
    hidden = np.asarray(result.at(gone[0]).opacities)[views.bodies == 2]
    assert np.median(hidden) < 1e-6


@pytest.mark.slow
def test_where_all_parts_are_there_none_is_hidden():
    result, _ = found(boxes(()))
    np.testing.assert_array_equal(result.trajectory.opacities, 1)


@pytest.mark.slow
def test_it_can_be_left_alone():
    result, _ = found(boxes(GONE), absences=False)
    np.testing.assert_array_equal(result.trajectory.opacities, 1)


@given(st.lists(st.booleans(), min_size=3, max_size=12))
def test_what_lasts_for_a_frame_alone_is_no_absence(there):
    absent = np.array(there)[:, None]
    kept = without_blips(absent, np.ones(len(there), bool))
    assert not (kept & ~absent).any()
    padded = np.concatenate([[False], absent[:, 0], [False]])
    alone = padded[1:-1] & ~padded[:-2] & ~padded[2:]
    np.testing.assert_array_equal(kept[:, 0], absent[:, 0] & ~alone)
