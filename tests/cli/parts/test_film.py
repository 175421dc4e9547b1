"""A film of `gsjax edit` is exported as a sequence of files or as a page, and viewed like a run."""

import json
import shutil

import numpy as np
import pytest
from rich.console import Console

from gsjax.engine.messages import Notes
from gsjax.engine.viewables import open_viewable
from gsjax.io.ply import read_ply
from tests.cli.parts.test_edit import SCRIPT, write_run


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folders of a run and, elsewhere, of a film of it."""
    root = tmp_path_factory.mktemp("film")
    return write_run(root / "run"), root / "film"


@pytest.fixture
def film(gsjax, made):
    run, folder = made
    if not folder.exists():
        (run / "slow.yaml").write_text(SCRIPT)
        ops = ("--op", "fade:parts=drawer,opacity=0.5", "--op", "echo:parts=drawer,copies=2")
        code, said = gsjax("edit", run, run / "slow.yaml", *ops, "--ply", "--out", folder)
        assert code == 0, said
    return folder


def in_order(gaussians):
    """Rows sorted by position, because a film that is viewed has the Gaussians that change first."""
    rows = np.lexsort(np.asarray(gaussians.means).T.round(5))
    return [np.asarray(a)[rows] for a in (gaussians.means, gaussians.opacities, gaussians.sh0)]


@pytest.mark.thorough
def test_a_film_leaves_as_files_of_its_frames(gsjax, film, tmp_path):
    code, said = gsjax("export", film, tmp_path / "frame_####.ply")
    assert code == 0, said
    assert "shut_door goes up to 100 mm" in said
    files = sorted(path.name for path in tmp_path.glob("*.ply"))
    assert files == [f"frame_{t:04d}.ply" for t in range(13)]
    for t in (0, 12):
        mine = in_order(read_ply(tmp_path / f"frame_{t:04d}.ply")[0])
        shown = in_order(read_ply(film / "ply" / f"{t:06d}.ply")[0])
        for one, other in zip(mine, shown, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-5)
    code, said = gsjax("export", film, tmp_path / "frame_####.sog", "--frames", "0:13:6")
    assert code == 0, said
    assert len(list(tmp_path.glob("*.sog"))) == 3


@pytest.mark.thorough
def test_a_film_leaves_as_a_page_that_plays(gsjax, film, tmp_path):
    code, said = gsjax("export", film, tmp_path / "film.html")
    assert code == 0, said
    assert "of 13 frames" in said


@pytest.mark.thorough
def test_a_film_is_viewed_over_its_own_time(film):
    scene, folder = open_viewable(film, Notes(Console(quiet=True)))
    assert (scene.num_frames, folder) == (13, film)
    np.testing.assert_allclose(np.diff(scene.times), 1 / 15, rtol=1e-5)
    assert scene.shots is not None


@pytest.mark.thorough
def test_a_film_is_described(gsjax, made, film):
    code, said = gsjax("info", film)
    assert code == 0, said
    assert f"gsjax edit {made[0]}" in said
    assert "speed; move; fade; echo" in said
    assert "0.87 s, 13 frames" in said


@pytest.mark.thorough
def test_a_film_whose_run_is_gone_names_it(gsjax, film, tmp_path):
    alone = tmp_path / "alone"
    shutil.copytree(film, alone)
    found = json.loads((alone / "metrics.json").read_text())
    found["run"] = str(tmp_path / "gone")
    (alone / "metrics.json").write_text(json.dumps(found))
    code, said = gsjax("export", alone, tmp_path / "film.html")
    assert code != 0
    assert f"alone: expected the run of this film, {tmp_path / 'gone'}, found none there" in said
    code, said = gsjax("info", alone)
    assert code == 0, said
    assert "13 frames" in said
    (alone / "edit.yaml").write_text("edits: 3")
    code, said = gsjax("export", alone, tmp_path / "film.html")
    assert code != 0
    assert "edit.yaml: edits: expected" in said


@pytest.mark.thorough
def test_a_film_goes_along_with_its_run(gsjax, made, film, tmp_path):
    moved = tmp_path / "elsewhere"
    shutil.copytree(made[0], moved)
    shutil.copytree(film, moved / "edit" / "slow")
    (moved / "edit.yaml").write_text(SCRIPT)  # a script in the run does not make a film of it
    found = json.loads((film / "metrics.json").read_text()) | {"run": str(tmp_path / "gone")}
    (moved / "edit" / "slow" / "metrics.json").write_text(json.dumps(found))
    notes = Notes(Console(quiet=True))
    assert open_viewable(moved / "edit" / "slow", notes)[0].num_frames == 13
    assert open_viewable(moved, notes)[0].num_frames == 4


@pytest.mark.thorough
def test_frames_a_second_and_length_may_be_given(gsjax, made, tmp_path):
    asked = ("edit", made[0], "--op", "speed:parts=drawer,factor=2", "--fps", 30, "--length", 0.5)
    code, said = gsjax(*asked, "--out", tmp_path / "film")
    assert code == 0, said
    assert "0.50 s, 15 frames" in said
    code, said = gsjax(*asked[:-3], "-1", "--out", tmp_path / "other")
    assert code != 0
    assert "--fps: expected frames a second, 0.1 to 1000, found -1" in said
