"""Queries on the page: typed, answered, shown as heat or in parts, saved. The answers are made up here."""

import threading
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.scene.gaussians import concatenate
from gsjax.viz.viewer import Answer, Asking, Viewable, moved, open_viewer
from gsjax.viz.viewer.ask_folder import heat_of
from gsjax.viz.viewer.viewable import redone
from tests.viz.test_viewer_edit import GREEN, RED, ball, rising
from tests.viz.test_viewer_page import browser, color_share, until

viser = pytest.importorskip("viser", reason="viser is not installed")
HEAT, ONLY, WITHOUT, SCENE = "heat of the scores", "only what was found", "all but that", "the scene"


class Answers:
    """`green` scores 0.9 on the second half of the Gaussians, and from frame 2 on, on the first half; other
    queries are refused."""

    def __init__(self):
        self.asked, self.saved, self.levels = [], [], ()

    def asking(self):
        return Asking("One of: green", self.ask, self.like, self.save, self.levels)

    def ask(self, text, frame, level):
        self.asked.append(text if level is None else (text, level))
        if text != "green":
            raise ValueError(f"no class <{text}>")
        scores = np.repeat([0.1, 0.9] if frame < 2 else [0.9, 0.1], 150)
        return Answer(text, scores, 0.5, "better than each negative", 0.02)

    def like(self, row, frame, level):
        self.asked.append(row if level is None else (row, level))
        return Answer(
            f"like {row}", np.repeat([0.9, 0.1] if row < 150 else [0.1, 0.9], 150), 0.5, "Otsu", 0.01
        )

    def save(self, selected, name, frame):
        if self.saved:
            raise OSError("no space")
        self.saved.append((np.flatnonzero(selected), name, frame))
        return Path("extracted") / f"{name}.ply"


@pytest.fixture
def answers():
    return Answers()


@pytest.fixture
def scene(answers):
    both = jax.tree.map(jnp.asarray, concatenate([ball(RED, -0.6), ball(GREEN, 0.6)]))
    shots = rising(both, 2).shots
    return Viewable("balls", both, np.repeat([1, 2], 150), shots=shots, asking=answers.asking())


@pytest.mark.thorough
def test_a_query_is_answered_shown_and_saved(scene, answers):
    with open_viewer(scene, port=0) as viewer, browser(viewer, scene) as (page, _):
        folder = page._questions
        folder._text.value = "green"
        until(lambda: "150 of 300" in folder._count.content)
        assert answers.asked == ["green"]
        assert folder._threshold.value == 0.5
        until(lambda: max(color_share(page._picture, GREEN).values()) < 0.001)  # heat in its place
        # Only what was found, then the rest, in their own colours.
        folder._showing.value = ONLY
        until(lambda: "all 150 Gaussians" in page._status.content)
        until(lambda: max(color_share(page._picture, GREEN).values()) > 0.02)
        assert max(color_share(page._picture, RED).values()) < 0.001
        folder._showing.value = WITHOUT
        until(lambda: max(color_share(page._picture, RED).values()) > 0.02)
        until(lambda: page._splats._nodes["still"].rgbs[0, 0] > 150)
        # The threshold slides.
        folder._threshold.value = 0.1 - 1e-6
        until(lambda: "nothing is left" in folder._count.content)
        folder._threshold.value = 0.5
        until(lambda: "150 of 300" in folder._count.content)
        # It is saved once; then the disk is full, which is reported.
        folder._save_part("object")
        assert "saved as" in folder._save_status.content
        rows, name, _ = answers.saved[0]
        np.testing.assert_array_equal(rows, np.arange(150, 300))
        assert name == "green object"
        folder._save_part("rest")
        assert "no space" in folder._save_status.content
        # The scene again.
        folder._showing.value = SCENE
        until(lambda: page._now.scene is scene)


@pytest.mark.thorough
def test_a_query_that_cannot_be_answered_is_reported(scene, answers):
    with open_viewer(scene, port=0) as viewer, browser(viewer, scene) as (page, _):
        folder = page._questions
        folder._save_part("object")
        assert "enter a query first" in folder._save_status.content
        folder._ask_similar()
        assert "pick something first" in folder._status.content
        folder._text.value = "spoon"
        until(lambda: "no class &lt;spoon&gt;" in folder._status.content)
        assert page._now.scene is scene


def test_an_answer_that_comes_late_does_not_replace_a_newer_one(scene, answers):
    begun, go_on = threading.Event(), threading.Event()
    ask = answers.ask

    def slow(text, frame=0, level=None):
        begun.set()
        assert go_on.wait(30)
        return ask(text, frame, level)

    answers.ask = slow
    scene = replace(scene, asking=answers.asking())
    with open_viewer(scene, port=0) as viewer, browser(viewer, scene) as (page, _):
        folder = page._questions
        late = threading.Thread(target=folder._answer, args=(lambda: slow("green"), ""))
        wrong = threading.Thread(target=folder._answer, args=(lambda: slow("spoon"), ""))
        for thread in (late, wrong):
            begun.clear()
            thread.start()
            assert begun.wait(30)
        folder._picked = lambda: 7
        folder._ask_similar()
        assert folder._found.what == "like 7"
        go_on.set()
        for thread in (late, wrong):
            thread.join(30)
        assert folder._found.what == "like 7"
        assert "like 7" in folder._status.content


def test_heat_is_shown_whatever_gaussians_were_coloured_by(scene, answers):
    with open_viewer(scene, port=0) as viewer, browser(viewer, scene) as (page, _):
        page._coloring.value = "label"
        page._questions._text.value = "green"
        until(lambda: "150 of 300" in page._questions._count.content)
        assert page._coloring.value == "colour"
        # Labels can be selected afterwards, also when only what was found is shown.
        page._coloring.value = "label"
        page._questions._showing.value = ONLY
        until(lambda: page._now.scene.gaussians.num == 150)
        assert page._coloring.value == "label"


def test_the_pick_is_queried_by_its_row_in_the_whole_scene(scene, answers):
    with open_viewer(scene, port=0) as viewer, browser(viewer, scene) as (page, _):
        folder = page._questions
        folder._text.value = "green"
        until(lambda: "150 of 300" in folder._count.content)
        folder._showing.value = ONLY
        until(lambda: page._now.scene.gaussians.num == 150)
        folder._picked = lambda: 7
        folder._ask_similar()
        assert answers.asked[-1] == 157


def test_another_level_asks_the_latest_query_again(scene, answers):
    answers.levels = ("small", "large")
    scene = replace(scene, asking=answers.asking())
    with open_viewer(scene, port=0) as viewer, browser(viewer, scene) as (page, _):
        folder = page._questions
        folder._level.value = "small"  # before anything is asked
        folder._level.value = "the best fit"
        assert "One of: green" in folder._status.content
        folder._text.value = "green"
        until(lambda: "150 of 300" in folder._count.content)
        folder._level.value = "large"
        until(lambda: answers.asked == ["green", ("green", "large")])
        folder._picked = lambda: 7
        folder._ask_similar()
        folder._picked = lambda: 8  # not queried: the level applies to the latest query
        folder._level.value = "small"
        until(lambda: answers.asked[2:] == [(7, "large"), (7, "small")])


def test_a_moving_scene_can_be_queried(scene, answers):
    """An answer is shown in all frames and follows the motion; another frame may have another answer."""
    moving = replace(rising(scene.gaussians, 4), labels=scene.labels, asking=answers.asking())
    with open_viewer(moving, port=0) as viewer, browser(viewer, moving) as (page, _):
        folder = page._questions
        folder._text.value = "green"
        until(lambda: "150 of 300" in folder._count.content)
        until(lambda: max(color_share(page._picture, GREEN).values()) < 0.001)  # heat in its place
        folder._showing.value = ONLY
        until(lambda: "all 150 Gaussians" in page._status.content)
        until(lambda: max(color_share(page._picture, GREEN).values()) > 0.02)
        assert page._now.scene.num_frames == 4
        np.testing.assert_array_equal(page._now.scene.labels, 2)
        page._slider.value = 3
        until(lambda: page._splats._nodes["moving"].centers[:, 2].mean() * page._splats._scale > 1.1)
        until(lambda: color_share(page._picture, GREEN)["above"] > 0.02)
        assert max(color_share(page._picture, RED).values()) < 0.001
        folder._save_part("object")
        np.testing.assert_array_equal(answers.saved[0][0], np.arange(150, 300))
        assert answers.saved[0][2] == 3
        # Asked again in this frame, the answer is the other ball.
        folder._ask()
        until(lambda: max(color_share(page._picture, RED).values()) > 0.02)
        assert page._slider.value == 3
        folder._showing.value = SCENE
        until(lambda: page._now.scene is moving)


def test_a_part_of_a_partly_moving_scene(scene):
    """The moving Gaussians stay first."""
    means = np.asarray(scene.gaussians.means)[None, :100] + np.array([0.0, 1.0])[:, None, None]
    quats = np.tile(np.asarray(scene.gaussians.quats)[None, :100], (2, 1, 1))
    some = replace(scene, motion=moved(scene.gaussians, means.astype(np.float32), quats))
    part = redone(some, lambda gaussians: gaussians, np.arange(300) % 3 == 0)
    assert (part.num_frames, part.num_moving, part.gaussians.num) == (2, 34, 100)
    np.testing.assert_allclose(
        part.at(1).means - part.at(0).means, (np.arange(100) < 34)[:, None] * np.ones(3)
    )


def test_heat_is_bright_above_the_threshold_and_grey_below(scene):
    found = Answer("x", np.linspace(0, 1, 300), 0.5, "", 0.0)
    colors = heat_of(scene.gaussians, found, found.scores > 0.5)
    assert colors.shape == (300, 3)
    assert colors[found.scores > 0.5].mean() > 2 * colors[found.scores < 0.3].mean()
    assert (colors[found.scores < 0.3].max(1) < 0.6).all()
