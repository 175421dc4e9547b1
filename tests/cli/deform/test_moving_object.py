"""D-NeRF's layout: photographs of a moving object from a camera that jumps around it, in three splits that
share times."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from rich.console import Console

import gsjax as gs
from gsjax.data import DataError, DataWarning, open_sequence, photographs_of
from gsjax.data.ordered import open_as_sequence
from gsjax.engine.deform.data import deform_data
from gsjax.engine.deform.depth import with_depth
from gsjax.engine.deform.file import read_metadata
from gsjax.engine.messages import Notes
from gsjax.engine.pictures import frame_rate
from gsjax.engine.teaching.choice import TeacherChoice
from gsjax.engine.viewables import open_viewable
from gsjax.methods.deform import PRESETS, Deform, DeformConfig, goes_around, hull_gaussians
from tests.data.moving_object import write_dnerf

SIZE, COUNTS = 40, {"train": 12, "val": 3, "test": 4}
SMALL = ("--deform.warmup", 6, "--deform.iterations", 12, "--deform.hull-points", 600, "--deform.nodes", 48)
SMALL += ("--deform.deformation.resolution", 8, "--deform.deformation.levels", 1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("dnerf") / "things"
    write_dnerf(root, SIZE, COUNTS)
    return root


@pytest.fixture(scope="module")
def sequence(folder):
    return open_as_sequence(str(folder))


@pytest.fixture(scope="module")
def data(sequence):
    return read(sequence)[0]


def read(sequence, every=8):
    quiet = Console(quiet=True)
    notes = Notes(quiet)
    found = deform_data(sequence, every, "leave-out", TeacherChoice("auto"), 8, (), notes, quiet)
    return found, " ".join(notes.all)


def test_splits_share_times(folder, sequence):
    assert sequence.splits[:3] == ("train", "val", "test")  # all of them at time 0
    assert sequence.times[:3].tolist() == [0, 0, 0]
    assert (np.diff(sequence.times) >= 0).all()
    assert sequence.background == (1, 1, 1)
    assert (sequence.image(0, 0)[0, 0] == 255).all()
    some = sequence.select([1, 2, 3])
    assert some.splits == ("val", "test", "train")
    again = photographs_of(some)
    assert (again.splits, again.background) == (some.splits, (1, 1, 1))
    assert frame_rate(sequence.times) == frame_rate(np.unique(sequence.times))


def test_times_of_recordings_still_increase(folder, sequence):
    with pytest.raises(ValueError, match=r"increase, but frame 1 is at 0\.0 s after 0\.0 s"):
        replace(sequence, shared_times=False)
    with pytest.raises(
        ValueError, match=r"not decrease, but frame 3 is at .* after 1\.0 s\. Sort the frames\."
    ):
        replace(sequence, times=sequence.times[::-1])
    with pytest.raises(ValueError, match="splits"):
        replace(sequence, splits=("train",))
    with pytest.raises(DataError, match="which are not ordered in time"):  # as gsjax track opens it
        open_sequence(folder)


def test_the_data_says_what_is_held_out(sequence):
    data, said = read(sequence)
    assert {sequence.splits[t] for t in data.train} == {"train"}
    assert {sequence.splits[t] for t in data.test} == {"test"}
    assert "12 frames of train learned, 4 held out, 3 of val left out of both" in said
    assert read(sequence, every=0)[0].test == data.test  # as for gsjax fit, the data's split comes first
    no_test = sequence.select([t for t, split in enumerate(sequence.splits) if split != "test"])
    assert {no_test.splits[t] for t in read(no_test)[0].test} == {"val"}
    with pytest.raises(ValueError, match="expected photographs of its split train, found none"):
        read(sequence.select([1, 2]))


@pytest.mark.slow
def test_times_that_are_missing_are_told_of(gsjax, tmp_path):
    """The order of the files, test after train, was once taken for time without a warning."""
    write_dnerf(tmp_path / "things", SIZE, {"train": 4, "val": 1, "test": 2})
    path = tmp_path / "things" / "transforms_train.json"
    meta = json.loads(path.read_text())
    del meta["frames"][1]["time"]
    path.write_text(json.dumps(meta))
    with pytest.warns(
        DataWarning, match="expected a time of each photograph or of none, found none of .*001"
    ):
        assert gs.open_photographs(tmp_path / "things").times is None
    code, said = gsjax("deform", tmp_path / "things", "--out", tmp_path / "run", *SMALL)
    assert code == 0, said
    assert "its photographs have splits but no times, or one time: the order of their files" in said


def test_the_scene_starts_within_what_most_frames_show(sequence, data):
    assert goes_around(sequence.viewmats[:, 0])
    assert not goes_around(open_sequence("simulated:tissue?width=16&height=12&frames=40").viewmats[:, 0])
    means = np.asarray(hull_gaussians(data.frames, sequence.background, 500, 0).means)
    assert len(means) == 500
    inside = np.linalg.norm(means[:, :2], axis=1) < 0.33  # the disc reaches 0.3
    inside &= (means[:, 2] > -0.05) & (means[:, 2] < 0.55)
    assert inside.mean() > 0.7  # as far as twelve views can tell
    assert 0.05 < (means[:, 2] > 0.15).mean() < 0.95  # some on the bar upon it
    nothing = [replace(frame, images=np.full_like(frame.images, 255)) for frame in data.frames]
    with pytest.raises(ValueError, match="expected something before the background"):
        hull_gaussians(nothing, sequence.background, 500, 0)


def test_where_there_is_no_depth_the_way_of_the_camera_decides(sequence):
    notes = Notes(Console(quiet=True))
    assert with_depth(sequence, "auto", 1.0, notes)[1] == "hull"
    assert with_depth(sequence, "plane", 1.0, notes)[1] == "plane"
    still = replace(sequence, viewmats=np.repeat(sequence.viewmats[:1], sequence.num_frames, axis=0))
    assert with_depth(still, "auto", 1.0, notes)[1] == "plane"
    with pytest.raises(ValueError, match="--depth hull: things is seen from one place"):
        with_depth(still, "hull", 1.0, notes)


def test_poses_are_interpolated_between_different_times_only(sequence, data):
    frames = [replace(frame, time=np.asarray(0.5)) for frame in data.frames]
    with pytest.raises(ValueError, match=r"expected frames at different times, .* found 12 at 1 times"):
        Deform(DeformConfig(refine_poses=True)).start(frames, hull=True)


@pytest.mark.thorough
def test_a_run_is_learned_and_scored_on_white(gsjax, folder, tmp_path):
    run = tmp_path / "run"
    code, said = gsjax("deform", folder, "--out", run, *SMALL, "--deform.rates.quats", 1e-3)
    assert code == 0, said
    assert "settings of --preset around" in said
    found = json.loads((run / "metrics.json").read_text())
    assert found["frames"] == {"learned": 12, "held_out": 4}
    assert found["depth"] == {"source": "hull", "metric": False}
    assert found["preset"] == "around"
    settings = yaml.safe_load((run / "config.yml").read_text())
    given = {"quats": 1e-3}  # though that is surst's default
    assert settings["deform"]["rates"] == vars(PRESETS["around"].rates) | given
    assert "words" not in settings
    assert (settings["deform"]["warmup"], settings["deform"]["deformation"]["resolution"]) == (6, 8)
    assert found["num_gaussians"] == 600
    splits = open_as_sequence(str(folder)).splits
    assert {splits[row["frame"]] for row in found["scores"]} == {"test"}
    assert found["test"]["psnr_masked"] > 12
    assert found["test"]["t_ssim"] is None  # the camera jumps
    for row in found["scores"]:
        picture = cv2.imread(str(run / "test" / f"{row['frame']:06d}.png"))
        assert (picture[:4, :4] == 255).all()
        assert picture.std() > 20
    assert read_metadata(run / "deformation.npz").background == (1, 1, 1)
    scene, _ = open_viewable(run, Notes(Console(quiet=True)))
    assert scene.background == (1, 1, 1)
    assert scene.num_frames == 19


@pytest.mark.slow
def test_opaque_pictures_are_told_of(gsjax, tmp_path):
    """For these, surst's settings were once taken in D-NeRF's layout without a warning."""
    write_dnerf(tmp_path / "things", SIZE, {"train": 4, "val": 1, "test": 2})
    for picture in (tmp_path / "things").rglob("*.png"):
        cv2.imwrite(str(picture), cv2.imread(str(picture)))
    code, said = gsjax("deform", tmp_path / "things", "--out", tmp_path / "run", *SMALL)
    assert code == 0, said
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert found["preset"] == "surst"
    assert "its pictures are not transparent" in " ".join(found["notes"])


@pytest.mark.slow
def test_a_run_of_an_earlier_version_goes_on_as_it_was_begun(gsjax, folder, interrupted, tmp_path):
    told = ("deform", folder, "--out", tmp_path / "run", *SMALL)
    with interrupted(8):
        assert gsjax(*told, "--preset", "surst")[0] == 130
    config = tmp_path / "run" / "config.yml"
    config.write_text(config.read_text().replace("    rigidity: 0.01\n", ""))
    code, said = gsjax(*told, "--resume")
    assert code == 0, said
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["preset"] == "surst"


@pytest.mark.thorough
def test_the_verb_learns_from_all_frames_that_it_is_given(sequence):
    train = sequence.select([t for t, split in enumerate(sequence.splits) if split == "train"])
    for given in (sequence, train):
        problem = gs.deform(given, DeformConfig(hull_points=100)).problem
        assert len(problem.frames) == given.num_frames
        assert problem.first is None
        np.testing.assert_array_equal(problem.background, [[1, 1, 1]])


@pytest.mark.thorough
def test_without_settings_the_verb_takes_those_that_suit(sequence):
    assert gs.deform(sequence).method.config == PRESETS["around"]
    tissue = open_sequence("simulated:tissue?width=32&height=26&frames=2")
    assert gs.deform(tissue).method.config == DeformConfig()
