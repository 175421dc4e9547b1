"""`gsjax distill` and `gsjax query` on a PLY file of the built-in scene, whose first frame's masks teach."""

import json
import shutil

import cv2
import numpy as np
import pytest
import yaml

from gsjax.cli import main
from gsjax.cli.field_run import camera_names
from gsjax.data import open_sequence
from gsjax.io.ply import read_ply, write_ply
from gsjax.scene.initialize import gaussians_from_points, points_from_rgbd

SMALL = ("--field.grid.levels", "4", "--field.grid.most-resolution", "32", "--field.grid.log2-entries", "12")
SMALL += ("--field.grid.hidden", "16", "--field.channels", "16", "--field.contrast-patch", "8")
SMALL += ("--field.rates.table", "0.1", "--field.rates.layers", "0.01", "--field.rates.lift", "0.02")
TABLE = ("--field.encoding", "table")  # learns in fewer steps
STEPS = 200


@pytest.fixture(scope="module")
def scene(pristine, tmp_path_factory):
    """A Gaussian for every other pixel of all cameras' first pictures, in a PLY file."""
    sequence, parts = open_sequence(str(pristine)), []
    for c in range(sequence.num_cameras):
        depth, K = sequence.depth(0, c), sequence.Ks[0, c]
        parts.append(points_from_rgbd(sequence.image(0, c), depth, sequence.viewmats[0, c], K, stride=2))
    points, colors = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    path = tmp_path_factory.mktemp("scene") / "scene.ply"
    write_ply(path, gaussians_from_points(points, colors))
    return path


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """A cache of features for these tests alone."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("cache")
        patch.setattr("gsjax.cli.feature_cache.user_cache_dir", lambda *a, **k: str(folder))
        yield folder


def images(pristine):
    return ("--images", pristine, "--frames", "0:1", "--test-every", "0")


@pytest.fixture(scope="module")
def distilled(pristine, scene, tmp_path_factory):
    """The field of the classes of the recording's masks."""
    out = tmp_path_factory.mktemp("fields") / "field"
    steps = ("--field.iterations", STEPS, *TABLE)
    assert main([str(a) for a in ("distill", scene, "--out", out, *images(pristine), *SMALL, *steps)]) == 0
    return out


@pytest.fixture
def field(distilled, tmp_path):
    """A copy of it to ask and to corrupt."""
    return shutil.copytree(distilled, tmp_path / "field")


def test_a_distillation_writes_all_that_it_promises(distilled):
    found = json.loads((distilled / "metrics.json").read_text())
    assert (found["kind"], found["complete"], found["steps"]) == ("distill", True, STEPS)
    assert found["features"] == "classes"
    assert found["masks"] == "files"
    assert found["test"]["miou_3d"] > 0.5
    assert found["test"]["cosine"] > 0.7
    assert {row["class"] for row in found["classes"]} >= {"can", "carton", "ball", "block"}
    lines = [json.loads(line) for line in (distilled / "metrics.jsonl").read_text().splitlines()]
    assert lines[-1]["step"] == STEPS
    assert lines[-1]["cos"] < 0.5 * lines[0]["cos"]
    assert "IoU, 3D query" in (distilled / "report.html").read_text()
    assert not (distilled / "resume").exists()
    assert list((distilled / "renders" / "taught").glob("*.png"))


def test_a_text_gives_gaussians_masks_and_scenes(gsjax, field, scene, pristine):
    code, said = gsjax("query", field, "can", "--move", 0, 0, 0.5)
    assert code == 0, said
    folder, whole = field / "query", read_ply(scene)[0]
    told = json.loads((folder / "query.json").read_text())
    with np.load(folder / "selection.npz") as found:
        rows, means = found["indices"], found["means"]
        assert len(rows) == told["gaussians"] == len(found["scores"])
        assert (found["scores"] > told["threshold"]).all()
        assert len(found["all_scores"]) == whole.num
    np.testing.assert_array_equal(means, np.asarray(whole.means)[rows])
    parts = {
        name: read_ply(folder / f"{name}.ply")[0] for name in ("object", "without", "recolored", "moved")
    }
    assert parts["object"].num + parts["without"].num == parts["recolored"].num == whole.num
    np.testing.assert_array_equal(np.asarray(parts["object"].means), means)
    gone = np.asarray(parts["moved"].means) - np.asarray(whole.means)
    np.testing.assert_allclose(gone[rows], np.tile([0, 0, 0.5], (len(rows), 1)), atol=1e-6)
    assert not np.delete(gone, rows, axis=0).any()
    changed = (np.asarray(parts["recolored"].sh0) != np.asarray(whole.sh0)).any(axis=(1, 2))
    assert changed[rows].all()
    assert not np.delete(changed, rows).any()
    mask = cv2.imread(str(folder / "masks" / "0.png"), cv2.IMREAD_UNCHANGED)
    truth = cv2.imread(str(pristine / "seg" / "0" / "000000.png"), cv2.IMREAD_UNCHANGED)
    label = next(row["label"] for row in _metrics(field)["classes"] if row["class"] == "can")
    both, either = ((mask == 255) & (truth == label)).sum(), ((mask == 255) | (truth == label)).sum()
    assert both > 0.6 * either
    assert sorted(told["pixels"]) == ["0", "1", "2"]
    assert cv2.imread(str(folder / "overview.png")) is not None


def _metrics(field):
    return json.loads((field / "metrics.json").read_text())


def test_a_point_means_the_thing_that_it_shows(gsjax, field, pristine):
    truth = cv2.imread(str(pristine / "seg" / "1" / "000000.png"), cv2.IMREAD_UNCHANGED)
    label = next(row["label"] for row in _metrics(field)["classes"] if row["class"] == "carton")
    inside = cv2.erode((truth == label).astype(np.uint8), np.ones((3, 3)))
    y, x = (int(places[len(places) // 2]) for places in np.nonzero(inside))
    assert gsjax("query", field, "--point", f"{x},{y}", "--camera", 1)[0] == 0
    by_point = np.load(field / "query" / "selection.npz")["indices"]
    assert gsjax("query", field, "carton")[0] == 0
    np.testing.assert_array_equal(np.load(field / "query" / "selection.npz")["indices"], by_point)


def test_resumed_it_is_the_same_field(gsjax, monkeypatch, pristine, scene, distilled, tmp_path):
    from gsjax.cli import distill_loop

    steps, add_row = ("--field.iterations", STEPS, *TABLE), distill_loop._add_row
    told = ("distill", scene, "--out", tmp_path / "again", *images(pristine), *SMALL, *steps)

    def stopped(learning, infos, folder):
        add_row(learning, infos, folder)
        if learning.state.step == 100:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(distill_loop, "_add_row", stopped)
        code, said = gsjax(*told)
    assert code == 130, said
    assert (tmp_path / "again" / "field.npz").is_file()  # what was learned so far can be asked
    assert gsjax("query", tmp_path / "again", "can")[0] in (0, 2)
    code, said = gsjax(*told)
    assert code == 2
    assert "--resume" in said
    code, said = gsjax(*told, "--resume")
    assert code == 0, said
    ours, theirs = np.load(tmp_path / "again" / "field.npz"), np.load(distilled / "field.npz")
    for name in theirs.files:
        np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)


def test_a_field_is_found_within_the_run_of_its_scene(gsjax, pristine, scene, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    shutil.copy(scene, run / "scene.ply")
    settings = {
        "dataset": str(pristine),
        "frames": "0:1",
        "cameras": [],
        "eval_cameras": [2],
        "test_every": 8,
    }
    (run / "config.yml").write_text(
        "# gsjax run\n" + yaml.safe_dump(settings | {"fit": {"antialiased": False}})
    )
    code, said = gsjax("distill", run, *SMALL, "--field.iterations", 20)
    assert code == 0, said
    assert (run / "field" / "field.npz").is_file()
    code, said = gsjax("query", run, "can", "--threshold", 0.0)
    assert code == 0, said
    assert (run / "query" / "selection.npz").is_file()
    moved = run.rename(tmp_path / "elsewhere")
    code, said = gsjax("query", moved, "can", "--threshold", 0.0)
    assert code == 0, said
    code, said = gsjax("distill", moved, "--frames", "0:2", "--overwrite")
    assert code == 2
    assert "--frames" in said


def test_colours_need_no_names_and_answer_to_pictures(gsjax, pristine, scene, tmp_path):
    out = tmp_path / "closed"
    told = ("--features", "closed", "--masks", "segment", *SMALL, *TABLE, "--field.iterations", STEPS)
    code, said = gsjax("distill", scene, "--out", out, *images(pristine), *told)
    assert code == 0, said
    assert _metrics(out)["masks"] == "segment"
    code, said = gsjax("query", out, "red", "--threshold", 0.5)
    assert code == 0, said
    red = np.zeros((20, 20, 3), np.uint8)
    red[..., 2] = 200
    cv2.imwrite(str(tmp_path / "red.png"), red)
    code, said = gsjax("query", out, "--image", tmp_path / "red.png")
    assert code == 0, said
    code, said = gsjax("query", out, "spoon")
    assert code == 2
    assert "'spoon'" in said


def test_what_was_encoded_is_not_encoded_again(gsjax, monkeypatch, pristine, scene, tmp_path, cache):
    told = ("distill", scene, *images(pristine), *SMALL, "--field.iterations", 2)
    assert gsjax(*told, "--out", tmp_path / "a")[0] == 0
    before = len(list(cache.rglob("*.npz")))
    for damaged in list(cache.rglob("*.npz"))[:1]:
        damaged.write_bytes(b"cut off")
    assert gsjax(*told, "--out", tmp_path / "b")[0] == 0
    encoded = _metrics(tmp_path / "b")["encoded"]
    assert encoded["from_cache"] >= encoded["anew"]
    assert len(list(cache.rglob("*.npz"))) == before


def test_files_of_features_are_read_and_checked(gsjax, pristine, scene, tmp_path):
    folder = tmp_path / "features"
    random = np.random.default_rng(0)
    (folder / "0").mkdir(parents=True)
    (folder / "1").mkdir()
    (folder / "2").mkdir()
    for camera in "012":
        np.save(folder / camera / "0.npy", random.normal(size=(15, 20, 12)).astype(np.float32))
    told = ("distill", scene, *images(pristine), *SMALL, "--field.iterations", 2, "--features", folder)
    assert gsjax(*told, "--out", tmp_path / "a")[0] == 0
    assert _metrics(tmp_path / "a")["dimension"] == 12
    code, said = gsjax("query", tmp_path / "a", "can")
    assert code == 2
    assert "--weights" in said
    assert "--point" in said

    def refused(array, *words):
        np.save(folder / "1" / "0.npy", array)
        code, said = gsjax(*told, "--out", tmp_path / "b")
        assert code == 2
        assert all(word in said for word in words), said

    refused(random.normal(size=(15, 50, 12)), "80x60", "50x15")
    refused(random.normal(size=(15, 20, 7)), "12", "7", "0.npy")
    refused(np.full((15, 20, 12), np.nan), "NaN", "0.npy")
    refused(np.array([{}], object), "0.npy")
    (folder / "1" / "0.npy").unlink()
    code, said = gsjax(*told, "--out", tmp_path / "b")
    assert code == 2
    assert "1/0" in said
    assert not (tmp_path / "b").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ((), ("one of TEXT, --image and --point",)),
        (("can", "--point", "1,1"), ("found 2",)),
        (("cannon",), ("'cannon'", "carton")),
        (("can", "--threshold", 2), ("best score", "--threshold")),
        (("--point", "1,1"), ("--camera",)),
        (("--point", "x", "--camera", "0"), ("X,Y", "'x'")),
        (("--point", "999,1", "--camera", "0"), ("80x60", "999")),
        (("--point", "1,1", "--camera", "7"), ("0, 1, 2", "7")),
        (("--image", "nowhere.png"), ("by name",)),
        (("can", "--encoder", "clip"), ("--encoder",)),
        (("can", "--color", 2, 0, 0), ("--color",)),
    ],
)
def test_a_question_that_cannot_be_answered(gsjax, field, options, words):
    code, said = gsjax("query", field, *options)
    assert code == 2
    for word in words:
        assert word in said, said
    assert not (field / "query").exists()


def test_everything_is_an_answer_with_a_warning(gsjax, field):
    code, said = gsjax("query", field, "can", "--threshold", -1)
    assert code == 0
    assert "means all" in said
    assert not (field / "query" / "without.ply").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--features", "nothing"), ("--features nothing", "classes")),
        (("--features", "clip"), ("--weights",)),
        (("--features", "classes", "--masks", "segment"), ("--features classes",)),
        (("--weights", "x", "--features", "closed"), ("--weights",)),
        (("--sam", "x", "--masks", "files"), ("--sam",)),
        (("--scale", 2), ("--scale",)),
        (("--frames", "9:"), ("--frames",)),
        (("--resume",), ("--resume",)),
    ],
)
def test_a_distillation_that_cannot_be_done(gsjax, pristine, scene, tmp_path, options, words):
    code, said = gsjax("distill", scene, "--out", tmp_path / "field", *images(pristine), *options)
    assert code == 2
    for word in words:
        assert word in said, said
    assert not (tmp_path / "field").exists()


def test_what_is_missing_is_said(gsjax, pristine, scene, tmp_path, field):
    code, said = gsjax("distill", scene, "--out", tmp_path / "x")
    assert code == 2
    assert "--images" in said
    code, said = gsjax("distill", scene, *images(pristine))
    assert code == 2
    assert "--out" in said
    code, said = gsjax("distill", tmp_path / "nothing", *images(pristine))
    assert code == 2
    assert "gsjax fit" in said
    code, said = gsjax("query", tmp_path / "nothing", "can")
    assert code == 2
    (field / "field.npz").write_bytes(b"no archive")
    code, said = gsjax("query", field, "can")
    assert code == 2
    assert "field.npz" in said


def test_a_field_with_numbers_that_are_none_is_refused(gsjax, field):
    with np.load(field / "field.npz") as stored:
        arrays = dict(stored)
    for name, wrong in {"vectors": np.nan, "lift": np.inf}.items():
        broken = {**arrays, name: np.full_like(arrays[name], wrong)}
        np.savez(field / "field.npz", **broken)
        code, said = gsjax("query", field, "can")
        assert code == 2
        assert name in said
    np.savez(field / "field.npz", **{**arrays, "vectors": arrays["vectors"][1:]})
    code, said = gsjax("query", field, "can")
    assert code == 2
    assert "Gaussians" in said


def test_photographs_have_short_names():
    assert camera_names(["3/000000", "12/000000"]) == ("3", "12")
    assert camera_names(["images/a.jpg", "images/b.jpg"]) == ("images_a", "images_b")
    assert camera_names(["a.png", "a.jpg"]) == ("a.png", "a.jpg")
