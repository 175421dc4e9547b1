"""The README stays short, and its two programs run; the five programs are tested in test_programs.py."""

import re

import jax.numpy as jnp
import pytest

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


@pytest.mark.thorough
def test_its_programs_run_one_after_the_other(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first, second = (program.text for program in programs("README.md"))
    names: dict = {}
    exec(
        compile(first.replace("steps=500, cap=5000", "steps=4, cap=300, coarse_until=0.0"), "fit", "exec"),
        names,
    )
    exec(compile(second, "README.md", "exec"), names)
    assert jnp.isfinite(names["by_gaussians"].means).all()
    assert jnp.isfinite(names["by_cameras"].viewmat).all()
