"""Fisheye photographs, kept as they were taken or undistorted."""

import json

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.data import DataError, DataWarning, ReadOptions, open_photographs
from gsjax.data.ordered import sequence_of
from gsjax.geometry.sight import pixels_at, rays
from gsjax.methods.fit.config import StartConfig
from gsjax.methods.fit.start import start_points
from gsjax.rasterize.plan import Plan
from gsjax.rasterize.rasterization import rasterization

WIDTH, HEIGHT = 48, 36
K = np.array([[16.0, 0.0, 25.0], [0.0, 15.0, 17.0], [0.0, 0.0, 1.0]])
COEFFS = np.array([0.05, -0.01, 0.002, 0.0])
KEPT = ReadOptions(fisheye="keep")


@pytest.fixture
def folder(tmp_path):
    """Writes two photographs, with depth and masks, from a fisheye that sees 90 degrees off axis and more."""

    def write(**changes):
        frames = []
        for i in range(2):
            cv2.imwrite(str(tmp_path / f"{i}.png"), picture(i))
            cv2.imwrite(str(tmp_path / f"depth{i}.png"), np.full((HEIGHT, WIDTH), 2000, np.uint16))
            cv2.imwrite(
                str(tmp_path / f"mask{i}.png"), np.uint8(np.arange(WIDTH) >= 3) * np.ones((HEIGHT, 1))
            )
            pose = np.eye(4)
            pose[0, 3] = i
            named = {"file_path": f"{i}.png", "depth_file_path": f"depth{i}.png", "mask_path": f"mask{i}.png"}
            frames.append(named | {"transform_matrix": pose.tolist()} | (changes if i else {}))
        lens = dict(zip(("k1", "k2", "k3", "k4"), COEFFS.tolist(), strict=True))
        camera = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": WIDTH, "h": HEIGHT}
        described = {"camera_model": "OPENCV_FISHEYE", **camera, **lens, "frames": frames}
        (tmp_path / "transforms.json").write_text(json.dumps(described))
        return tmp_path

    return write


def picture(i):
    return np.random.default_rng(i).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def test_kept_photographs_are_those_of_the_files_and_have_their_lens(folder):
    photographs = open_photographs(folder(), KEPT)
    np.testing.assert_array_equal(photographs.image(1), picture(1)[..., ::-1])
    np.testing.assert_array_equal(photographs.mask(0), np.arange(WIDTH) >= 3 * np.ones((HEIGHT, 1)))
    camera = photographs.select([1]).camera(0)
    np.testing.assert_allclose(camera.fisheye, COEFFS, rtol=1e-6)
    np.testing.assert_allclose(camera.K, K)
    np.testing.assert_allclose(photographs.scaled(0.5).frame(0).cameras.fisheye, COEFFS[None])


def test_depth_along_the_axis_becomes_distance(folder):
    photographs = open_photographs(folder(), KEPT)
    distances = photographs.depth(0)
    looks = rays(np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), -1), K, COEFFS)
    ahead = looks[..., 2] > 0.01
    assert not ahead.all()
    np.testing.assert_allclose((distances * looks[..., 2])[ahead], 2.0, rtol=1e-5)
    assert not distances[looks[..., 2] <= 0].any()


@pytest.mark.thorough
def test_points_appear_where_they_were_seen_and_where_the_rasterizer_draws_them(folder):
    """Points from depth project back to their pixels, on the host and in the rasterizer."""
    photographs = open_photographs(folder(), KEPT)
    points, colors, source = start_points([photographs.frame(0)], None, StartConfig(count=60), 0)
    assert source == "depth"
    camera = photographs.camera(0)
    local = np.float64(points) @ photographs.viewmats[0, :3, :3].T
    pixels, distances = pixels_at(local, K, COEFFS)
    np.testing.assert_allclose(pixels % 1, 0.5, atol=1e-3)
    column, row = pixels.astype(int).T
    np.testing.assert_allclose(colors, photographs.image(0)[row, column] / 255, atol=1e-6)
    scene = (points, np.tile([1.0, 0, 0, 0], (60, 1)), np.full((60, 3), 0.02), np.full(60, 0.9), colors)
    views = (camera.viewmat[None], camera.K[None], WIDTH, HEIGHT)
    drawn = rasterization(
        *(jnp.asarray(a, jnp.float32) for a in scene),
        *views,
        fisheye=camera.fisheye[None],
        plan=Plan(WIDTH, HEIGHT, 8192),
    )
    np.testing.assert_allclose(drawn[2].means2d[0], pixels, atol=2e-3)
    np.testing.assert_allclose(drawn[2].depths[0], distances, rtol=1e-5)


def test_a_recording_of_kept_fisheyes_is_refused(folder):
    """Its cameras would otherwise be taken for pinhole cameras."""
    with pytest.raises(DataError, match=r"expected photographs of pinholes.*Leave out --read.fisheye"):
        sequence_of(open_photographs(folder(), KEPT))


def test_undistorting_says_how_much_it_loses(folder):
    with pytest.warns(DataWarning, match=r"undistorting keeps \d\d% of a photograph .*--read.fisheye keep"):
        photographs = open_photographs(folder())
    assert photographs.fisheye is None


def test_pixels_beyond_the_lens_do_not_count(folder):
    """A lens whose projection folds back within the photograph shows nothing beyond that radius."""
    photographs = open_photographs(folder(k1=-0.2), KEPT)
    mask = photographs.mask(1)
    assert not mask[0, -1]
    assert mask[17, 25]


def test_photographs_by_other_lenses_beside_fisheyes_cannot_be_kept(folder):
    path = folder(camera_model="OPENCV", k3=0, k4=0)
    with pytest.raises(DataError, match=r"all by fisheyes, found 1 of 2 by other lenses. Leave out fisheye"):
        open_photographs(path, KEPT)


@pytest.mark.parametrize("lens", [None, COEFFS])
def test_rays_and_pixels_are_inverse(lens):
    pixels = np.random.default_rng(0).uniform([0, 0], [WIDTH, HEIGHT], (50, 2))
    looks = rays(pixels, K, lens)
    again, depths = pixels_at(3 * looks, K, lens)
    np.testing.assert_allclose(again, pixels, atol=1e-3)
    np.testing.assert_allclose(depths, 3.0)
