"""The page of a scene, opened from disk by a browser: it shows what the rasterizer does. Skipped without
Chromium (`apt install chromium`)."""

import base64
import html
import json
import re
import shutil
import subprocess

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.geometry.cameras import Camera, intrinsics
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


def camera_at(yaw, pitch, distance, center) -> Camera:
    """The camera of `page.html#yaw,pitch,distance,center`, with y down."""
    forward = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    right = np.array([np.cos(yaw), 0, -np.sin(yaw)])
    rotation = np.stack([right, np.cross(forward, right), forward])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ (center - distance * forward)
    K = intrinsics(1.2 * HEIGHT, WIDTH, HEIGHT)
    return Camera(jnp.asarray(viewmat, jnp.float32)[None], jnp.asarray(K, jnp.float32)[None], WIDTH, HEIGHT)


@pytest.mark.skipif(BROWSER is None, reason="there is no Chromium")
@pytest.mark.parametrize("antialiased", [False, True])
def test_a_browser_shows_what_the_rasterizer_does(tmp_path, antialiased):
    scene = flat(make_scene(200))
    page, picture = tmp_path / "scene.html", tmp_path / "page.png"
    write_gaussians(page, scene, antialiased=antialiased)
    write_gaussians(tmp_path / "scene.splat", scene)
    view = (0.4, 0.3, 14.0, (1.0, 1.0, 1.0))
    address = f"{page.as_uri()}#{view[0]},{view[1]},{view[2]},1,1,1"
    command = [BROWSER, *OPTIONS, f"--window-size={WIDTH},{HEIGHT}", "--timeout=10000", "--hide-scrollbars"]
    subprocess.run([*command, f"--screenshot={picture}", address], capture_output=True, timeout=120)
    shown = cv2.imread(str(picture))[..., ::-1] / 255
    held, camera = read_gaussians(tmp_path / "scene.splat")[0], camera_at(*view[:3], np.array(view[3]))
    plan = plan_render(held, camera, rasterize_mode="antialiased" if antialiased else "classic")
    wanted = np.clip(np.asarray(render(held, camera, plan).colors)[0], 0, 1)
    assert wanted.std() > 0.1
    assert psnr(shown[:-CAPTION], wanted[:-CAPTION]) > 40
