"""Writes glTF with KHR_gaussian_splatting as one .glb, with Gaussians in float32. The format is not read.

Attributes of one primitive of points: POSITION, rotations x y z w, scales, opacities 0 to 1 and an
accessor for each coefficient of the harmonics, all float32; and COLOR_0, for programs that lack the extension
and show points. The y axis points up in glTF and down in a 3DGS PLY, so the node is rotated by 180 degrees
about x. For a scene far from 0 it is also translated to the scene's origin, since numbers in JSON have the
digits that float32 lacks.
Source: extensions/2.0/Khronos/KHR_gaussian_splatting in github.com/KhronosGroup/glTF.
"""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gsjax.io.atomic import atomic_write
from gsjax.io.scene_file import SH_C0, columns_of, to_bytes
from gsjax.scene.gaussians import Gaussians

MAGIC = b"glTF"
_EXTENSION = "KHR_gaussian_splatting"
_FLOAT, _BYTE, _POINTS, _VERTICES = 5126, 5121, 0, 34962
_MOST_BYTES = 2**32 - 2**20  # leaves room for the JSON
_SHAPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write_glb(path: Path, gaussians: Gaussians, *, origin: Float[np.ndarray, "3"] | None = None) -> None:
    """Write a .glb, atomically.

    Args:
        path: the file.
        gaussians: Gaussians that can all be drawn.
        origin: the point that means are relative to; None for 0.

    Raises:
        ValueError: they take more than 4 GiB.
    """
    attributes = _attributes(gaussians)
    views, accessors, start = [], [], 0
    for array in attributes.values():
        views.append({"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": _VERTICES})
        accessors.append(_accessor(len(accessors), array))
        start += array.nbytes
    if start > _MOST_BYTES:
        raise ValueError(
            f"{path}: expected at most 4 GiB, the most that .glb has room for, found {start:,} bytes; write "
            "another format"
        )
    accessors[0] |= {end: getattr(attributes["POSITION"], end)(axis=0).tolist() for end in ("min", "max")}
    primitive = {
        "attributes": {name: index for index, name in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {_EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    node: dict[str, Any] = {"mesh": 0, "rotation": [1, 0, 0, 0]}
    if origin is not None:
        node["translation"] = (origin * [1, -1, -1]).tolist()  # glTF rotates a node before translating it
    scene = {
        "asset": {"version": "2.0", "generator": "gsjax"},
        "extensionsUsed": [_EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": start}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    header = MAGIC + struct.pack("<II", 2, 12 + 8 + len(text) + 8 + start)
    with atomic_write(path) as temporary, open(temporary, "wb") as stream:
        stream.write(header + struct.pack("<I4s", len(text), b"JSON") + text)
        stream.write(struct.pack("<I4s", start, b"BIN\0"))
        for array in attributes.values():
            stream.write(array.tobytes())


def _attributes(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """The arrays by their names in glTF; POSITION first."""
    columns = columns_of(gaussians)
    found = {
        "POSITION": columns.means,
        "COLOR_0": np.column_stack([to_bytes(columns.colors), to_bytes(columns.opacities)]),
        f"{_EXTENSION}:ROTATION": columns.quats[:, [1, 2, 3, 0]],
        f"{_EXTENSION}:SCALE": np.exp(columns.log_scales),  # drafts stored logarithms
        f"{_EXTENSION}:OPACITY": columns.opacities[:, None],
        f"{_EXTENSION}:SH_DEGREE_0_COEF_0": (columns.colors - 0.5) / SH_C0,
    }
    for band in range(1, gaussians.sh_degree + 1):
        for index in range(2 * band + 1):
            found[f"{_EXTENSION}:SH_DEGREE_{band}_COEF_{index}"] = columns.rest[:, band**2 - 1 + index]
    return {name: array if array.dtype == np.uint8 else array.astype("<f4") for name, array in found.items()}


def _accessor(view: int, array: np.ndarray) -> dict[str, Any]:
    count, width = array.shape
    kind = (
        {"componentType": _BYTE, "normalized": True} if array.dtype == np.uint8 else {"componentType": _FLOAT}
    )
    return {"bufferView": view, "count": count, "type": _SHAPES[width], **kind}
