"""The hooks of mkdocs."""

import runpy
from types import SimpleNamespace

import pytest

from tests.docs.blocks import ROOT

pytest.importorskip("mkdocs")
pytest.importorskip("latex2mathml")


def test_a_figure_that_is_missing_is_warned_of_and_not_copied(tmp_path, caplog):
    hooks = runpy.run_path(str(ROOT / "docs/hooks.py"))
    page = SimpleNamespace(file=SimpleNamespace(src_uri="results.md"), url="results/")
    hooks["on_page_content"]('<img src="../experiments/gone/figure.png">', page)
    assert "results.md: there is no experiments/gone/figure.png" in caplog.text
    hooks["on_post_build"](SimpleNamespace(site_dir=tmp_path))
    assert not list(tmp_path.iterdir())
