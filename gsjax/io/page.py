"""A web page that shows a scene: one .html that opens from disk, without a network or a program beside it.

It holds the scene as a .splat, so without view-dependent colour, and a viewer (page.html) of a few kB: WebGL
2, sorted in a worker. Of a scene that moves it also holds, for each frame, what moves: 16 bits for each
coordinate of places, rotations and, where they change, scales, and for opacities.
"""

import base64
import html
import json
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt16

from gsjax.io.atomic import atomic_write
from gsjax.io.scene_file import columns_of
from gsjax.io.splat import splat_bytes
from gsjax.scene.gaussians import Gaussians, take

_FOCAL = 1.2  # of the height: 45 degrees from top to bottom
_MOST = 65535
_LEAST_STEP = 1e-3  # seconds that the last frame is shown
_TEMPLATE = Path(__file__).with_name("page.html")


class Film(NamedTuple):
    """A scene over time.

    Attributes:
        at: frame -> all Gaussians; colours are the same in all.
        times: of T frames, two or more, in seconds, increasing.
        num_moving: only the first so many Gaussians may differ between frames.
    """

    at: Callable[[int], Gaussians]
    times: Float[np.ndarray, "T"]
    num_moving: int


def write_page(
    path: Path,
    gaussians: Gaussians,
    *,
    antialiased: bool = False,
    up: Sequence[float] = (0.0, -1.0, 0.0),
    background: Sequence[float] = (0.0, 0.0, 0.0),
    film: Film | None = None,
) -> None:
    """Write the page, atomically.

    Args:
        path: the file; the page is titled by its name.
        gaussians: Gaussians that can all be drawn.
        antialiased: whether the scene was fitted with antialiasing; it is drawn so.
        up: unit vector; by default as in most PLY files, whose y points down.
        background: RGB, 0 to 1.
        film: the scene over time, which the page plays; `gaussians` in its first frame. None if it stands
            still.
    """
    means = np.asarray(gaussians.means, np.float64)
    center = np.quantile(means, (0.01, 0.99), axis=0).mean(axis=0)  # but for a few that are far away
    radius = np.quantile(np.linalg.norm(means - center, axis=1), 0.98)
    order, motion, moved = (np.arange(gaussians.num), None, b"") if film is None else _packed(film)
    order = np.append(order, np.arange(len(order), gaussians.num))
    about = {
        "title": path.stem,
        "up": [float(value) + 0.0 for value in up],
        "background": [float(value) for value in background],
        "antialiased": bool(antialiased),
        "center": center.tolist(),
        "distance": float(max(radius, 1e-6) * 2.7),
        "focal": _FOCAL,
        "motion": motion,
    }
    shades = ", ".join(str(round(255 * value)) for value in background)
    text = Template(_TEMPLATE.read_text(encoding="utf-8")).substitute(
        title=html.escape(path.stem),
        background=f"rgb({shades})",
        about=json.dumps(about).replace("<", "\\u003c"),
        data=base64.b64encode(splat_bytes(take(gaussians, order))).decode(),
        motion=base64.b64encode(moved).decode(),
    )
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _packed(film: Film) -> tuple[np.ndarray, dict[str, Any] | None, bytes]:
    """The order in which those of the first Gaussians that move come before those that do not, what the page
    is told of them, and their values.

    Raises:
        ValueError: some frame holds values that are not finite.
    """
    rows = np.arange(film.num_moving)
    values = np.stack([_values(take(film.at(frame), rows)) for frame in range(len(film.times))])
    if not np.isfinite(values).all():
        raise ValueError("film: expected finite places, rotations and scales in each frame, found others")
    moves = (values != values[0]).any(axis=(0, 2))
    order = np.argsort(~moves, kind="stable")
    values = values[:, order[: moves.sum()]]
    if not moves.any():
        return order, None, b""
    low, high = values[..., :3].min(axis=(0, 1)), values[..., :3].max(axis=(0, 1))
    span = np.maximum(high - low, np.finfo(np.float32).tiny)
    scales = values[..., 8:]
    least, most = float(scales.min()), float(scales.max())
    fractions = [(values[..., :3] - low) / span, values[..., 3:4], (values[..., 4:8] + 1) / 2]
    if (scales != scales[0]).any():
        fractions += [(scales - least) / max(most - least, 1e-6), np.zeros_like(scales[..., :1])]
    steps = np.round(np.concatenate(fractions, axis=2) * _MOST).astype(np.uint16)
    times = np.asarray(film.times, np.float64) - film.times[0]
    motion = {
        "times": np.round(times, 6).tolist(),
        "step": float(max(np.median(np.diff(times)), _LEAST_STEP)),
        "moving": int(moves.sum()),
        "texels": steps.shape[2] // 4,
        "low": low.tolist(),
        "span": span.tolist(),
        "sizes": [least, max(most - least, 1e-6)],
    }
    return order, motion, zlib.compress(_differences(steps), 6)


def _values(gaussians: Gaussians) -> Float[np.ndarray, "M 11"]:
    """Place, opacity, rotation and logarithms of scales, float32."""
    found = columns_of(gaussians)
    return np.column_stack([found.means, found.opacities, found.quats, found.log_scales]).astype(np.float32)


def _differences(steps: UInt16[np.ndarray, "T M values"]) -> bytes:
    """Differences between frames, the first to 0, which deflate shrinks further than the values: their signs
    in the lowest bit, and for each frame and value the low bytes of all before the high ones."""
    change = np.diff(steps, axis=0, prepend=np.zeros_like(steps[:1])).astype(np.int16)
    zigzag = ((change << 1) ^ (change >> 15)).astype(np.uint16).transpose(0, 2, 1)
    return np.stack([zigzag & 0xFF, zigzag >> 8], axis=2).astype(np.uint8).tobytes()
