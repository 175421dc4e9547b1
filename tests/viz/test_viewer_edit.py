"""Edits on the page: composed, previewed, refused, saved. The edits themselves are made up here."""

import threading
from pathlib import Path

import numpy as np
import pytest

from gsjax.scene.gaussians import gaussians_from_activated, take
from gsjax.viz.viewer import Editing, Motion, Preview, Shots, Viewable, markup, moved, open_viewer
from gsjax.viz.viewer.splat_nodes import Appearance, Displayed, SplatNodes
from gsjax.viz.viewer.splats import Palette
from tests.viz.scenes import Api
from tests.viz.test_viewer_page import (
    Saved,
    browser,
    chromium,
    color_share,
    look,
    middle_of,
    seen,
    until,
)

viser = pytest.importorskip("viser", reason="viser is not installed")
chromium = chromium  # a fixture
RED, GREEN = (0.9, 0.1, 0.1), (0.1, 0.8, 0.2)


def ball(color, x, count=150):
    rng = np.random.default_rng(0)
    shell = rng.normal(size=(count, 3))
    shell *= 0.35 / np.linalg.norm(shell, axis=1, keepdims=True)
    return gaussians_from_activated(
        shell + [x, 0, 0],  # noqa: RUF005
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.full((count, 3), 0.08),
        np.full(count, 0.95),
        np.tile(color, (count, 1)),
    )


def rising(gaussians, frames, editing=None):
    """Gaussians that rise by 1.2 metres over the given number of frames, before a camera at (0, -4, 0)."""
    means = np.asarray(gaussians.means)[None] + np.linspace(0, 1.2, frames)[:, None, None] * [0, 0, 1.0]
    quats = np.tile(np.asarray(gaussians.quats)[None], (frames, 1, 1))
    motion = moved(gaussians, means.astype(np.float32), quats)
    times = np.arange(frames) / 10
    K = np.array([[300.0, 0, 150], [0, 300, 100], [0, 0, 1]])
    view = look(np.array([0.0, -4, 0]), (0, 0, 0), (0, 0, 1))
    shots = Shots(("front",), view[None, None], K[None, None], np.array([[300, 200]]))
    return Viewable("ball", gaussians, motion=motion, times=times, shots=shots, editing=editing)


class Edits:
    """`longer` makes a film of 8 frames of a green ball, `fewer` one of 2 frames of a smaller, still part of
    it; other edits are refused."""

    def __init__(self):
        self.asked, self.saved, self.go, self.went_on = [], [], threading.Event(), []

    def editing(self):
        return Editing(
            operations={"longer": ["It lasts `longer`.", "by: <seconds>"], "fewer": ["Less of it."]},
            parts={"ball (1)": "ball", "all": "all"},
            cameras=("camera 2", "camera 0"),
            begin=lambda operation, part: f"{operation}:parts={part}",
            preview=self.preview,
            save=self.save,
        )

    def preview(self, lines):
        self.asked.append(list(lines))
        last = lines[-1].partition(":")[0]
        if last == "longer":
            return Preview(rising(ball(GREEN, 0.0), 8), ["it goes <far> beyond"])
        if last == "fewer":
            less = take(ball(GREEN, 0.0), np.arange(40))
            return Preview(Viewable("b", less, motion=Motion(2, 0, lambda frame: less)))
        raise ValueError(f"edit {len(lines)}: op: expected one of longer, fewer, found <{last}>")

    def save(self, lines, name, camera, goes_on):
        self.saved.append((list(lines), name, camera))
        if name == "full":
            raise OSError("no space")
        self.went_on.append(goes_on(1, 2))
        assert self.go.wait(60)
        self.went_on.append(goes_on(2, 2))
        return Path("edit") / name


@pytest.mark.thorough
def test_a_list_is_composed_previewed_and_reset():
    edits = Edits()
    scene = rising(ball(RED, 0.0), 4, edits.editing())
    with open_viewer(scene, port=0) as viewer, browser(viewer, scene) as (page, _):
        folder = page._edits
        assert folder._line.value == "longer:parts=ball"
        assert "<b>by</b> &lt;seconds&gt;" in folder._help.content
        folder._part.value = "all"
        assert folder._line.value == "longer:parts=all"
        # The list is previewed: in time, in splats and in our render.
        page._slider.value = 3
        folder._add()
        assert folder._list.value == "longer:parts=all"
        until(lambda: "8 frames, 150 Gaussians" in folder._status.content)
        assert page._slider.max == 7
        assert "it goes &lt;far&gt; beyond" in folder._status.content
        assert page._moment.content == "0.30 s of 0.70 s"
        until(lambda: max(color_share(page._picture, GREEN).values()) > 0.02)
        until(lambda: page._splats._nodes["moving"].rgbs[0, 1] > 150)
        page._slider.value = 7
        until(lambda: page._splats._nodes["moving"].centers[:, 2].mean() * page._splats._scale > 1.1)
        # An edit that cannot be done is reported, and the last preview stays.
        folder._operation.value, folder._line.value = "fewer", "fever:  parts=1"
        folder._add()
        until(lambda: "found &lt;fever&gt;" in folder._status.content)
        assert edits.asked[-1] == ["longer:parts=all", "fever: parts=1"]
        assert (page._slider.max, page._now.scene.num_frames) == (7, 8)
        # A disabled line is not previewed; Gaussians that do not move are sent as such.
        folder._list.value = "# longer:parts=all\n\n  fewer:parts=1\n"
        until(lambda: "2 frames, 40 Gaussians" in folder._status.content)
        assert page._slider.max == 1
        assert edits.asked[-1] == ["fewer:parts=1"]
        assert page._frame == 1
        until(lambda: set(page._splats._nodes) == {"still"})
        until(lambda: "all 40 Gaussians" in page._status.content)
        # Resetting restores the recorded motion.
        folder._list.value = ""
        until(lambda: "editing" not in folder._status.content and "frames" not in folder._status.content)
        assert page._slider.max == 3
        assert page._now.scene is scene
        until(lambda: set(page._splats._nodes) == {"moving"})


@pytest.mark.thorough
def test_playback_continues_with_the_preview():
    scene = rising(ball(RED, 0.0), 4, Edits().editing())
    with open_viewer(scene, port=0) as viewer, browser(viewer, scene) as (page, _):
        page._player.toggle()
        page._edits._list.value = "longer:"
        until(lambda: page._frame == 7)
        page._edits._list.value = ""
        until(lambda: page._slider.max == 3)
        until(lambda: page._frame == 2)
        until(lambda: page._frame == 0)
        page._player.toggle()


@pytest.mark.thorough
def test_a_film_is_saved_with_its_progress():
    edits = Edits()
    scene = rising(ball(RED, 0.0), 4, edits.editing())
    with open_viewer(scene, port=0) as viewer, browser(viewer, scene) as (page, _):
        folder = page._edits
        folder._save_film()
        assert "expected edits in the list, found none" in folder._save_status.content
        folder._list.value = "# disabled\nlonger:"
        folder._name.value, folder._camera.value = " mine ", "camera 0"
        keeping = threading.Thread(target=folder._save_film)
        keeping.start()
        until(lambda: folder._progress.value == 50)
        assert folder._save_button.disabled
        assert folder._progress.visible
        folder._save_film()
        assert "one film at a time" in folder._save_status.content
        edits.go.set()
        keeping.join(60)
        assert edits.saved == [(["longer:"], "mine", "camera 0")]
        assert "saved as edit/mine" in folder._save_status.content
        assert not folder._save_button.disabled
        assert not folder._progress.visible
        folder._name.value = "full"
        folder._save_film()
        assert "no space" in folder._save_status.content
        assert not folder._save_button.disabled


@pytest.mark.filterwarnings("ignore:Queued a GuiUpdateMessage")  # to the browser that left
def test_closing_the_viewer_ends_films_and_one_leaving_browser_does_not():
    edits = Edits()
    scene = rising(ball(RED, 0.0), 4, edits.editing())
    with open_viewer(scene, port=0) as viewer:
        with browser(viewer, scene) as (page, _):
            page._edits._list.value = "longer:"
            keeping = threading.Thread(target=page._edits._save_film)
            keeping.start()
            until(lambda: edits.went_on == [True])
        until(lambda: not viewer._pages)
        assert page._edits._report_progress(1, 2)
        threading.Timer(0.5, edits.go.set).start()
    assert edits.went_on == [True, False]  # closing waited for it


def test_a_new_scene_replaces_what_the_browser_has():
    api = Api()
    first = rising(ball(RED, 0.0), 4)
    nodes = SplatNodes(api, first, 1000)
    fewer = Viewable("fewer", ball(GREEN, 1.0, 60))

    def show(scene, frame):
        nodes.show(Displayed(scene, Palette(scene), frame, scene.at(frame)), Appearance("colour"))

    show(first, 0)
    show(fewer, 0)
    assert api.nodes.keys() == {"/splats/still"}
    centers, _, colors, _ = api.nodes["/splats/still"]
    assert len(centers) == 60
    assert centers[:, 0].mean() * nodes._scale == pytest.approx(1.0, abs=0.05)
    np.testing.assert_allclose(colors[0], GREEN, atol=0.01)
    show(first, 2)
    assert api.nodes.keys() == {"/splats/moving"}


def test_texts_of_films():
    scene = rising(ball(RED, 0.0), 4)
    assert markup.film_summary(scene) == "0.30 s, 4 frames, 150 Gaussians"
    assert "&lt;i&gt;" in markup.as_lines("<i>", color="red")
    assert "<b>to</b>" in markup.operation_help(["It goes on after `to`."])


@pytest.mark.slow
def test_in_a_browser(chromium):
    edits = Edits()
    scene = rising(ball(RED, 0.0), 4, edits.editing())
    with open_viewer(scene, port=0, save=Saved()) as viewer:
        chromium.goto(viewer.url)
        until(lambda: middle_of(seen(chromium), RED))
        chromium.get_by_text("Add", exact=True).click()
        until(lambda: middle_of(seen(chromium), GREEN) and not middle_of(seen(chromium), RED))
        assert chromium.get_by_text("8 frames, 150 Gaussians").is_visible()
        written = chromium.locator("textarea").nth(1)
        assert written.input_value() == "longer:parts=ball"
        written.fill("longer:parts=ball\nnonsense")
        until(lambda: chromium.get_by_text("found <nonsense>").count() > 0)
        assert middle_of(seen(chromium), GREEN)
        chromium.get_by_text("Reset", exact=True).click()
        until(lambda: middle_of(seen(chromium), RED) and not middle_of(seen(chromium), GREEN))
        assert written.input_value() == ""
