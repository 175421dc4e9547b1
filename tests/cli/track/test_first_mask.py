"""`gsjax track --masks PICTURE`: objects from the user's own mask, whether the recording has masks or not."""

import json
import shutil

import cv2
import numpy as np
import pytest

from gsjax.engine.track import loop
from gsjax.engine.track.saved import open_run
from gsjax.io.pictures import write_png


@pytest.fixture
def unmasked(pristine, tmp_path):
    """The recording of three cameras without its masks, and its first masks by camera."""
    folder = tmp_path / "table"
    shutil.copytree(pristine, folder)
    first = {
        c: cv2.imread(str(min((folder / "seg" / str(c)).iterdir())), cv2.IMREAD_UNCHANGED) for c in range(3)
    }
    shutil.rmtree(folder / "seg")
    return folder, first


@pytest.mark.thorough
def test_a_picture_names_the_objects(unmasked, tmp_path, gsjax_track, still):
    folder, first = unmasked
    labels = np.where(first[1] == 3, 7, 0).astype(np.uint8)  # the can alone, with another value
    write_png(tmp_path / "can.png", labels)
    code, said = gsjax_track(
        folder, "--cameras", "0", "1", "--mask-camera", "1", "--masks", str(tmp_path / "can.png")
    )
    assert code == 0, said
    assert "labels from your picture in camera 1" in " ".join(said.split())
    run = tmp_path / "run"
    found = json.loads((run / "metrics.json").read_text())
    assert found["mask"] == {"source": "picture", "camera": 1}
    assert list(found["objects"]) == ["object 7"]
    assert found["objects"]["object 7"]["mask_pixels"] == (first[1] == 3).sum()
    assert "segmenter" not in " ".join(found["notes"])


@pytest.mark.thorough
def test_of_pictures_read_smaller_the_mask_is_too(unmasked, tmp_path, gsjax_track, still):
    folder, first = unmasked
    write_png(tmp_path / "mask.png", first[0].astype(np.uint8))
    said = gsjax_track(folder, "--cameras", "0", "--scale", "0.5", "--masks", str(tmp_path / "mask.png"))
    assert said[0] == 0, said
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    pixels = [scored["mask_pixels"] for scored in found["objects"].values()]
    assert sum(pixels) == pytest.approx((first[0] > 0).sum() / 4, rel=0.1)


@pytest.mark.thorough
def test_one_of_another_size_is_none_of_these_pictures(unmasked, tmp_path, gsjax_track):
    folder, first = unmasked
    cv2.imwrite(str(tmp_path / "mask.png"), np.kron(first[0], np.ones((2, 2), first[0].dtype)))
    code, said = gsjax_track(folder, "--cameras", "0", "--masks", str(tmp_path / "mask.png"))
    assert (code, "80x60 pixels" in said, "found 160x120" in " ".join(said.split())) == (2, True, True)
    code, said = gsjax_track(folder, "--cameras", "0", "--masks", str(folder / "ims"))
    assert (code, "found the folder" in " ".join(said.split())) == (2, True)
    np.save(tmp_path / "mask.npy", first[0])
    code, said = gsjax_track(folder, "--cameras", "0", "--masks", str(tmp_path / "mask.npy"))
    assert (code, "a picture of labels (PNG), found" in " ".join(said.split())) == (2, True)


@pytest.mark.thorough
def test_where_the_recording_has_masks_the_picture_counts(pristine, tmp_path, gsjax_track, still):
    labels = cv2.imread(str(min((pristine / "seg" / "1").iterdir())), cv2.IMREAD_UNCHANGED)
    write_png(tmp_path / "mine.png", np.where(labels == 3, 1, 0).astype(np.uint8))
    code, said = gsjax_track(pristine, "--cameras", "1", "--masks", str(tmp_path / "mine.png"))
    assert code == 0, said
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert list(found["objects"]) == ["object 1"]
    assert found["objects"]["object 1"]["gaussians"] > 0
    assert found["objects"]["object 1"]["point_error_mm"] is None
    assert "Motion and labels were not scored: the objects are those of your picture." in found["notes"]
    assert not any("recording has no" in note for note in found["notes"])


@pytest.mark.parametrize(
    ("mask", "wants"),
    [
        (None, ("--masks", "expected auto, files, segment or a picture of labels (PNG), found no")),
        (np.zeros((60, 80), np.uint8), ("mask.png", "expected at least one object, found background only")),
        (np.ones((60, 60), np.uint8), ("mask.png", "80x60 pixels, as the pictures of camera 0", "60x60")),
        (np.ones((30, 40), np.uint8), ("mask.png", "80x60 pixels", "40x30")),
        (
            np.arange(4800, dtype=np.uint16).reshape(60, 80),
            ("mask.png", "one value for each object", "4799 values"),
        ),
        (
            np.eye(60, 80, dtype=np.uint8) * np.arange(80, dtype=np.uint8),
            ("59 of them in fewer than 10", "PNG"),
        ),
        (np.eye(60, 80, dtype=np.uint8)[..., None] * [9, 5, 7], ("mask.png", "one label per pixel")),
    ],
)
def test_a_picture_that_names_nothing_is_refused_before_any_work(
    mask, wants, unmasked, tmp_path, gsjax_track
):
    folder, _ = unmasked
    if mask is not None:
        cv2.imwrite(str(tmp_path / "mask.png"), mask)
    code, said = gsjax_track(folder, "--cameras", "0", "1", "--masks", str(tmp_path / "mask.png"))
    assert code == 2, said
    for want in wants:
        assert want in " ".join(said.split())
    assert not (tmp_path / "run" / "config.yml").exists()


@pytest.mark.thorough
def test_a_run_keeps_its_picture_and_goes_on_with_it(unmasked, tmp_path, gsjax_track, still, monkeypatch):
    folder, first = unmasked
    monkeypatch.chdir(tmp_path)
    write_png(tmp_path / "mask.png", np.where(first[0] == 3, 7, 0).astype(np.uint8))
    told = (folder, "--cameras", "0", "--masks", "mask.png")

    def stopped(*arguments, **options):
        yield next(still(*arguments, **options))
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(loop, "track", stopped)
        assert gsjax_track(*told)[0] == 130
    assert cv2.imread(str(tmp_path / "run" / "mask.png"), cv2.IMREAD_UNCHANGED).max() == 7
    (tmp_path / "mask.png").unlink()
    code, said = gsjax_track(*told, "--resume")
    assert code == 0, said
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["mask"]["source"] == "picture"
    assert open_run(tmp_path / "run").names == {1: "object 7"}


@pytest.mark.thorough
def test_without_depth_a_picture_says_nothing_and_an_earlier_run_is_kept(pristine, tmp_path, gsjax_track):
    folder = tmp_path / "flat"
    shutil.copytree(pristine, folder, ignore=shutil.ignore_patterns("depth"))
    write_png(tmp_path / "mask.png", np.ones((60, 80), np.uint8))
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yml").write_text("# gsjax run of before")
    code, said = gsjax_track(folder, "--cameras", "0", "--masks", str(tmp_path / "mask.png"), "--overwrite")
    assert (code, "expected depth of camera 0" in " ".join(said.split())) == (2, True), said
    assert (tmp_path / "run" / "config.yml").read_text() == "# gsjax run of before"
