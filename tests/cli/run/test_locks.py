"""One writer at a time in a folder, whatever happens to that writer."""

import fcntl
import json
import os
import signal
import socket
import subprocess
import sys

import pytest

from gsjax.engine import locks
from gsjax.engine.locks import LOCK, Writer, lock, locked, releasing_locks, share

pytestmark = pytest.mark.skipif(os.name != "posix", reason="locks of files")


def refusal(folder, **how) -> str:
    with pytest.raises(BlockingIOError) as refused, locked(folder, **how):
        pass
    return str(refused.value)


def test_a_second_writer_is_told_who_writes_and_since_when(tmp_path, written):
    other = written(tmp_path)
    since = json.loads((tmp_path / LOCK).read_text())["since"]
    said = refusal(tmp_path)
    assert f"found process {other.pid}, which has been writing there since {since}; wait until" in said
    assert "remove" not in said  # since the lock ends with its process
    other.communicate("")
    with locked(tmp_path):
        assert json.loads((tmp_path / LOCK).read_text())["pid"] == os.getpid()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_what_a_dead_writer_left_is_taken_over(tmp_path, written, number):
    other = written(tmp_path)
    other.send_signal(number)
    other.wait()
    assert (tmp_path / LOCK).exists()
    with locked(tmp_path):
        assert json.loads((tmp_path / LOCK).read_text())["pid"] == os.getpid()


@pytest.mark.parametrize(
    "left",
    [
        *("", "{", "[1]\n", '{"pid": "x"}', '{"pid": 1.5}', '{"pid": 1' + "0" * 22 + "}", "[" * 50_000),
        json.dumps({"pid": 1, "host": socket.gethostname()}),
        "\0" * 99,
    ],
    ids=range(9),
)
def test_what_the_file_says_locks_nothing(tmp_path, left):
    """Another process may have its process id by now: process 1, for one, always exists."""
    (tmp_path / LOCK).write_text(left)
    with locked(tmp_path):
        pass
    assert not (tmp_path / LOCK).exists()


def test_some_share_what_another_must_not_replace(tmp_path, written):
    other = written(tmp_path, shared=True)
    with locked(tmp_path, shared=True):
        pass
    assert f"process {other.pid}" in refusal(tmp_path)
    other.communicate("")
    alone = written(tmp_path)
    assert f"process {alone.pid}" in refusal(tmp_path, shared=True)
    alone.communicate("")
    assert list(tmp_path.iterdir()) == []


def test_who_is_refused_a_folder_alone_still_shares_it(tmp_path, written):
    other = written(tmp_path, shared=True)
    with locked(tmp_path, shared=True):
        assert f"process {other.pid}" in refusal(tmp_path)
        other.communicate("")
        third = os.open(tmp_path / LOCK, os.O_RDWR)
        with pytest.raises(BlockingIOError):
            fcntl.flock(third, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.close(third)


def test_a_writer_may_let_others_add_to_its_folder_but_not_replace_it(tmp_path, written):
    with locked(tmp_path):
        share(tmp_path)
        other = written(tmp_path, shared=True)
        listed = [json.loads(line) for line in (tmp_path / LOCK).read_text().splitlines()]
        assert [(one["pid"], one["shared"]) for one in listed] == [(os.getpid(), True), (other.pid, True)]
        other.communicate("")
        third = os.open(tmp_path / LOCK, os.O_RDWR)
        with pytest.raises(BlockingIOError):
            fcntl.flock(third, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.close(third)
    assert list(tmp_path.iterdir()) == []


def test_parts_of_a_folder_are_locked_apart(tmp_path, written):
    written(tmp_path)
    with locked(tmp_path, "query"):
        assert (tmp_path / f".query{LOCK}").exists()
    assert not (tmp_path / f".query{LOCK}").exists()


def test_a_process_may_lock_what_it_has_locked(tmp_path):
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "run")
    with locked(tmp_path / "run"), locked(link, shared=True):
        pass
    assert not (tmp_path / "run").exists()


def test_a_folder_is_left_as_it_was_found(tmp_path):
    with locked(tmp_path / "a" / "b"):
        assert (tmp_path / "a" / "b" / LOCK).is_file()
    assert list(tmp_path.iterdir()) == []
    with locked(tmp_path / "a" / "b"):
        (tmp_path / "a" / "kept").touch()
    assert list((tmp_path / "a").iterdir()) == [tmp_path / "a" / "kept"]


def test_locks_of_a_command_end_with_it(tmp_path):
    @releasing_locks()
    def command():
        lock(tmp_path / "run")
        inner()
        assert not (tmp_path / "inner").exists()
        assert (tmp_path / "run" / LOCK).exists()
        raise KeyboardInterrupt

    @releasing_locks()
    def inner():
        lock(tmp_path / "inner")
        assert (tmp_path / "inner" / LOCK).exists()

    with pytest.raises(KeyboardInterrupt):
        command()
    assert list(tmp_path.iterdir()) == []


def test_places_where_nobody_can_write(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    with (
        pytest.raises(NotADirectoryError, match="file: expected a folder, found a file"),
        locked(tmp_path / "file"),
    ):
        pass
    with pytest.raises(OSError, match="file/run: cannot make this folder"), locked(tmp_path / "file" / "run"):
        pass

    def read_only(*_):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(os, "open", read_only)
    with pytest.raises(OSError, match="cannot write into this folder"), locked(tmp_path):
        pass
    with locked(tmp_path, shared=True):  # to write elsewhere from a run takes no write access to it
        pass


def listed(tmp_path, **about) -> None:
    values = {"pid": 1, "host": socket.gethostname(), "since": "2026-01-02 03:04:05", "shared": False}
    (tmp_path / LOCK).write_text(json.dumps(values | about) + "\n")


def test_without_locks_of_files_the_writers_that_are_listed_decide(tmp_path, monkeypatch):
    monkeypatch.setattr(locks, "_flock", lambda *_, **__: None)
    listed(tmp_path)
    said = refusal(tmp_path)
    assert "found process 1, which has been writing there since 2026-01-02 03:04:05" in said
    assert f"if it is gone, remove {tmp_path / LOCK}" in said
    listed(tmp_path, host="elsewhere")
    assert "process 1 on elsewhere, which" in refusal(tmp_path)
    listed(tmp_path, host="x" * 9000, since="y" * 9000)
    assert len(refusal(tmp_path)) < 500 + 2 * len(str(tmp_path))
    listed(tmp_path, shared=True)
    with locked(tmp_path, shared=True):
        pass
    for wrong in ({"pid": 0}, {"pid": -1}, {"host": [0]}, {"since": None}, {"shared": 1}):
        listed(tmp_path, **wrong)
        with locked(tmp_path):
            pass
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    listed(tmp_path, pid=ended.pid)
    assert not Writer(ended.pid).may_live
    with locked(tmp_path):
        assert json.loads((tmp_path / LOCK).read_text())["pid"] == os.getpid()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.thorough
def test_without_locks_of_files_one_of_two_that_begin_at_one_instant_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(locks, "_flock", lambda *_, **__: None)
    monkeypatch.setattr(locks.time, "sleep", lambda _: listed(tmp_path))  # the other is listed meanwhile
    assert "found process 1, which" in refusal(tmp_path)
    assert json.loads((tmp_path / LOCK).read_text())["pid"] == 1
