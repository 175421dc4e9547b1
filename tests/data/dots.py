"""Pictures of soft dots whose positions are known to a fraction of a pixel, for tests of readers."""

import cv2
import numpy as np

_SIGMA, _REACH = 1.5, 6.0


def save(path, image):
    """Writes a grey, RGB or RGBA image."""
    path.parent.mkdir(parents=True, exist_ok=True)
    order = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}
    assert cv2.imwrite(str(path), image if image.ndim == 2 else cv2.cvtColor(image, order[image.shape[2]]))


def draw(width, height, pixels):
    """White dots on black at pixels (x, y), centres at +0.5."""
    v, u = np.mgrid[:height, :width] + 0.5
    image = np.zeros((height, width))
    for x, y in pixels:
        image += np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * _SIGMA**2))
    return np.repeat(np.round(255 * np.minimum(image, 1)).astype(np.uint8)[..., None], 3, axis=-1)


def offset(image, pixel):
    """Distance in pixels of the dot near a pixel from it; infinite if there is no dot."""
    v, u = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    weight = image.mean(-1) * (np.hypot(u - pixel[0], v - pixel[1]) < _REACH)
    if weight.sum() < 255:
        return np.inf
    return np.hypot(np.average(u, weights=weight) - pixel[0], np.average(v, weights=weight) - pixel[1])


def project(K, viewmat, point):
    """The pixel (x, y) of a world point in front of the camera."""
    x, y, z = K @ (viewmat[:3, :3] @ point + viewmat[:3, 3])
    assert z > 0
    return np.array([x / z, y / z])


def inside(pixel, width, height, margin=7):
    return margin <= pixel[0] <= width - margin and margin <= pixel[1] <= height - margin
