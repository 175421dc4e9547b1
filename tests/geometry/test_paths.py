"""Camera paths look at the focus of the given cameras, at their height and distance."""

import numpy as np
import pytest

from gsjax.geometry.cameras import look_at
from gsjax.geometry.paths import orbit

FOCUS = np.array([0.3, -0.2, 0.5])


def ring(angles, radius=2.0, height=0.7, up=(0.0, 0.0, 1.0)):
    eyes = FOCUS + np.stack(
        [radius * np.cos(angles), radius * np.sin(angles), np.full(len(angles), height)], -1
    )
    return np.stack([look_at(eye, FOCUS, np.array(up)) for eye in eyes])


def centers(viewmats):
    return -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])


def test_all_around_where_cameras_stand_all_around():
    path = orbit(ring(np.linspace(0, 2 * np.pi, 12, endpoint=False)), FOCUS, 40)
    away = centers(path) - FOCUS
    np.testing.assert_allclose(np.linalg.norm(away[:, :2], axis=1), 2.0, rtol=1e-6)
    np.testing.assert_allclose(away[:, 2], 0.7, rtol=1e-6)
    steps = np.diff(np.unwrap(np.arctan2(away[:, 1], away[:, 0])))
    np.testing.assert_allclose(np.abs(steps), 2 * np.pi / 40, rtol=1e-6)


@pytest.mark.parametrize("middle", [0.0, 3.0])  # an arc across the seam of arctan2 is an arc
def test_to_and_fro_within_an_arc(middle):
    arc = middle + np.linspace(-0.5, 0.5, 9)
    away = centers(orbit(ring(arc), FOCUS, 60)) - FOCUS
    angles = np.angle(np.exp(1j * (np.arctan2(away[:, 1], away[:, 0]) - middle)))
    assert np.abs(angles).max() == pytest.approx(0.4, abs=0.02)
    assert angles.min() == pytest.approx(-angles.max(), abs=0.02)


@pytest.mark.parametrize("count", [1, 2, 12])
def test_every_view_looks_at_the_focus_and_stands_upright(count):
    path = orbit(ring(np.linspace(0, 2 * np.pi, count, endpoint=False)), FOCUS, 7)
    assert np.isfinite(path).all()
    local = path[:, :3, :3] @ FOCUS + path[:, :3, 3]
    np.testing.assert_allclose(local[:, :2], 0.0, atol=1e-9)
    assert (local[:, 2] > 0).all()
    assert (-path[:, 1, 2] > 0.5).all()  # the world's up is up in the image


def test_cameras_that_all_stand_at_one_place_give_a_path_too():
    one = ring(np.array([0.4]))
    path = orbit(np.concatenate([one] * 5), FOCUS, 8)
    assert np.isfinite(path).all()
    assert np.linalg.norm(np.diff(centers(path), axis=0), axis=1).max() > 0.05
