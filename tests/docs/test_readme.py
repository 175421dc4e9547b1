"""The README stays short, and its derivative runs; the five programs are in test_programs.py."""

import re

import jax.numpy as jnp
import pytest

from gsjax.cli import main
from tests.docs.blocks import ROOT, programs


def test_it_is_short_and_its_picture_is_there():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.split()) < 750
    assert len(text.splitlines()) < 90
    assert len(programs("README.md")) == 2
    for program in programs("README.md"):
        compile(program.text, "README.md", "exec")
    for picture in re.findall(r"!\[.*?\]\((.*?)\)", text):
        assert 0 < (ROOT / picture).stat().st_size < 400_000


@pytest.mark.slow
def test_its_derivative_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    quick = ("--frames", "0:1", "--track.start.iterations", "1")
    assert main(["track", "simulated:tabletop", "--cameras", "0", "--out", "runs/demo", *quick]) == 0
    names: dict = {}
    exec(compile(programs("README.md")[-1].text, "README.md", "exec"), names)
    assert jnp.isfinite(names["by_gaussians"].means).all()
    assert jnp.isfinite(names["by_cameras"].viewmat).all()
