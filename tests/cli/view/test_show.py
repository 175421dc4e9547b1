"""`gsjax.show`: a scene in the cell of a notebook."""

import json
import re

import equinox as eqx
import pytest

import gsjax
from tests.cli.view.conftest import some


def about(shown):
    """The data that is passed to the page in a cell."""
    return json.loads(re.search(r"const about = (\{.*\});", shown.page)[1])


def test_a_cell_holds_the_page_whole():
    shown = gsjax.show(some(), height=300)
    cell = shown._repr_html_()
    assert cell.lower().startswith('<iframe srcdoc="&lt;!doctype html&gt;')
    assert "height: 300px" in cell
    assert cell.count('"') == 4  # none within the page ends the attribute
    assert about(shown)["motion"] is None
    assert about(shown)["up"] == [0, 0, 1]
    assert len(repr(shown)) < 100


def test_moments_are_played():
    first = some()
    later = eqx.tree_at(lambda g: g.means, first, first.means.at[:5].add(0.1))
    shown = gsjax.show([first, later], up=(0, -1, 0))
    assert about(shown)["motion"]["moving"] == 5
    assert about(shown)["up"] == [0, -1, 0]


def test_moments_of_other_numbers_of_gaussians_are_refused():
    with pytest.raises(ValueError, match="same number of Gaussians, found 20 to 30"):
        gsjax.show([some(), some(20)])
    with pytest.raises(ValueError, match="found no moment"):
        gsjax.show([])


@pytest.mark.parametrize("up", [(0, 0, 0), (0, 0), (0, 0, float("nan")), "up"])
def test_what_is_no_direction_is_refused(up):
    with pytest.raises(ValueError, match=r"^up: expected "):
        gsjax.show(some(), up=up)


@pytest.mark.parametrize(("up", "found"), [((0, 0, 2), [0, 0, 1]), ("-y", [0, -1, 0]), ("x", [1, 0, 0])])
def test_up_is_a_direction_or_its_name(up, found):
    assert about(gsjax.show(some(), up=up))["up"] == found


@pytest.mark.parametrize("scene", [None, 3, {0: some()}, [some(), None]])
def test_what_is_no_scene_is_refused(scene):
    with pytest.raises(TypeError, match=r"^scene: expected Gaussians, a list of them, the result of "):
        gsjax.show(scene)


def test_a_file_and_a_run_are_shown_as_exported(ply, tracked, export, tmp_path):
    assert about(gsjax.show(ply))["up"] == [0, -1, 0]
    export(tracked, tmp_path / "scene.html")
    assert gsjax.show(tracked).page == (tmp_path / "scene.html").read_text()
    assert gsjax.show(gsjax.open_scene(tracked)).page == gsjax.show(tracked).page


def test_each_page_of_a_frame_shows_that_frame_alone(export, tracked, tmp_path):
    code, _ = export(tracked, tmp_path / "frame_#.html")
    assert code == 0
    assert '"motion": null' in (tmp_path / "frame_1.html").read_text()
