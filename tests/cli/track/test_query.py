"""`gsjax query` and `gsjax grasp` on a run of the built-in scene, whose tracker leaves all objects still."""

import json
import re
import shutil
from types import SimpleNamespace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import yaml
from rich.console import Console

from gsjax.cli import main
from gsjax.engine.messages import Notes
from gsjax.engine.teaching.source import Source
from gsjax.engine.track import query
from gsjax.engine.track.grasp import Options, _obstacle_rows, draw_grasp
from gsjax.engine.track.query import Answer
from gsjax.engine.track.saved import SavedRun
from gsjax.engine.viewables import open_viewable
from gsjax.io.ply import read_ply
from gsjax.io.video import read_video_frames
from gsjax.methods.grasping import Grasp, Gripper
from gsjax.perception.codebook import ClassCodebook
from tests.cli.conftest import LABELS, standing_still, unfitted, write_made_field


@pytest.fixture(scope="module")
def tracked(pristine, tmp_path_factory):
    """A run of four frames in which nothing moves; camera 2 is held out."""
    out = tmp_path_factory.mktemp("runs") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsjax.engine.track.run.start_scene", unfitted)
        patch.setattr("gsjax.engine.track.loop.track", standing_still)
        options = ("--cameras", "0", "1", "--mask-camera", "1", "--eval-cameras", "2")
        assert main(["track", str(pristine), "--out", str(out), *options]) == 0
    return out


@pytest.fixture
def run(tracked, tmp_path):
    """A copy of `tracked` to corrupt."""
    return shutil.copytree(tracked, tmp_path / "run")


@pytest.mark.thorough
def test_an_answer_elsewhere_and_without_pictures(gsjax, run, tmp_path):
    out = tmp_path / "answer"
    code, said = gsjax("query", run, "the blue can", "--no-pictures", "--out", out)
    assert code == 0, said
    assert f"query {out}" in said
    with np.load(out / "selection.npz") as found:
        where = ", ".join(f"{x:.3f}" for x in found["means"][-1].mean(0))
    assert f"where {where} m in frame 3" in said
    assert {file.name for file in out.iterdir()} == {"query.json", "selection.npz"}
    assert not (run / "query").exists()


def test_query_says_which_object_and_shows_it_over_time(gsjax, run, pristine):
    code, said = gsjax("query", run, "the blue can")
    assert code == 0, said
    assert "can 0." in said
    folder = run / "query"
    told = json.loads((folder / "query.json").read_text())
    assert (told["name"], told["group"], told["label"], told["camera"]) == ("can", 3, 3, 2)
    assert told["scores"]["can"] == max(told["scores"].values())
    assert set(told["scores"]) == {"robot", "carton", "can", "ball", "block"}
    with np.load(run / "trajectory.npz") as whole, np.load(folder / "selection.npz") as found:
        members = np.flatnonzero(whole["labels"] == 3)
        np.testing.assert_array_equal(found["indices"], members)
        np.testing.assert_array_equal(found["means"], whole["means"][:, members])
        assert found["names"].tolist()[int(found["scores"].argmax())] == "can"
    masks = [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in sorted((folder / "masks").glob("*.png"))]
    assert [mask.shape for mask in masks] == [(60, 80)] * 4
    truth = cv2.imread(str(pristine / "seg" / "2" / "000000.png"), cv2.IMREAD_UNCHANGED) == 3
    found = masks[0] == 255
    assert (found & truth).sum() > 0.5 * (found | truth).sum()
    assert told["pixels"] == [int((mask > 0).sum()) for mask in masks]
    assert read_video_frames(folder / "video.mp4").shape == (4, 480, 640, 3)


@pytest.mark.thorough
def test_a_tracked_run_answers_what_only_its_field_can(gsjax, run, pristine):
    with np.load(run / "trajectory.npz") as whole:
        labels = whole["labels"]
    book = ClassCodebook({label + 1: name for label, name in LABELS.items()})
    vectors = np.stack([book.embed_text(name) for name in LABELS.values()])
    source = Source("classes", {label + 1: name for label, name in LABELS.items()})
    write_made_field(run / "field", run / "scene.ply", pristine, source, labels, vectors)
    assert gsjax("query", run, "can")[0] == 0
    assert json.loads((run / "query" / "query.json").read_text())["name"] == "can"  # the object
    code, said = gsjax("query", run, "can", "--threshold", 0.6, "--camera", 0)
    assert code == 0, said
    told = json.loads((run / "query" / "query.json").read_text())
    assert (told["features"], told["threshold"], told["gaussians"]) == ("classes", 0.6, (labels == 3).sum())
    # It is found in all frames, as the field moves along with the Gaussians.
    with np.load(run / "query" / "over_time.npz") as found, np.load(run / "trajectory.npz") as whole:
        np.testing.assert_allclose(found["means"], whole["means"][:, labels == 3], atol=1e-6)
        assert found["frames"].tolist() == [0, 1, 2, 3]
        masks = [
            cv2.imread(str(pristine / "seg" / "0" / f"{t:06d}.png"), cv2.IMREAD_UNCHANGED) for t in range(4)
        ]
        true = np.array([(mask == 3).sum() for mask in masks])
        np.testing.assert_allclose(found["pixels"], true, atol=0.5 * true.max())
    assert read_video_frames(run / "query" / "video.mp4").shape == (4, 480, 640, 3)
    # It is found there too without pictures, and without the film.
    for name, less in (("bare", "--no-pictures"), ("still", "--no-film")):
        code, said = gsjax("query", run, "can", "--threshold", 0.6, less, "--out", run / name)
        assert code == 0, said
        assert json.loads((run / name / "query.json").read_text())["at_last"] == told["at_last"]
        with np.load(run / name / "over_time.npz") as found:
            assert (set(found), found["means"].shape[0]) == ({"frames", "means"}, 4)
        assert not (run / name / "video.mp4").exists()
    # The viewer queries it in any frame, and saves what was found as it is in that frame.
    with Notes(Console(quiet=True)) as notes:
        scene = open_viewable(run, notes)[0]
    assert notes.all == []
    answer = scene.asking.ask("can", 2)
    np.testing.assert_array_equal(answer.scores > answer.threshold, labels == 3)
    saved = scene.asking.save(labels == 3, "can", 2)
    assert saved.name == "can_frame_2.ply"
    np.testing.assert_allclose(
        read_ply(saved)[0].means, np.asarray(scene.motion.at(2).means)[labels == 3], atol=1e-6
    )


@pytest.mark.parametrize(("option", "value"), [("--threshold", 0.5), ("--negatives", "x"), ("--scene", "x")])
def test_a_tracked_run_without_a_field_says_so(gsjax, tracked, option, value):
    code, said = gsjax("query", tracked, "can", option, value)
    assert code == 2
    assert f"{option}: {tracked} has no field that could be queried so; gsjax distill" in said


@pytest.mark.parametrize("command", ["query", "grasp"])
def test_what_somebody_else_left_there_is_kept(gsjax, run, command):
    (run / command).mkdir()
    (run / command / "precious.txt").write_text("mine")
    code, said = gsjax(command, run, "can")
    assert code == 2
    assert "found precious.txt; move it elsewhere" in said
    assert (run / command / "precious.txt").read_text() == "mine"


@pytest.mark.thorough
def test_a_second_query_leaves_nothing_of_the_first(gsjax, run):
    assert gsjax("query", run, "can")[0] == 0
    (run / "query" / "masks" / "999999.png").touch()
    assert gsjax("query", run, "largest object", "--camera", "0")[0] == 0
    told = json.loads((run / "query" / "query.json").read_text())
    assert (told["name"], told["camera"]) == ("robot", 0)
    assert len(list((run / "query" / "masks").iterdir())) == 4


@pytest.mark.parametrize("command", ["query", "grasp"])
@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("red can",), "'red can' matches none of the objects of"),
        (("red can",), "The objects are: ca"),
        (("mug",), "the closed vocabulary has no word 'mug'. It has colors: black"),
        (("mug",), "names: robot, carton, can, ball, block"),
        (("the object",), "no word in 'the object' that tells objects apart"),
        (("can", "--camera", "7"), "--camera: "),
        (("can", "--camera", "7"), "has no camera 7; it has [0, 1, 2]."),
        (("can", "--encoder", "clip"), "expected --weights PATH as well"),
        (("can", "--weights", "x"), "--weights: expected none with the closed vocabulary"),
        (("can", "--encoder", "clip", "--weights", "x"), "x: expected a folder of CLIP's weights"),
        (("can", "--min-score", "0.9"), "and 0.90 is required"),
    ],
)
def test_what_cannot_be_answered(gsjax, tracked, command, options, says):
    code, said = gsjax(command, tracked, *options)
    assert code == 2
    assert says in said
    assert "earlier answer" not in said
    assert not (tracked / command).exists()


def test_help_tells_options_of_fields_from_those_of_tracked_runs(capfd):
    with pytest.raises(SystemExit):
        main(["query", "--help"])
    groups = "─ (?:gaussians|field|deform|track) options ─"
    shared, gaussians, field, deform, track = re.split(groups, capfd.readouterr().out)
    where = {"--camera": shared, "--threshold": gaussians, "--negatives": gaussians, "--image": field}
    where["--box"] = deform
    where["--min-score"] = track
    for option, group in where.items():
        assert option in group
        others = {"shared": shared, "gaussians": gaussians, "field": field, "deform": deform, "track": track}
        assert [name for name, text in others.items() if f"{option} " in text and text is not group] == []


def test_what_fits_two_alike_is_said(gsjax, run):
    code, said = gsjax("query", run, "can", "--min-score", "0")
    assert code == 0
    assert "about as well" not in said
    code, said = gsjax("query", run, "pink", "--min-score", "0")
    assert "fits 'pink' about as well" in said


@pytest.mark.parametrize(
    ("break_it", "says"),
    [
        (
            lambda run: shutil.rmtree(run),
            "expected the folder of a run, found nothing there",
        ),
        (lambda run: (run / "config.yml").write_text("a: 1"), "config.yml begins with '# gsjax run'"),
        (lambda run: (run / "config.yml").write_text("# gsjax run\na: 1"), "expected a run's settings"),
        (lambda run: (run / "scene.ply").unlink(), "expected a complete run, found no scene.ply"),
        (lambda run: (run / "metrics.json").write_text("[]"), "expected a run's scores"),
        (lambda run: (run / "trajectory.npz").write_bytes(b"x"), "trajectory.npz: expected plain arrays"),
        (lambda run: np.savez(run / "trajectory.npz", means=0), "expected an array quats, found means"),
        (lambda run: _another_recording(run), "its recording cannot be opened"),
    ],
)
def test_a_run_that_is_none(gsjax, run, break_it, says):
    break_it(run)
    code, said = gsjax("query", run, "can")
    assert code == 2
    assert says in said


def _another_recording(run):
    config = run / "config.yml"
    settings = yaml.safe_load(config.read_text()) | {"dataset": "gone"}
    config.write_text("# gsjax run\n" + yaml.safe_dump(settings))


@pytest.mark.thorough
def test_grasps_are_found_frame_by_frame_and_drawn(gsjax, run):
    code, said = gsjax("grasp", run, "can", "--samples", "128")
    assert code == 0
    assert "can: a feasible grasp in 4 of 4 frames" in said
    with np.load(run / "grasp" / "grasps.npz") as found, np.load(run / "trajectory.npz") as whole:
        assert found["poses"].shape == (4, 4, 4)
        np.testing.assert_array_equal(found["times"], whole["times"])
        assert found["feasible"].all()
        assert (found["widths"] <= 0.08).all()
        can = whole["means"][:, whole["labels"] == 3].mean(axis=1)
        assert (np.linalg.norm(found["poses"][:, :3, 3] - can, axis=1) < 0.06).all()
        # Nothing moves, and the samples are the same in each frame.
        np.testing.assert_allclose(found["poses"][1:], found["poses"][:-1], atol=1e-6)
    assert read_video_frames(run / "grasp" / "video.mp4").shape == (4, 480, 640, 3)
    assert len(list((run / "grasp").glob("frame_*.png"))) == 1


@pytest.mark.thorough
def test_no_feasible_grasp_is_said_and_is_no_success(gsjax, run):
    code, said = gsjax("grasp", run, "can", "--samples", "16", "--gripper.max-width", "0.01")
    assert code == 3
    assert "can: no feasible grasp in any of 4 frames" in said
    with np.load(run / "grasp" / "grasps.npz") as found:
        assert not found["feasible"].any()


def test_what_is_to_be_ignored_must_be_there(gsjax, tracked):
    code, said = gsjax("grasp", tracked, "can", "--ignore", "gripper")
    assert code == 2
    assert "has no object 'gripper'; it has robot, carton" in said


@pytest.mark.parametrize("approach", [("0", "0", "0"), ("0", "0", "nan")])
def test_an_approach_must_have_a_direction(capfd, tracked, approach):
    with pytest.raises(SystemExit, match="2"):
        main(["grasp", str(tracked), "can", "--approach", *approach])
    said = " ".join(capfd.readouterr().err.replace("│", " ").split())
    assert f"--approach: expected a direction, such as 0 0 -1, found {' '.join(approach)}" in said


@pytest.mark.thorough
def test_nothing_at_all_may_be_ignored(gsjax, run):
    """`--ignore` without names means that no object is ignored, not that the default applies."""
    code, said = gsjax("grasp", run, "can", "--samples", "16", "--ignore")
    assert code in (0, 3), said


def test_a_grasp_is_drawn_where_it_is():
    picture = np.full((200, 300, 3), 40, np.uint8)
    K = np.array([[200.0, 0, 150], [0, 200, 100], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, 3] = [0.1, 0.0, 1.0]
    grasp = Grasp(pose, np.float32(0.06), np.float32(0.9), np.bool_(True))
    drawn = draw_grasp(picture, grasp, Gripper(), np.eye(4), K)
    changed = np.argwhere((drawn != picture).any(-1))
    changed = changed[changed[:, 0] >= 30]  # below the caption
    # At one metre, 200 pixels a metre: 20 to the right of the middle, 12 pixels wide and a margin.
    assert (abs(changed.mean(0) - [100, 170]) < 4).all()
    assert np.ptp(changed[:, 0]) < 30
    for nowhere in (-pose, np.full((4, 4), np.nan)):  # behind the camera; nothing found
        drawn = draw_grasp(picture, grasp._replace(pose=nowhere), Gripper(), np.eye(4), K)
        np.testing.assert_array_equal(drawn[30:], picture[30:])


def test_what_is_beside_the_end_of_a_long_object_is_an_obstacle(tmp_path):
    """A bar of 80 cm, a point 3 cm beside its end, and one 1 m away from there."""
    bar = [[x, 0.0, 0.0] for x in np.linspace(-0.4, 0.4, 41)]
    means = np.array([[*bar, [0.4, 0.03, 0.0], [1.4, 0.03, 0.0]]])
    gaussians = SimpleNamespace(opacities=np.ones(43))
    tracking = SimpleNamespace(scene=SimpleNamespace(labels=np.array([1] * 41 + [0, 0]), gaussians=gaussians))
    saved = Mock(spec=SavedRun, names={1: "bar"}, tracking=tracking)
    answer = Answer(1, "bar", {}, 0.0, 0.0, np.arange(41))
    assert _obstacle_rows(Options(tmp_path, "bar"), saved, answer, means).tolist() == [41]


def test_brackets_in_the_name_of_an_object_are_printed(capsys):
    query._print_scores({"can[red]": 0.5}, "can[red]")
    assert "can[red]" in capsys.readouterr().out
