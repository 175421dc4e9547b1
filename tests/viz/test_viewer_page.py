"""The page itself on viser's server: with a stand-in for a browser that reports only its camera, and, if
there is one, with a headless Chromium."""

import io
import shutil
import time
from contextlib import contextmanager

import numpy as np
import pytest

from gsjax.scene.gaussians import gaussians_from_activated
from gsjax.viz.colors import label_color
from gsjax.viz.viewer import Shots, Viewable, moved, open_viewer
from gsjax.viz.viewer.cameras import first_pose
from gsjax.viz.viewer.page import Page

viser = pytest.importorskip("viser", reason="viser is not installed")
RED, GREEN = (0.9, 0.1, 0.1), (0.1, 0.8, 0.2)


def look(eye, target, up):
    """World to camera, OpenCV axes."""
    forward = np.array(target, float) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    view = np.eye(4)
    view[:3, :3] = [right, np.cross(forward, right), forward]
    view[:3, 3] = -view[:3, :3] @ eye
    return view


@pytest.fixture(scope="module")
def scene() -> Viewable:
    """A red ball on the left and a green one on the right, 4 metres away; over four frames the red one rises
    by 1.2 metres. Two photographs: from the front and from the left."""
    rng = np.random.default_rng(0)
    shell = rng.normal(size=(150, 3))
    shell *= 0.35 / np.linalg.norm(shell, axis=1, keepdims=True)
    means = np.concatenate([shell + [-0.8, 0, 0], shell + [0.8, 0, 0]])  # noqa: RUF005
    gaussians = gaussians_from_activated(
        means,
        np.tile([1.0, 0, 0, 0], (300, 1)),
        np.full((300, 3), 0.08),
        np.full(300, 0.95),
        np.repeat([RED, GREEN], 150, axis=0),
        features=rng.normal(size=(300, 4)),
    )
    rise = np.linspace(0, 1.2, 4)[:, None, None] * [0, 0, 1.0]
    viewmats = np.stack(
        [look(np.array(eye, float), (0, 0, 0), (0, 0, 1)) for eye in ((0, -4, 0), (-4, 0, 0))]
    )
    K = np.array([[300.0, 0, 150], [0, 300, 100], [0, 0, 1]])
    pictures = {0: np.full((200, 300, 3), 7, np.uint8)}

    def photograph(t: int, v: int) -> np.ndarray:
        if v not in pictures:
            raise OSError(f"{v}.jpg: not there")
        return pictures[v]

    return Viewable(
        "two balls",
        gaussians,
        np.repeat([1, 2], 150),
        {1: "red ball", 2: "green ball"},
        motion=moved(
            gaussians,
            (means[None, :150] + rise).astype(np.float32),
            np.tile(np.array([1.0, 0, 0, 0], np.float32), (4, 150, 1)),
        ),
        times=np.arange(4) / 10,
        shots=Shots(
            ("front", "left"),
            viewmats[None],
            np.tile(K, (1, 2, 1, 1)),
            np.tile([300, 200], (2, 1)),
            photograph,
        ),
        unit="m",
    )


class Saved:
    """Keeps screenshots in memory; passed as `save` to `open_viewer`."""

    def __init__(self):
        self.pictures = []

    def __call__(self, kind, picture):
        from pathlib import Path

        self.pictures.append((kind, picture))
        return Path(f"{kind}.png")


@contextmanager
def browser(viewer, scene):
    """A stand-in for a browser; yields its page on the server, once that has a picture, and its socket."""
    from websockets.sync.client import connect

    pose = first_pose(scene)
    where = viewer.url.replace("http", "ws")
    protocol = f"viser-v{viser.__version__}"
    with connect(where, subprotocols=[protocol], max_size=None) as socket:
        socket.send(camera_message(pose.position, pose.fov))
        until(lambda: viewer._pages)
        page = next(iter(viewer._pages.values()))
        until(lambda: page._picture is not None)
        yield page, socket


def camera_message(position, fov, wxyz=(0.5**0.5, -(0.5**0.5), 0, 0)):
    """A browser's message about its camera (default: looking along +y) in a window of 600x400."""
    where = {"wxyz": wxyz, "position": tuple(map(float, position)), "look_at": (0.0, 0.0, 0.0)}
    lens = {"fov": fov, "near": 0.01, "far": 1000.0, "image_height": 400, "image_width": 600}
    return message("ViewerCameraMessage", up_direction=(0.0, 0.0, 1.0), **where, **lens)


def message(kind, **fields) -> bytes:
    """One of viser's messages, as browsers send it."""
    import msgspec

    return msgspec.msgpack.encode({"type": kind, **fields})


def until(true, seconds=120.0):
    """Wait for something that another thread does."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "timed out waiting for a condition"
        time.sleep(0.02)


def drawn_after(page, change):
    """The next picture of the page after a change."""
    before = page._picture
    change()
    until(lambda: page._picture is not before)
    return page._picture


def color_share(picture, color):
    """Share of pixels close to a colour, in each half: left and right, above and below the middle."""
    near = np.abs(picture.astype(int) - np.array(color) * 255).max(-1) < 60
    h, w = near.shape[0] // 2, near.shape[1] // 2
    parts = {"left": near[:, :w], "right": near[:, w:], "above": near[:h], "below": near[h:]}
    return {name: part.mean() for name, part in parts.items()}


@pytest.mark.thorough
def test_a_page_from_the_first_picture_to_the_last_screenshot(scene):
    saved = Saved()
    with open_viewer(scene, port=0, save=saved) as viewer, browser(viewer, scene) as (page, socket):
        assert viewer.url == f"http://127.0.0.1:{viewer.port}"
        # From where the front photograph was taken: red on the left, green on the right.
        assert page._picture.shape == (216, 320, 3)
        red, green = color_share(page._picture, RED), color_share(page._picture, GREEN)
        assert red["left"] > 0.03 > red["right"]
        assert green["right"] > 0.03 > green["left"]
        assert "320 x 216 pixels, all 300 Gaussians" in page._status.content
        # Later the red one is above.
        picture = drawn_after(page, lambda: setattr(page._slider, "value", 3))
        red = color_share(picture, RED)
        assert red["above"] > 0.03 > red["below"]
        assert page._moment.content == "0.30 s of 0.30 s"
        nodes = page._splats._nodes
        assert set(nodes) == {"moving", "still"}
        until(lambda: nodes["moving"].centers[:, 2].mean() * page._splats._scale > 1.1)
        # Seen from the left, the red ball is still above.
        turned = (0.5, -0.5, 0.5, -0.5)
        picture = drawn_after(page, lambda: socket.send(camera_message((-4, 0, 0), 0.64, turned)))
        assert color_share(picture, RED)["above"] > 0.02
        # Other channels are shown, in another size.
        picture = drawn_after(page, lambda: setattr(page._shown, "value", "alpha"))
        assert (picture[..., 0] == picture[..., 1]).all()
        picture = drawn_after(page, lambda: setattr(page._shown, "value", "label"))
        assert color_share(picture, np.array(label_color(1)) / 255)["above"] > 0.02
        picture = drawn_after(page, lambda: setattr(page._width, "value", "160"))
        assert picture.shape == (104, 160, 3)
        picture = drawn_after(page, lambda: setattr(page._shown, "value", "depth"))
        assert "bright: " in page._status.content
        # Splats have other colourings, too.
        assert page._coloring.options == ("colour", "depth", "label", "features")
        for coloring, says in (("label", "green ball"), ("depth", "away"), ("features", "principal")):
            page._coloring.value = coloring
            until(lambda says=says: says in page._legend.content)
        assert nodes["still"].rgbs.std() > 10
        # What is clicked is described and marked.
        ray = {"ray_origin": (0.8, -4.0, 0.0), "ray_direction": (0.0, 1.0, 0.0), "screen_pos": ((0.6, 0.5),)}
        socket.send(message("ScenePointerMessage", event_type="click", modifier=None, **ray))
        until(lambda: "green ball" in page._picked_info.content)
        assert page._client.scene.get_handle_by_name("/picked/shape") is not None
        page._slider.value = 0
        until(lambda: page._client.scene.get_handle_by_name("/picked/shape") is None)
        # Playback starts and stops.
        page._player.toggle()
        assert page._play.label == "Stop"
        until(lambda: page._frame == 3)
        until(lambda: page._frame == 0)
        page._player.toggle()
        until(lambda: page._play.label == "Play")
        # Photographs: their frustums, and moving the camera there.
        page._shots.show(True, 0)
        frustum = page._client.scene.get_handle_by_name("/photographs/1")
        np.testing.assert_allclose(frustum.position, (-4, 0, 0), atol=1e-9)
        until(lambda: page._shots._nodes[0].image is not None)
        page._visited.value = "front"
        until(lambda: page._photograph.visible)
        assert page._photograph.label == "photograph front"
        np.testing.assert_allclose(page._client.camera.position, (0, -4, 0), atol=1e-6)
        np.testing.assert_allclose(page._client.camera.fov, 2 * np.arctan(1 / 3), atol=1e-6)
        # The page stays usable after an unreadable photograph.
        page._visited.value = "left"
        until(lambda: not page._photograph.visible)
        np.testing.assert_allclose(page._client.camera.position, (-4, 0, 0), atol=1e-6)
        # A click on the frustum that was visited last leads back there.
        page._go(page._start)
        page._shots._go(1)
        until(lambda: np.allclose(page._client.camera.position, (-4, 0, 0), atol=1e-6))
        # What is shown can be saved.
        page._save_screenshot("render", page._picture)
        assert saved.pictures[0][0] == "render"
        assert saved.pictures[0][1].shape == (104, 160, 3)


@pytest.mark.thorough
def test_a_page_can_be_used_while_it_is_built(scene, monkeypatch):
    built = Page._build_shots

    def touched(page, nodes):
        """The slider and the colorings exist; the render does not yet."""
        built(page, nodes)
        page._slider.value = 2
        page._coloring.value = "label"
        time.sleep(0.5)

    monkeypatch.setattr(Page, "_build_shots", touched)
    with open_viewer(scene, port=0) as viewer, browser(viewer, scene) as (page, _):
        until(lambda: page._now.frame == 2 and "300 Gaussians" in page._status.content)
        drawn_after(page, lambda: setattr(page._shown, "value", "alpha"))
        until(lambda: "green ball" in page._legend.content)


@pytest.mark.thorough
def test_a_page_of_a_plain_scene_offers_no_more_than_it_has(scene):
    plain = Viewable("plain", scene.at(0), up=np.array([0.0, 0, 1]))
    with open_viewer(plain, port=0, max_gaussians=100) as viewer, browser(viewer, plain) as (page, _):
        assert page._coloring.options == ("colour", "depth")
        assert page._shown.options == ("colour", "depth", "alpha")
        assert page._shots is None
        assert not hasattr(page, "_slider")
        assert len(page._splats._nodes["still"].centers) == 100
        assert "all 300 Gaussians" in page._status.content


def test_two_browsers_have_pages_of_their_own_and_leave_nothing(scene):
    with open_viewer(scene, port=0) as viewer:
        with browser(viewer, scene), browser(viewer, scene):
            until(lambda: len(viewer._pages) == 2)
        until(lambda: not viewer._pages)


def test_what_cannot_be_drawn_is_reported_on_the_page(scene, monkeypatch):
    def fail(*_):
        raise ValueError("these Gaussians touch too many tiles")

    with open_viewer(scene, port=0) as viewer, browser(viewer, scene) as (page, _):
        monkeypatch.setattr("gsjax.viz.viewer.drawing.Drawer.__call__", fail)
        page._width.value = "240"
        until(lambda: "cannot be drawn: these Gaussians touch too many tiles" in page._status.content)


def test_nobody_opens_a_tunnel_to_the_internet(scene):
    with open_viewer(scene, port=0) as viewer:
        assert viewer._server.request_share_url() is None
        assert viewer._server._share_tunnel is None


def test_bad_arguments(scene):
    with pytest.raises(ValueError, match="max_gaussians: expected 1 or more, found 0"):
        open_viewer(scene, max_gaussians=0)


# In a browser.

FLAGS = """--no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking
--disable-component-update --disable-sync --use-gl=angle --use-angle=swiftshader
--enable-unsafe-swiftshader"""
WINDOW = {"width": 1100, "height": 560}


@pytest.fixture
def chromium(tmp_path):
    """Opens a page in a new headless Chromium."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if path is None:
        pytest.skip("no chromium on the PATH")
    with playwright.sync_playwright() as driver:
        context = driver.chromium.launch_persistent_context(
            tmp_path / "profile", executable_path=path, args=FLAGS.split(), headless=True, viewport=WINDOW
        )
        yield context.new_page()
        context.close()


def seen(page) -> np.ndarray:
    """The scene in the middle of the window, between the panels."""
    import cv2

    data = np.frombuffer(io.BytesIO(page.screenshot()).read(), np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1]
    return picture[:, 360 : WINDOW["width"] - 340]


def middle_of(picture, color):
    """Mean row and column of the pixels close to a colour; None if there are few."""
    rows, columns = np.nonzero(np.abs(picture.astype(int) - np.array(color) * 255).max(-1) < 60)
    return None if len(rows) < 150 else (rows.mean(), columns.mean())


@pytest.mark.slow
def test_in_a_browser(scene, chromium):
    with open_viewer(scene, port=0, save=Saved()) as viewer:
        chromium.goto(viewer.url)
        until(lambda: middle_of(seen(chromium), RED) and middle_of(seen(chromium), GREEN))
        assert chromium.get_by_text("two balls").first.is_visible()
        page = next(iter(viewer._pages.values()))
        until(lambda: page._picture is not None)
        chromium.wait_for_timeout(3000)  # splats fade in
        red, green = middle_of(seen(chromium), RED), middle_of(seen(chromium), GREEN)
        assert red[1] < green[1]
        assert abs(red[0] - green[0]) < 15
        # Our render shows the same in the same places, in its own size.
        picture = page._picture
        shown = seen(chromium)
        for color, (row, column) in ((RED, red), (GREEN, green)):
            ours = middle_of(np.repeat(np.repeat(picture, 2, 0), 2, 1), color)
            assert ours[0] / 2 / picture.shape[0] == pytest.approx(row / shown.shape[0], abs=0.04)
            assert ours[1] / 2 / picture.shape[1] == pytest.approx(column / shown.shape[1], abs=0.06)
        # The slider moves the red ball up, and not the other.
        chromium.locator(".mantine-NumberInput-input:visible").first.fill("3")
        chromium.keyboard.press("Enter")
        until(lambda: page._frame == 3)
        until(lambda: (found := middle_of(seen(chromium), RED)) is not None and found[0] < red[0] - 40)
        later = middle_of(seen(chromium), GREEN)
        assert np.abs(np.subtract(later, green)).max() < 8
        # A click on the green ball names it.
        chromium.mouse.click(360 + green[1], green[0])
        until(lambda: chromium.get_by_text("green ball (2)").count() > 0)
        # The browser's own picture can be saved.
        chromium.get_by_text("Save the view").click()
        until(lambda: page._shared.save.pictures)
        kind, kept = page._shared.save.pictures[0]
        assert kind == "view"
        assert middle_of(kept, GREEN) is not None
