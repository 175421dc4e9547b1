"""Pictures of a textured corner of a room, drawn wall by wall, for tests of camera pose estimation."""

import cv2
import numpy as np

from gsjax.geometry.cameras import intrinsics, look_at
from tests.data import dots

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
K = intrinsics(FOCAL, WIDTH, HEIGHT)
_TEXELS = 256  # along each side of a wall, 2 m
_WALLS = (  # a corner and two edges: the floor, and the walls at y = 1 and x = 1
    ((-1, -1, 0), (1, 0, 0), (0, 1, 0)),
    ((-1, 1, 0), (1, 0, 0), (0, 0, 1)),
    ((1, -1, 0), (0, 1, 0), (0, 0, 1)),
)


def viewmats(count):
    """View matrices of cameras on an arc in front of the corner, at varying height."""
    angles = np.linspace(0.3, 1.3, count)
    eyes = (-2.2 * np.cos(angles), -2.2 * np.sin(angles), 1.2 + 0.2 * np.sin(9 * angles))
    return np.stack([look_at(eye, np.array([0.2, 0.2, 0.5])) for eye in np.stack(eyes, axis=-1)])


def picture(viewmat, plain=False):
    """RGB image of the corner; `plain` walls have no texture."""
    random = np.random.default_rng(0)
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for corner, across, along in _WALLS:
        coarse = (random.random((size, size, 3)) for size in (8, 16, 32, 64, 128))
        texture = sum(
            cv2.resize(noise, (_TEXELS, _TEXELS), interpolation=cv2.INTER_CUBIC) for noise in coarse
        )
        texture = np.clip(texture * 51, 0, 255).astype(np.uint8)
        if plain:
            texture[:] = texture.mean((0, 1)).astype(np.uint8)
        step = 2 / _TEXELS
        plane = np.stack([step * np.array(across), step * np.array(along), np.array(corner, float)], axis=1)
        homography = K @ (viewmat[:3, :3] @ plane + np.outer(viewmat[:3, 3], [0, 0, 1]))
        cv2.warpPerspective(
            texture, homography, (WIDTH, HEIGHT), dst=image, borderMode=cv2.BORDER_TRANSPARENT
        )
    return image


def write(folder, count, plain=False):
    """Writes NUMBER.png for each camera; returns the view matrices."""
    cameras = viewmats(count)
    for i, viewmat in enumerate(cameras):
        dots.save(folder / f"{i}.png", picture(viewmat, plain))
    return cameras
