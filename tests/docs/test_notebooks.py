"""The notebooks: their code runs with fewer steps, and they contain the outputs of a full run."""

import json
from dataclasses import replace

import matplotlib
import matplotlib.pyplot as plt
import pytest

from gsjax.engine.parts import start as parts_start
from gsjax.methods.track import first_fit
from tests.docs.blocks import ROOT
from tests.docs.test_programs import PARTS
from tests.engine.cases import TRACK

NOTEBOOKS = {path.stem: path for path in (ROOT / "docs/notebooks").glob("*.ipynb")}
MOST_BYTES = 600_000  # of a notebook; hosts do not render larger ones
SHORTER = {
    "fit": {"steps=800, cap=8000": "steps=4, cap=300, coarse_until=0.0", "(60)": "(2)", ", 60)": ", 2)"},
    "track": {"gsjax.TrackConfig()": "TRACK", "frames=12": "frames=2"},
    "parts": {
        "gsjax.PartsConfig()": "PARTS",
        "simulated:articulated?width=160&height=120&frames=20": "simulated:hard_parts?width=96&height=72",
        "fig, axes = plt.subplots(1, 4": "sequence = sequence.select([0, 5])\nfig, axes = plt.subplots(1, 4",
        "eval_cameras=[1]": "eval_cameras=[3, 6]",
        "(0, 6, 12, 19)": "(0, 1, 0, 1)",
    },
}
"""Replacements in the text of each notebook, so that it takes less time."""


def cells(name: str, kind: str) -> list[dict]:
    """The cells of one kind, in order."""
    notebook = json.loads(NOTEBOOKS[name].read_text(encoding="utf-8"))
    return [cell for cell in notebook["cells"] if cell["cell_type"] == kind]


def test_there_is_one_for_each_of_three_ways_in():
    assert set(NOTEBOOKS) == set(SHORTER) == {"fit", "track", "parts"}


@pytest.mark.parametrize("name", SHORTER)
def test_it_was_run_in_full_and_shows_what_came_out(name):
    assert NOTEBOOKS[name].stat().st_size < MOST_BYTES
    outputs = [output for cell in cells(name, "code") for output in cell["outputs"]]
    assert not any(output["output_type"] == "error" for output in outputs)
    assert sum("image/jpeg" in output.get("data", {}) for output in outputs) >= 3
    text = "".join("".join(output.get("text", ())) for output in outputs)
    assert "Gaussians" in text
    assert "/" + "work/" not in text  # no path of the machine that ran it


@pytest.mark.thorough
@pytest.mark.parametrize(
    "name",
    ["fit", *(pytest.param(name, marks=pytest.mark.slow) for name in ("track", "parts"))],
    # whose verbs run in test_programs.py
)
def test_it_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(first_fit, "TrackConfig", lambda: TRACK)
    monkeypatch.setattr(parts_start, "FIT", replace(parts_start.FIT, steps=40, cap=4000, coarse_until=0.0))
    text = "\n".join("".join(cell["source"]) for cell in cells(name, "code"))
    for long, short in SHORTER[name].items():
        assert long in text, f"{name}: expected {long!r}, which is shortened here"
        text = text.replace(long, short)
    names = {"__name__": name, "TRACK": TRACK, "PARTS": PARTS}
    with matplotlib.rc_context({"backend": "Agg"}):
        exec(compile(text, name, "exec"), names)
    found = {"fit": "psnr", "track": "moments", "parts": "moments"}[name]
    assert len(names[found]) == {"fit": 4, "track": 1, "parts": 2}[name]
    assert plt.get_fignums()
    plt.close("all")
