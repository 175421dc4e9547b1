"""The README fits one screen, and its programs run as they stand there."""

import re

import pytest

from gsjax.cli import main
from tests.docs.blocks import ROOT, programs, run_programs


def test_it_fits_one_screen_and_its_picture_is_there():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) < 95
    assert len(programs("README.md")) == 3
    for program in programs("README.md"):
        compile(program.text, "README.md", "exec")
    for picture in re.findall(r"!\[.*?\]\((.*?)\)", text):
        assert 0 < (ROOT / picture).stat().st_size < 400_000


@pytest.mark.slow
def test_its_programs_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    quick = ("--frames", "0:1", "--track.start.iterations", "1")
    assert main(["track", "simulated:tabletop", "--cameras", "0", "--out", "runs/demo", *quick]) == 0
    assert run_programs("README.md")
