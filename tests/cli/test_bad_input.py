"""Bad recordings and options: each gives a clear error and exit code 2, or a warning and a sound run."""

import json
import os
import shutil

import cv2
import numpy as np
import pytest

import gsjax.engine.recording
from gsjax.data import Sequence, open_sequence


@pytest.fixture
def refused(gsjax_track, tmp_path):
    """Runs `gsjax track`, which must refuse; returns its output."""

    def call(dataset, *options) -> str:
        code, said = gsjax_track(dataset, *options)
        assert code == 2, said
        assert "error:" in said
        assert not (tmp_path / "run" / "report.html").exists()
        return said

    return call


@pytest.fixture
def sound(gsjax_track, tmp_path):
    """Runs `gsjax track`, which must succeed with finite numbers; returns its output and metrics.json."""

    def call(dataset, *options) -> tuple[str, dict]:
        code, said = gsjax_track(dataset, *options)
        assert code == 0, said
        found = json.loads((tmp_path / "run" / "metrics.json").read_text())
        with np.load(tmp_path / "run" / "trajectory.npz") as saved:
            assert np.isfinite(saved["means"]).all()
        assert (tmp_path / "run" / "report.html").exists()
        return said, found

    return call


def change_meta(folder, change) -> None:
    path = folder / "train_meta.json"
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))


def rewrite(path, change) -> None:
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(path), change(picture))


def test_missing_dataset(refused, tmp_path):
    said = refused(tmp_path / "nowhere")
    assert "expected a folder with a recording, found nothing there" in said
    assert not (tmp_path / "run").exists()


def test_unknown_built_in_scene(refused):
    assert "no built-in scene 'kitchen'; available: tabletop, articulated" in refused("simulated:kitchen")


def test_folder_of_several_sequences(refused, tmp_path):
    (tmp_path / "kitchen" / "seq-01").mkdir(parents=True)
    said = refused(tmp_path / "kitchen")
    assert "expected the frames of one sequence, found the sequences seq-01. Pass one of them" in said


@pytest.mark.thorough
def test_missing_image(refused, recording):
    (recording / "ims" / "1" / "000002.png").unlink()
    assert "000002.png: expected images of all 3 cameras in frame 2" in refused(recording)


@pytest.mark.thorough
def test_one_mask_is_enough(sound, recording, still):
    for file in (recording / "seg").rglob("*.png"):
        if file.parent.name != "1" or file.stem != "000000":
            file.unlink()
    for camera in ("0", "2"):
        shutil.rmtree(recording / "seg" / camera, ignore_errors=True)
    said, found = sound(recording, "--mask-camera", "1")
    assert found["complete"]
    assert "no such file" not in said


def test_missing_first_mask(refused, recording):
    (recording / "seg" / "1" / "000000.png").unlink()
    said = refused(recording, "--mask-camera", "1")
    assert "seg/1/000000.png" in said


def test_missing_depth_image(refused, recording):
    (recording / "depth" / "0" / "000000.png").unlink()
    assert "depth/0/000000.png" in refused(recording)


def test_camera_count_that_differs(refused, recording):
    change_meta(recording, lambda meta: meta["w2c"][2].pop())
    assert "expected 3 cameras in w2c, as in frame 0, found 2 in frame 2" in refused(recording)


def test_depth_in_the_wrong_unit(refused, recording):
    change_meta(recording, lambda meta: meta.update(depth_unit_m=1.0))
    assert "unit is likely wrong" in refused(recording)


def test_depth_that_is_all_zero(refused, recording):
    for path in recording.glob("depth/*/000000.png"):
        rewrite(path, np.zeros_like)
    said = refused(recording)
    assert said.count("warning:") == 1
    assert "no pixel has a valid depth" in said
    assert "depths: expected positive values in the first frame, found none in any camera" in said


def test_pose_that_is_no_rotation(refused, recording):
    def skew(meta):
        meta["w2c"][1][2][0][0] += 0.3

    change_meta(recording, skew)
    assert "viewmat of camera 2 in frame 1: R is not a rotation" in refused(recording)


def test_mask_of_another_size(refused, recording):
    rewrite(recording / "seg" / "1" / "000000.png", lambda mask: mask[:30])
    said = refused(recording, "--mask-camera", "1")
    assert "seg/1/000000.png" in said
    assert "80x30" in said or "(30, 80)" in said


def test_mask_that_is_all_background(refused, recording):
    rewrite(recording / "seg" / "1" / "000000.png", np.zeros_like)
    said = refused(recording, "--mask-camera", "1")
    assert "seg/1/000000.png: expected at least one object" in said
    assert "Use --mask-camera 0" in said


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--cameras", "0", "7"), "--cameras: table has no camera 7; it has [0, 1, 2]."),
        (("--eval-cameras", "9"), "--eval-cameras: table has no camera 9"),
        (("--cameras", "0", "0"), "camera 0 is named twice"),
        (("--cameras", "0", "--eval-cameras", "0"), "camera 0 is in --cameras too"),
        (("--cameras", "0", "--mask-camera", "2"), "camera 2 is not tracked; the tracked ones are [0]."),
        (("--eval-cameras", "0", "1", "2"), "--cameras: expected at least one that is not held out"),
        (("--frames", "60:90"), "--frames: 60:90 selects no frame of table, which has 0 to 3."),
        (("--frames", "4"), "found '4'; :4 is the first four"),
        (("--frames", "x"), "--frames: expected START:STOP"),
    ],
)
def test_wishes_that_cannot_be_met(refused, pristine, options, says):
    assert says in refused(pristine, *options)


def test_out_is_a_file(refused, pristine, tmp_path):
    (tmp_path / "run").touch()
    assert "expected a folder, found a file" in refused(pristine)


def test_out_holds_something_else(refused, pristine, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "thesis.tex").touch()
    assert "found other files" in refused(pristine)


def test_out_cannot_be_written(refused, pristine, tmp_path):
    if os.name != "posix" or os.geteuid() == 0:
        (tmp_path / "file").touch()  # root may write anywhere, but not below a file
        parent = tmp_path / "file"
    else:
        parent = tmp_path / "locked"
        parent.mkdir(mode=0o500)
    assert str(parent) in refused(pristine, "--out", str(parent / "run"))


@pytest.mark.thorough
def test_a_bad_frame_in_the_middle_keeps_what_came_before(gsjax_track, recording, tmp_path, still):
    (recording / "depth" / "0" / "000002.png").write_bytes(b"nonsense")
    code, said = gsjax_track(recording, "--cameras", "0", "--frames", "0:4")
    assert code == 2
    assert "depth/0/000002.png" in said
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert found["frames"]["tracked"] == 2
    assert "000002.png" in found["stopped"]


@pytest.mark.slow
def test_label_that_no_pixel_has(sound, recording, still):
    rewrite(recording / "seg" / "1" / "000000.png", lambda mask: np.where(mask == 4, 0, mask))
    said, found = sound(recording, "--mask-camera", "1")
    assert "ball (label 4) has no pixel in the first mask of camera 1: it is not tracked" in said
    assert found["objects"]["ball"]["gaussians"] == 0
    assert any(note.startswith("ball: not tracked") for note in found["notes"])


@pytest.mark.slow
def test_empty_frame(sound, recording, still):
    for path in recording.glob("ims/*/000002.png"):
        rewrite(path, np.zeros_like)
    said, found = sound(recording)
    assert said.count("the image is empty") == 1  # one for all cameras and frames
    assert any("the image is empty" in note and "more like it" in note for note in found["notes"])


def test_pixels_that_are_not_finite(sound, pristine, still, monkeypatch):
    def with_nan(path, read):
        found = open_sequence(path, read)

        def load(t, c):
            image = found.load_image(t, c) / 255.0
            image[5:8, 5:8] = np.nan
            return image

        return Sequence(**{**vars(found), "load_image": load, "float_images": True})

    monkeypatch.setattr(gsjax.engine.recording, "open_sequence", with_nan)
    said, found = sound(pristine)
    assert said.count("9 pixels are not finite") == 1
    assert found["cameras"]["0"]["psnr"] > 10


@pytest.mark.thorough
def test_one_frame_only(sound, pristine, tmp_path, still):
    said, found = sound(pristine, "--frames", "2:3", "--eval-cameras", "2")
    assert "(1 of 1 requested)" in said
    assert found["frames"]["first_id"] == found["frames"]["last_id"] == 2
    assert found["update_hz"] is None
    with np.load(tmp_path / "run" / "trajectory.npz") as saved:
        assert saved["means"].shape[0] == 1
        assert saved["update_s"].tolist() == [0.0]


def test_no_depth_and_no_shapes(refused, recording):
    for path in recording.glob("depth/*/*.png"):
        path.unlink()
    for folder in (recording / "depth").iterdir():
        folder.rmdir()
    assert "depth" in refused(recording)


@pytest.mark.thorough
@pytest.mark.parametrize("frame", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_a_bad_held_out_image_keeps_the_run_and_its_report(gsjax_track, recording, tmp_path, still, frame):
    (recording / "ims" / "2" / f"{frame:06d}.png").write_bytes(b"nonsense")
    code, said = gsjax_track(recording, "--cameras", "0", "1", "--eval-cameras", "2")
    assert code == 2
    assert f"2/{frame:06d}.png: expected an image" in said
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert (found["complete"], found["frames"]["tracked"], found["frames"]["scored"]) == (False, 4, frame)
    assert f"2/{frame:06d}.png" in " ".join(found["notes"])
    assert "partial run" in (tmp_path / "run" / "report.html").read_text()


def test_a_truth_that_is_cut_off(refused, recording):
    path = recording / "truth.npz"
    path.write_bytes(path.read_bytes()[:200])
    assert "truth.npz: expected plain arrays" in refused(recording)


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("fn", 3, "expected the lists and numbers of this layout"),
        ("cam_id", [5], "expected the lists and numbers of this layout"),
        ("w", "80", "expected w to be a whole number of pixels, found '80'"),
        ("depth_unit_m", 0, "expected depth_unit_m to be metres above 0, found 0"),
    ],
)
def test_a_meta_of_other_types(refused, recording, key, value, says):
    change_meta(recording, lambda meta: meta.update({key: value}))
    said = refused(recording)
    assert "train_meta.json" in said
    assert says in said


@pytest.mark.parametrize(
    ("option", "value", "says"),
    [
        ("headroom", "0.5", "track.headroom: expected at least 1, found 0.5"),
        ("start.part-size", "0", "track.start.part_size: expected more than 0, found 0"),
        ("refine.iterations", "-1", "track.refine.iterations: expected at least 0, found -1"),
        ("align.spacing", "nan", "track.align.spacing: expected more than 0, found nan"),
    ],
)
def test_settings_without_a_meaning(gsjax_track, pristine, capfd, option, value, says):
    with pytest.raises(SystemExit) as left:
        gsjax_track(pristine, f"--track.{option}", value)
    assert left.value.code == 2
    said = capfd.readouterr().err
    assert says in " ".join(said.replace("│", " ").split())
