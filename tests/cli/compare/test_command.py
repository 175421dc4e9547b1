"""`gsjax compare`: the best run by each comparable score, over the views that the runs have in common."""

import json
import shutil

import cv2
import numpy as np
import pytest
import yaml

from gsjax.cli import main
from gsjax.engine.compare.comparison import labels
from gsjax.engine.pictures import PANELS
from gsjax.engine.records import digest
from gsjax.viz.colors import side_by_side

MACHINE = {"processor": "A", "cores": 2, "device": "cpu", "devices": 1}
VIEWS = ("images/1.jpg", "images/2.jpg", "images/3.jpg")


def photograph(view, size=(240, 320)):
    return np.random.default_rng(VIEWS.index(view)).integers(0, 255, (*size, 3), np.uint8)


@pytest.fixture
def make(tmp_path):
    """Writes as much of a run of `gsjax fit` as a comparison reads; returns its folder."""

    def made(name, psnr=(20.0, 22.0, 24.0), views=VIEWS, evaluated=None, config=None, **metrics):
        run = tmp_path / name
        run.mkdir(parents=True)
        fit = {"steps": 100, "growth": {"every": 10}}
        settings = {"dataset": "data/fox", "out": str(run), "scale": 0.5, "test_every": 8, "debug": False}
        settings |= {"fit": fit | (config or {})}
        (run / "config.yml").write_text("# gsjax run\n" + yaml.safe_dump(settings))
        (run / "scene.ply").write_bytes(name.encode())
        rows = []
        for i, (view, score) in enumerate(zip(views, psnr, strict=True)):
            picture = f"renders/held_out/{i:06d}.png"
            (run / picture).parent.mkdir(parents=True, exist_ok=True)
            truth = photograph(view)
            drawn = np.clip(truth.astype(int) + int(score), 0, 255).astype(np.uint8)
            cv2.imwrite(str(run / picture), side_by_side(truth, drawn, captions=PANELS)[..., ::-1])
            known = {"ssim": score / 40, "depth_mm": None, "picture": picture}
            rows.append({"view": view, "psnr": score} | known)
        found = {"kind": "fit", "dataset": "fox", "complete": True, "size": [320, 240], "views": rows}
        found |= {"photographs": {"fitted": 9, "held_out": len(views)}, "steps": 100, "machine": MACHINE}
        found |= {"seconds": {"fit": 60.0, "compile": 30.0, "total": 99.0}, "num_gaussians": 500}
        (run / "metrics.json").write_text(json.dumps(found | metrics))
        curve = [
            {"step": 50 * i, "seconds": 30.0 * i, "alive": 200 * i, "test_psnr": None if i == 2 else 18.0 + i}
            for i in (1, 2, 3)
        ]
        (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in curve))
        if evaluated is not None:
            weights, *perceived = evaluated
            scored = [
                {"view": view, "split": "held out", "ms_ssim": 0.9, "lpips": value}
                for view, value in zip(views, perceived, strict=True)
            ]
            scored.append({"view": "images/9.jpg", "split": "train", "ms_ssim": 0.1, "lpips": 0.9})
            lpips = {"absent": "no"} if weights is None else {"network": "AlexNet", "weights": weights}
            evaluation = {"scene_sha256": digest(run / "scene.ply"), "lpips": lpips, "views": scored}
            (run / "eval").mkdir()
            (run / "eval" / "metrics.json").write_text(json.dumps(evaluation))
        return run

    return made


@pytest.fixture
def gsjax_compare(tmp_path, capfd):
    """Runs `gsjax compare` into tmp_path/comparison; returns the exit code, output and comparison.json."""

    def call(*runs, out=tmp_path / "comparison"):
        code = main(["compare", *map(str, runs), *(["--out", str(out)] if out else [])])
        said = "".join(capfd.readouterr())
        assert "Traceback" not in said
        found = json.loads((out / "comparison.json").read_text()) if out and code == 0 else None
        return code, said, found

    return call


def by_run(found, key):
    return {row["run"]: row[key] for row in found["runs"]}


def test_the_best_of_each_column_stands_out(make, gsjax_compare, tmp_path):
    a = make("a", evaluated=("w", 0.3, 0.2, 0.1), num_gaussians=400)
    b = make("b", psnr=(21.0, 23.0, 25.0), evaluated=("w", 0.4, 0.2, 0.3), config={"steps": 200, "cap": 7})
    code, said, found = gsjax_compare(a, b)
    assert code == 0, said
    assert by_run(found, "psnr") == {"a": pytest.approx(22.0), "b": pytest.approx(23.0)}
    assert by_run(found, "lpips") == {"a": pytest.approx(0.2), "b": pytest.approx(0.3)}
    assert by_run(found, "minutes") == {"a": 1.5, "b": 1.5}
    (group,) = found["groups"]
    assert group["views"] == list(VIEWS)
    # Equal scores (MS-SSIM, minutes) have no best, and neither more nor fewer steps are better.
    assert group["best"] == {"psnr": ["b"], "ssim": ["b"], "lpips": ["a"], "num_gaussians": ["a"]}
    assert found["options"] == {"fit.steps": {"a": 100, "b": 200}}
    assert "Another version of gsjax made a: no setting fit.cap there." in found["notes"]
    for words in ("PSNR", "dB ↑", "23.00", "fit.steps"):
        assert words in said
    page = (tmp_path / "comparison" / "report.html").read_text()
    assert '<td class="number best">23.00</td>' in page
    assert '<td class="number">22.00</td>' in page
    assert page.count("data:image/png") == len(VIEWS)
    assert page.count("data:image/svg") == 1
    # The photograph, then each run; below the captions, the pictures are the runs' own.
    strip = cv2.imread(str(tmp_path / "comparison" / "pictures" / "0_0000.png"))[..., ::-1]
    assert strip.shape == (240, 3 * 320, 3)
    truth = photograph(VIEWS[0]).astype(int)
    for i, brighter in enumerate((0, 20, 21)):
        expected = np.clip(truth + brighter, 0, 255)
        np.testing.assert_array_equal(strip[60:, 320 * i : 320 * (i + 1)], expected[60:])


def test_only_tables_are_printed_without_a_folder(make, gsjax_compare, tmp_path):
    code, said, _ = gsjax_compare(make("a"), make("b", psnr=(1.0, 2.0, 3.0)), out=None)
    assert code == 0
    assert "22.00" in said
    assert not (tmp_path / "comparison").exists()


def test_scores_are_of_the_views_in_common(make, gsjax_compare):
    a = make("a", psnr=(20.0, 30.0, 40.0))
    b = make("b", psnr=(33.0, 35.0), views=VIEWS[1:])
    _, _, found = gsjax_compare(a, b)
    assert by_run(found, "psnr") == {"a": pytest.approx(35.0), "b": pytest.approx(34.0)}
    assert found["groups"][0]["views"] == list(VIEWS[1:])
    assert "a, b: different views were held out; scores are means over the 2 in common." in found["notes"]


@pytest.mark.parametrize("other", ["views", "photographs"])
def test_scores_of_different_views_are_not_compared(make, gsjax_compare, tmp_path, other):
    a = make("a", psnr=(20.0,), views=VIEWS[:1])
    b = make("b", psnr=(33.0,), views=VIEWS[1:2] if other == "views" else VIEWS[:1], num_gaussians=3)
    if other == "photographs":
        shutil.copy(make("c") / "renders/held_out/000002.png", b / "renders/held_out/000000.png")
    _, _, found = gsjax_compare(a, b)
    assert by_run(found, "psnr") == {"a": 20.0, "b": 33.0}
    assert found["groups"][0]["best"] == {"num_gaussians": ["b"]}
    said = {"views": "no held-out view in common", "photographs": "images/1.jpg show different photographs"}
    assert any(said[other] in note for note in found["notes"])
    assert list((tmp_path / "comparison" / "pictures").iterdir()) == []
    assert list((tmp_path / "comparison" / "plots").iterdir()) == []


def test_runs_of_different_data_are_apart(make, gsjax_compare, tmp_path):
    runs = [make("a"), make("b", psnr=(30.0, 30.0, 30.0))]
    runs += [make("c", dataset="garden"), make("d", size=[640, 480])]
    code, _, found = gsjax_compare(*runs)
    assert code == 0
    assert [group["labels"] for group in found["groups"]] == [["a", "b"], ["c"], ["d"]]
    assert [group["best"].get("psnr") for group in found["groups"]] == [["b"], None, None]
    note = "fox at 320x240: a, b; garden at 320x240: c; fox at 640x480: d"
    assert f"Only runs of the same data are compared with each other: {note}." in found["notes"]
    assert "Runs of garden" in (tmp_path / "comparison" / "report.html").read_text()


def test_unfinished_runs_are_marked_and_never_best(make, gsjax_compare):
    stopped = make("stopped", psnr=(40.0, 40.0, 40.0), complete=False)
    going_on = make("going_on")
    (going_on / "metrics.json").unlink()
    code, said, found = gsjax_compare(make("a"), make("b", psnr=(1.0, 1.0, 1.0)), stopped, going_on)
    assert code == 0
    assert "stopped (partial)" in said
    assert found["groups"][0]["labels"] == ["a", "b", "stopped", "going_on"]
    assert found["groups"][0]["best"]["psnr"] == ["a"]
    assert by_run(found, "psnr")["going_on"] is None
    assert by_run(found, "steps")["going_on"] == 150
    assert by_run(found, "num_gaussians")["going_on"] == 600
    assert by_run(found, "minutes")["going_on"] == 1.5
    assert any("going_on is still going on, or was killed" in note for note in found["notes"])
    assert any("stopped was stopped" in note for note in found["notes"])


def test_what_is_not_alike_is_left_out_and_said(make, gsjax_compare):
    a = make("a", evaluated=("one", 0.1, 0.1, 0.1))
    b = make("b", evaluated=("two", 0.2, 0.2, 0.2), machine=MACHINE | {"processor": "B"})
    c = make("c", evaluated=(None, None, None, None), seconds={"fit": 6.0, "compile": 0.0, "total": 9.0})
    d = make("d", evaluated=("one", 0.1, 0.1, 0.1))
    (d / "scene.ply").write_text("resumed since")
    _, _, found = gsjax_compare(a, b, c, d)
    assert not {"lpips", "minutes"} & set(found["groups"][0]["best"])
    assert by_run(found, "lpips")["c"] is by_run(found, "lpips")["d"] is None
    notes = " ".join(found["notes"])
    assert "LPIPS is of different weights and not compared" in notes
    assert "run on different machines; time is not compared" in notes
    assert "LPIPS is absent for c, evaluated without weights" in notes
    assert f"{d}: the scores of `gsjax eval` are of an earlier scene" in notes
    assert "MS-SSIM and LPIPS are absent for d: gsjax eval RUN adds them" in notes


def test_a_run_whose_training_views_alone_were_evaluated_is_named(make, gsjax_compare):
    a, b = (make(name, evaluated=("w", 0.3, 0.2, 0.1)) for name in "ab")
    file = a / "eval" / "metrics.json"
    found = json.loads(file.read_text())
    found["views"] = [row for row in found["views"] if row["split"] == "train"]
    file.write_text(json.dumps(found))
    assert "MS-SSIM and LPIPS are absent for a: gsjax eval RUN adds them" in " ".join(
        gsjax_compare(a, b)[2]["notes"]
    )


@pytest.mark.thorough
def test_runs_of_the_tracker_are_compared_and_kinds_not_mixed(
    make, gsjax_compare, recording, still, gsjax_track, tmp_path
):
    assert gsjax_track(recording, "--cameras", "0", "1", "--eval-cameras", "2")[0] == 0
    first = tmp_path / "run"
    second = shutil.copytree(first, tmp_path / "better")
    metrics = json.loads((first / "metrics.json").read_text())
    metrics["tracked"]["psnr"] += 1
    (second / "metrics.json").write_text(json.dumps(metrics))
    settings = yaml.safe_load((first / "config.yml").read_text())
    settings["track"]["match"]["patch"] = 1
    (second / "config.yml").write_text("# gsjax run\n" + yaml.safe_dump(settings))
    code, said, found = gsjax_compare(first, second)
    assert code == 0, said
    assert found["kind"] == "track"
    assert found["groups"][0]["best"] == {"psnr": ["better"]}
    assert by_run(found, "frames") == {"run": 4, "better": 4}
    assert by_run(found, "iou")["run"] == min(metrics["iou"].values())
    assert list(found["options"]) == ["track.match.patch"]
    code, said, _ = gsjax_compare(first, make("a"))
    assert code == 2
    assert "expected runs of one command, found those of `gsjax track`" in said
    assert "and `gsjax fit`" in said


def test_mistakes_are_said_and_nothing_is_written(make, gsjax_compare, tmp_path):
    a, b = make("a"), make("b")
    for runs, says in (
        ((a,), "expected two runs or more to compare, found 1"),
        ((a, a), "named twice"),
        ((a, tmp_path / "none"), "expected the folder of a run, found nothing there"),
    ):
        code, said, _ = gsjax_compare(*runs)
        assert code == 2
        assert says in said
    assert not (tmp_path / "comparison").exists()
    for out, says in ((a, "found a run"), (tmp_path, "found other files"), (a / "scene.ply", "found a file")):
        code, said, _ = gsjax_compare(a, b, out=out)
        assert code == 2
        assert says in said
    for name in ("metrics.json", "metrics.jsonl"):
        for text in ("{", "{}"):
            whole = (a / name).read_text()
            (a / name).write_text(text)
            code, said, _ = gsjax_compare(a, b)
            assert code == 2
            assert f"{name}: expected" in said
            (a / name).write_text(whole)
    assert gsjax_compare(a, b)[0] == gsjax_compare(b, a)[0] == 0  # an earlier comparison is replaced
    (tmp_path / "comparison" / "pictures" / "holiday.png").write_bytes(b"mine")
    code, said, _ = gsjax_compare(a, b)
    assert code == 2
    assert "found holiday.png; move it elsewhere" in said
    assert list((tmp_path / "comparison" / "plots").glob("*.svg"))  # the plots are as they were, too


def test_labels_say_as_much_of_a_path_as_tells_it_from_others(tmp_path):
    paths = [tmp_path / "x" / "run", tmp_path / "y" / "run", tmp_path / "y" / "other"]
    assert labels(paths) == ["x/run", "y/run", "other"]
