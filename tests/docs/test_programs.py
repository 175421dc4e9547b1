"""The five example programs: the same in docs/programs.md and on their own pages, alike in form, and run with
fewer steps."""

import re
from dataclasses import replace

import pytest

import gsjax
from gsjax.engine.parts import start as parts_start
from gsjax.methods.parts import DiscoverConfig, PartsConfig, RefineConfig, StreamConfig
from gsjax.methods.track import first_fit
from gsjax.scene.feature_grid import FeatureGridConfig
from tests.docs.blocks import ROOT, Block, blocks, programs
from tests.engine.cases import TRACK

VERBS = ("fit", "track", "parts", "distill", "deform")
MOST_LINES = 10
PARTS = PartsConfig(
    discover=DiscoverConfig(most_parts=2, lift_iterations=2),
    stream=StreamConfig(iterations=2, coarse=0.0),
    refine=RefineConfig(iterations=1),
    grid=FeatureGridConfig(2, 4, 16, 8, 2, 8),
)
SHORTER = {
    "fit": {"steps=500, cap=5000": "steps=4, cap=300, coarse_until=0.0"},
    "track": {"gsjax.TrackConfig()": "TRACK", "frames=4": "frames=2"},
    "parts": {"gsjax.PartsConfig()": "PARTS", "frames=[0, 5, 10, 15]": "frames=[0, 5]"},
    "distill": {"steps=500, cap=5000": "steps=4, cap=300, coarse_until=0.0"},
    "deform": {"warmup=100, iterations=200": "warmup=2, iterations=3, nodes=64"},
}
"""Replacements in the text of each program, so that it takes less time."""


def program(verb: str) -> Block:
    """The program of docs/programs.md that calls a verb in its last loop."""
    found = [block for block in programs("docs/programs.md") if _loops(block.text)[-1:] == [verb]]
    assert len(found) == 1, f"docs/programs.md: expected one program of gsjax.{verb}, found {len(found)}"
    return found[0]


def _loops(text: str) -> list[str]:
    return re.findall(r"^for now in gsjax\.(\w+)\(", text, re.MULTILINE)


@pytest.mark.parametrize("verb", VERBS)
def test_the_page_opens_with_the_program_and_a_picture(verb):
    page = f"docs/{verb}.md"
    first = blocks(page)[0]
    assert first.text == program(verb).text
    assert programs(page) == [first]  # there is nothing else to run
    lines = first.text.splitlines()
    assert len(lines) <= MOST_LINES
    after = (ROOT / page).read_text(encoding="utf-8").split("```")[2]
    assert after.strip().startswith("!["), f"{page}: expected a picture after the program"


def test_the_readme_shows_the_first():
    assert programs("README.md")[0].text == program("fit").text


@pytest.mark.parametrize("verb", VERBS)
def test_all_use_the_same_words(verb):
    text = program(verb).text
    assert text.startswith("import gsjax\n\n")
    assert f"gsjax.{verb.capitalize()}Config(" in text
    loop = (
        rf"^for now in gsjax\.{verb}\(.*\):\n"
        r"    print\(now\.step, now\.info\[\"\w+\"\], now\.seconds\)\n"
        r"gsjax\.save\(\"run\.npz\", now\)\n"
        r"now = gsjax\.load\(\"run\.npz\"\)\n"
        r"(?:.*now\.result.*\n)+\Z"
    )
    assert re.search(loop, text, re.MULTILINE), text


@pytest.mark.thorough
@pytest.mark.parametrize("verb", VERBS)
def test_it_runs(verb, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(first_fit, "TrackConfig", lambda: TRACK)
    monkeypatch.setattr(parts_start, "FIT", replace(parts_start.FIT, steps=40, cap=4000, coarse_until=0.0))
    text = program(verb).text
    for long, short in SHORTER[verb].items():
        assert long in text, f"gsjax.{verb}: expected {long!r}, which is shortened here"
        text = text.replace(long, short)
    names = {"TRACK": TRACK, "PARTS": PARTS}
    exec(compile(text, f"gsjax.{verb}", "exec"), names)
    now = names["now"]
    assert now.step > 0
    assert now.problem is None  # not stored in the file
    assert type(now).__name__ == "Tick"
    assert gsjax.load("run.npz").step == now.step
    given = names.get("photographs", names.get("sequence"))
    for said in map(repr, (now, now.result, given)):  # as a notebook shows them
        assert len(said) < 150, said
    assert repr(now).startswith(f"Tick(step {now.step}: ")
    assert given.name in repr(given)
    if verb != "distill":  # its result is not a scene
        assert "<iframe" in gsjax.show(now.result)._repr_html_()
