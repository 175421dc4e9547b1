"""Files of Gaussians of every format: read by their content, written by their ending.

PLY (of 3DGS, and compressed), .splat, .spz and .sog are read and written; .ksplat is only read; .glb and
.html, a page that shows the scene, are only written.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from gsjax.io import glb, ksplat, page, ply, sog, splat, spz
from gsjax.io.compressed_ply import write_compressed_ply
from gsjax.io.scene_file import SceneError, SceneReport
from gsjax.scene.gaussians import Gaussians, take, valid_rows
from gsjax.scene.origin import origin_text

Reader = Callable[[Path], tuple[Gaussians, SceneReport]]


@dataclass(frozen=True)
class Format:
    """A format that can be written.

    Attributes:
        name: what it is called in messages.
        write: (path, Gaussians that can all be drawn, ...) -> None.
        degree: largest degree of spherical harmonics that it keeps.
        options: the other arguments that `write` takes.
    """

    name: str
    write: Callable[..., None]
    degree: int = 3
    options: tuple[str, ...] = ()


_PAGE_OPTIONS = ("antialiased", "up", "background", "view", "near", "film")
FORMATS = {
    ".compressed.ply": Format("PlayCanvas's compressed PLY", write_compressed_ply, options=("order",)),
    ".ply": Format("PLY of 3DGS", ply.write_ply, options=("labels", "antialiased", "origin")),
    ".splat": Format(".splat", splat.write_splat, degree=0),
    ".spz": Format("SPZ", spz.write_spz, options=("antialiased",)),
    ".sog": Format("SOG", sog.write_sog, options=("antialiased", "order")),
    ".glb": Format("glTF", glb.write_glb, options=("origin",)),
    ".html": Format("a page", page.write_page, degree=0, options=_PAGE_OPTIONS),
}
"""The formats that can be written, by the ending of a file; of two that fit, the first counts."""

READ = (".ply", ".compressed.ply", ".splat", ".spz", ".sog", ".ksplat")
"""Endings of files that can be read. Only .splat is recognised by its ending, since it has no header."""
_BY_MAGIC: dict[bytes, Reader] = {
    b"ply": ply.read_ply,
    spz.MAGIC: spz.read_spz,
    spz.GZIP: spz.read_spz,
    sog.MAGIC: sog.read_sog,
    ksplat.MAGIC: ksplat.read_ksplat,
}
_KNOWN = {
    glb.MAGIC: "glTF, which is only written",
    b"<": "a page or another text of tags",
    b"\x89PNG": "a PNG picture",
    b"\xff\xd8\xff": "a JPEG picture",
    b"{": "JSON, as a run has beside its scene (give the folder of the run)",
    b"version https://git-lfs": "a pointer of Git LFS, which stands for the file (git lfs pull fetches it)",
}


def is_scene(path: str | os.PathLike) -> bool:
    """Whether a file has the ending of one that `read_gaussians` reads, or is the meta.json of a SOG.

    Args:
        path: the file.
    """
    return os.fspath(path).lower().endswith(READ) or sog.is_meta(Path(path))


def read_gaussians(path: str | os.PathLike) -> tuple[Gaussians, SceneReport]:
    """The Gaussians of a file, float32, and what else it held. The format is recognised by the content.

    Gaussians that cannot be drawn (with a NaN or a zero quaternion) are left out and counted, with a warning.

    Args:
        path: a PLY of 3DGS or PlayCanvas's compressed one, .splat, .spz, .sog (or its meta.json), .ksplat.

    Raises:
        FileNotFoundError: there is no file at `path`.
        SceneError: it is none of these, is cut off or damaged, or claims to be far larger than it can be.
    """
    path = Path(path)
    if not path.is_file():
        found = "a folder" if path.is_dir() else "no file"
        raise FileNotFoundError(f"{path}: expected a file of Gaussians, found {found}. Check the path")
    with path.open("rb") as stream:
        start = stream.read(24)
    for magic, read in _BY_MAGIC.items():
        if start.startswith(magic):
            return read(path)
    if path.name == "meta.json":
        return sog.read_sog(path)
    if path.suffix.lower() == ".splat" and start:
        return splat.read_splat(path)
    found = next((what for magic, what in _KNOWN.items() if start.startswith(magic)), None)
    found = found or (f"one that starts with {start[:8]!r}" if start else "an empty one")
    advice = "Give such a file, or export the scene as .ply"
    raise SceneError(path, f"a file of Gaussians ({', '.join(READ)})", found, advice)


def write_gaussians(
    path: str | os.PathLike,
    gaussians: Gaussians,
    *,
    labels: Int[np.ndarray, "labels"] | None = None,
    antialiased: bool = False,
    origin: Float[np.ndarray, "3"] | None = None,
    order: Int[np.ndarray, "N"] | None = None,
    up: Sequence[float] | None = None,
    background: Sequence[float] | None = None,
    view: tuple[Sequence[float], Sequence[float]] | None = None,
    near: float | None = None,
    film: page.Film | None = None,
) -> tuple[str, ...]:
    """Write Gaussians in the format that the ending of `path` names, atomically.

    Features are not written, nor Gaussians that cannot be drawn.

    Args:
        path: a .ply, .compressed.ply, .splat, .spz, .sog, .glb, or .html, a page that shows the scene.
        gaussians: the scene, on the host or a device.
        labels: one for each Gaussian, [N]. A .ply has them in a file beside it (`write_ply`); others leave
            them out, which is reported unless all are the same.
        antialiased: whether it is to be drawn antialiased, which .ply, .spz, .sog and a page record.
        origin: the point that means are relative to (`SceneReport.origin`, `Photographs.origin`). It is added
            back in a .ply and a .glb; the others would round positions, which stay relative to it.
        order: only for .compressed.ply and .sog: rows in the order of the file; default: spatial. The others
            keep the order of the scene.
        up: only for a page: the direction that points up; default: -y, as in most PLY files.
        background: only for a page: RGB, 0 to 1; default: black.
        view: only for a page: initial position of the eye, and the point that it looks at; default: from the
            side.
        near: only for a page: distance from the eye below which nothing is drawn; default: next to nothing.
        film: only for a page: the scene over time, which it plays; `gaussians` is its first frame.

    Returns:
        What was left out, each in a few words.

    Raises:
        ValueError: no format has that ending, none of the Gaussians can be drawn, the format has no room for
            them, an option is given that it does not take, `labels` are not one for each Gaussian,
            or not all Gaussians of a film can be drawn.
    """
    written = format_of(path)
    valid = valid_rows(gaussians)
    culled = int(np.sum(~valid))
    drawn = take(gaussians, np.flatnonzero(valid)) if culled else gaussians
    if drawn.num == 0:
        raise ValueError(f"{path}: expected Gaussians that can be drawn, found none of {gaussians.num}")
    if order is not None and len(order) != drawn.num:
        raise ValueError(f"order: expected {drawn.num} rows, as many as can be drawn, found {len(order)}")
    if film is not None and culled:
        raise ValueError(f"film: expected Gaussians that can all be drawn, found {culled} that cannot")
    left_out = [f"what cannot be drawn, {culled} of {gaussians.num} Gaussians"] if culled else []
    if drawn.sh_degree > written.degree:
        left_out.append("view-dependent colour")
        drawn = _without(drawn, "shN")
    if drawn.features is not None:
        left_out.append("features")
        drawn = _without(drawn, "features")
    if labels is not None:
        if labels.shape != (gaussians.num,):
            raise ValueError(
                f"labels: expected one for each of {gaussians.num} Gaussians, found an array of shape "
                f"{labels.shape}"
            )
        labels = labels[valid]
        if "labels" not in written.options and len(np.unique(labels)) == 1:
            labels = None
    asked = {"labels": labels, "antialiased": antialiased or None, "origin": origin}
    asked |= {"order": order, "up": up, "background": background, "view": view}
    asked |= {"near": near, "film": film}
    options = {name: value for name, value in asked.items() if value is not None}
    no_room = {"labels": "labels", "antialiased": "that the scene is antialiased"}
    if origin is not None:
        no_room["origin"] = f"the origin {origin_text(origin)}, to which its places are relative"
    for name in [name for name in options if name not in written.options]:
        if name not in no_room:
            having = ", ".join(ending for ending, each in FORMATS.items() if name in each.options)
            raise ValueError(f"{name}: expected a format that has it ({having}), found {path}; leave it out")
        left_out.append(no_room[name])
        del options[name]
    written.write(Path(path), drawn, **options)
    return tuple(left_out)


def format_of(path: str | os.PathLike) -> Format:
    """The format that `write_gaussians` writes.

    Args:
        path: the file.

    Raises:
        ValueError: no format has that ending.
    """
    name = os.fspath(path).lower()
    for ending, written in FORMATS.items():
        if name.endswith(ending):
            return written
    found = ".ksplat, which is only read" if name.endswith(".ksplat") else repr(Path(path).suffix)
    raise ValueError(f"{path}: expected one of the endings {', '.join(FORMATS)}, found {found}")


def _without(gaussians: Gaussians, field: str) -> Gaussians:
    return eqx.tree_at(lambda g: getattr(g, field), gaussians, None)
