"""Two runs are never mixed in one folder: the second is refused while the first lives."""

import os
from dataclasses import dataclass

import pytest

from gsjax.engine.folder import RunFolder, replaced_folder

pytestmark = pytest.mark.skipif(os.name != "posix", reason="locks of files")


@dataclass
class Written:
    """Settings."""

    seed: int = 0


@pytest.mark.thorough
@pytest.mark.parametrize("how", [(), ("--overwrite",), ("--resume",)])
@pytest.mark.parametrize("command", ["fit", "track", "parts", "deform", "live"])
def test_a_second_run_is_refused(command, how, gsjax, photographs, pristine, tmp_path, written):
    if command == "live" and "--resume" in how:
        pytest.skip("a stream cannot be followed again")
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "config.yml").write_text("# gsjax run\nseed: 3\n")
    (folder / "scene.ply").write_text("precious")
    number = written(folder).pid
    code, said = gsjax(command, photographs if command == "fit" else pristine, "--out", folder, *how)
    assert code == 2
    assert f"run: expected a folder into which no other process writes, found process {number}, which" in said
    assert sorted(path.name for path in folder.iterdir()) == [".gsjax.lock", "config.yml", "scene.ply"]
    assert (folder / "config.yml").read_text() == "# gsjax run\nseed: 3\n"


def test_a_new_folder_is_claimed_before_anything_is_read(gsjax, photographs, tmp_path, written):
    number = written(tmp_path / "run").pid
    code, said = gsjax("fit", photographs, "--out", tmp_path / "run")
    assert (code, f"process {number}" in said) == (2, True)


@pytest.mark.parametrize("command", ["poses IMAGES", "compare A B"])
def test_so_is_whatever_else_writes_a_folder(command, gsjax, tmp_path, written):
    number = written(tmp_path / "out").pid
    code, said = gsjax(*command.split(), "--out", tmp_path / "out")
    assert (code, f"process {number}" in said) == (2, True)


def test_what_is_made_from_a_run_keeps_out_its_like_and_who_would_replace_the_run(tmp_path, written):
    folder = tmp_path / "run" / "answer"
    for part in ("", "answer"):
        other = written(tmp_path / "run", part)
        with pytest.raises(BlockingIOError, match=f"process {other.pid}"), replaced_folder(folder, ("a",)):
            pass
        other.communicate("")
    written(tmp_path / "run", shared=True)
    with replaced_folder(folder, ("a",)) as new:
        (new / "a").touch()
        with pytest.raises(BlockingIOError, match="found process"):
            RunFolder.locked(tmp_path / "run", overwrite=True)
    assert (folder / "a").exists()


def test_a_run_around_a_field_is_not_replaced(tmp_path, written):
    RunFolder(tmp_path).write_config(Written())
    number = written(tmp_path).pid
    with pytest.raises(BlockingIOError, match=f"process {number}"):
        RunFolder.locked(tmp_path / "field")
