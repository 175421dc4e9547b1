"""A web page that shows a scene: one .html that opens from disk, without a network or a server.

It holds the scene as a .splat, so without view-dependent colour, and a viewer (page.html) of a few kB: WebGL
2, with sorting in a worker. For a moving scene it also holds each frame of the moving Gaussians, with 16 bits
for each coordinate of positions (on a logarithmic scale, as in SOG), opacity, component of rotations and,
where they change, scale.
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
from jaxtyping import Float, Int, UInt16

from gsjax.io.atomic import atomic_write
from gsjax.io.scene_file import columns_of
from gsjax.io.splat import RECORD, splat_bytes
from gsjax.scene.gaussians import Gaussians, take

_FOCAL = 1.2  # of the height: 45 degrees from top to bottom
_MOST = 65535
_MOST_BYTES = 400_000_000  # in base64, the 2^29 characters of Chromium's longest text
_MOST_GAUSSIANS = _MOST_BYTES // RECORD.itemsize
_LEAST_STEP = 1e-3  # seconds that the last frame is shown
_LEAST_UNIT = 1e-6  # of the distance of the farthest Gaussian
_TEMPLATE = Path(__file__).with_name("page.html")


class Film(NamedTuple):
    """A scene over time.

    Attributes:
        at: frame -> all Gaussians; colours are the same in all.
        times: times of the T frames (two or more) in seconds, increasing.
        num_moving: only the first `num_moving` Gaussians may differ between frames.
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
    view: tuple[Sequence[float], Sequence[float]] | None = None,
    near: float = 0.0,
    film: Film | None = None,
) -> None:
    """Write the page, atomically.

    Args:
        path: the file; the page is titled by its name.
        gaussians: Gaussians that can all be drawn.
        antialiased: whether the scene was fitted with antialiasing, and is to be drawn with it.
        up: unit vector; by default as in most PLY files, whose y points down.
        background: RGB, 0 to 1.
        view: initial position of the eye, and the point that it looks at; default: from the side.
        near: distance from the eye below which nothing is drawn; at least a small share of the scene's size.
        film: the scene over time, which the page plays; `gaussians` is its first frame. None for a static
            scene.

    Raises:
        ValueError: the Gaussians or their motion are more than a page can hold, or some frame of the film
            holds values that are not finite.
    """
    if gaussians.num > _MOST_GAUSSIANS:
        raise ValueError(
            f"{path}: expected at most {_MOST_GAUSSIANS:,} Gaussians, the most that a browser opens in a "
            f"page, found {gaussians.num:,}; write .sog, or fewer"
        )
    means = np.asarray(gaussians.means, np.float64)
    center = np.quantile(means, (0.01, 0.99), axis=0).mean(axis=0)  # without a few that are far away
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
        "view": None if view is None else [[float(value) for value in place] for place in view],
        "near": float(near),
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
        temporary.write_text(text, encoding="utf-8", errors="replace")  # the title may not be UTF-8


def _packed(film: Film) -> tuple[np.ndarray, dict[str, Any] | None, bytes]:
    """An order of the first `num_moving` Gaussians in which those that do move come first, the description of
    their motion for the page, and their values. Frames are evaluated one at a time, in two passes: for the
    ranges, then for the values.

    Raises:
        ValueError: some frame holds values that are not finite, or there are more than a page can hold.
    """
    rows, frames = np.arange(film.num_moving), range(len(film.times))
    low = high = _values(take(film.at(0), rows))
    for frame in frames[1:]:
        values = _values(take(film.at(frame), rows))
        low, high = np.minimum(low, values), np.maximum(high, values)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ValueError("film: expected finite places, rotations and scales in each frame, found others")
    moves = (low != high).any(axis=1)
    order = np.argsort(~moves, kind="stable")
    if not moves.any():
        return order, None, b""
    rows = order[: moves.sum()]
    ranges = _ranges(low[rows], high[rows])
    scales_vary = bool((low[rows, 8:] != high[rows, 8:]).any())
    times = np.asarray(film.times, np.float64) - film.times[0]
    motion = {
        "times": np.round(times, 6).tolist(),
        "step": float(max(np.median(np.diff(times)), _LEAST_STEP)),
        "moving": len(rows),
        "texels": 2 + scales_vary,
        **{name: value.tolist() for name, value in ranges._asdict().items()},
    }
    return order, motion, _compressed(film, rows, ranges, scales_vary)


class _Ranges(NamedTuple):
    """Ranges of the 16-bit values. Positions x are quantised as sign(u) log(1 + |u|) with u = (x - middle) /
    unit, so that a few Gaussians far away do not coarsen the others; scales are quantised as logarithms."""

    middle: Float[np.ndarray, "3"]
    unit: Float[np.ndarray, ""]
    low: Float[np.ndarray, "3"]
    span: Float[np.ndarray, "3"]
    sizes: Float[np.ndarray, "2"]


def _ranges(low: Float[np.ndarray, "M 11"], high: Float[np.ndarray, "M 11"]) -> _Ranges:
    """The ranges of the moving Gaussians, from the smallest and largest values of each."""
    first, last = low[:, :3].astype(np.float64), high[:, :3].astype(np.float64)
    middle = np.median((first + last) / 2, axis=0)
    reach = np.linalg.norm(np.maximum(middle - first, last - middle), axis=1)
    unit = np.asarray(max(np.median(reach), _LEAST_UNIT * reach.max(), np.finfo(np.float32).tiny))
    least, most = (_logarithms((each - middle) / unit) for each in (first.min(axis=0), last.max(axis=0)))
    smallest, largest = low[:, 8:].min(), high[:, 8:].max()
    return _Ranges(
        middle=middle,
        unit=unit,
        low=least,
        span=np.maximum(most - least, np.finfo(np.float32).tiny),
        sizes=np.array([smallest, max(largest - smallest, 1e-6)], np.float64),
    )


def _logarithms(values: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    return np.sign(values) * np.log1p(np.abs(values))


def _compressed(film: Film, rows: Int[np.ndarray, "M"], ranges: _Ranges, scales_vary: bool) -> bytes:
    """The values of all frames, compressed.

    Raises:
        ValueError: they are more than a page can hold.
    """
    packer, packed, size = zlib.compressobj(6), [], 0
    before = np.zeros((len(rows), 12 if scales_vary else 8), np.uint16)
    for frame in range(len(film.times)):
        values = _values(take(film.at(frame), rows)).astype(np.float64)
        logs = _logarithms((values[:, :3] - ranges.middle) / ranges.unit)
        fractions = [(logs - ranges.low) / ranges.span, values[:, 3:4], (values[:, 4:8] + 1) / 2]
        if scales_vary:
            fractions += [(values[:, 8:] - ranges.sizes[0]) / ranges.sizes[1], np.zeros((len(rows), 1))]
        steps = np.round(np.concatenate(fractions, axis=1) * _MOST).astype(np.uint16)
        packed.append(packer.compress(_differences(steps, before)))
        before, size = steps, size + len(packed[-1])
        if size > _MOST_BYTES:
            raise ValueError(
                f"film: expected motion of at most {_MOST_BYTES / 1e6:.0f} MB, the most that a browser "
                f"opens, found more in the first {frame + 1} of {len(film.times)} frames; take fewer frames "
                "(--frames)"
            )
    return b"".join([*packed, packer.flush()])


def _values(gaussians: Gaussians) -> Float[np.ndarray, "M 11"]:
    """Position, opacity, rotation and logarithms of scales, float32."""
    found = columns_of(gaussians)
    return np.column_stack([found.means, found.opacities, found.quats, found.log_scales]).astype(np.float32)


def _differences(steps: UInt16[np.ndarray, "M values"], before: UInt16[np.ndarray, "M values"]) -> bytes:
    """Differences from the previous frame, which deflate compresses better than the values: with the sign in
    the lowest bit (zigzag), and for each value the low bytes of all Gaussians before the high ones."""
    change = (steps - before).astype(np.int16)
    zigzag = ((change << 1) ^ (change >> 15)).astype(np.uint16).T
    return np.stack([zigzag & 0xFF, zigzag >> 8], axis=1).astype(np.uint8).tobytes()
