import pytest

from gsjax.data import DataError, open_sequence


def test_built_in_scenes_take_arguments():
    sequence = open_sequence("simulated:tabletop?seed=3&frames=5&width=64&height=48&cameras=2&still=true")
    assert (sequence.num_frames, sequence.num_cameras, sequence.width, sequence.height) == (5, 2, 64, 48)
    assert (sequence.truth.poses[0] == sequence.truth.poses[-1]).all()
    assert sequence.name == "tabletop_seed3"
    assert open_sequence("simulated:tabletop").num_frames == 60


@pytest.mark.parametrize(
    ("path", "says"),
    [
        ("simulated:kitchen", "no built-in scene 'kitchen'; there are: tabletop"),
        ("simulated:tabletop?sed=3", "no argument 'sed'; it has: seed, frames"),
        ("simulated:tabletop?seed=x", "seed must be an integer, got 'x'"),
        ("simulated:tabletop?seed=", "seed must be an integer, got ''"),
        ("simulated:tabletop?hide=2", "hide must be true or false"),
        ("simulated:tabletop?frames=0", "frames must be at least 1"),
        ("simulated:tabletop?hide=1&leave=1", "at most one"),
    ],
)
def test_what_is_wrong_with_a_built_in_scene(path, says):
    with pytest.raises(ValueError, match=says):
        open_sequence(path)


def test_folders_that_fit_no_layout(tmp_path):
    with pytest.raises(
        DataError, match=r"train_meta.json \(Panoptic layout\), sample_demos .*an empty folder"
    ):
        open_sequence(tmp_path)
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(DataError, match=r"found notes.txt"):
        open_sequence(tmp_path)
    with pytest.raises(DataError, match="found a file"):
        open_sequence(tmp_path / "notes.txt")
    with pytest.raises(DataError, match=r"found nothing there.*simulated:tabletop"):
        open_sequence(tmp_path / "nowhere")


@pytest.mark.parametrize(("name", "cameras"), [("tabletop_0", 3), ("push_t", 3), ("seven_scenes_kitchen", 1)])
def test_recordings_are_recognised(shared_data, name, cameras):
    assert open_sequence(shared_data / name).num_cameras == cameras
