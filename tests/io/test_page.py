"""The HTML page of a scene: what it holds, and that a browser shows what the rasterizer renders. Tests in a
browser are skipped without Chromium (`apt install chromium`)."""

import base64
import html
import json
import os
import re
import shutil
import subprocess
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import gsjax.io.page
from gsjax.geometry.cameras import Camera, intrinsics
from gsjax.io.page import Film
from gsjax.io.scene_file import columns_of
from gsjax.io.scenes import read_gaussians, write_gaussians
from gsjax.metrics.image import psnr
from gsjax.scene.render import plan_render, render
from tests.io.scenes_to_write import flat, make_scene

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
OPTIONS = ("--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
WIDTH, HEIGHT = 640, 480
CAPTION = 100  # pixels from the bottom


def test_it_holds_the_scene_and_asks_no_network(tmp_path):
    up = (0.0, 0.0, 1.0)
    said = write_gaussians(tmp_path / "a <b> & $c.html", make_scene(5, 1), up=up, background=(1, 1, 1))
    assert said == ("view-dependent colour",)
    text = (tmp_path / "a <b> & $c.html").read_text()
    assert f"<title>{html.escape('a <b> & $c')}</title>" in text
    about = json.loads(re.search(r"const about = (\{.*\});", text)[1])
    assert (about["title"], about["up"], about["background"]) == ("a <b> & $c", [0, 0, 1], [1, 1, 1])
    assert "<b>" not in text
    assert "default-src 'none'" in text
    assert not [word for word in ("http:", "https:", "import(", "fetch(", "XMLHttp") if word in text]
    held = base64.b64decode(re.search(r'type="text/plain">([^<]*)<', text)[1])
    write_gaussians(tmp_path / "scene.splat", make_scene(5, 1))
    assert held == (tmp_path / "scene.splat").read_bytes()


def test_more_than_a_browser_holds_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("gsjax.io.page._MOST_GAUSSIANS", 10)
    write_gaussians(tmp_path / "ten.html", make_scene(10))
    with pytest.raises(ValueError, match=r"more\.html: expected at most 10 Gaussians, .* found 11; write"):
        write_gaussians(tmp_path / "more.html", make_scene(11))
    film = film_of(make_scene(30), scales=False)._replace(at=lambda frame: pytest.fail("wasted work"))
    with pytest.raises(ValueError, match=r"found 30; write"):
        write_gaussians(tmp_path / "more.html", make_scene(30), film=film)
    assert not (tmp_path / "more.html").exists()


def camera_at(yaw, pitch, distance, center) -> Camera:
    """The camera of `page.html#yaw,pitch,distance,center`, with y down."""
    forward = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    right = np.array([np.cos(yaw), 0, -np.sin(yaw)])
    rotation = np.stack([right, np.cross(forward, right), forward])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ (center - distance * forward)
    K = intrinsics(1.2 * HEIGHT, WIDTH, HEIGHT)
    return Camera(jnp.asarray(viewmat, jnp.float32)[None], jnp.asarray(K, jnp.float32)[None], WIDTH, HEIGHT)


def film_of(scene, *, scales: bool) -> Film:
    """Three frames in which all but the last 20 Gaussians move, rotate and fade, and grow if `scales`."""

    def at(frame):
        some = (jnp.arange(scene.num) < scene.num - 20)[:, None] * frame * 1.0
        changed = (
            scene.means + some * jnp.array([0.2, -0.1, 0.3]),
            scene.quats + some * jnp.array([0.0, 0.1, -0.2, 0.3]),
            scene.log_scales + 0.2 * some * scales,
            scene.logit_opacities - 0.2 * some[:, 0],
        )
        return eqx.tree_at(lambda g: (g.means, g.quats, g.log_scales, g.logit_opacities), scene, changed)

    return Film(at, np.array([5.0, 5.5, 1005.0]), scene.num - 10)


def motion_in(page):
    """A page's description of its motion, and the quantised motion, [T,M,values]."""
    text = page.read_text()
    motion = json.loads(re.search(r"const about = (\{.*\});", text)[1])["motion"]
    packed = zlib.decompress(base64.b64decode(re.search(r'id="motion" type="text/plain">([^<]*)<', text)[1]))
    frames, moving = len(motion["times"]), motion["moving"]
    planes = np.frombuffer(packed, np.uint8).reshape(frames, -1, 2, moving).astype(np.int64)
    zigzag = planes[:, :, 0] + 256 * planes[:, :, 1]
    steps = np.cumsum(np.where(zigzag % 2, -(zigzag + 1) // 2, zigzag // 2), axis=0) % 65536
    return motion, steps.transpose(0, 2, 1)


def places_of(motion, steps):
    logs = motion["low"] + motion["span"] * (steps[:, :3] / 65535)
    return motion["middle"] + motion["unit"] * np.sign(logs) * np.expm1(np.abs(logs))


@pytest.mark.parametrize("scales", [False, True])
def test_it_holds_what_moves_to_16_bits(tmp_path, scales):
    scene = flat(make_scene(50))
    film = film_of(scene, scales=scales)
    assert write_gaussians(tmp_path / "scene.html", scene, film=film) == ()
    motion, steps = motion_in(tmp_path / "scene.html")
    assert (motion["times"], motion["moving"], motion["texels"]) == ([0, 0.5, 1000], 30, 2 + scales)
    for frame in range(3):
        wanted, found = columns_of(film.at(frame)), steps[frame] / 65535
        np.testing.assert_allclose(places_of(motion, steps[frame]), wanted.means[:30], atol=2e-4)
        np.testing.assert_allclose(found[:, 3], wanted.opacities[:30], atol=1e-5)
        np.testing.assert_allclose(2 * found[:, 4:8] - 1, wanted.quats[:30], atol=2e-5)
        if scales:
            sizes = motion["sizes"][0] + motion["sizes"][1] * found[:, 8:11]
            np.testing.assert_allclose(sizes, wanted.log_scales[:30], atol=2e-4)


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_one_gaussian_far_away_does_not_coarsen_the_others(tmp_path, size):
    """Quantisation of positions is fine relative to Gaussians of 0.7 % of the scene, whatever its unit."""
    scene = flat(make_scene(50))
    scene = eqx.tree_at(lambda g: g.means, scene, size * scene.means.at[0].set(jnp.array([2000.0, 0, 0])))
    shift = size * jnp.array([0.01, 0, 0])
    film = Film(
        lambda t: eqx.tree_at(lambda g: g.means, scene, scene.means + t * shift), np.arange(3.0), scene.num
    )
    write_gaussians(tmp_path / "scene.html", scene, film=film)
    motion, steps = motion_in(tmp_path / "scene.html")
    for frame in range(3):
        wanted = np.asarray(film.at(frame).means)
        found = places_of(motion, steps[frame])
        np.testing.assert_allclose(found[1:], wanted[1:], rtol=0, atol=7e-4 * size)
        np.testing.assert_allclose(found[0], wanted[0], rtol=3e-4, atol=7e-4 * size)


def test_one_gaussian_that_moves(tmp_path):
    scene = flat(make_scene(5))
    film = Film(
        lambda t: eqx.tree_at(lambda g: g.means, scene, scene.means.at[0, 0].add(t)), np.arange(3.0), 1
    )
    write_gaussians(tmp_path / "scene.html", scene, film=film)
    motion, steps = motion_in(tmp_path / "scene.html")
    for frame in range(3):
        np.testing.assert_allclose(places_of(motion, steps[frame]), film.at(frame).means[:1], atol=1e-4)


def test_a_name_that_is_not_utf_8_is_shown_as_far_as_it_is(tmp_path):
    path = tmp_path / os.fsdecode(b"donn\xe9es.html")
    write_gaussians(path, make_scene(2))
    assert "<title>donn?es</title>" in path.read_text(encoding="utf-8")


def test_what_cannot_be_played_is_refused(tmp_path, monkeypatch):
    scene = make_scene(50)
    film = film_of(scene, scales=False)
    lost = film._replace(at=lambda frame: eqx.tree_at(lambda g: g.means, scene, scene.means / (1 - frame)))
    with pytest.raises(ValueError, match="film: expected finite places, rotations and scales in each frame"):
        write_gaussians(tmp_path / "scene.html", scene, film=lost)
    monkeypatch.setattr("gsjax.io.page._MOST_BYTES", 1)
    with pytest.raises(
        ValueError, match=r"film: .* found more in the first \d of 3 frames; take fewer frames"
    ):
        write_gaussians(tmp_path / "scene.html", scene, film=film)
    bad = eqx.tree_at(lambda g: g.means, scene, scene.means.at[0].set(jnp.nan))
    with pytest.raises(
        ValueError, match="film: expected Gaussians that can all be drawn, found 1 that cannot"
    ):
        write_gaussians(tmp_path / "scene.html", bad, film=film)
    with pytest.raises(ValueError, match=r"film: expected a format that has it \(.html\), found"):
        write_gaussians(tmp_path / "scene.spz", scene, film=film)
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(shutil.which("node") is None, reason="there is no Node.js")
def test_one_gaussian_far_away_leaves_the_others_in_order():
    page = (Path(gsjax.io.page.__file__).parent / "page.html").read_text()
    sorter = re.search(r"function sorter\(\) \{.*?\n\}\n", page, re.DOTALL)[0]
    depths = np.random.default_rng(0).uniform(-1, 1, 300)
    depths[:3] = 1e5, -3.5, -2.95  # far away, behind the eye, and nearer than the near plane
    points = np.stack([0 * depths, 0 * depths, depths], 1)
    data = "{ forward: [0, 0, 1], eye: -3, near: 0.1, turn: 0 }"
    script = f"""{sorter} sorter();
        globalThis.postMessage = ({{ order, drawn }}) => console.log(JSON.stringify([[...order], drawn]));
        onmessage({{ data: {{ points: new Float32Array({points.ravel().tolist()}) }} }});
        onmessage({{ data: {data} }});"""
    told = subprocess.run(["node", "-e", script], capture_output=True, text=True, timeout=60, check=True)
    order, drawn = json.loads(told.stdout)
    assert drawn == 298
    assert {*order[drawn:]} == {1, 2}
    assert (np.diff(depths[order[:drawn]]) < 1e-3).all()


def browse(*arguments) -> str:
    """The output of Chromium."""
    command = [BROWSER, *OPTIONS, f"--window-size={WIDTH},{HEIGHT}", "--hide-scrollbars", *arguments]
    return subprocess.run(command, capture_output=True, timeout=120, text=True).stdout


@pytest.mark.skipif(BROWSER is None, reason="there is no Chromium")
def test_a_browser_plays_it(tmp_path):
    """It starts by itself and keeps the times of the frames: the second is shown from 0.5 s on."""
    scene = flat(make_scene(50))
    write_gaussians(tmp_path / "scene.html", scene, film=film_of(scene, scales=False))
    page = browse("--virtual-time-budget=4000", "--dump-dom", (tmp_path / "scene.html").as_uri())
    assert ">0.50 s of 1000.00 s</output>" in page


@pytest.mark.thorough
@pytest.mark.skipif(BROWSER is None, reason="there is no Chromium")
@pytest.mark.parametrize(
    ("antialiased", "frame", "near"),
    [(False, None, None), (True, None, None), (False, 2, None), (False, None, 14.0)],
)
def test_a_browser_shows_what_the_rasterizer_does(tmp_path, antialiased, frame, near):
    scene = flat(make_scene(200))
    scene = eqx.tree_at(lambda g: g.means, scene, scene.means.at[0].set(jnp.array([0, 0, 2000.0])))
    page, picture = tmp_path / "scene.html", tmp_path / "page.png"
    film = None if frame is None else film_of(scene, scales=True)
    write_gaussians(page, scene, antialiased=antialiased, near=near, film=film)
    write_gaussians(tmp_path / "scene.splat", scene if film is None else film.at(frame))
    view = (0.4, 0.3, 14.0, (1.0, 1.0, 1.0))
    address = f"{page.as_uri()}#{view[0]},{view[1]},{view[2]},1,1,1" + ("" if frame is None else f",{frame}")
    browse("--timeout=10000", f"--screenshot={picture}", address)
    shown = cv2.imread(str(picture))[..., ::-1] / 255
    held, camera = read_gaussians(tmp_path / "scene.splat")[0], camera_at(*view[:3], np.array(view[3]))
    camera = camera if near is None else replace(camera, near=near)
    plan = plan_render(held, camera, rasterize_mode="antialiased" if antialiased else "classic")
    wanted = np.clip(np.asarray(render(held, camera, plan).colors)[0], 0, 1)
    assert wanted.std() > 0.1
    assert psnr(shown[:-CAPTION], wanted[:-CAPTION]) > 40
