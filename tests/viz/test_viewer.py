"""The viewer's scenes, texts, player and port, without a browser."""

import threading
import time

import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.viz.colors import label_color
from gsjax.viz.viewer import Shots, Viewable, markup, moved
from gsjax.viz.viewer.page import over, unique
from gsjax.viz.viewer.pick import Picked
from gsjax.viz.viewer.player import Player, frame_pause
from gsjax.viz.viewer.server import free_port, is_loopback
from gsjax.viz.viewer.shot_nodes import shrunk
from tests.viz.scenes import cloud, made, moving_scene, shots_around

# what is shown


def test_frames_move_the_first_gaussians_only():
    scene = moving_scene()
    assert scene.num_frames == 4
    later = scene.at(3)
    np.testing.assert_allclose(later.means[:8], scene.gaussians.means[:8] + np.array([0.6, 0, 0]), atol=1e-6)
    np.testing.assert_array_equal(later.means[8:], scene.gaussians.means[8:])
    assert later.features is None


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"labels": np.zeros(3, int)}, r"labels: expected shape \(24,\), found \(3,\)"),
        ({"times": np.zeros(2)}, r"times: expected shape \(1,\), found \(2,\)"),
    ],
)
def test_bad_scenes_are_refused(change, says):
    with pytest.raises(ValueError, match=says):
        Viewable("x", cloud(), **change)


def test_bad_motions_are_refused():
    with pytest.raises(ValueError, match=r"\[T,M,3\], T at least 1 and M at most 24"):
        moved(cloud(), np.zeros((2, 25, 3)), np.zeros((2, 25, 4)))
    with pytest.raises(ValueError, match="quats: expected shape"):
        moved(cloud(), np.zeros((2, 5, 3)), np.zeros((2, 4, 4)))


def test_what_cannot_be_drawn_is_refused():
    broken = cloud()
    means = broken.means.at[0, 0].set(jnp.nan)
    with pytest.raises(ValueError, match="NaN"):
        Viewable("x", made(means, broken.quats, broken.scales, [0.5] * 24, means))
    with pytest.raises(ValueError, match="found none"):
        Viewable("x", cloud(0))
    with pytest.raises(ValueError, match="Ks: expected shape"):
        Shots(("a",), np.eye(4)[None, None], np.zeros((1, 2, 3, 3)), np.array([[4, 3]]))


# playing


def test_play_stop_play_at_once_is_one_player():
    """The first thread has not yet noticed that it should stop when the second starts."""
    waits, changes = [], []

    def pause():
        waits.append(threading.current_thread())
        return 0.3

    player = Player(lambda: None, pause, changes.append)
    for _ in range(3):
        player.toggle()
    assert changes == [True, False, True]
    until = time.monotonic() + 30
    while len(set(waits)) < 2 or sum(thread.is_alive() for thread in set(waits)) > 1:
        assert time.monotonic() < until, "two play"
        time.sleep(0.01)
    player.close()
    for thread in set(waits):
        thread.join(30)
        assert not thread.is_alive()
    player.toggle()
    assert changes == [True, False, True]


# texts


def test_a_pick_is_described_in_full():
    scene = Viewable("x", cloud(), np.full(24, 2), {2: "can|*top*"}, unit="m")
    table = markup.describe_pick(scene, Picked(7, 1.2345, np.zeros(3), 0.61, 0.9), 0)
    x, y, z = np.asarray(scene.gaussians.means)[7]
    assert f"| centre | {x:.3f}, {y:.3f}, {z:.3f} m |" in table
    assert "| Gaussian | 7 of 24 |" in table
    assert r"| label | can\|\*top\* (2) |" in table
    assert f"| opacity | {float(scene.gaussians.opacities[7]):.2f} |" in table
    assert "| distance | 1.23 m |" in table
    assert "| share of colour | 61 % |" in table
    assert "label" not in markup.describe_pick(Viewable("x", cloud()), Picked(7, 1, np.zeros(3), 1, 1), 0)
    assert "Nothing there" in markup.describe_pick(scene, None, 0)


def test_the_centre_of_a_pick_is_in_the_coordinates_of_the_data():
    scene = Viewable("x", cloud(), origin=np.array([500_000.0, 5_000_000.0, 300.0]))
    x, y, z = np.asarray(scene.gaussians.means, float)[7] + scene.origin
    table = markup.describe_pick(scene, Picked(7, 1, np.zeros(3), 1, 1), 0)
    assert f"| centre | {x:.3f}, {y:.3f}, {z:.3f} |" in table


def test_legends_name_what_colours_mean():
    scene = Viewable("x", cloud(), np.arange(24) % 3, {1: "<b>mug</b>"}, unit="m")
    html = markup.legend(scene, "label", None, [0, 1, 2])
    assert "&lt;b&gt;mug&lt;/b&gt;" in html
    assert "<b>" not in html
    assert "background" in html
    assert "object 2" in html
    assert "rgb({}, {}, {})".format(*label_color(1)) in html
    assert "and 6 more" in markup.legend(scene, "label", None, range(30))
    assert "bright: 0.5 m away, dark: 2.25 m" in markup.legend(scene, "depth", (0.5, 2.25))
    assert markup.legend(scene, "colour", (0.5, 2.25)) == ""


def test_the_heading_describes_the_scene():
    scene = moving_scene()
    assert "**24** Gaussians, SH degree 0, 4 frames." in markup.heading(scene, 24)
    assert "the 10 most opaque" in markup.heading(scene, 10)
    assert markup.frame_label(scene, 2) == "0.20 s of 0.30 s"
    assert "photographs" in markup.heading(Viewable("x", cloud(), shots=shots_around([0, 0, 1])), 24)


# the rest of the page


def test_names_that_repeat_are_numbered():
    assert unique(("a", "b")) == ("a", "b")
    assert unique(("a", "b", "a")) == ("0: a", "1: b", "2: a")


def test_playing_keeps_the_recordings_time_within_reason():
    assert frame_pause(np.arange(5) / 5) == pytest.approx(0.2)
    assert frame_pause(np.arange(5) / 1000) == pytest.approx(1 / 12)
    assert frame_pause(np.arange(5) * 60.0) == 1
    assert frame_pause(None) == pytest.approx(1 / 12)


def test_a_transparent_picture_lies_over_the_background():
    clear = np.zeros((2, 2, 4), np.uint8)
    clear[0, 0] = (10, 20, 30, 255)
    found = over(clear, (1.0, 0.0, 0.5))
    assert found[0, 0].tolist() == [10, 20, 30]
    assert found[1, 1].tolist() == [255, 0, 128]
    np.testing.assert_array_equal(over(clear[..., :3], (1.0, 1.0, 1.0)), clear[..., :3])


def test_thumbnails():
    assert shrunk(np.zeros((300, 400, 3), np.uint8), 100).shape == (75, 100, 3)
    assert shrunk(np.zeros((30, 40, 3), np.uint8), 100).shape == (30, 40, 3)


# where it listens


def test_loopback():
    assert all(map(is_loopback, ("127.0.0.1", "::1", "localhost", "127.9.9.9")))
    assert not any(map(is_loopback, ("0.0.0.0", "192.168.1.5", "::", "example.org")))


def test_a_port_in_use_is_reported_and_the_next_one_taken(monkeypatch):
    import socket

    with socket.socket() as busy:
        busy.bind(("127.0.0.1", 0))
        busy.listen()
        port = busy.getsockname()[1]
        with pytest.raises(OSError, match=f"port {port}: cannot listen there on 127.0.0.1"):
            free_port("127.0.0.1", port)
        monkeypatch.setattr("gsjax.viz.viewer.server.PORT", port)
        assert port < free_port("127.0.0.1", None) < port + 50
    assert free_port("127.0.0.1", 0) > 0
    with pytest.raises(ValueError, match="port: expected"):
        free_port("127.0.0.1", 70_000)
    with pytest.raises(OSError, match="expected an address of this machine"):
        free_port("no-such-host.invalid", None)
