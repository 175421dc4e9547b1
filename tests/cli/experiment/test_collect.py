"""Tables and figures, from cells that were run here and from committed results."""

import json
import re
from pathlib import Path

import pytest

from gsjax import __version__
from gsjax.engine import machine
from gsjax.engine.experiments import script as scripts
from tests.cli.experiment.toys import SCRIPT, calls, cell_files, markdown_table, results

VERSION = re.escape(__version__)


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
    assert len(cell_files()) == 4  # kept in case the grid has them again


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
    gsjax("run", "toy", "--only", "size=320")  # cells that are asked for are measured here
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
    assert re.search(rf"Machine: abacus, .*, gsjax {VERSION}\+\w{{8}} \(1 of 4 cells\)\.", out)
    found = results(folder)
    assert "machine" not in found["same"]
    assert sum(row["machine"]["processor"] == "abacus" for row in found["rows"]) == 1


def test_rows_of_two_versions_are_said_to_be(toy, gsjax):
    """Shared code of experiments may change between two cells, as gsjax may: neither makes cells stale."""
    folder = toy()
    gsjax("run", "toy", "--only", "size=320")
    (folder.parent / "shared.py").write_text("WIDTH = 640")
    scripts._hash_of.cache_clear()
    _, out, _ = gsjax("run", "toy")
    made = re.findall(rf"Machine: .*, gsjax {VERSION}\+(\w{{8}}) \((\d) of (\d) cells\)", out)
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


@pytest.mark.thorough
def test_the_one_in_the_docs_runs(toy, gsjax):
    folder = toy()
    page = (Path(__file__).resolve().parents[3] / "docs" / "experiments.md").read_text(encoding="utf-8")
    for name, language in (("config.yaml", "yaml"), ("sweep.py", "python")):
        (folder / name).write_text(page.split(f"```{language}\n")[1].split("```")[0])
    code, out, _ = gsjax("run", "toy")
    assert code == 0
    assert [line[:2] for line in markdown_table(folder)[1:3]] == [["1", "mean"], ["1", "median"]]
    assert "RMS error [mm] ↓" in out
    drawn = (folder / "figure.png").read_bytes()
    gsjax("table", "toy")
    assert (folder / "figure.png").read_bytes() == drawn
