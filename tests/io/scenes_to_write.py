"""Scenes within the ranges of every format, the rounding of each format, and files made by hand."""

import gzip
import io
import json
import struct
import zipfile
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import zstandard
from PIL import Image
from scipy.spatial import cKDTree

from gsjax.io.scene_file import columns_of
from gsjax.io.scenes import write_gaussians
from gsjax.scene.gaussians import SH_SIZES, Gaussians


def make_scene(count: int = 300, degree: int = 0, seed: int = 0) -> Gaussians:
    """Random Gaussians in a cube whose centre is not the origin."""
    rng = np.random.default_rng(seed)

    def values(low, high, *shape):
        return jnp.asarray(rng.uniform(low, high, shape), jnp.float32)

    rest = SH_SIZES[degree] - 1
    return Gaussians(
        means=values(-3, 5, count, 3),
        quats=jnp.asarray(rng.normal(size=(count, 4)), jnp.float32),
        log_scales=values(-8, 1, count, 3),
        logit_opacities=values(-4, 4, count),
        sh0=values(-1.6, 1.6, count, 1, 3),
        shN=values(-0.9, 0.9, count, rest, 3) if rest else None,
    )


@dataclass(frozen=True)
class Rounding:
    """The largest rounding errors of a format: centres in scene units, rotations as 1 - |q1 . q2|, the others
    in the units of their values; colours and opacities are from 0 to 1."""

    means: float = 1e-6
    turn: float = 1e-6
    log_scales: float = 1e-5
    opacities: float = 1e-6
    colors: float = 1e-6
    rest: float = 1e-6
    degree: int = 3


BYTE = 0.51 / 255
ROUNDING = {
    ".ply": Rounding(),
    # 11 bits of a chunk that may be as large as the scene; 10 of a rotation; 1/32 of a coefficient
    ".compressed.ply": Rounding(8 / 1023, 4e-6, 9 / 1023, BYTE, BYTE, 0.016),
    ".splat": Rounding(turn=2e-4, log_scales=1e-6, opacities=BYTE, colors=BYTE, degree=0),
    ".spz": Rounding(2**-16, 5e-6, 0.0313, BYTE, 0.283 / 0.15 * BYTE, 8.6 / 128),
    ".sog": Rounding(1.6e-4, 6e-5, 0.04, BYTE, 0.01, 0.02),
}
"""By ending."""


def differences(a: Gaussians, b: Gaussians) -> dict[str, float]:
    """The largest differences between two scenes, whose Gaussians may be in any order."""
    left, right = columns_of(a), columns_of(b)
    assert len(left.means) == len(right.means)
    rows = cKDTree(right.means).query(left.means)[1]
    assert len(set(rows.tolist())) == len(rows)
    found = {"turn": 1 - np.abs(np.sum(left.quats * right.quats[rows], axis=1)).min()}
    for name in ("means", "log_scales", "opacities", "colors", "rest"):
        there = getattr(right, name)[rows]
        assert there.shape == getattr(left, name).shape, name
        found[name] = np.abs(there - getattr(left, name)).max(initial=0)
    return found


def assert_alike(a: Gaussians, b: Gaussians, rounding: Rounding, times: float = 1.0) -> None:
    """Asserts that the scenes differ by at most `times` a format's rounding."""
    for name, found in differences(a, b).items():
        assert found <= times * getattr(rounding, name), f"{name}: {found} > {getattr(rounding, name)}"


def flat(scene):
    """The scene without view-dependent colour."""
    return eqx.tree_at(lambda g: g.shN, scene, None, is_leaf=lambda leaf: leaf is None)


def spz(version, count, degree=0, flags=0, arrays=b"", bits=12):
    return struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, bits, flags, 0) + arrays


def spz4(scene, path, change=None):
    """Writes an SPZ of version 4: the arrays of version 3, each in its own Zstandard frame."""
    write_gaussians(path, scene)
    body = gzip.decompress(path.read_bytes())
    degree, bits = body[12], body[13]
    sizes = [scene.num * width for width in (9, 1, 3, 3, 4, 3 * (degree * (degree + 2)))]
    starts = 16 + np.concatenate([[0], np.cumsum(sizes)])
    arrays = [body[a:b] for a, b in pairwise(starts) if b > a]
    frames = [zstandard.ZstdCompressor().compress(array) for array in arrays]
    pairs = [[len(frame), len(array)] for frame, array in zip(frames, arrays, strict=True)]
    if change:
        change(pairs)
    table = b"".join(struct.pack("<QQ", *pair) for pair in pairs)
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, scene.num, degree, bits, 1, len(pairs), 40)
    path.write_bytes(head + b"extended" + table + b"".join(frames))


def ksplat(level, scene, degree, bucket=7):
    """The bytes of a .ksplat of two sections, the first empty, with full buckets and a partial one."""
    columns = columns_of(scene)
    types = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))[level]
    bands, count, block = degree * (degree + 2), scene.num, 5.0
    fields = [("means", types[0], 3), ("scales", types[1], 3), ("quats", types[1], 4), ("rgba", "u1", 4)]
    records = np.zeros(count, np.dtype([*fields, ("rest", types[2], (3 * bands,))]))
    full, left = divmod(count, bucket) if level else (0, 0)
    buckets = full + bool(left)
    centers = np.stack(
        [columns.means[i * bucket : (i + 1) * bucket].mean(0) for i in range(buckets)] or [[0] * 3]
    )
    means = columns.means
    if level:
        off = means - centers.astype("f4")[np.minimum(np.arange(count) // bucket, buckets - 1)]
        block = 2.1 * np.abs(off).max()
        means = np.round(off / (block / 2) * 32767 + 32767)
    records["means"], records["scales"], records["quats"] = means, np.exp(columns.log_scales), columns.quats
    records["rgba"] = np.round(np.column_stack([columns.colors, columns.opacities]).clip(0, 1) * 255)
    rest = [
        columns.rest[:, d**2 - 1 : (d + 1) ** 2 - 1].transpose(0, 2, 1).reshape(count, -1) for d in (1, 2, 3)
    ]
    rest = np.concatenate(rest, axis=1)[:, : 3 * bands]
    records["rest"] = np.round((rest + 1) / 2 * 255) if level == 2 else rest
    header = struct.pack("<4sIIIIHxx12xff", b"\0\1\0\0", 2, 2, count, count, level, -1.0, 1.0).ljust(
        4096, b"\0"
    )
    empty = struct.pack("<IIIIfHxxIIIIH", 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0).ljust(1024, b"\0")
    stored = (bucket, buckets, block, 12, 32767, 0, full, bool(left), degree)
    section = struct.pack("<IIIIfHxxIIIIH", count, count, *stored).ljust(1024, b"\0")
    data = struct.pack("<I", left) if left else b""
    data += centers.astype("<f4").tobytes() if level else b""
    return header + empty + section + data + records.tobytes()


def sog(change_meta=None, pictures=(), extra=()):
    """The bytes of a SOG of 100 Gaussians, with changed metadata and added or replaced files."""
    stream = io.BytesIO()
    with TemporaryDirectory() as folder:
        write_gaussians(Path(folder) / "a.sog", make_scene(100, 1))
        with zipfile.ZipFile(Path(folder) / "a.sog") as source:
            files = {name: source.read(name) for name in source.namelist()}
    meta = json.loads(files["meta.json"])
    if change_meta:
        change_meta(meta)
    files |= {"meta.json": json.dumps(meta).encode(), **dict(pictures), **dict(extra)}
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as target:
        for name, data in files.items():
            target.writestr(name, data)
    return stream.getvalue()


def picture(width, height, kind="PNG"):
    stream = io.BytesIO()
    Image.new("RGBA", (width, height)).save(stream, kind, lossless=True)
    return stream.getvalue()
