"""`gsjax deform` without depth: depth is matched between a stereo pair, or the scene starts on a plane."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from rich.console import Console

import gsjax as gs
from gsjax.data import DataError, DataWarning, open_photographs, open_sequence
from gsjax.data.ordered import sequence_of
from gsjax.engine.deform.depth import with_depth
from gsjax.engine.messages import Notes
from gsjax.io.video import VideoWriter

EYES = "simulated:tissue?width=96&height=80&frames=4"
SMALL = ("--deform.warmup", 6, "--deform.iterations", 14, "--deform.start-pixels", 2.0, "--deform.nodes", 48)
SMALL += ("--deform.deformation.resolution", 8, "--deform.deformation.levels", 1, "--deform.channels", 4)


def metrics(run):
    return json.loads((run / "metrics.json").read_text())


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """A video of a pattern that shifts by a pixel per frame in front of a fixed camera."""
    noise = np.random.default_rng(0).uniform(30, 220, (16, 24, 3))
    wide = cv2.resize(noise, (96, 64), interpolation=cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8)
    path = tmp_path_factory.mktemp("clip") / "pulled.mp4"
    with VideoWriter(path, 10, quality=1) as writer:
        for t in range(5):
            writer.write(np.ascontiguousarray(wide[:48, t : t + 64]))
    return path


@pytest.mark.slow
def test_two_eyes_without_depth_are_matched_and_poses_refined(gsjax, tmp_path):
    run = tmp_path / "run"
    code, said = gsjax("deform", EYES, "--out", run, "--depth", "stereo", "--deform.refine-poses", *SMALL)
    assert code == 0, said
    found = metrics(run)
    assert found["depth"] == {"source": "stereo", "metric": True}
    assert found["curve"][-1]["depth"] is not None
    assert found["test"]["depth_mm"] < 5
    assert found["tracks"]["points"] > 50  # the scene is in metres, as the ground truth is
    assert any("Depth is matched between cameras 0 and 1" in note for note in found["notes"])
    assert any("Poses were refined (poses.npz)" in note for note in found["notes"])
    stored, given = np.load(run / "poses.npz"), open_sequence(EYES).viewmats
    assert stored["viewmats"].shape == given.shape
    np.testing.assert_allclose(stored["viewmats"][0], given[0], atol=1e-6)  # the first stays as given
    assert np.abs(stored["viewmats"][2] - given[2]).max() > 1e-6
    assert 0 < found["poses"]["moved"]["max"] < 0.02


@pytest.mark.slow
def test_a_clip_begins_on_a_plane(gsjax, clip, tmp_path):
    run = tmp_path / "run"
    code, said = gsjax("deform", clip, "--out", run, *SMALL)
    assert code == 0, said
    found = metrics(run)
    assert found["depth"] == {"source": "plane", "metric": False}
    assert found["poses"] is None
    assert found["test"]["depth_mm"] is None
    assert {row["depth"] for row in found["curve"]} == {None}
    assert found["test"]["psnr_masked"] > 18
    assert (run / "test" / "000001.png").is_file()
    notes = " ".join(found["notes"])
    assert "the scene starts on a plane 1 in front of the first camera" in notes
    assert "The camera has one pose in all frames" in notes


def test_what_is_known_in_metres_does_not_judge_a_plane():
    notes = Notes(Console(quiet=True))
    alone, _ = with_depth(open_sequence(EYES), "plane", 0.1, notes)
    assert (alone.has_depth, alone.truth, alone.num_cameras) == (False, None, 1)
    assert any("pass it, roughly, with --deform.plane-depth (now 0.1)" in note for note in notes.all)


def test_what_there_is_is_taken_first():
    notes, both = Notes(Console(quiet=True)), open_sequence(EYES)
    assert with_depth(both, "auto", 1.0, notes)[1] == "data"
    blind = replace(both, load_depth=None)
    assert with_depth(blind, "auto", 1.0, notes)[1] == "stereo"
    assert with_depth(blind.select(cameras=[0]), "auto", 1.0, notes)[1] == "plane"
    dark = replace(blind, load_image=lambda t, c: np.full((80, 96, 3), 9 + c, np.uint8))
    with pytest.warns(DataWarning, match="all of one colour"):
        with_depth(dark, "auto", 1.0, notes)
    assert "found depth in 0% of the first frame's pixels" in notes.all[-1]
    together = replace(blind, viewmats=blind.viewmats[:, [0, 0]])
    with pytest.raises(ValueError, match=r"cameras 0 and 1 cannot be matched: .* --depth plane starts"):
        with_depth(together, "auto", 1.0, notes)


def test_depth_of_another_camera_is_not_that_of_the_training_camera():
    notes, both = Notes(Console(quiet=True)), open_sequence(EYES)
    left = replace(both, load_depth=lambda t, c: both.load_depth(t, c) if c == 0 else None)
    assert with_depth(left.select(cameras=[0, 1]), "auto", 1.0, notes)[1] == "data"
    assert with_depth(left.select(cameras=[1]), "auto", 1.0, notes)[1] == "plane"
    for cameras in ([1], [1, 0]):
        with pytest.raises(ValueError, match=r"--depth data: .* has none of camera 1; leave it at auto"):
            with_depth(left.select(cameras=cameras), "data", 1.0, notes)
    # Matching needs the left eye first.
    swapped = replace(left.select(cameras=[1, 0]), viewmats=both.viewmats)
    assert with_depth(swapped, "auto", 1.0, notes)[1] == "stereo"


@pytest.mark.thorough
def test_in_python_each_kind_of_warning_is_given_once():
    grey = replace(open_sequence(EYES), load_image=lambda t, c: np.full((80, 96, 3), 9 + c, np.uint8))
    with pytest.warns(DataWarning) as caught:
        gs.deform(grey, gs.DeformConfig(warmup=2, iterations=2), teacher="none")
    empty = [str(one.message) for one in caught if "all of one colour" in str(one.message)]
    assert len(empty) == 1
    assert empty[0].endswith("more like it)")


def test_photographs_that_were_placed_are_frames(gsjax, photographs, tmp_path):
    """What `gsjax poses` writes has an order, but no depth."""
    table = shutil.copytree(photographs, tmp_path / "table")
    told = json.loads((table / "transforms.json").read_text())
    told["frames"] = [frame for frame in told["frames"] if "lost" not in frame["file_path"]][::-1]
    (table / "transforms.json").write_text(json.dumps(told))
    code, said = gsjax("deform", table, "--out", tmp_path / "run", "--frames", "0:3", "--depth", "data")
    assert code == 2
    assert "--depth data: table has none of camera 0" in said
    sequence = sequence_of(open_photographs(table))
    assert (sequence.num_frames, sequence.camera_ids) == (9, (0,))
    np.testing.assert_array_equal(sequence.image(1, 0), open_photographs(table).image(7))
    some = open_photographs(table)
    np.testing.assert_array_equal(sequence.viewmats[1, 0], some.viewmats[7])
    sizes = some.sizes.copy()
    sizes[3] += 2
    with pytest.raises(DataError, match="frames of 48x36 like the first, found 50x38 in"):
        sequence_of(replace(some, sizes=sizes))


@pytest.mark.thorough
def test_what_is_not_there_is_named(gsjax, clip, tmp_path):
    code, said = gsjax("deform", clip, "--out", tmp_path / "run", "--depth", "data")
    assert code == 2
    assert "--depth data: pulled has none of camera 0; leave it at auto" in said
    code, said = gsjax("deform", clip, "--out", tmp_path / "run", "--depth", "stereo")
    assert code == 2
    assert "--depth stereo: pulled has one camera, 0; expected a second one to its right" in said
    assert not (tmp_path / "run").exists()
