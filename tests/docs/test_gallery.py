"""The gallery: its commands are valid, and its page is the one that the script would write."""

import importlib.util
import shlex

import numpy as np
import pytest
from PIL import Image

from tests.docs.blocks import ROOT, check_command


@pytest.fixture(scope="module")
def gallery():
    spec = importlib.util.spec_from_file_location("make_gallery", ROOT / "docs/make_gallery.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.thorough
def test_what_it_runs_has_options_that_exist(gallery):
    for command in gallery.COMMANDS.values():
        check_command(["gsjax", *shlex.split(command)])
        check_command(["gsjax", *gallery.anew(command)])


def test_what_was_stopped_is_made_anew(gallery, tmp_path):
    assert not gallery.made(tmp_path / "none", "track DATASET")
    (tmp_path / "config.yml").write_text("# gsjax run\n")
    for command in ("track DATASET", "edit RUN"):
        assert not gallery.made(tmp_path, command)
        (tmp_path / "metrics.json").write_text('{"complete": false, "report": true}')
        (tmp_path / "report.html").touch()
        assert not gallery.made(tmp_path, command)
        (tmp_path / "metrics.json").write_text('{"complete": true, "report": true}')
        assert gallery.made(tmp_path, command)
        (tmp_path / "metrics.json").unlink()


def test_the_page_is_as_the_script_has_it_and_its_films_and_pictures_are_small(
    gallery, monkeypatch, tmp_path
):
    monkeypatch.setattr(gallery, "RUNS", tmp_path)
    (tmp_path / "furniture").mkdir()
    (tmp_path / "furniture" / "video_3.mp4").touch()
    files = {name: f"{name}.{'webp' if name in gallery.films() else 'jpg'}" for name in gallery.SAYS}
    written = gallery.PAGE.read_text(encoding="utf-8")
    monkeypatch.undo()
    assert written == gallery.page({name: f"gallery/{file}" for name, file in files.items()})
    sizes = {path.name: path.stat().st_size for path in gallery.PICTURES.iterdir()}
    assert sizes.keys() == {"trades.png", *files.values()}
    assert max(sizes.values()) < 300_000


def test_a_video_becomes_a_film_that_moves(gallery, tmp_path):
    frames = np.zeros((4, 60, 1000, 3), np.uint8)
    frames[:, :, :, 0] = np.arange(4)[:, None, None] * 60
    assert gallery.write_film(tmp_path / "some.webp", frames) == "gallery/some.webp"
    with Image.open(tmp_path / "some.webp") as film:
        assert (film.n_frames, film.size) == (4, (480, 29))


@pytest.mark.thorough
def test_trades_are_those_of_the_committed_results(gallery, tmp_path):
    for trade, found in zip(gallery.TRADES, gallery.points(), strict=True):
        costs, gains, first = (np.array(column) for column in zip(*found, strict=True))
        assert np.isfinite(costs).all(), trade
        assert np.isfinite(gains).all(), trade
        assert (costs > 0).all(), trade
        assert first.any(), trade
        assert not first.all(), trade
    gallery.draw_trades(tmp_path / "trades.png")
    assert (tmp_path / "trades.png").stat().st_size > 20_000
