"""The data `gsjax deform` learns from: which classes are tools, and frames without masks."""

from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from gsjax.data import open_sequence
from gsjax.engine.deform.data import deform_data
from gsjax.engine.messages import Notes
from gsjax.engine.teaching.choice import TeacherChoice

KIDNEY, SHAFT = 4, 7
NAMES = {0: "background-tissue", KIDNEY: "kidney-parenchyma", SHAFT: "instrument-shaft"}


def recording(masked=range(10), names=NAMES):
    """The built-in scene with a kidney in its left half, and an instrument across the upper rows."""
    seen = open_sequence("simulated:tissue?width=48&height=40&frames=10")

    def mask(t, c):
        labels = np.zeros((40, 48), np.int32)
        labels[:, :24], labels[:8] = KIDNEY, SHAFT
        return labels if t in masked and c == 0 else None

    return replace(seen, load_mask=mask, label_names=names, truth=None)


def read(sequence, tools="leave-out", tool_values=(), features="auto"):
    console = Console(quiet=True)
    notes = Notes(console)
    told = (tools, TeacherChoice(features), 8, tool_values, notes, console)
    return deform_data(sequence, 8, *told), " ".join(notes.all)


def test_tools_are_left_out_by_name_and_other_classes_are_learned():
    data, said = read(recording())
    assert data.names == ("background-tissue", "kidney-parenchyma")
    (mask,), ids = data.frames[0].masks, data.lesson.ids[0]
    np.testing.assert_array_equal(mask[:8], False)
    np.testing.assert_array_equal(mask[8:], True)
    np.testing.assert_array_equal(np.unique(ids[8:, :24]), [1])
    np.testing.assert_array_equal(np.unique(ids[8:, 24:]), [0])
    assert "instrument-shaft; kept: background-tissue, kidney-parenchyma" in said


def test_a_class_may_be_named_tissue():
    """Label 0 is then the background."""
    data, _ = read(recording(masked=[0, 2], names={KIDNEY: "Tissue", SHAFT: "instrument-shaft"}))
    assert data.names == ("background", "Tissue")


def test_two_classes_of_one_name_are_told_apart_by_their_values():
    data, _ = read(recording(names={KIDNEY: "organ", SHAFT: "Organ"}))
    assert data.names == ("tissue", f"organ ({KIDNEY})", f"Organ ({SHAFT})")


def test_tools_may_be_named_by_value():
    data, _ = read(recording(), tool_values=(KIDNEY,))
    assert data.names == ("background-tissue", "instrument-shaft")
    np.testing.assert_array_equal(data.frames[0].masks[0, 8:, :24], False)
    np.testing.assert_array_equal(data.frames[0].masks[0, :8], True)


def test_frames_without_a_mask_are_left_out_with_the_tools_and_said():
    data, said = read(recording(masked=[0, 1, 3, 4]))
    assert (data.train, data.test) == ([0, 3, 4], [1])
    assert "frames 2, 5, 6, 7, 8, 9 have no tool mask" in said
    data, _ = read(recording(masked=[0, 3, 4]), tools="draw")
    assert data.train == [0, 2, 3, 4, 5, 6, 7, 8]
    assert (data.lesson.ids[1] == -1).all()  # nothing says what frame 2 shows
    with pytest.raises(ValueError, match="expected masks of training frames"):
        read(recording(masked=[1]))


@pytest.mark.thorough
def test_the_scene_begins_where_most_classes_are_seen():
    """The instrument enters in frame 4, with only two pixels; frame 5 has no depth."""
    seen = recording()

    def mask(t, c):
        labels = seen.load_mask(t, c)
        labels[:8] = 0
        labels[: {4: 1}.get(t, 8), : {4: 2}.get(t, 48) if t >= 4 else 0] = SHAFT
        return labels

    def depth(t, c):
        return seen.load_depth(t, c) * (t != 5)

    data, _ = read(replace(seen, load_mask=mask, load_depth=depth), tools="draw")
    assert data.train[data.first] == 6
    assert read(seen, features="none")[0].first is None
