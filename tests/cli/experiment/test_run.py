"""Sweeps: their order, which cells run, resuming, failures."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from gsjax.cli import main
from gsjax.engine.experiments.run import choose
from gsjax.engine.experiments.sweep import Cell, read_experiment
from tests.cli.experiment.toys import calls, cell_files, markdown_table, results, stopping


def test_cells_run_in_the_order_of_the_grid_with_seeds_innermost(toy, gsjax):
    folder = toy(seeds=[0, 7])
    assert gsjax("run", "toy")[0] == 0
    expected = [
        f"{size} {mode} {seed}" for size in (320, 640) for mode in ("fast", "exact") for seed in (0, 7)
    ]
    assert calls() == expected
    rows = results(folder)["rows"]
    assert [f"{r['options']['size']} {r['options']['mode']} {r['seed']}" for r in rows] == expected
    assert len(cell_files()) == 8


def test_the_grid_is_swept_in_every_case(toy):
    toy(cases=[{"method": "ours", "rate": 0.1}, {"method": "theirs"}], grid={"size": [1, 2]})
    experiment = read_experiment(Path("experiments"), "toy", Path("runs"))
    assert [str(cell) for cell in experiment.cells] == [
        "method=ours rate=0.1 size=1 seed=0",
        "method=ours rate=0.1 size=2 seed=0",
        "method=theirs size=1 seed=0",
        "method=theirs size=2 seed=0",
    ]


def test_a_cell_is_known_by_its_options_in_any_order():
    known = Cell({"a": 1, "b": [True, None]}, 0)
    assert known.id == Cell({"b": [True, None], "a": 1}, 0).id == "30840f1365ea53ca"
    assert len({known.id, Cell({"a": 1}, 0).id, Cell(known.options, 1).id}) == 3


def test_a_second_run_has_nothing_to_do_and_changes_no_file(toy, gsjax):
    folder = toy()
    gsjax("run", "toy")
    calls()
    before = {path: path.read_bytes() for path in folder.glob("results.*")}
    code, _, err = gsjax("run", "experiments/toy/")  # as a shell completes it
    assert (code, calls()) == (0, [])
    assert "4 of 4 cells are done; --fresh runs them again" in err
    assert {path: path.read_bytes() for path in folder.glob("results.*")} == before
    gsjax("run", "toy", "--fresh", "--only", "size=640")
    assert calls() == ["640 fast 0", "640 exact 0"]


def test_ctrl_c_keeps_what_is_done_and_the_next_run_does_the_rest(toy, gsjax):
    folder = toy(stopping("raise KeyboardInterrupt"))
    Path("stop").touch()
    code, _, err = gsjax("run", "toy")
    assert code == 130
    assert "stopped: by Ctrl-C after 2 of 4 cells; the same command continues from there" in err
    assert len(cell_files()) == 2
    assert not (folder / "results.json").exists()
    Path("stop").unlink()
    calls()
    assert gsjax("run", "toy")[0] == 0
    assert calls() == ["640 fast 0", "640 exact 0"]
    assert len(results(folder)["rows"]) == 4


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("then", ["pass", "raise KeyError('test')"])
def test_ctrl_c_that_a_script_catches_stops_the_sweep_too(toy, gsjax, then):
    """A fit within a cell writes what it has and returns; that is no result of the cell."""
    caught = f"""try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            {then}"""
    toy(stopping(caught))
    Path("stop").touch()
    code, _, err = gsjax("run", "toy")
    assert code == 130
    assert "stopped: by Ctrl-C after 2 of 4 cells; the same command continues from there" in err
    assert len(cell_files()) == 2
    Path("stop").unlink()
    calls()
    assert gsjax("run", "toy")[0] == 0
    assert calls() == ["640 fast 0", "640 exact 0"]


def test_ctrl_c_in_a_fresh_run_does_not_bring_back_what_it_forgot(toy, gsjax):
    toy(stopping("raise KeyboardInterrupt"))
    gsjax("run", "toy")
    Path("stop").touch()
    code, _, err = gsjax("run", "toy", "--fresh")
    assert code == 130
    assert "after 2 of 4 cells; the same command without --fresh continues" in err
    Path("stop").unlink()
    calls()
    gsjax("run", "toy")
    assert calls() == ["640 fast 0", "640 exact 0"]


def test_ctrl_c_leaves_stale_rows_that_were_not_run_again(toy, gsjax):
    toy(stopping("raise KeyboardInterrupt"))
    gsjax("run", "toy")
    before = cell_files()
    toy(stopping("raise KeyboardInterrupt") + "# another\n")
    Path("stop").touch()
    assert gsjax("run", "toy")[0] == 130
    assert cell_files() == before


@pytest.mark.thorough
@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_kill_keeps_what_is_done(toy, gsjax):
    toy(stopping("os.kill(os.getpid(), signal.SIGKILL)"))
    Path("stop").touch()
    command = [sys.executable, "-m", "gsjax.cli", "experiment", "run", "toy"]
    assert subprocess.run(command, capture_output=True).returncode == -9
    assert len(cell_files()) == 2
    Path("stop").unlink()
    calls()
    assert gsjax("run", "toy")[0] == 0
    assert calls() == ["640 fast 0", "640 exact 0"]


@pytest.mark.parametrize(
    "how", ["raise RuntimeError('no\\nlight [red]')", "sys.exit('RuntimeError: no light [red]')"]
)
def test_a_cell_that_fails_is_recorded_and_the_others_go_on(toy, gsjax, how):
    folder = toy(stopping(how))
    Path("stop").touch()
    code, out, err = gsjax("run", "toy")
    assert code == 1
    assert "RuntimeError: no light [red]" in err
    assert "1 of 4 cells failed and will run again next time" in err
    assert len(calls()) == 4
    found = results(folder)
    assert len(found["rows"]) == 3
    (failed,) = found["failed"]
    assert failed["options"] == {"size": 640, "mode": "fast"}
    assert "no light" in failed["error"]
    assert "Not complete: 3 of 4 cells are done." in out
    assert "1 failed" in gsjax("list")[1]
    (record,) = (r for r in map(json.loads, (p.read_text() for p in cell_files())) if r["error"])
    assert record["result"] is None
    assert record["traceback"][0].startswith("Traceback")
    Path("stop").unlink()
    assert gsjax("run", "toy")[0] == 0
    assert calls() == ["640 fast 0"]
    assert results(folder)["failed"] == []


def test_debug_lets_through_what_a_cell_raises(toy):
    toy(stopping("raise RuntimeError('no light')"))
    Path("stop").touch()
    with pytest.raises(RuntimeError, match="no light"):
        main(["experiment", "run", "toy", "--debug"])


def test_when_every_cell_fails_nothing_is_collected(toy, gsjax):
    folder = toy("def run(options, seed, folder): return 1 / 0")
    code, _, err = gsjax("run", "toy")
    assert code == 1
    assert "nothing to collect" in err
    assert not (folder / "results.json").exists()


def test_a_folder_in_brackets_is_named_as_it_is(toy, gsjax):
    toy().parent.rename("[old]")
    code, out, _ = gsjax("run", "toy", "--root", "[old]")
    assert code == 0
    assert "results  [old]/toy/results.html" in out


@pytest.mark.parametrize(
    ("seeds", "only", "chosen"),
    [
        ((), (), 8),
        ((1,), (), 4),
        ((), ("rate=1e-3",), 4),
        ((), ("rate=0.001", "rate=0.5"), 8),
        ((0,), ("rate=0.5", "flag=true"), 1),
    ],
)
def test_only(toy, seeds, only, chosen):
    toy(grid={"rate": [0.001, 0.5], "flag": [True, False]}, seeds=[0, 1])
    experiment = read_experiment(Path("experiments"), "toy", Path("runs"))
    assert len(choose(experiment, seeds, only)) == chosen


def test_text_that_looks_like_a_number_can_be_chosen(toy):
    toy(grid={"version": ["1.10", "1.9"]})
    experiment = read_experiment(Path("experiments"), "toy", Path("runs"))
    assert [cell.options["version"] for cell in choose(experiment, (), ("version=1.10",))] == ["1.10"]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--only",), "--only: expected one value or more, found none"),
        (("--only", "size"), "--only: expected KEY=VALUE, found 'size'"),
        (("--only", "sise=1"), "--only: toy has no option 'sise'; it has size, mode, seed"),
        (("--only", "size=1"), "toy: no cell has size=1; it is one of 320, 640"),
        (("--seeds", "5"), "toy: no cell has seed=5; it is one of 0"),
    ],
)
def test_cells_that_there_are_not(toy, gsjax, options, says):
    toy()
    code, _, err = gsjax("run", "toy", *options)
    assert (code, calls()) == (2, [])
    assert says in err


@pytest.mark.parametrize(
    ("returned", "says"),
    [
        ("3", "run() returned int, expected a dict of named figures"),
        ("{'x': object()}", "run() returned 'x' of type object, expected numbers, text, or lists of them"),
        ("{'x': {'y': [1j]}}", "run() returned 'x' of type dict, expected"),
        ("{'size': 3}", "run() returned 'size', expected a name other than seed, seconds or an option"),
        ("{1: 3}", "run() returned 1, expected a name"),
    ],
)
def test_what_a_script_must_not_return(toy, gsjax, returned, says):
    toy(f"def run(options, seed, folder): return {returned}", grid={"size": [1]})
    code, _, err = gsjax("run", "toy")
    assert code == 1
    assert says in err


def test_what_a_script_does_to_its_options_or_beside_it(toy, gsjax):
    (toy(grid={"cameras": [[0, 1]]}) / "helper_of_toy.py").write_text("X = 5")
    script = (
        "import helper_of_toy\ndef run(o, s, f):\n    o['cameras'].pop()\n    return {'x': helper_of_toy.X}"
    )
    folder = toy(script, grid={"cameras": [[0, 1]]})
    assert gsjax("run", "toy")[0] == 0
    assert markdown_table(folder)[1] == ["[0, 1]", "5"]
