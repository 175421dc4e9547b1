"""Editing a run of `gsjax parts` in the viewer: previews, messages, and the same films as of `gsjax edit`."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from scipy.spatial import cKDTree

from gsjax.engine.messages import Notes
from gsjax.engine.parts.films import new_folder
from gsjax.engine.parts.outputs import write_parts
from gsjax.engine.parts.saved import open_parts_run
from gsjax.engine.parts.viewer import script_of
from gsjax.engine.viewables import open_viewable
from gsjax.io.video import read_video_frames
from gsjax.methods.parts import trajectory_of
from gsjax.methods.parts.film import film_gaussians
from gsjax.methods.parts.operations import OPERATIONS
from gsjax.methods.parts.timeline import apply, parse_op
from gsjax.scene.handles import HandlePose
from tests.cli.parts.test_edit import STEP, scene_and_trajectory, write_run

pytest.importorskip("viser", reason="viser is not installed")


@pytest.fixture
def run(tmp_path):
    return write_run(tmp_path / "run")


def opened(run):
    scene, _ = open_viewable(run, Notes(Console(quiet=True)))
    return scene


def always(done, asked):
    return True


def assert_the_same_in_any_order(ours, theirs):
    one, other = (
        np.concatenate([np.asarray(leaf).reshape(g.num, -1) for leaf in jax.tree.leaves(g)], axis=1)
        for g in (ours, theirs)
    )
    assert one.shape == other.shape
    for some, all_others in ((one, other), (other, one)):
        assert cKDTree(all_others).query(some)[0].max() < 1e-4


def test_the_first_frame_is_not_that_of_the_anchor(run):
    """Parts are stored as they are in the anchor frame, which is seldom the first."""
    scene, _ = scene_and_trajectory()
    quats, shifts = np.zeros((4, 3, 4)), np.zeros((4, 3, 3))
    quats[..., 0], shifts[:, 1, 0] = 1, [-0.2, -0.1, 0.0, 0.1]
    poses = HandlePose(jnp.asarray(quats, float), jnp.asarray(shifts, float))
    trajectory = trajectory_of(jnp.asarray(STEP * np.arange(4), float), poses)
    write_parts(run / "parts.npz", scene, trajectory, 2)
    shown = opened(run)
    drawer = shown.labels == 1
    x, y, z = np.asarray(scene.gaussians.means)[np.asarray(scene.labels) == 1].mean(axis=0)
    for gaussians, by in ((shown.gaussians, -0.2), (shown.at(0), -0.2), (shown.at(2), 0.0)):
        found = np.asarray(gaussians.means)[drawer].mean(axis=0)
        np.testing.assert_allclose(found, [x + by, y, z], atol=1e-5)


def test_what_is_offered(run):
    editing = opened(run).editing
    assert tuple(editing.operations) == tuple(OPERATIONS)
    assert dict(editing.parts) == {
        "drawer (1)": "drawer",
        "shut_door (2)": "shut_door",
        "background (0)": "background",
        "all": "all",
    }
    assert editing.cameras == ("camera 2 (held out)", "camera 0", "camera 1")
    assert editing.begin("speed", "drawer") == "speed:parts=drawer,factor=2"


@pytest.mark.parametrize("name", ["1", "on", "a,b", "all"])
def test_a_part_whose_name_reads_as_something_else_is_offered_by_its_number(run, name):
    """`parts=1` is part 1, whatever the name of part 2."""
    found = json.loads((run / "metrics.json").read_text())
    found["parts"][1]["true_name"] = name
    (run / "metrics.json").write_text(json.dumps(found))
    parts = opened(run).editing.parts
    assert (parts["drawer (1)"], parts[f"{name} (2)"]) == ("drawer", "2")


def test_a_part_called_background_does_not_hide_the_background(run):
    found = json.loads((run / "metrics.json").read_text())
    found["parts"][1]["true_name"] = "Background"
    (run / "metrics.json").write_text(json.dumps(found))
    parts = opened(run).editing.parts
    assert (parts["background (2)"], parts["background (0)"]) == ("background", "0")


@pytest.mark.thorough
@pytest.mark.parametrize(
    "lines",
    [
        ["speed:parts=drawer,factor=0.5"],
        ["echo:parts=drawer,copies=2,every=0.07", "scale:parts=shut_door,factor=2,from=0.1"],
        ["fade:parts=shut_door,from=0.05,to=0.15", "isolate:parts=drawer"],
        ["ghost:parts=shut_door"],
    ],
)
def test_a_preview_is_the_film(run, lines):
    saved, scene = open_parts_run(run), opened(run).editing.preview(lines).scene
    film = apply(script_of(lines), saved.layer, saved.names)
    assert scene.num_frames == len(film[0].trajectory.times)
    np.testing.assert_allclose(scene.times, film[0].trajectory.times, atol=1e-6)
    first = scene.at(0)
    for t in range(scene.num_frames):
        now = scene.at(t)
        assert_the_same_in_any_order(now, film_gaussians(film, t))
        # Gaussians that are declared still are so in everything that browsers receive.
        for name in ("means", "quats", "log_scales", "logit_opacities"):
            still = [np.asarray(getattr(g, name))[scene.num_moving :] for g in (first, now)]
            np.testing.assert_array_equal(*still)
    assert len(scene.labels) == scene.gaussians.num


def test_what_does_not_change_is_not_sent_again(run):
    editing = opened(run).editing
    assert opened(run).num_moving == 133
    assert editing.preview(["isolate:parts=drawer"]).scene.num_moving == 67
    assert editing.preview(["freeze:parts=all"]).scene.num_moving == 0
    ghost = editing.preview(["ghost:parts=drawer"]).scene
    assert (ghost.gaussians.num, ghost.num_moving) == (67, 67)
    assert ghost.name_of(0) == "drawer"


def test_photographs_are_those_of_the_same_second(run):
    recorded, slow = opened(run), opened(run).editing.preview(["speed:parts=all,factor=0.5"]).scene
    assert (recorded.num_frames, slow.num_frames) == (4, 7)
    for t, taken in ((0, 0), (2, 2), (6, 3)):  # the clock goes on as it did; only the parts are slower
        pictures = [scene.shots.load_image(at, 1) for scene, at in ((slow, t), (recorded, taken))]
        np.testing.assert_array_equal(*pictures)
    dense = opened(run).editing.preview(["speed:parts=all,factor=2"]).scene
    assert dense.shots.viewmats.shape == (dense.num_frames, 3, 4, 4)


def test_parts_of_another_run_have_names_of_their_own(run):
    other = write_run(run.parent / "other")
    line = f"composite:parts=drawer,from_run={other},place={{to: [0.1, 0.0, 0.5]}}"
    scene = opened(run).editing.preview([line, "echo:parts=drawer,copies=1,every=0.07"]).scene
    assert scene.gaussians.num == 200 + 2 * 67
    names = [scene.name_of(row) for row in range(scene.gaussians.num)]
    assert names.count("drawer") == 2 * 67
    assert names.count("part 1 of another run") == 67


def test_what_is_doubtful_and_what_cannot_be_done_is_said(run, tmp_path):
    editing = opened(run).editing
    assert editing.preview(["speed:parts=drawer,factor=2"]).doubts == []
    (doubt,) = editing.preview(["move:parts=shut_door,by=[0,0,0.1]"]).doubts
    assert "shut_door goes up to 100 mm" in doubt
    with pytest.raises(ValueError, match=r"edit 2 \(speed\): parts: .* did you mean 'drawer'\?"):
        editing.preview(["freeze:parts=1", "speed:parts=drawr,factor=2"])
    with pytest.raises(ValueError, match=r"edit 2 \(speed\): factor: expected a factor .* found 0"):
        editing.preview(["freeze:parts=1", "speed:parts=drawer,factor=0"])
    with pytest.raises(FileNotFoundError, match="gone: expected the folder of a run"):
        editing.preview(["composite:parts=drawer,from_run=gone"])
    partial = opened(write_run(tmp_path / "partial", followed=2))
    assert "is a partial run" in partial.editing.preview(["freeze:parts=all"]).doubts[0]


def test_without_its_recording_nothing_is_edited(run):
    config = run / "config.yml"
    config.write_text(config.read_text().replace("simulated:articulated", "simulated:nothing"))
    notes = Notes(Console(quiet=True))
    scene, _ = open_viewable(run, notes)
    assert scene.editing is None
    assert any("its recording is not shown, and nothing can be edited" in note for note in notes.all)


@pytest.mark.thorough
def test_a_film_is_kept_as_gsjax_edit_does(gsjax, run, tmp_path):
    lines = ["echo:parts=drawer,copies=2,every=0.07", "move:parts=shut_door,by=[0,0,0.1]"]
    told = []

    def goes_on(done, asked):
        told.append((done, asked))
        return True

    editing = opened(run).editing
    folder = editing.save(lines, "copies", editing.cameras[0], goes_on)
    assert folder == run / "edit" / "copies"
    assert told == [(done, 7) for done in range(1, 8)]  # the last copy ends 0.14 s after the drawer
    out = tmp_path / "by_hand"
    edits = ("--op", lines[0], "--op", lines[1])
    code, said = gsjax("edit", run, *edits, "--out", out, "--camera", 2)
    assert code == 0, said
    assert {path.name for path in folder.iterdir()} == {path.name for path in out.iterdir()}
    assert (folder / "edit.yaml").read_bytes() == (out / "edit.yaml").read_bytes()
    videos = (read_video_frames(where / "video.mp4") for where in (folder, out))
    np.testing.assert_array_equal(*videos)
    ours, theirs = (json.loads((where / "metrics.json").read_text()) for where in (folder, out))
    assert "shut_door goes up to 100 mm" in ours["notes"][0]
    assert ours | {"render_hz": 0} == theirs | {"render_hz": 0}


@pytest.mark.thorough
def test_a_film_has_the_camera_that_is_asked_for_and_none_is_written_over(run):
    editing, lines = opened(run).editing, ["freeze:parts=all"]
    names = [editing.save(lines, "still", "camera 1", always).name for _ in range(3)]
    assert names == ["still", "still_2", "still_3"]
    found = json.loads((run / "edit" / "still_3" / "metrics.json").read_text())
    assert (found["camera"], found["complete"]) == (1, True)


def test_a_film_that_is_to_end_can_be_watched(run):
    folder = opened(run).editing.save(["freeze:parts=all"], "cut", "camera 0", lambda done, asked: done < 2)
    found = json.loads((folder / "metrics.json").read_text())
    assert (found["complete"], found["frames"]) == (False, 2)
    assert len(read_video_frames(folder / "video.mp4")) == 2


@pytest.mark.parametrize("name", ["", "..", "../up", "a/b", "a\\b", ".hidden", "/abs", "a\0b"])
def test_a_film_lies_in_the_run(run, name):
    with pytest.raises(ValueError, match="film name: expected letters"):
        new_folder(run / "edit", name)
    with pytest.raises(ValueError, match="film name: expected letters"):
        opened(run).editing.save(["freeze:parts=all"], name, "camera 0", always)
    assert not (run / "edit").exists()


def test_where_no_folder_can_be_made_no_other_name_is_tried(run):
    """The link leads to a disk that is gone."""
    (run / "edit").symlink_to(run / "gone")
    with pytest.raises(FileExistsError):
        new_folder(run / "edit", "ops")


def test_edits_that_cannot_be_done_leave_no_folder(run):
    with pytest.raises(ValueError, match="did you mean"):
        opened(run).editing.save(["freeze:parts=drawr"], "film", "camera 0", always)
    assert not (run / "edit").exists()


@pytest.mark.thorough
def test_lines_are_those_of_the_command_line():
    lines = ["speed:parts=drawer,factor=2", "move:parts=[1, lid],by=[0, 0, 0.1]"]
    assert script_of(lines).edits == tuple(map(parse_op, lines))
