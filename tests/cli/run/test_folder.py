import dataclasses
import enum
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from gsjax.engine.folder import RunFolder, is_finished, replaced_folder


class Mode(enum.Enum):
    FAST = "fast"


@dataclasses.dataclass
class Inner:
    rate: float = 0.5
    mode: Mode = Mode.FAST


@dataclasses.dataclass
class Config:
    out: Path = Path("runs/a")
    cameras: tuple[int, ...] = (0, 1)
    count: object = dataclasses.field(default_factory=lambda: np.int64(3))
    inner: Inner = dataclasses.field(default_factory=Inner)
    note: str | None = None


@pytest.fixture
def finished(tmp_path):
    """A finished run with a file of every kind, and one that is not of the run."""
    run = RunFolder(tmp_path / "run")
    run.write_config(Config())
    run.write_metrics({"psnr": 30.0})
    run.write_trajectory(means=np.zeros((2, 3, 3)))
    for file in (run.scene, run.render(0, 5), run.video(0), run.plot("psnr"), run.report):
        file.write_text("x")
    (run.path / "my notes.txt").write_text("keep")
    return run


def contents(run):
    return sorted(str(file.relative_to(run.path)) for file in run.path.rglob("*") if file.is_file())


def test_layout_is_what_the_docstring_says(finished):
    assert contents(finished) == [
        "config.yml",
        "metrics.json",
        "my notes.txt",
        "plots/psnr.svg",
        "renders/0/000005.png",
        "report.html",
        "scene.ply",
        "trajectory.npz",
        "video_0.mp4",
    ]
    assert is_finished(finished.path)


def test_config_is_plain_yaml(finished):
    assert yaml.safe_load((finished.path / "config.yml").read_text()) == {
        "out": "runs/a",
        "cameras": [0, 1],
        "count": 3,
        "inner": {"rate": 0.5, "mode": "fast"},
        "note": None,
    }


def test_metrics_have_null_for_what_is_not_finite(finished):
    finished.write_metrics({"psnr": np.float32("nan"), "iou": {"cup": [0.5, float("inf")]}})
    metrics = json.loads((finished.path / "metrics.json").read_text())
    assert metrics == {"psnr": None, "iou": {"cup": [0.5, None]}}


def test_finished_run_is_not_overwritten(finished):
    before = contents(finished)
    with pytest.raises(FileExistsError, match="finished run"):
        RunFolder(finished.path)
    assert contents(finished) == before


def test_overwriting_clears_the_run_and_nothing_else(finished):
    (finished.path / "poses.npz").touch()
    for name in ("query", "grasp"):  # answers from the old run do not hold for the new one
        (finished.path / name).mkdir()
        (finished.path / name / "video.mp4").touch()
    run = RunFolder(finished.path, overwrite=True)
    assert is_finished(run.path)  # until there is something to take its place
    run.write_config(Config())
    assert contents(run) == ["config.yml", "my notes.txt"]
    assert not is_finished(run.path)


@pytest.mark.parametrize("text", ["", "{", "[]"])
def test_a_run_with_damaged_scores_can_be_replaced_as_the_message_says(finished, text):
    finished.metrics.write_text(text)
    with pytest.raises(ValueError, match="replace the run with --overwrite"):
        RunFolder(finished.path)
    RunFolder(finished.path, overwrite=True).write_config(Config())
    assert contents(finished) == ["config.yml", "my notes.txt"]


def test_a_removal_that_was_stopped_can_be_gone_on_with(finished, monkeypatch):
    def stopped(path):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(shutil, "rmtree", stopped)
        with pytest.raises(KeyboardInterrupt):
            RunFolder(finished.path, overwrite=True).write_config(Config())
    RunFolder(finished.path, overwrite=True).write_config(Config())
    assert contents(finished) == ["config.yml", "my notes.txt"]


def test_of_a_link_only_the_link_is_removed(finished, tmp_path):
    shutil.move(finished.path / "renders", tmp_path / "large")
    (finished.path / "renders").symlink_to(tmp_path / "large")
    RunFolder(finished.path, overwrite=True).write_config(Config())
    assert not (finished.path / "renders").is_symlink()
    assert (tmp_path / "large/0/000005.png").is_file()


def test_unfinished_run_is_replaced_where_it_left_nothing_to_resume(finished):
    for name in ("report.html", "metrics.json", "trajectory.npz", "scene.ply"):
        (finished.path / name).unlink()
    finished.resume.mkdir()
    run = RunFolder(finished.path)
    run.write_config(Config())
    assert contents(run) == ["config.yml", "my notes.txt"]


def test_unfinished_run_is_resumed_or_replaced_only_when_told(finished):
    finished.report.unlink()
    finished.resume.mkdir()
    (finished.resume / "state.npz").touch()
    before = contents(finished)
    with pytest.raises(
        FileExistsError, match=r"an unfinished run; continue it with --resume, or .*--overwrite"
    ):
        RunFolder(finished.path)
    with pytest.raises(FileExistsError, match=r"an unfinished run; replace it with --overwrite"):
        RunFolder(finished.path, resume=None)
    RunFolder(finished.path, resume=True)
    assert contents(finished) == before
    (finished.resume / "state.npz").unlink()
    with pytest.raises(FileExistsError, match=r"an unfinished run; replace it with --overwrite"):
        RunFolder(finished.path)  # a stream cannot be followed again
    RunFolder(finished.path, overwrite=True).write_config(Config())
    assert contents(finished) == ["config.yml", "my notes.txt"]


@pytest.mark.parametrize("left", ["canonical/resume/step-00000100.npz", "canonical/scene.ply"])
def test_a_fit_within_an_unfinished_run_can_be_gone_on_with(tmp_path, left):
    run = RunFolder(tmp_path / "run")
    run.write_config(Config())
    (run.path / left).parent.mkdir(parents=True)
    (run.path / left).touch()
    with pytest.raises(FileExistsError, match="an unfinished run; continue it with --resume"):
        RunFolder(run.path)
    assert (run.path / left).exists()


def test_a_folder_is_made_when_there_is_something_to_keep(tmp_path):
    run = RunFolder(tmp_path / "a" / "run")
    assert not (tmp_path / "a").exists()
    run.write_config(Config())
    assert run.config.is_file()
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file/run: cannot make this folder"):
        RunFolder(tmp_path / "file" / "run").write_config(Config())


@pytest.mark.parametrize("overwrite", [False, True])
def test_folder_of_something_else_is_left_alone(tmp_path, overwrite):
    (tmp_path / "scene.ply").write_text("precious")
    with pytest.raises(FileExistsError, match=r"expected .* found other files"):
        RunFolder(tmp_path, overwrite=overwrite)
    assert (tmp_path / "scene.ply").read_text() == "precious"


def test_file_in_place_of_a_folder(tmp_path):
    (tmp_path / "run").touch()
    with pytest.raises(NotADirectoryError, match="expected a folder, found a file"):
        RunFolder(tmp_path / "run")


def test_empty_folder_is_taken(tmp_path):
    assert RunFolder(tmp_path).path == tmp_path


def test_a_config_of_another_program_makes_no_run(tmp_path):
    (tmp_path / "plots").mkdir()
    mine = {"config.yml": "theme: dark\n", "scene.ply": "ply\n", "plots/thesis.png": "x"}
    for name, text in mine.items():
        (tmp_path / name).write_text(text)
    for overwrite in (False, True):
        with pytest.raises(FileExistsError, match="found other files"):
            RunFolder(tmp_path, overwrite=overwrite)
    assert {name: (tmp_path / name).read_text() for name in mine} == mine


OURS = ("answer.json", "masks", "picture_*.png")


def listed(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


def test_what_gsjax_wrote_is_replaced_whole_and_late(tmp_path):
    folder = tmp_path / "answer"
    for number in (1, 2):
        with replaced_folder(folder, OURS) as new:
            (new / "answer.json").write_text(f"{number}")
            (new / f"picture_{number}.png").touch()
            assert not folder.exists() or listed(folder) == ["answer.json", "picture_1.png"]
        assert listed(tmp_path) == ["answer", "answer/answer.json", f"answer/picture_{number}.png"]

    def stopped():
        with replaced_folder(folder, OURS) as new:
            (new / "answer.json").write_text("3")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stopped()
    assert listed(tmp_path) == ["answer", "answer/answer.json", "answer/picture_2.png"]
    assert (folder / "answer.json").read_text() == "2"


def test_what_stood_there_comes_back_where_the_new_cannot_take_its_place(tmp_path, monkeypatch):
    folder, rename = tmp_path / "answer", Path.rename
    folder.mkdir()
    (folder / "answer.json").write_text("1")

    def not_the_new(self, target):
        if self.name.endswith(".partial"):
            raise OSError("no")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", not_the_new)
    with pytest.raises(OSError, match="no"), replaced_folder(folder, OURS):
        pass
    assert listed(tmp_path) == ["answer", "answer/answer.json"]


@pytest.mark.parametrize(
    "there",
    [("answer.json", "notes.txt"), ("answer.json", ".git"), ("masks",), ("picture_1.png", "picture_2.png")],
)
def test_a_folder_with_something_else_is_not_replaced(tmp_path, there):
    folder = tmp_path / "answer"
    folder.mkdir()
    for name in there:
        (folder / name).touch()
    message = r"answer: expected nothing, or only what gsjax writes there"
    with pytest.raises(FileExistsError, match=message), replaced_folder(folder, OURS):
        pass
    assert listed(folder) == sorted(there)


def test_a_link_stays_one_and_an_empty_folder_and_files_of_file_managers_are_nobodys(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "answer").symlink_to(tmp_path / "elsewhere")
    for _ in range(2):
        with replaced_folder(tmp_path / "answer", OURS) as new:
            (new / "answer.json").touch()
        (tmp_path / "elsewhere" / ".DS_Store").touch()
    assert (tmp_path / "answer").is_symlink()
    assert listed(tmp_path / "elsewhere") == [".DS_Store", "answer.json"]
    (tmp_path / "file").touch()
    with pytest.raises(FileExistsError, match="found a file"), replaced_folder(tmp_path / "file", OURS):
        pass
