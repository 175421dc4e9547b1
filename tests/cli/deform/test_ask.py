"""`gsjax ask`: questions about a scene that is made by hand, not learned."""

import json
import re

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.engine.deform.file import write_deformation
from gsjax.engine.folder import DEFORMATION
from gsjax.engine.teaching.source import Source
from gsjax.geometry.cameras import intrinsics
from gsjax.methods.deform import QUESTIONS, DeformingScene, DeformResult, Meaning, Timeline
from gsjax.scene.initialize import gaussians_from_points

WIDTH, HEIGHT, FRAMES = 48, 40, 3


def written(run, names=("tissue", "tool"), metric=True, nearer=0.0):
    """Writes a run of a wall and a plate 20 mm in front of its left half, both still; returns its folder."""
    wall, plate = (
        np.stack(np.meshgrid(np.arange(*x, 0.002), np.arange(*y, 0.002), [z]), -1).reshape(-1, 3)
        for x, y, z in (((-0.06, 0.06), (-0.05, 0.05), 0.1), ((-0.03, -0.015), (-0.006, 0.006), 0.08))
    )
    points = np.concatenate([wall, plate]).astype(np.float32)
    gaussians = gaussians_from_points(points, np.full_like(points, 0.5))
    logits = jnp.full(len(points), 4.0)
    gaussians = eqx.tree_at(lambda g: g.logit_opacities, gaussians, logits)
    meaning = None
    if names:
        book = np.eye(2, 3)
        source = Source("classes", dict(enumerate(names, 1)))
        meaning = Meaning(source, names, book, np.eye(4, 3))
        values = jnp.asarray(book[np.repeat([0, 1], [len(wall), len(plate)])], jnp.float32)
        gaussians = eqx.tree_at(lambda g: g.features, gaussians, values, is_leaf=lambda leaf: leaf is None)
    viewmats = np.tile(np.eye(4), (FRAMES, 1, 1))
    viewmats[1:, 2, 3] = -nearer
    timeline = Timeline(
        times=np.linspace(0, 1, FRAMES),
        frame_ids=np.arange(FRAMES) + 5,
        seconds=1.0,
        viewmats=viewmats,
        Ks=np.tile(intrinsics(45.0, WIDTH, HEIGHT), (FRAMES, 1, 1)),
        size=(WIDTH, HEIGHT),
        near=0.01,
        held_out=np.zeros(0, int),
        metric=metric,
    )
    run.mkdir()
    write_deformation(run / DEFORMATION, DeformResult(DeformingScene(gaussians), None, meaning, timeline))
    return run


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return written(tmp_path_factory.mktemp("asked") / "run")


@pytest.mark.thorough
def test_an_answer_is_a_sentence(gsjax, scene):
    code, said = gsjax("ask", scene, "Where is the tool in frame 6?")
    assert code == 0
    assert "The centre of tool is in the middle left of the picture." in said
    assert "measuring frame 6" in said


@pytest.mark.thorough
def test_json_has_the_value_and_what_it_rests_on(scene, capsys):
    from gsjax.cli import main

    capsys.readouterr()
    assert main(["ask", str(scene), "how far is the tool from the tissue in frame 7", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["type"], found["unit"]) == ("distance", "mm")
    assert found["value"] == pytest.approx(20, abs=2)
    (frame,) = found["facts"]["frames"]
    assert frame["frame"] == 7
    assert frame["classes"]["tool"]["distance_to"]["tissue"] == pytest.approx(found["value"], abs=1e-5)
    assert found["facts"]["gaussians"].keys() == {"tissue", "tool"}


def test_over_time(gsjax, scene):
    code, said = gsjax(
        "ask", scene, "in which direction does the tool move between frames 7 and 5?", "--json"
    )
    assert code == 0
    assert '"value": "still"' in said
    assert '"from_frame": 7' in said
    code, said = gsjax("ask", scene, "when do tool and tissue first touch?")
    assert (code, "Never: in none of the 3 frames. They are nearest in frame" in said) == (0, True)


def test_a_scene_that_began_on_a_plane_has_no_millimetres(gsjax, tmp_path):
    run = written(tmp_path / "run", metric=False, nearer=0.02)
    for frame, per_cent in ((5, 80), (6, 60)):  # of the depth in frame 5, the first
        code, said = gsjax("ask", run, f"how deep is the tool in frame {frame}?")
        assert code == 0
        deep = re.search(r"tool is ([\d.]+) % of the depth deep", said)
        assert deep is not None, said
        assert float(deep[1]) == pytest.approx(per_cent, abs=2)
    code, said = gsjax("ask", run)
    assert code == 0
    assert re.search(r"\bmm\b", said) is None
    assert said.count("% of the") == 5


def test_without_a_question_it_says_what_can_be_asked(gsjax, scene, tmp_path):
    code, said = gsjax("ask", scene)
    assert code == 0
    assert "X and Y are of: tissue, tool F and G are frames: 5 to 7" in said
    said = gsjax("ask", written(tmp_path / "run", names=("tissue", "tool[left]")))[1]
    assert "X and Y are of: tissue, tool[left] F" in said
    assert all(kind.name in said for kind in QUESTIONS)


@pytest.mark.parametrize(
    ("question", "words"),
    [
        ("is it safe?", "expected one of these questions"),
        ("is there a liver in frame 5?", "found 'liver'; there are: tissue, tool"),
        ("is there a tool in frame 9?", "frame 9: expected one of the recording's 3 frames, numbered 5 to 7"),
    ],
)
def test_what_cannot_be_answered_is_said(gsjax, scene, question, words):
    code, said = gsjax("ask", scene, question)
    assert (code, words in said) == (2, True), said


def test_what_is_no_run_of_it_or_knows_nothing(gsjax, tmp_path):
    code, said = gsjax("ask", tmp_path, "is there a tool in frame 0?")
    assert (code, "expected a scene that `gsjax deform` wrote" in said) == (2, True)
    bare = written(tmp_path / "bare", names=())
    code, said = gsjax("ask", bare)
    assert (code, "a scene with named things, found none" in said) == (2, True)
