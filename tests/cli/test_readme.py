"""The README's programs run as they stand there."""

import re
from pathlib import Path

import pytest

from gsjax.cli import main

ROOT = Path(__file__).resolve().parents[2]


def programs(page: Path = ROOT / "README.md") -> list[str]:
    return re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL)


def test_it_fits_one_screen_and_its_picture_is_there():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) < 95
    assert len(programs()) == 3
    for program in programs():
        compile(program, "README.md", "exec")
    for picture in re.findall(r"!\[.*?\]\((.*?)\)", text):
        assert 0 < (ROOT / picture).stat().st_size < 400_000


@pytest.mark.parametrize(
    "page",
    [
        *(
            pytest.param(page, marks=pytest.mark.slow)
            for page in ("rasterizer.md", "fields.md", "deform.md", "composition.md")
        ),
        "data.md",
        "fit.md",
    ],
)
def test_the_programs_of_a_page_run_one_after_another(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for program in programs(ROOT / "docs" / page):
        exec(compile(program, page, "exec"), names)
    assert names


@pytest.mark.slow
def test_its_programs_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    quick = ("--frames", "0:1", "--tracker.start.iterations", "1")
    assert main(["track", "simulated:tabletop", "--cameras", "0", "--out", "runs/demo", *quick]) == 0
    names: dict = {}
    for program in programs():
        exec(compile(program, "README.md", "exec"), names)
