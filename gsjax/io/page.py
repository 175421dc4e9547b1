"""A web page that shows a scene: one .html that opens from disk, without a network or a program beside it.

It holds the scene as a .splat, so without view-dependent colour, and a viewer (page.html) of a few kB: WebGL
2, sorted in a worker.
"""

import base64
import html
import json
from collections.abc import Sequence
from pathlib import Path
from string import Template

import numpy as np

from gsjax.io.atomic import atomic_write
from gsjax.io.splat import splat_bytes
from gsjax.scene.gaussians import Gaussians

_FOCAL = 1.2  # of the height: 45 degrees from top to bottom
_TEMPLATE = Path(__file__).with_name("page.html")


def write_page(
    path: Path,
    gaussians: Gaussians,
    *,
    antialiased: bool = False,
    up: Sequence[float] = (0.0, -1.0, 0.0),
    background: Sequence[float] = (0.0, 0.0, 0.0),
) -> None:
    """Write the page, atomically.

    Args:
        path: the file; the page is titled by its name.
        gaussians: Gaussians that can all be drawn.
        antialiased: whether the scene was fitted with antialiasing; it is drawn so.
        up: unit vector; by default as in most PLY files, whose y points down.
        background: RGB, 0 to 1.
    """
    means = np.asarray(gaussians.means, np.float64)
    center = np.quantile(means, (0.01, 0.99), axis=0).mean(axis=0)  # but for a few that are far away
    radius = np.quantile(np.linalg.norm(means - center, axis=1), 0.98)
    about = {
        "title": path.stem,
        "up": [float(value) + 0.0 for value in up],
        "background": [float(value) for value in background],
        "antialiased": bool(antialiased),
        "center": center.tolist(),
        "distance": float(max(radius, 1e-6) * 2.7),
        "focal": _FOCAL,
    }
    shades = ", ".join(str(round(255 * value)) for value in background)
    text = Template(_TEMPLATE.read_text(encoding="utf-8")).substitute(
        title=html.escape(path.stem),
        background=f"rgb({shades})",
        about=json.dumps(about).replace("<", "\\u003c"),
        data=base64.b64encode(splat_bytes(gaussians)).decode(),
    )
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
