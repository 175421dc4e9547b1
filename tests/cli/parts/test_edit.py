"""`gsjax edit` on a run of `gsjax parts` made by hand: two parts that move in front of three cameras."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from rich.console import Console

from gsjax.data.video import describe_video
from gsjax.engine.files import write_scene
from gsjax.engine.messages import Notes
from gsjax.engine.parts import films
from gsjax.engine.parts.films import shots
from gsjax.engine.parts.outputs import write_parts
from gsjax.engine.parts.saved import open_parts_run, read_parts
from gsjax.io.ply import read_ply
from gsjax.io.video import read_video_frames
from gsjax.methods.parts import PartScene, gaussians_at, moment, trajectory_of
from gsjax.methods.parts.timeline import apply, parse_op, parse_script
from gsjax.scene.gaussians import gaussians_from_activated
from gsjax.scene.handles import HandlePose

DATASET = "simulated:articulated?width=48&height=36&frames=4&cameras=3"
STEP = 1 / 15  # seconds between its frames
SCRIPT = """
fps: 15
edits:
  - {op: speed, parts: [drawer], factor: 0.5}
  - {op: move, parts: [part 2], by: [0, 0, 0.1], from: 0.2}
"""


def scene_and_trajectory():
    """A red part that slides along x, a green one that rotates about z, and a grey background."""
    rng = np.random.default_rng(0)
    labels = np.arange(200) % 3
    centers = np.array([[0.0, 0.0, 0.0], [0.1, -0.2, 0.2], [0.1, 0.3, 0.2]])
    means = centers[labels] + rng.uniform(-0.08, 0.08, (200, 3))
    gaussians = gaussians_from_activated(
        jnp.asarray(means, float),
        jnp.asarray(np.tile([1.0, 0, 0, 0], (200, 1)), float),
        jnp.full((200, 3), 0.02),
        jnp.full(200, 0.9),
        jnp.asarray(np.array([[0.5, 0.5, 0.5], [0.9, 0.1, 0.1], [0.1, 0.9, 0.1]])[labels], float),
    )
    scene = PartScene(gaussians, jnp.eye(3)[labels], jnp.asarray(centers, float))
    quats, shifts = np.zeros((4, 3, 4)), np.zeros((4, 3, 3))
    angles = np.array([0.0, 0.3, 0.6, 0.9]) / 2
    quats[..., 0] = 1
    quats[:, 2, 0], quats[:, 2, 3] = np.cos(angles), np.sin(angles)
    shifts[:, 1, 0] = [0.0, 0.05, 0.1, 0.15]
    poses = HandlePose(jnp.asarray(quats, float), jnp.asarray(shifts, float))
    return scene, trajectory_of(jnp.asarray(STEP * np.arange(4), float), poses)


def write_run(path, *, followed=4, anchor=0, origin=None):
    """Writes as much of a run of `gsjax parts` as is read of it; returns its folder."""
    path.mkdir()
    settings = {"dataset": DATASET, "cameras": [0, 1], "eval_cameras": [2], "frames": ":"}
    settings |= {"read": {"images": "images"}, "parts": {"stream": {"blend": "quaternion"}}}
    (path / "config.yml").write_text("# gsjax run\n" + yaml.safe_dump(settings))
    scene, trajectory = scene_and_trajectory()
    write_parts(path / "parts.npz", scene, trajectory, anchor, origin)
    write_scene(path / "scene.ply", scene.gaussians, np.asarray(scene.labels), origin=origin)
    true = enumerate(("Drawer", "shut door"), 1)
    rows = [{"part": part, "name": f"part {part}", "true_name": name} for part, name in true]
    (path / "metrics.json").write_text(json.dumps({"frames": {"followed": followed}, "parts": rows}))
    return path


@pytest.fixture
def run(tmp_path):
    return write_run(tmp_path / "run")


def moved_away(run):
    config = run / "config.yml"
    config.write_text(config.read_text().replace(DATASET, "gone"))


def test_a_run_is_read_as_it_was_written(run):
    saved = open_parts_run(run)
    scene, trajectory = scene_and_trajectory()
    assert saved.complete
    assert saved.names == {"part 1": 1, "part 2": 2, "drawer": 1, "shut_door": 2}
    assert (saved.camera(None), saved.camera(1)) == (2, 1)
    for t in range(4):
        was = gaussians_at(scene, moment(trajectory, t))
        now = gaussians_at(saved.layer.scene, moment(saved.layer.trajectory, t))
        for name in ("means", "quats", "log_scales", "logit_opacities", "sh0"):
            np.testing.assert_allclose(getattr(now, name), getattr(was, name), atol=1e-6)


@pytest.mark.parametrize(
    ("anchor", "followed", "kept"), [(1, 2, [1, 2]), (1, 3, [1, 2, 3]), (2, 3, [1, 2, 3])]
)
def test_of_a_partial_run_only_what_was_followed_is_taken(tmp_path, anchor, followed, kept):
    """Frames are followed from the anchor on, then back from it."""
    saved = open_parts_run(write_run(tmp_path / "run", followed=followed, anchor=anchor))
    assert not saved.complete
    np.testing.assert_allclose(saved.layer.trajectory.times, STEP * np.array(kept), rtol=1e-6)


@pytest.mark.thorough
def test_a_script_is_filmed_and_can_be_given_again(gsjax, run, tmp_path):
    script = tmp_path / "slow.yaml"
    script.write_text(SCRIPT)
    code, said = gsjax("edit", run, script, "--op", "fade:parts=drawer,opacity=0.5", "--ply")
    assert code == 0, said
    folder = run / "edit" / "slow"
    assert "warning: shut_door goes up to 100 mm" in said
    assert str(folder) in said
    assert "fade: drawer (1)" in said
    found = json.loads((folder / "metrics.json").read_text())
    # The drawer takes twice its 0.2 s: six steps of 1/15 s, hence seven frames.
    assert (found["frames"], found["fps"], found["camera"], found["complete"]) == (7, 15.0, 2, True)
    assert found["seconds"] == pytest.approx(7 / 15)
    assert found["render_hz"] > 0
    assert any("shut_door goes up to 100 mm" in note for note in found["notes"])
    video = describe_video(folder / "video.mp4")
    assert (video.frames, video.width, video.height) == (7, 48, 36)
    applied = parse_script((folder / "edit.yaml").read_text())
    given = parse_script(SCRIPT)
    assert applied.edits == (*given.edits, parse_op("fade:parts=drawer,opacity=0.5"))
    assert (applied.fps, applied.length) == (given.fps, given.length)
    files = sorted(path.name for path in (folder / "ply").iterdir())
    assert files == [f"{t:06d}.ply" for t in range(7)]
    last, seen = read_ply(folder / "ply" / "000006.ply")[0], scene_and_trajectory()
    was = gaussians_at(seen[0], moment(seen[1], 3))
    raised = np.where(np.asarray(seen[0].labels)[:, None] == 2, [0.0, 0.0, 0.1], 0.0)
    np.testing.assert_allclose(last.means, was.means + raised, atol=1e-5)
    code, said = gsjax("edit", run, folder / "edit.yaml", "--out", tmp_path / "again")
    assert code == 0, said
    assert (tmp_path / "again" / "edit.yaml").read_text() == (folder / "edit.yaml").read_text()
    np.testing.assert_array_equal(
        read_video_frames(tmp_path / "again" / "video.mp4"), read_video_frames(folder / "video.mp4")
    )


def test_what_is_frozen_looks_the_same_in_all_frames(run):
    saved = open_parts_run(run)
    camera = saved.recording.judged.camera(0, 0)

    def images(line):
        film = apply(parse_script(f"edits: [{line}]"), saved.layer, saved.names)
        return np.stack([shot.image for shot in shots(film, camera, saved)])

    frozen = images("{op: freeze, parts: all}")
    assert len(frozen) == 4
    assert frozen.max() > 0.3
    np.testing.assert_array_equal(frozen, np.broadcast_to(frozen[:1], frozen.shape))
    moving = images("{op: freeze, parts: [drawer]}")
    assert np.abs(moving[-1] - moving[0]).max() > 0.1
    np.testing.assert_array_equal(moving[0], frozen[0])


def test_a_film_of_another_length_compiles_nothing(run, caplog):
    saved = open_parts_run(run)
    camera = saved.recording.judged.camera(0, 0)

    def filmed(factor):
        film = apply(parse_script(f"edits: [{{op: speed, parts: 1, factor: {factor}}}]"), saved.layer, {})
        return len([*shots(film, camera, saved)])

    assert filmed(0.5) == 7
    with jax.log_compiles(), caplog.at_level("WARNING"):
        assert filmed(0.25) == 13
    compiled = [one.message for one in caplog.records if one.message.startswith("Compiling ")]
    assert compiled == []


@pytest.mark.thorough
def test_edits_without_a_script_from_another_camera(gsjax, run):
    """The drawer of another run, whose recording need not exist, replaces this run's."""
    other = write_run(run.parent / "other")
    moved_away(other)
    place = f"composite:parts=drawer,from_run={other},place={{to: [0.1, 0.0, 0.5]}}"
    edits = ("--op", "fade:parts=drawer", "--op", place)
    code, said = gsjax("edit", run, *edits, "--camera", "0", "--ply")
    assert code == 0, said
    folder = run / "edit" / "ops"
    found = json.loads((folder / "metrics.json").read_text())
    assert (found["num_gaussians"], found["camera"], found["frames"], found["notes"]) == (200, 0, 4, [])
    scene, _ = scene_and_trajectory()
    drawer = np.asarray(scene.labels) == 1
    there = read_ply(folder / "ply" / "000000.ply")[0].means[-drawer.sum() :]
    shift = np.array([0.1, 0.0, 0.5]) - np.asarray(scene.centers[1])
    np.testing.assert_allclose(there, np.asarray(scene.gaussians.means)[drawer] + shift, atol=1e-5)


def test_a_film_with_parts_of_another_run_is_made_again_from_anywhere(run, tmp_path, monkeypatch):
    """Its script finds the other run, also one within a composite, from another working directory."""
    write_run(tmp_path / "other")
    within = "[{op: composite, parts: 1, from_run: other}, {op: freeze, parts: 1}]"
    script = parse_script(f"edits: [{{op: composite, parts: 1, from_run: other, edits: {within}}}]")
    saved, notes = open_parts_run(run), Notes(Console(quiet=True))
    monkeypatch.chdir(tmp_path)
    folder, film = films.new_folder(run / "edit", "ops"), (saved.layer,)
    films.write_film(folder, script, film, saved, 2, notes, watch=lambda frames, count: ())
    monkeypatch.chdir(run)
    (again,) = films.read_film(Path("edit/ops"))[0].edits
    for edit in (again, again.edits[0]):
        assert read_parts(edit.from_run)[1] == saved.names
    assert again.edits[1] == script.edits[0].edits[1]


@pytest.mark.thorough
def test_films_of_ops_alone_are_numbered_on(gsjax, run):
    once = ("edit", run, "--op", "freeze:parts=all")
    for name in ("ops", "ops_2"):
        assert gsjax(*once)[0] == 0
        assert (run / "edit" / name / "video.mp4").is_file()
    assert gsjax(*once, "--overwrite")[0] == 0
    assert gsjax("edit", run, "--op", "freeze:parts=nobody")[0] == 2
    assert sorted(folder.name for folder in (run / "edit").iterdir()) == ["ops", "ops_2"]


@pytest.mark.slow
def test_the_camera_films_to_which_the_edits_change_most(gsjax, run):
    """Each camera sees each of the two parts at a different size; pixels a part no longer covers count."""
    saved, films_of = open_parts_run(run), {}
    for part in ("drawer", "shut_door"):
        script = parse_script(f"edits: [{{op: fade, parts: {part}, opacity: 0}}]")
        film, _ = films.edited(script, saved)
        plain, _ = films.edited(parse_script("edits: []"), saved)
        apart = []
        for camera in (0, 1, 2):
            view = saved.recording.judged.camera(0, camera)
            pairs = zip(shots(film, view, saved), shots(plain, view, saved), strict=True)
            apart.append(np.mean([np.abs(a.image - b.image).max(-1) > 0.05 for a, b in pairs]))
        code, said = gsjax("edit", run, "--op", f"fade:parts={part},opacity=0", "--out", run / part)
        assert code == 0, said
        films_of[part] = json.loads((run / part / "metrics.json").read_text())["camera"]
        assert films_of[part] == int(np.argmax(apart)), apart


def test_an_edit_that_is_seen_by_what_follows_it_is_not_idle(run):
    """Alone it lies past the end of the film; a later edit lengthens the film, or brings it forward."""
    saved = open_parts_run(run)
    for text in (
        "edits: [{op: move, parts: 1, by: [0, 0, 0.1], from: 0.3}, {op: loop, parts: 2, times: 4}]",
        "{length: 0.2, edits: [{op: move, parts: 1, by: [0, 0, 0.1], from: 0.19}, "
        "{op: speed, parts: 1, factor: 2}]}",
    ):
        _, doubts = films.edited(parse_script(text), saved)
        assert not any("no visible effect" in doubt for doubt in doubts), doubts
    _, doubts = films.edited(parse_script("edits: [{op: freeze, parts: 1}, {op: freeze, parts: 1}]"), saved)
    assert doubts == ["no visible effect: edit 2 (freeze)"]


@pytest.mark.thorough
@pytest.mark.parametrize("script", ["length: 0.01", "{fps: 15, length: 0.05}", "{fps: 1000, length: 0.01}"])
def test_a_film_of_one_moment_has_a_camera(run, script):
    saved = open_parts_run(run)
    edits = replace(parse_script(script), edits=(parse_op("fade:parts=drawer,opacity=0"),))
    film, _ = films.edited(edits, saved)
    assert films.most_changed_camera(film, saved, edits) in (0, 1, 2)


@pytest.mark.thorough
def test_an_edit_near_the_end_is_looked_at(run):
    """At one third and at two thirds of the film nothing has changed yet."""
    saved = open_parts_run(run)
    for text in ("length: 3", "length: 3, fps: 30"):
        early, late = (
            parse_script(f"{{{text}, edits: [{{op: fade, parts: shut_door, opacity: 0, from: {begin}}}]}}")
            for begin in (0.0, 2.9)
        )
        cameras = [
            films.most_changed_camera(films.edited(one, saved)[0], saved, one) for one in (early, late)
        ]
        assert cameras[0] == cameras[1] != saved.camera(None)


@pytest.mark.thorough
def test_edits_that_change_nothing_are_said_to(gsjax, run):
    """The first held-out camera films them, as no camera sees a change."""
    edits = ["freeze:parts=drawer,from=9", "move:parts=drawer,by=[0,0,0.1]", "scale:parts=1,factor=1"]
    code, said = gsjax("edit", run, *(word for op in edits for word in ("--op", op)))
    assert code == 0, said
    assert "warning: no visible effect: edit 1 (freeze), edit 3 (scale)" in said
    code, said = gsjax("edit", run, "--op", edits[0])
    assert "no visible effect: edit 1 (freeze)" in said
    assert "seen by camera 2" in said


@pytest.mark.thorough
def test_an_earlier_film_is_replaced_when_asked(gsjax, run, tmp_path):
    out = tmp_path / "film"
    once = ("edit", run, "--op", "freeze:parts=all", "--out", out)
    assert gsjax(*once, "--ply")[0] == 0
    (out / "mine.txt").touch()
    code, said = gsjax(*once)
    assert (code, "holds an earlier film" in said) == (2, True)
    assert (out / "ply").is_dir()
    assert gsjax(*once, "--overwrite")[0] == 0
    assert {path.name for path in out.iterdir()} == {"edit.yaml", "metrics.json", "video.mp4", "mine.txt"}


@pytest.mark.parametrize(("signal", "by"), [((), "Ctrl-C"), (("SIGTERM",), "SIGTERM")])
def test_a_film_that_is_stopped_can_be_watched(gsjax, run, monkeypatch, signal, by):
    def stopped(*arguments):
        for count, shot in enumerate(shots(*arguments)):
            if count == 2:
                raise KeyboardInterrupt(*signal)
            yield shot

    monkeypatch.setattr(films, "shots", stopped)
    code, said = gsjax("edit", run, "--op", "speed:parts=drawer,factor=2")
    assert code == 130
    assert f"2 frames of 4 (stopped by {by})" in said
    folder = run / "edit" / "ops"
    assert describe_video(folder / "video.mp4").frames == 2
    found = json.loads((folder / "metrics.json").read_text())
    assert (found["complete"], found["stopped"], found["frames"]) == (False, by, 2)


@pytest.mark.thorough
def test_a_partial_run_is_said(gsjax, tmp_path):
    partial = write_run(tmp_path / "run", followed=2, anchor=1)
    code, said = gsjax("edit", partial, "--op", "freeze:parts=all")
    assert code == 0
    assert "is a partial run: only 2 of its frames are there" in said


def test_without_edits_it_says_which_parts_there_are(gsjax, run):
    (run / "video_2.mp4").touch()
    code, said = gsjax("edit", run)
    assert code == 0
    assert "Parts" in said
    assert "Drawer" in said
    assert f"where {run}/video_2.mp4, and those of other cameras" in said
    assert f'gsjax edit {run} --op "speed:parts=1,factor=2"' in said
    assert not (run / "edit").exists()


def test_without_edits_it_names_no_video_that_a_stopped_run_did_not_make(gsjax, tmp_path):
    code, said = gsjax("edit", write_run(tmp_path / "run", followed=2, anchor=1))
    assert code == 0
    assert "Drawer" in said
    assert "video_" not in said
