"""Sweeps on a Dask cluster: they keep what a local run keeps, even if a worker is killed."""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path

import pytest

from gsjax import __version__
from gsjax.engine.experiments.cluster import slurm_cluster
from tests.cli.experiment.toys import SCRIPT, calls, cell_files, results

pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
config = pytest.importorskip("dask").config

LOGGED = """
import os, time

def log(word, options):
    with open("log.txt", "a") as lines:
        print(word, options["n"], os.getpid(), file=lines)

def run(options, seed, folder):
    log("begun", options)
    {}
    (folder / "left.txt").write_text("kept")
    log("ended", options)
    return {{"n2": options["n"] ** 2, "nothing": float("nan")}}
"""


def logged(word: str) -> list[list[str]]:
    """Cell and process of each line of the log that begins with the word."""
    lines = Path("log.txt").read_text().splitlines() if Path("log.txt").exists() else []
    return [line.split()[1:] for line in lines if line.split()[0] == word]


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """Starts a scheduler and two workers, as by hand, in a new folder; yields its address and the folder."""
    folder = tmp_path_factory.mktemp("cluster")
    (folder / "experiments").mkdir()
    there = folder / "scheduler.json"
    shared = ["--scheduler-file", str(there), "--no-dashboard"]
    quiet = {"cwd": folder, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    dask_program = [sys.executable, "-m", "dask"]
    programs = [["scheduler", "--host", "127.0.0.1", "--port", "0", *shared]]
    programs += [["worker", "--nthreads", "1", "--host", "127.0.0.1", *shared]] * 2
    root = str(Path(__file__).resolve().parents[3])
    environment = {**os.environ, "PYTHONPATH": root}
    started = [subprocess.Popen(dask_program + words, env=environment, **quiet) for words in programs]
    try:
        while not there.exists():
            assert all(program.poll() is None for program in started)
            time.sleep(0.05)
        yield json.loads(there.read_text())["address"], folder
    finally:
        for program in reversed(started):  # workers first
            program.terminate()
            program.wait(20)


@pytest.fixture
def beside(address, toy, monkeypatch):
    """Enters a new folder for the toy where the workers are; returns the arguments that run it there."""
    where, folder = address
    for left in ("experiments", "runs"):
        shutil.rmtree(folder / left, ignore_errors=True)
    for left in ("log.txt", "calls.txt"):
        (folder / left).unlink(missing_ok=True)
    monkeypatch.chdir(folder)
    (folder / "experiments" / "toy").mkdir(parents=True)
    return ("run", "toy", "--executor", "dask", "--scheduler", where)


def kill_once_begun(count: int) -> threading.Thread:
    """Starts a thread that kills the process of the `count`-th cell to begin, while that cell runs."""

    def wait_and_kill() -> None:
        while len(begun := logged("begun")) < count:
            time.sleep(0.02)
        os.kill(int(begun[count - 1][1]), signal.SIGKILL)

    thread = threading.Thread(target=wait_and_kill, daemon=True)
    thread.start()
    return thread


@pytest.mark.thorough
@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_a_worker_that_is_killed_loses_nothing_and_nothing_is_done_twice(beside, toy, gsjax):
    folder = toy(LOGGED.format("time.sleep(0.4)"), grid={"n": [0, 1, 2, 3, 4, 5]})
    killer = kill_once_begun(4)
    code, _, err = gsjax(*beside)
    killer.join()
    assert code == 0, err
    assert err.count("done  ") == 6
    assert Counter(cell for cell, _ in logged("ended")) == dict.fromkeys("012345", 1)
    assert len(logged("begun")) == 7  # one was begun twice
    found = results(folder)
    assert [row["result"] for row in found["rows"]] == [{"n2": n * n, "nothing": None} for n in range(6)]
    assert found["failed"] == []
    for path in cell_files():
        assert json.loads(path.read_text())["machine"]["cores"] > 0
        assert [file.name for file in path.with_suffix("").iterdir()] == ["left.txt"]
    assert sorted(p.name for p in path.parent.iterdir() if p.name.startswith(".")) == []
    _, _, err = gsjax(*beside)
    assert "6 of 6 cells are done" in err
    assert len(logged("ended")) == 6


@pytest.mark.thorough
def test_what_is_kept_is_what_a_run_here_keeps(beside, toy, gsjax):
    failing = SCRIPT.replace(
        "return", "if options['size'] == 640: raise RuntimeError('no light')\n    return"
    )
    toy(failing)
    kept = []
    for arguments in (beside, ("run", "toy", "--fresh")):
        code, _, err = gsjax(*arguments)
        assert code == 1
        assert "RuntimeError: no light" in err
        assert "2 of 4 cells failed and will run again next time" in err
        records = [json.loads(path.read_text()) for path in cell_files()]
        for record in records:
            assert record.pop("traceback") == [] or record["error"]
            assert record.pop("seconds") >= 0
            record.pop("finished")
            record.pop("machine")
        kept.append(records)
    assert kept[0] == kept[1]
    calls()
    toy(failing)
    assert gsjax(*beside)[0] == 1
    assert sorted(calls()) == ["640 exact 0", "640 fast 0"]  # those that failed


@pytest.mark.thorough
def test_scripts_and_helpers_that_were_edited_are_loaded_again(beside, toy, gsjax):
    script = "import helper\ndef run(options, seed, folder): return {'x': helper.X}"
    for value in (1, 2):
        folder = toy(script, grid={"n": [1, 2]})
        (folder / "helper.py").write_text(f"X = {value}{' ' * value}\n")
        assert gsjax(*beside)[0] == 0
        assert [row["result"]["x"] for row in results(folder)["rows"]] == [value] * 2


@pytest.mark.thorough
def test_a_worker_of_another_gsjax_is_refused(beside, toy, gsjax, monkeypatch):
    toy()
    monkeypatch.setattr("gsjax.__version__", "9.9")
    code, _, err = gsjax(*beside)
    assert (code, calls()) == (2, [])
    assert "error: worker tcp://" in err
    assert "expected gsjax 9.9+" in err
    assert f"found {__version__}+" in err


@pytest.mark.thorough
@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_a_cell_that_kills_every_worker_fails_and_the_others_are_done(toy, gsjax):
    dies = "options['n'] == 0 and os.path.exists('stop') and os.kill(os.getpid(), 9)"
    folder = toy(LOGGED.format(dies), grid={"n": [0, 1, 2]})
    Path("stop").touch()
    with config.set({"distributed.scheduler.allowed-failures": 0}):
        code, _, err = gsjax("run", "toy", "--executor", "dask", "--workers", "1")
    assert code == 1
    assert "n=0 seed=0  KilledWorker: 2 workers died with this cell" in err
    assert Counter(cell for cell, _ in logged("ended")) == {"1": 1, "2": 1}
    assert "KilledWorker" in results(folder)["failed"][0]["error"]
    assert "1 failed" in gsjax("list")[1]
    Path("stop").unlink()
    assert gsjax("run", "toy")[0] == 0
    assert Counter(cell for cell, _ in logged("ended")) == {"0": 1, "1": 1, "2": 1}


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_ctrl_c_keeps_what_is_done_on_a_cluster_too(toy, gsjax):
    toy(LOGGED.format("time.sleep(60 if options['n'] else 0)"), grid={"n": [0, 1, 2]})
    command = [sys.executable, "-m", "gsjax.cli", "experiment", "run", "toy", "--executor", "dask"]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[3])}
    said = {"stderr": subprocess.PIPE, "text": True}
    going = subprocess.Popen([*command, "--workers", "1"], env=environment, start_new_session=True, **said)
    while len(logged("begun")) < 2 and going.poll() is None:
        time.sleep(0.02)
    time.sleep(0.3)
    os.killpg(going.pid, signal.SIGINT)  # as a terminal does: to the whole process group
    _, err = going.communicate(timeout=60)
    assert going.returncode == 130, err
    assert "stopped: by Ctrl-C after 1 of 3 cells; the same command continues from there" in err
    assert "Traceback" not in err
    assert len(cell_files()) == 1


@pytest.fixture
def defaults():
    """dask-jobqueue's defaults for a SLURM job; its import replaces Ctrl-C's handler, which is restored."""
    heard_by = signal.getsignal(signal.SIGINT)
    pytest.importorskip("dask_jobqueue")
    signal.signal(signal.SIGINT, heard_by)
    return config.get("jobqueue.slurm")


def test_ctrl_c_is_heard_as_before_once_dask_jobqueue_is_imported(defaults, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "dask_jobqueue"]:
        monkeypatch.delitem(sys.modules, name)
    heard_by = signal.getsignal(signal.SIGINT)
    with (
        config.set({"jobqueue.slurm": {**defaults, "memory": None}}),
        pytest.raises(ValueError, match="found no"),
    ):
        slurm_cluster()
    assert signal.getsignal(signal.SIGINT) is heard_by


def test_a_job_of_slurm_is_one_worker_with_all_its_cores(defaults):
    asked = {"cores": 12, "memory": "48GB", "queue": "long", "walltime": "08:00:00", "interface": "lo"}
    settings = {"jobqueue.slurm": {**defaults, **asked}}
    with config.set(settings), slurm_cluster() as cluster:
        script = cluster.job_script()
    for line in ("-p long", "--cpus-per-task=12", "--mem=45G", "-t 08:00:00", "-n 1"):
        assert f"#SBATCH {line}\n" in script
    assert "--nthreads 1 " in script
    assert "--nworkers" not in script
    settings = {"jobqueue.slurm.memory": None, "jobqueue.slurm.cores": 12}
    with config.set(settings), pytest.raises(ValueError, match=r"Dask's settings, .*found no memory"):
        slurm_cluster()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--workers", "2"), "--workers: expected --executor dask, found --executor local"),
        (("--scheduler", "slurm"), "--scheduler: expected --executor dask, found --executor local"),
        (("--executor", "dask", "--workers", "0"), "--workers: expected 1 or more, found 0"),
        (
            ("--executor", "dask", "--scheduler", "slum"),
            "--scheduler: expected processes, slurm or an address such as tcp://HOST:8786, found 'slum'",
        ),
        (
            ("--executor", "dask", "--scheduler", "tcp://nowhere:1", "--workers", "2"),
            "--workers: expected none, because tcp://nowhere:1 has its own, found 2",
        ),
        (
            ("--executor", "dask", "--scheduler", "slurm"),
            "--workers: expected the number of jobs to submit to SLURM, found none",
        ),
        (
            ("--executor", "dask", "--scheduler", "slurm", "--workers", "2"),
            "--scheduler slurm: expected SLURM's sbatch on this machine, found none",
        ),
    ],
)
def test_who_cannot_run_cells(toy, gsjax, options, says, monkeypatch):
    toy()
    monkeypatch.setattr(shutil, "which", lambda name: None)
    code, _, err = gsjax("run", "toy", *options)
    assert (code, calls()) == (2, [])
    assert says in err


@pytest.mark.thorough
def test_nothing_is_forgotten_where_no_scheduler_answers(toy, gsjax, monkeypatch):
    toy()
    gsjax("run", "toy")
    before = cell_files()
    monkeypatch.setattr("gsjax.engine.experiments.cluster.CONNECT_S", 1)
    elsewhere = ("--executor", "dask", "--scheduler", "tcp://127.0.0.1:1")
    code, _, err = gsjax("run", "toy", "--fresh", *elsewhere)
    assert code == 2
    assert "found none that answers within 1 s" in err
    assert cell_files() == before


@pytest.mark.thorough
def test_without_the_extra_it_is_named(toy, gsjax, monkeypatch):
    toy()
    monkeypatch.setitem(sys.modules, "distributed", None)
    code, _, err = gsjax("run", "toy", "--executor", "dask")
    assert (code, calls()) == (2, [])
    assert "--executor dask needs distributed, which is not installed: " in err
    assert f"{sys.executable} -m pip install 'gsjax[cluster]'" in err
