"""A recording as a user writes it from arrays (docs/data.md): names of labels, a mask of the first frame."""

import json
from dataclasses import replace

import numpy as np
import pytest

import gsjax.engine.track.loop
from gsjax.data import open_sequence, write_panoptic
from gsjax.data.simulated import tabletop
from gsjax.engine.first_mask import label_names
from gsjax.engine.recording import Recording

CARTON, CAN, BALL = 2, 3, 4


@pytest.fixture
def own(pristine, tmp_path):
    table, folder = open_sequence(pristine), tmp_path / "own"

    def first(t, c):
        return table.mask(t, c) if (t, table.camera_ids[c]) == (0, 1) else None

    write_panoptic(replace(table, truth=None, load_mask=first, label_names={CAN: "my can"}), folder)
    return folder


@pytest.mark.thorough
def test_objects_have_their_names_and_the_first_mask_is_no_test(own, tmp_path, gsjax_track, still):
    code, said = gsjax_track(own, "--cameras", "0", "1", "--mask-camera", "1")
    assert code == 0, said
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert {"my can", "object 2"} <= found["objects"].keys()
    assert found["iou"] == found["iou_held_out"] == {}
    assert "Labels were not scored: the recording has masks of the first frame alone." in found["notes"]
    assert found["objects"]["my can"]["agrees_least"] == 1


@pytest.mark.thorough
def test_what_is_not_seen_agrees_with_nothing(own, tmp_path, gsjax_track, still, monkeypatch):
    """The can is seen in the first update alone, the ball in none."""

    def hiding(scene, first, frames, config, **how):
        ids = np.asarray(scene.label_ids[1:])
        for t, now in enumerate(still(scene, first, frames, config), 1):
            seen = np.where(ids == CAN, t == 1, ids != BALL)
            agrees = np.where(ids == CAN, 0.7 if t == 1 else 0.2, 0.9)
            yield replace(now, info=now.info | {"visible": seen, "agrees": agrees})

    monkeypatch.setattr(gsjax.engine.track.loop, "track", hiding)
    assert gsjax_track(own, "--cameras", "1")[0] == 0
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    shares = {name: (o["agrees_least"], o["agrees_last"]) for name, o in found["objects"].items()}
    assert shares["my can"] == (pytest.approx(0.7), None)
    assert shares["object 4"] == (None, None)
    assert shares["object 2"] == (pytest.approx(0.9), pytest.approx(0.9))
    assert not any("agrees" in note for note in found["notes"])


def test_names_that_several_objects_have_are_told_apart_by_the_mask_value():
    given = {2: "cup", 3: "milk carton", 4: "Cup", 5: "cup_1", 6: "cup 1"}
    table = replace(tabletop(frames=1, width=8, height=6), truth=None, label_names=given)
    names = label_names(Recording(table, table, 1), "files")
    expected = {2: "cup (2)", 3: "milk carton", 4: "Cup (4)", 5: "cup_1 (5)", 6: "cup 1 (6)"}
    assert names == {0: "background"} | expected


@pytest.mark.thorough
def test_each_of_two_objects_of_one_name_has_its_scores(pristine, tmp_path, gsjax_track, still):
    table, folder = open_sequence(pristine), tmp_path / "twins"
    names = tuple("cup" if label in (CAN, BALL) else f"thing {label}" for label in table.truth.label_ids)
    write_panoptic(replace(table, truth=replace(table.truth, names=names)), folder)
    code, said = gsjax_track(folder, "--cameras", "0", "1", "--mask-camera", "1", "--eval-cameras", "2")
    assert code == 0, said
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert {f"cup ({CAN})": CAN, f"cup ({BALL})": BALL}.items() <= {
        name: scored["label"] for name, scored in found["objects"].items()
    }.items()
    for scores in (found["iou"], found["iou_held_out"], found["over_frames"]["centroid_error_mm"]):
        assert {f"cup ({CAN})", f"cup ({BALL})"} <= scores.keys()
