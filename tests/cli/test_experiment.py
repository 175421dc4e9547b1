"""Sweeps: their order, resuming, failures, stale cells, tables, and each way in which a config is wrong."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from gsjax.cli import experiment_sweep, machine, main
from gsjax.cli.experiment import choose
from gsjax.cli.experiment_sweep import Cell, experiment_names, read_experiment

CONFIG = {
    "claim": "Larger pictures take longer.",
    "source": "nobody, section 1",
    "script": "sweep.py",
    "grid": {"size": [320, 640], "mode": ["fast", "exact"]},
}
SCRIPT = """
def run(options, seed, folder):
    with open("calls.txt", "a") as calls:
        print(options["size"], options["mode"], seed, file=calls)
    return {"ms": options["size"] / 10 + seed, "curve": [1.0, 2.0]}
"""


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """Writes experiments/toy/ in the working directory, which is new; returns its folder."""
    monkeypatch.chdir(tmp_path)
    folder = Path("experiments/toy")
    folder.mkdir(parents=True)

    def write(text: str = SCRIPT, without: str = "", **changes) -> Path:
        config = {key: value for key, value in {**CONFIG, **changes}.items() if key != without}
        (folder / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
        (folder / "sweep.py").write_text(text)
        return folder

    return write


@pytest.fixture
def gsjax(capfd):
    """Runs `gsjax experiment`; returns the exit code, and what stdout and stderr said."""

    def call(*arguments: str) -> tuple[int, str, str]:
        code = main(["experiment", *arguments])
        out, err = capfd.readouterr()
        assert "Traceback" not in out + err
        return code, out, err

    return call


def calls() -> list[str]:
    """The cells that ran since this was asked last."""
    path = Path("calls.txt")
    lines = path.read_text().splitlines() if path.exists() else []
    path.unlink(missing_ok=True)
    return lines


def results(folder: Path) -> dict:
    return json.loads((folder / "results.json").read_text())


def cell_files() -> list[Path]:
    return sorted(Path("runs/experiments/toy").glob("*.json"))


def markdown_table(folder: Path) -> list[list[str]]:
    """Heads and lines of the table in results.md."""
    lines = [line for line in (folder / "results.md").read_text().splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines if "---" not in line]


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


def stopping(how: str) -> str:
    """The script, which in its third cell does something else while the file `stop` is there."""
    stop = f"if options == dict(size=640, mode='fast') and os.path.exists('stop'):\n        {how}\n    return"
    return "import os, signal, sys\n" + SCRIPT.replace("return", stop)


def test_ctrl_c_keeps_what_is_done_and_the_next_run_does_the_rest(toy, gsjax):
    folder = toy(stopping("raise KeyboardInterrupt"))
    Path("stop").touch()
    code, _, err = gsjax("run", "toy")
    assert code == 130
    assert "stopped: by Ctrl-C after 2 of 4 cells; the same command goes on from there" in err
    assert len(cell_files()) == 2
    assert not (folder / "results.json").exists()
    Path("stop").unlink()
    calls()
    assert gsjax("run", "toy")[0] == 0
    assert calls() == ["640 fast 0", "640 exact 0"]
    assert len(results(folder)["rows"]) == 4


def test_ctrl_c_in_a_fresh_run_does_not_bring_back_what_it_forgot(toy, gsjax):
    toy(stopping("raise KeyboardInterrupt"))
    gsjax("run", "toy")
    Path("stop").touch()
    code, _, err = gsjax("run", "toy", "--fresh")
    assert code == 130
    assert "after 2 of 4 cells; the same command without --fresh goes on" in err
    Path("stop").unlink()
    calls()
    gsjax("run", "toy")
    assert calls() == ["640 fast 0", "640 exact 0"]


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


@pytest.mark.parametrize("change", ["script", "helper", "version"])
def test_a_stale_cell_is_reported_and_runs_again(toy, gsjax, change):
    folder = toy()
    gsjax("run", "toy")
    calls()
    folder = toy(SCRIPT + "# another\n") if change == "script" else toy(version=1 + (change == "version"))
    if change == "helper":
        (folder / "helper.py").write_text("FACTOR = 2\n")
    _, out, _ = gsjax("list")
    assert "0 of 4" in out
    assert "4 stale" in out
    assert "Stale: 4 of 4 cells" in gsjax("table", "toy")[1]
    gsjax("run", "toy", "--only", "size=320", "mode=fast")
    assert calls() == ["320 fast 0"]
    _, out, _ = gsjax("table", "toy")
    assert "Stale: 3 of 4 cells" in out
    assert len(set(r["script"] for r in results(folder)["rows"])) == 2
    gsjax("run", "toy")
    assert len(calls()) == 3
    assert "stale" not in gsjax("list")[1]


def test_a_figure_drawn_otherwise_leaves_the_rows_as_they_are(toy, gsjax):
    drawn = "\f\ndef figure(rows, path):\n    path.write_text({!r})\n"
    folder = toy(SCRIPT + drawn.format("one"), figure={"caption": "c"})
    gsjax("run", "toy")
    calls()
    toy(SCRIPT + drawn.format("another"), figure={"caption": "c"})
    assert "4 of 4" in gsjax("list")[1]
    gsjax("run", "toy")
    assert calls() == []
    assert (folder / "figure.png").read_text() == "another"
    toy(SCRIPT.replace("/ 10", "/ 5") + drawn.format("another"), figure={"caption": "c"})
    assert "4 stale" in gsjax("list")[1]


def test_no_line_of_the_table_averages_over_two_versions(toy, gsjax):
    toy(seeds=[0, 1])
    gsjax("run", "toy")
    folder = toy(SCRIPT.replace("/ 10", "/ 100"), seeds=[0, 1])
    gsjax("run", "toy", "--seeds", "1", "--only", "size=320")
    assert [line[-1] for line in markdown_table(folder)[1:3]] == ["4.20 (1/2)"] * 2
    assert len(results(folder)["rows"]) == 6


def test_cells_that_left_the_grid_leave_the_table(toy, gsjax):
    toy()
    gsjax("run", "toy")
    folder = toy(grid={"size": [640, 320], "mode": ["exact"]})
    calls()
    assert gsjax("run", "toy")[0] == 0
    assert calls() == []
    assert [line[:2] for line in markdown_table(folder)[1:]] == [["640", "exact"], ["320", "exact"]]
    assert len(cell_files()) == 4  # they are kept, should the grid have them again


def test_committed_results_are_rows_where_there_are_no_cells(toy, gsjax):
    folder = toy()
    gsjax("run", "toy")
    before = {path: path.read_bytes() for path in folder.glob("results.*")}
    for path in cell_files():
        path.unlink()
    calls()
    assert gsjax("table", "toy")[0] == 0
    assert {path: path.read_bytes() for path in folder.glob("results.*")} == before
    assert "4 of 4" in gsjax("list")[1]
    gsjax("run", "toy", "--only", "size=320")  # what is to be measured is measured here
    assert calls() == ["320 fast 0", "320 exact 0"]
    assert len(results(folder)["rows"]) == 4


COLUMNS = [
    {"key": "ms", "label": "update", "unit": "ms", "direction": "lower", "format": ".1f"},
    {"key": "psnr", "unit": "dB", "direction": "higher"},
    {"key": "kind"},
]
FIGURES = """
import numpy as np

def run(options, seed, folder):
    (folder / "log.txt").write_text("kept")
    psnr = float("nan") if options["size"] == 640 else np.float32(30.0)
    return {"ms": 10.0 + seed + 1e-9, "psnr": psnr, "kind": "a|b", "curve": np.arange(3) / 3}

def figure(rows, path):
    assert path.suffix == ".svg"
    path.write_text(f"<svg>{[row['size'] for row in rows]}{rows[0]['curve']}</svg>")
"""


def test_tables_and_figure(toy, gsjax):
    figure = {"file": "times.svg", "caption": "Times | sizes"}
    folder = toy(FIGURES, seeds=[0, 1, 2], columns=COLUMNS, figure=figure, grid={"size": [320, 640]})
    code, out, _ = gsjax("run", "toy")
    assert code == 0
    assert markdown_table(folder) == [
        ["size", "update [ms] ↓", "psnr [dB] ↑", "kind"],
        ["320", "11.0 ± 1.0", "30.0 ± 0", "a\\|b"],
        ["640", "11.0 ± 1.0", "–", "a\\|b"],
    ]
    text = (folder / "results.md").read_text()
    assert text.startswith("# toy\n\nLarger pictures take longer.\n\nSource: nobody, section 1\n")
    assert "| ---: | ---: | ---: | --- |" in text
    assert "![Times \\| sizes](times.svg)" in text
    assert "- Mean ± standard deviation over 3 seeds" in text
    assert f"- Machine: {machine.in_words(machine.describe())}, gsjax" in text
    assert "[320, 320, 320, 640, 640, 640][0.0, 0.333333, 0.666667]" in (folder / "times.svg").read_text()
    page = (folder / "results.html").read_text()
    assert "data:image/svg+xml" in page
    assert "11.0 ± 1.0" in page
    assert "11.0 ± 1.0" in out
    found = results(folder)
    assert found["rows"][0]["result"]["ms"] == 10.0  # noise in the tenth digit makes no diff
    assert found["rows"][3]["result"]["psnr"] is None
    assert found["same"]["machine"]["cores"] > 0
    assert all("machine" not in row for row in found["rows"])
    assert (cell_files()[0].with_suffix("") / "log.txt").read_text() == "kept"


def test_machines_are_named_in_the_rows_where_they_differ(toy, gsjax):
    folder = toy()
    gsjax("run", "toy")
    record = json.loads(cell_files()[0].read_text())
    cell_files()[0].write_text(json.dumps({**record, "machine": record["machine"] | {"processor": "abacus"}}))
    _, out, _ = gsjax("table", "toy")
    assert re.search(r"Machine: abacus, .*, gsjax 0.1.0\+\w{8} \(1 of 4 cells\)\.", out)
    found = results(folder)
    assert "machine" not in found["same"]
    assert sum(row["machine"]["processor"] == "abacus" for row in found["rows"]) == 1


def test_rows_of_two_versions_are_said_to_be(toy, gsjax):
    """What experiments share may change between two cells, as gsjax itself may: neither makes them stale."""
    folder = toy()
    gsjax("run", "toy", "--only", "size=320")
    (folder.parent / "shared.py").write_text("WIDTH = 640")
    experiment_sweep._hash_of.cache_clear()
    _, out, _ = gsjax("run", "toy")
    made = re.findall(r"Machine: .*, gsjax 0.1.0\+(\w{8}) \((\d) of (\d) cells\)", out)
    assert len({version for version, *_ in made}) == len(made) == 2
    assert sum(int(count) for _, count, _ in made) == int(made[0][2])


def test_without_columns_the_table_has_every_plain_figure(toy, gsjax):
    folder = toy()
    gsjax("run", "toy")
    assert markdown_table(folder)[:2] == [["size", "mode", "ms"], ["320", "fast", "32.0"]]


def test_a_column_that_no_cell_has_is_said(toy, gsjax):
    folder = toy(columns=[{"key": "hz"}, {"key": "seconds", "format": ".0f"}])
    code, out, _ = gsjax("run", "toy")
    assert code == 0
    assert "No cell returned hz; there are seconds, ms, curve." in out
    assert markdown_table(folder)[1] == ["320", "fast", "–", "0"]


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ("1 / 0", "ZeroDivisionError: division by zero"),
        ("pass", "it wrote nothing to the path that it was given"),
    ],
)
def test_a_figure_that_fails_leaves_the_tables(toy, gsjax, body, says):
    folder = toy(SCRIPT + f"\ndef figure(rows, path):\n    {body}\n")
    code, _, err = gsjax("run", "toy")
    assert code == 1
    assert "sweep.py: figure(rows, path)" in err
    assert says.lower() in err.lower()
    assert "There is no figure" in (folder / "results.md").read_text()
    assert (folder / "results.html").exists()
    assert sorted(p.name for p in folder.iterdir() if p.is_file() and p.suffix != ".pyc") == [
        *("config.yaml", "results.html", "results.json", "results.md", "sweep.py"),
    ]


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
    ("changes", "says"),
    [
        ({"without": "claim"}, "config.yaml: claim: expected text, found nothing"),
        ({"source": "  "}, "config.yaml: source: expected text, found none"),
        (
            {"script": "gone.py"},
            "config.yaml: script: expected a file, found none at experiments/toy/gone.py",
        ),
        (
            {"script": "../../sweep.py"},
            "config.yaml: script: expected a path within experiments, found ../../sweep.py",
        ),
        (
            {"without": "grid"},
            "config.yaml: grid: expected option: [values], or cases, found nothing to sweep",
        ),
        ({"grid": {}}, "config.yaml: grid: expected option: [values], or cases, found nothing to sweep"),
        ({"grid": None}, "config.yaml: grid: expected key: value pairs, found nothing"),
        ({"grid": {"size": []}}, "config.yaml: grid.size: expected a list of values, found []"),
        ({"grid": {"size": 320}}, "config.yaml: grid.size: expected a list of values, found 320"),
        (
            {"grid": {"size": [{"w": 1}]}},
            'grid.size: expected numbers, text, true, false, null, or lists of those, found {"w": 1}',
        ),
        (
            {"grid": {"rate": ["1e-3"]}},
            "grid.rate: expected a number as YAML has it, with a point and a sign (1.0e-3), found 1e-3",
        ),
        ({"grid": {"rate": [float("nan")]}}, "grid.rate: expected finite numbers, found NaN"),
        (
            {"grid": {"size": [1, 2, 1]}},
            "grid, cases and seeds: expected each once, found size=1 seed=0 more than once",
        ),
        ({"grid": {"seed": [1]}}, "grid.seed: expected an option's name, found seed"),
        ({"grid": {3: [1]}}, "grid.3: expected an option's name, found 3"),
        ({"cases": [3]}, "config.yaml: cases[0]: expected option: value pairs, found 3"),
        ({"cases": [{"size": 1}]}, "cases[0].size: expected an option that the grid has not, found size"),
        ({"seeds": 3}, "config.yaml: seeds: expected a list, found 3"),
        ({"seeds": []}, "config.yaml: seeds: expected a list of whole numbers, found []"),
        ({"seeds": [0, "a"]}, 'config.yaml: seeds: expected a list of whole numbers, found [0, "a"]'),
        ({"version": True}, "config.yaml: version: expected a whole number, found true"),
        (
            {"sedes": [1]},
            "seeds, columns, figure, version, found 'sedes'; did you mean 'seeds'?",
        ),
        ({"columns": ["ms"]}, "columns[0]: expected the keys key, label, unit, direction, format, found ms"),
        ({"columns": [{"label": "x"}]}, "config.yaml: columns[0].key: expected text, found nothing"),
        (
            {"columns": [{"key": "ms", "direction": "up"}]},
            "columns[0].direction: expected lower or higher, found up",
        ),
        (
            {"columns": [{"key": "ms", "format": "pretty"}]},
            "columns[0].format: expected one of Python's for a number, such as .2f, found pretty",
        ),
        ({"columns": [{"key": "ms"}, {"key": "ms"}]}, "columns: expected each once, found ms more than once"),
        (
            {"figure": {"file": "../x.png"}},
            "figure.file: expected a file name in .png, .svg, .jpg, .webp, found ../x.png",
        ),
        (
            {"figure": {"file": "x.pdf"}},
            "figure.file: expected a file name in .png, .svg, .jpg, .webp, found x.pdf",
        ),
        (
            {"figure": {"caption": "x"}},
            "sweep.py: expected a function figure(rows, path), which the config describes, found none",
        ),
        (
            {"text": "x = 1"},
            "sweep.py: expected a function run(options, seed, folder), found none",
        ),
        (
            {"text": "def run(:"},
            "sweep.py: expected a script that can be loaded, found SyntaxError: invalid syntax",
        ),
        ({"text": "import nowhere"}, "found ModuleNotFoundError: No module named 'nowhere'"),
        ({"text": "exit(3)"}, "sweep.py: expected a script that can be loaded, found SystemExit: 3"),
    ],
)
def test_a_bad_config_is_one_sentence(toy, gsjax, changes, says):
    toy(**changes)
    code, out, err = gsjax("run", "toy")
    assert (code, out, calls()) == (2, "", [])
    assert err.count("error:") == err.count("\n") == 1
    assert err.startswith("error: experiments/toy/")
    assert says in err


@pytest.mark.parametrize("text", ["claim: [", "claim: a: b", "- 1", "", "claim: \x00"])
def test_a_config_that_is_no_mapping(toy, gsjax, text):
    (toy() / "config.yaml").write_text(text)
    code, _, err = gsjax("run", "toy")
    assert code == 2
    assert "experiments/toy/config.yaml: expected " in err


@pytest.mark.parametrize(
    ("returned", "says"),
    [
        ("3", "run() returned int, expected a dict of figures by name"),
        ("{'x': object()}", "run() returned 'x' of type object, expected numbers, text, or lists of them"),
        ("{'x': {'y': [1j]}}", "run() returned 'x' of type dict, expected"),
        ("{'size': 3}", "run() returned 'size', expected a name that is no option, seed or seconds"),
        ("{1: 3}", "run() returned 1, expected a name"),
    ],
)
def test_what_a_script_must_not_return(toy, gsjax, returned, says):
    toy(f"def run(options, seed, folder): return {returned}", grid={"size": [1]})
    code, _, err = gsjax("run", "toy")
    assert code == 1
    assert says in err


def test_two_experiments_share_a_script(toy, gsjax):
    """Its helpers stand beside the script, not beside the config."""
    folder = toy("from factor import FACTOR\n" + SCRIPT, script="../shared/sweep.py")
    shared = folder.parent / "shared"
    shared.mkdir()
    (folder / "sweep.py").rename(shared / "sweep.py")
    (shared / "factor.py").write_text("FACTOR = 1\n")
    other = folder.parent / "other"
    other.mkdir()
    (other / "config.yaml").write_text((folder / "config.yaml").read_text())
    assert [gsjax("run", name)[0] for name in ("toy", "other")] == [0, 0]
    assert results(folder)["rows"][0]["result"] == results(other)["rows"][0]["result"]


def test_what_a_script_does_to_its_options_or_beside_it(toy, gsjax):
    (toy(grid={"cameras": [[0, 1]]}) / "helper_of_toy.py").write_text("X = 5")
    script = (
        "import helper_of_toy\ndef run(o, s, f):\n    o['cameras'].pop()\n    return {'x': helper_of_toy.X}"
    )
    folder = toy(script, grid={"cameras": [[0, 1]]})
    assert gsjax("run", "toy")[0] == 0
    assert markdown_table(folder)[1] == ["[0, 1]", "5"]


def test_list_shows_the_sound_ones_beside_a_broken_one(toy, gsjax):
    toy()
    for name in ("broken", "paper/nested"):
        folder = Path("experiments") / name
        folder.mkdir(parents=True)
        (folder / "config.yaml").write_text(yaml.safe_dump({**CONFIG, "claim": f"That of {name}."}))
    (folder / "sweep.py").write_text(SCRIPT)
    code, out, err = gsjax("list")
    assert code == 2
    assert "experiments/broken/config.yaml: script" in err
    lines = {line.split()[0]: line for line in out.splitlines()}
    assert "Larger pictures take longer." in lines["toy"]
    assert "0 of 4" in lines["paper/nested"]
    assert "broken" not in lines
    assert gsjax("run", "paper/nested")[0] == 0
    assert "4 of 4" in gsjax("list")[1]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (
            ("list", "--root", "nowhere"),
            "nowhere: expected a folder of experiments (--root names another), found none there",
        ),
        (("run", "../toy"), "experiments: no experiment '../toy'; there are: toy"),
        (("run", "to"), "experiments: no experiment 'to'; there are: toy"),
        (("table", "tyo"), "experiments: no experiment 'tyo'; there are: toy"),
    ],
)
def test_what_is_not_there(toy, gsjax, arguments, says):
    toy()
    code, _, err = gsjax(*arguments)
    assert code == 2
    assert says in err


def test_a_table_of_nothing(toy, gsjax):
    folder = toy()
    code, _, err = gsjax("table", "toy")
    assert code == 1
    assert "toy has no cell that is done: nothing to collect" in err
    assert not (folder / "results.md").exists()


@pytest.mark.parametrize(
    "text", ["<<<<<<< HEAD", "[]", '{"rows": [{}], "same": {}}', '{"rows": [3], "same": {}}']
)
def test_files_that_were_damaged_are_named(toy, gsjax, text):
    folder = toy()
    gsjax("run", "toy")
    calls()
    (folder / "results.json").write_text(text)
    code, _, err = gsjax("run", "toy", "--fresh")
    assert (code, calls()) == (2, [])
    assert "experiments/toy/results.json: expected " in err
    assert "delete the file to do without it" in err
    (folder / "results.json").unlink()
    cell_files()[0].write_text(text)
    code, _, err = gsjax("run", "toy")
    assert code == 2
    assert f"{cell_files()[0]}: expected " in err


def test_the_one_in_the_docs_runs(toy, gsjax):
    folder = toy()
    page = (Path(__file__).resolve().parents[2] / "docs" / "experiments.md").read_text(encoding="utf-8")
    for name, language in (("config.yaml", "yaml"), ("sweep.py", "python")):
        (folder / name).write_text(page.split(f"```{language}\n")[1].split("```")[0])
    code, out, _ = gsjax("run", "toy")
    assert code == 0
    assert [line[:2] for line in markdown_table(folder)[1:3]] == [["1", "mean"], ["1", "median"]]
    assert "RMS error [mm] ↓" in out
    drawn = (folder / "figure.png").read_bytes()
    gsjax("table", "toy")
    assert (folder / "figure.png").read_bytes() == drawn


ROOT = Path(__file__).resolve().parents[2] / "experiments"


@pytest.mark.parametrize("name", experiment_names(ROOT))
def test_every_experiment_of_this_repository_can_be_loaded(name, tmp_path):
    """Settings that scripts name may be gone or refused, which only a run would tell."""
    try:
        read_experiment(ROOT, name, tmp_path).load()
    except ValueError as error:
        if "No module named" not in str(error):
            raise
        pytest.skip(f"{error}")
