"""Gaussians as PLY files in the 3DGS layout (Kerbl et al. 2023), which most viewers and trainers read.

One vertex per Gaussian: x y z, nx ny nz (zeros), f_dc_0..2, f_rest_* channel-major (all of red, then green,
then blue), opacity as a logit, scale_0..2 as logarithms, rot_0..3 as w x y z. gsjax adds feature_* if a scene
has them. Labels lie in a file beside it (`gsjax.io.labels`), because other readers trip over integers.
PlayCanvas's compressed PLY is read too.

A comment in the header says whether the scene is to be drawn antialiased (Mip-Splatting): Brush and
splat-transform write "SplatRenderMode: mip", Postshot "antialiased 1"; the last such line counts.
"""

import os
import re
import warnings
from collections.abc import Iterable
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Integer
from plyfile import PlyData, PlyElement

from gsjax.io.atomic import atomic_write
from gsjax.io.compressed_ply import PACKED, decompress, find_fault, is_compressed, positions
from gsjax.io.labels import labels_beside, read_labels, write_labels
from gsjax.io.parsed_ply import parse_ply
from gsjax.io.scene_file import AGAIN, SceneError, SceneReport, drawable
from gsjax.scene.gaussians import FLAT, OPAQUE, SH_SIZES, Gaussians
from gsjax.scene.origin import far_origin, in_world, origin_message

_REQUIRED = (
    *("x", "y", "z"),
    *(f"f_dc_{i}" for i in range(3)),
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
)
_PLACE = ("x", "y", "z")
_NORMALS = ("nx", "ny", "nz")
_REST_COUNTS = tuple(3 * (size - 1) for size in SH_SIZES)
_ANTIALIASED = "SplatRenderMode: mip"
_MODES = re.compile(r"\s*(?:splatrendermode\s*:\s*(\w+)|antialiased\s+([01])|train_flags\b(.*))\s*$", re.I)
_ENOUGH, _VARY = 10, 0.05  # least number of Gaussians, and range of opacities, to judge by
_LOST = 0.01  # of a Gaussian's size: larger steps of float32 lose its position


class PlyError(SceneError):
    """A file is not a PLY of Gaussians; the message has the path, what was expected and found, and advice."""


def write_ply(
    path: str | os.PathLike,
    gaussians: Gaussians,
    *,
    labels: Integer[np.ndarray, "labels"] | None = None,
    origin: Float[np.ndarray, "3"] | None = None,
    antialiased: bool = False,
) -> None:
    """Write Gaussians as a binary little-endian PLY of float32, atomically.

    Args:
        path: the file.
        gaussians: the Gaussians, on the host or a device.
        labels: integers [N], written to a file beside it: NAME_labels.npz of NAME.ply. Without labels, the
            labels of a PLY that is replaced are removed.
        origin: the point that means are relative to (`SceneReport.origin`, `Photographs.origin`); it is added
            back. Where float32 would then lose positions, x y z are of type double.
        antialiased: say in a comment that the scene is to be drawn antialiased.

    Raises:
        ValueError: `labels` is not one integer per Gaussian, or the name has the ending of another format.
    """
    ending = "".join(Path(path).suffixes[-2:]).lower()
    if ending == ".compressed.ply" or Path(path).suffix.lower() not in (".ply", ""):
        raise ValueError(
            f"{path}: expected a name that ends in .ply, found {ending}; gsjax.write_gaussians writes each "
            "format by its ending"
        )
    if labels is not None:
        labels = np.asarray(labels)
        if labels.shape != (gaussians.num,) or not np.issubdtype(labels.dtype, np.integer):
            raise ValueError(
                f"labels: expected integers of shape [{gaussians.num}], found {labels.dtype} of shape "
                f"{labels.shape}"
            )
    columns = _columns(gaussians, origin)
    kind = "<f8" if origin is not None and _loses_precision(_reach(columns), _size(gaussians)) else "<f4"
    fields = [(name, kind if name in _PLACE else "<f4") for name in columns]
    vertices = np.empty(gaussians.num, dtype=fields)
    for name, column in columns.items():
        vertices[name] = column
    comments, element = [_ANTIALIASED] if antialiased else [], PlyElement.describe(vertices, "vertex")
    replaced = Path(path).exists()
    with atomic_write(path) as temporary:
        PlyData([element], byte_order="<", comments=comments).write(str(temporary))
    if labels is not None:
        write_labels(path, labels)
    elif replaced:
        labels_beside(path).unlink(missing_ok=True)


def _reach(columns: dict[str, np.ndarray]) -> float:
    """The largest magnitude of a finite coordinate."""
    finite = (columns[axis][np.isfinite(columns[axis])] for axis in _PLACE)
    return float(max(np.abs(values).max(initial=0) for values in finite))


def _size(gaussians: Gaussians) -> float:
    """The median Gaussian's size; 0 if none has a finite one."""
    log_scales = np.asarray(gaussians.log_scales, np.float64)
    finite = log_scales[np.isfinite(log_scales).all(axis=1)]
    with np.errstate(over="ignore"):
        return float(np.exp(np.median(np.median(finite, axis=1)))) if len(finite) else 0.0


def _loses_precision(reach: float, size: float) -> bool:
    """Whether float32 moves Gaussians by more than a small part of their size."""
    return bool(np.spacing(np.float32(reach)) > _LOST * size)


def _columns(gaussians: Gaussians, origin: Float[np.ndarray, "3"] | None) -> dict[str, np.ndarray]:
    """The float properties of a file, by name, in the order of 3DGS."""
    means, quats = in_world(np.asarray(gaussians.means), origin), np.asarray(gaussians.quats)
    sh0, log_scales = np.asarray(gaussians.sh0)[:, 0], np.asarray(gaussians.log_scales)
    columns = dict(zip(_PLACE, means.T, strict=True))
    columns |= {name: np.zeros(gaussians.num) for name in _NORMALS}
    columns |= {f"f_dc_{i}": sh0[:, i] for i in range(3)}
    if gaussians.shN is not None:
        # [N, K-1, 3] -> [N, 3, K-1]: the file is channel-major, which is easy to miss.
        rest = np.asarray(gaussians.shN).transpose(0, 2, 1).reshape(gaussians.num, 3 * gaussians.shN.shape[1])
        columns |= {f"f_rest_{i}": column for i, column in enumerate(rest.T)}
    columns["opacity"] = np.asarray(gaussians.logit_opacities)
    columns |= {f"scale_{i}": log_scales[:, i] for i in range(3)}
    columns |= {f"rot_{i}": quats[:, i] for i in range(4)}
    if gaussians.features is not None:
        columns |= {f"feature_{i}": column for i, column in enumerate(np.asarray(gaussians.features).T)}
    return columns


def read_ply(path: str | os.PathLike) -> tuple[Gaussians, SceneReport]:
    """The Gaussians of a 3DGS PLY or a PlayCanvas compressed PLY (detected from the header), as float32.

    The file may be binary of either byte order, or ASCII. Rows that cannot be drawn (with a NaN or a zero
    quaternion) are left out and counted, with a warning. Infinities that mean something are kept as the
    nearest value that can be drawn: an opacity of logit +inf is opaque, a log scale of -inf is flat; a logit
    of -inf is invisible, and left out and counted. Positions far from 0 are returned relative to
    `SceneReport.origin`, with a warning. See `gsjax.io.compressed_ply` for packed values.

    Raises:
        FileNotFoundError: there is no file at `path`.
        PlyError: the file is not a PLY, is truncated, or lacks properties of a Gaussian; or the number of
            chunks of a compressed one does not match its Gaussians, or a chunk's bounds are not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a PLY file of Gaussians, found no file. Check the path")
    ply = _parse(path)
    vertices = ply["vertex"].data
    if is_compressed(ply):
        if fault := find_fault(ply):
            raise PlyError(path, *fault)
        places = positions(ply)
        gaussians, known = decompress(ply, _relative(places, None)), {*PACKED}
        format = "PlayCanvas's compressed PLY"
        invisible = np.zeros(len(vertices), bool)
    else:
        known = _known(path, vertices)
        places = np.stack([vertices[axis] for axis in _PLACE], axis=1).astype(np.float64)
        gaussians, invisible = _uncompressed(vertices, _relative(places, None))
        _warn_if_activated(path, gaussians)
        format = "PLY of 3DGS" + (", as text" if ply.text else "")
    names, size = vertices.dtype.names or (), _size(gaussians)
    if (origin := far_origin(places, least=size)) is not None:
        gaussians = eqx.tree_at(lambda g: g.means, gaussians, jnp.asarray(_relative(places, origin)))
        words = origin_message(places, origin)
        if "x" in names and vertices.dtype["x"].itemsize < 8 and _loses_precision(np.abs(origin).max(), size):
            words += "; the file itself is of float32, which has lost what is smaller than these steps"
        warnings.warn(f"{path}: {words}", UserWarning, stacklevel=1)
    return drawable(
        path,
        format,
        gaussians,
        invisible=invisible,
        extra=tuple(name for name in names if name not in {*known, "label"}),
        labels=np.asarray(vertices["label"]) if "label" in names else read_labels(path, len(vertices)),
        origin=origin,
        places=places,
        antialiased=_antialiased_flag([*ply.comments, *(c for e in ply.elements for c in e.comments)]),
    )


def _relative(
    places: Float[np.ndarray, "N 3"], origin: Float[np.ndarray, "3"] | None
) -> Float[np.ndarray, "N 3"]:
    with np.errstate(over="ignore"):
        return (places if origin is None else places - origin).astype(np.float32)


def _antialiased_flag(comments: Iterable[str]) -> bool | None:
    """Whether the last comment on how to draw the scene asks for antialiasing; None if there is none."""
    said = [found for comment in comments if (found := _MODES.match(comment))]
    if not said:
        return None
    mode, flag, flags = said[-1].groups()
    return (mode or "").lower() == "mip" or flag == "1" or "antialiasing" in (flags or "").lower()


def _warn_if_activated(path: Path, gaussians: Gaussians) -> None:
    """Warns if the opacities and scales look like activated ones rather than logits and logarithms."""
    log_scales, logits = np.asarray(gaussians.log_scales), np.asarray(gaussians.logit_opacities)
    finite = np.isfinite(logits) & np.isfinite(log_scales).all(axis=1)
    logits = logits[finite]
    if len(logits) < _ENOUGH or np.ptp(logits) < _VARY or log_scales[finite].min() < 0:
        return
    if logits.min() >= 0 and logits.max() <= 1:
        words = (
            "opacities lie between 0 and 1, and no scale is negative: they are read as logits and logarithms"
        )
        warnings.warn(f"{path}: {words}, as 3DGS writes them; if they are not, write them so", stacklevel=3)


def _known(path: Path, vertices: np.ndarray) -> set[str]:
    """The names of the properties of the 3DGS layout.

    Raises:
        PlyError: one is missing, or there is an unusual number of harmonics.
    """
    names = vertices.dtype.names or ()
    missing = [name for name in _REQUIRED if name not in names]
    if missing:
        raise PlyError(
            path,
            f"the properties {', '.join(_REQUIRED)}",
            f"no {', '.join(missing)} among {', '.join(names) or 'none'}",
            _advice(names),
        )
    rest, features = _numbered(names, "f_rest_"), _numbered(names, "feature_")
    if len(rest) not in _REST_COUNTS:
        counts = ", ".join(map(str, _REST_COUNTS[:-1])) + f" or {_REST_COUNTS[-1]}"
        raise PlyError(
            path,
            f"{counts} properties f_rest_* (degree 0 to 3)",
            f"{len(rest)}",
            "Export the scene with spherical harmonics of degree 3 or less",
        )
    return {*_REQUIRED, *_NORMALS, *rest, *features}


def _uncompressed(
    vertices: np.ndarray, means: Float[np.ndarray, "N 3"]
) -> tuple[Gaussians, Bool[np.ndarray, "N"]]:
    """The Gaussians of a PLY in the 3DGS layout, with meaningful infinities replaced by finite values, and
    which of them are invisible."""
    names = vertices.dtype.names or ()
    rest, features = _numbered(names, "f_rest_"), _numbered(names, "feature_")
    shN = _stack(vertices, rest).reshape(len(vertices), 3, len(rest) // 3) if rest else None
    logits = _stack(vertices, ["opacity"])[:, 0]
    log_scales = _stack(vertices, [f"scale_{i}" for i in range(3)])
    gaussians = Gaussians(
        means=jnp.asarray(means),
        quats=jnp.asarray(_stack(vertices, [f"rot_{i}" for i in range(4)])),
        log_scales=jnp.asarray(np.where(np.isneginf(log_scales), np.float32(FLAT), log_scales)),
        logit_opacities=jnp.asarray(np.where(np.isinf(logits), np.float32(OPAQUE), logits)),
        sh0=jnp.asarray(_stack(vertices, [f"f_dc_{i}" for i in range(3)])[:, None, :]),
        shN=None if shN is None else jnp.asarray(shN.transpose(0, 2, 1)),
        features=jnp.asarray(_stack(vertices, features)) if features else None,
    )
    return gaussians, np.isneginf(logits)


def _parse(path: Path) -> PlyData:
    """Parse a PLY file that has an element `vertex`."""
    with open(path, "rb") as stream:
        start = stream.read(4)
    if start[:3] != b"ply" or start[3:] not in (b"\n", b"\r"):
        raise PlyError(path, "a PLY file, which starts with 'ply'", repr(start), "Export the scene as PLY")
    try:
        ply = parse_ply(path)
    except ValueError as error:
        found = f"one that cannot be parsed ({error})"
        raise PlyError(path, "a complete PLY file", found, AGAIN) from error
    if "vertex" not in ply:
        names = ", ".join(element.name for element in ply.elements) or "none"
        raise PlyError(path, "an element 'vertex'", f"elements {names}", "Export a scene of Gaussians")
    return ply


def _numbered(names: tuple[str, ...], prefix: str) -> list[str]:
    """Properties prefix0, prefix1, ... up to the first gap."""
    count = 0
    while f"{prefix}{count}" in names:
        count += 1
    return [f"{prefix}{i}" for i in range(count)]


def _stack(vertices: np.ndarray, names) -> np.ndarray:
    """Columns of a structured array stacked along axis 1, float32; values that overflow become infinite."""
    with np.errstate(over="ignore"):
        return np.stack([vertices[name] for name in names], axis=1).astype(np.float32)


def _advice(names: tuple[str, ...]) -> str:
    """Advice for a PLY that lacks properties, depending on what it seems to be."""
    if {"scale_0", "scale_1"} <= set(names) and "scale_2" not in names:
        return "This seems to be a scene of 2D Gaussian splatting, which has no third axis"
    if {"opacity", "scale_0"} <= set(names):
        return "It lacks a part of each Gaussian: export them whole, in the 3D Gaussian splatting PLY format"
    if "scalar_opacity" in names:
        return "Its properties begin with scalar_, as CloudCompare writes them: remove that from their names"
    if {"x", "y", "z"} <= set(names):
        return (
            "This seems to be a point cloud or a mesh; gsjax fit begins with the cloud of a dataset, and "
            "gsjax.scene.initialize.gaussians_from_points makes Gaussians of points"
        )
    return "Export the scene in the 3D Gaussian splatting PLY format"
