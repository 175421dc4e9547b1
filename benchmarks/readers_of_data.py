"""Readers of data that benchmarks/fuzz_files.py tries: how to write files for each, and how to open them.

Pictures are accessed too, since they are read lazily. The files are those of the tests of the readers.
"""

import gzip
import io
import json
import zipfile
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image
from plyfile import PlyData, PlyElement

from gsjax.data import (
    Photographs,
    ReadOptions,
    Sequence,
    open_photographs,
    open_sequence,
    read_dynerf,
    read_llff,
    read_open3d,
)
from gsjax.data.clouds import read_cloud
from gsjax.data.files import find_background, picture_size, read_depth, read_image
from gsjax.data.masks import read_mask, read_shades
from gsjax.io.labels import write_labels
from gsjax.io.scenes import read_gaussians, write_gaussians
from gsjax.io.video import VideoWriter
from tests.data import dots
from tests.data import faults_of_photographs as photographs
from tests.data import faults_of_recordings as recordings
from tests.data import faults_of_surgery as surgery
from tests.data.faulty import HEIGHT, WIDTH, K, deep, picture
from tests.data.sensors import realsense
from tests.io.scenes_to_write import ksplat, make_scene, sog, spz, spz4

Arrays = Iterable[np.ndarray | None]


class Reader(NamedTuple):
    """A reader.

    Attributes:
        build: writes files that it reads into a folder.
        open: reads them, and returns what has to be finite.
        share: fraction of the cases that is tried; below 1 where each takes long.
        needs: the package that it needs from an optional extra; "" if none.
    """

    build: Callable[[Path], object]
    open: Callable[[Path], Arrays]
    share: float = 1.0
    needs: str = ""


def _look(data: Photographs | Sequence) -> Arrays:
    if isinstance(data, Photographs):
        data.image(0), data.mask(0)
        cloud = () if data.cloud is None else (data.cloud.points, data.cloud.colors)
        return data.Ks, data.viewmats, data.depth(0), *cloud
    last = data.num_cameras - 1
    data.image(0, 0), data.image(0, last), data.mask(0, 0)
    truth = () if data.truth is None else (data.truth.poses,)
    return data.Ks, data.viewmats, data.times, data.depth(0, 0), *truth


# Files of Gaussians.


def _scene(path: Path) -> Arrays:
    scene, _ = read_gaussians(path)
    return scene.means, scene.quats, scene.log_scales, scene.logit_opacities, scene.sh0, scene.shN


def _scene_reader(name: str, build: Callable[[Path], object]) -> Reader:
    return Reader(lambda root: build(root / name), lambda root: _scene(root / name), 0.5)


def written(path: Path) -> None:
    """Write a scene of 20 Gaussians."""
    write_gaussians(path, make_scene(20, 1))


def _labelled(path: Path) -> None:
    written(path)
    write_labels(path, np.arange(20))


def _ascii_ply(path: Path) -> None:
    written(path)
    ply = PlyData.read(str(path), mmap=False)
    ply.text = True
    ply.write(str(path))


def _sog_folder(root: Path) -> None:
    with zipfile.ZipFile(io.BytesIO(sog())) as archive:
        archive.extractall(root)


def _spz2(path: Path) -> None:
    path.write_bytes(gzip.compress(spz(2, 20, arrays=np.random.default_rng(0).bytes(20 * 19))))


SCENES = {
    "PLY": _scene_reader("scene.ply", _labelled),
    "PLY, as text": _scene_reader("scene.ply", _ascii_ply),
    "compressed PLY": _scene_reader("scene.compressed.ply", written),
    ".splat": _scene_reader("scene.splat", written),
    "SPZ 2": _scene_reader("scene.spz", _spz2),
    "SPZ 3": _scene_reader("scene.spz", written),
    "SPZ 4": _scene_reader("scene.spz", lambda path: spz4(make_scene(20, 1), path)),
    "SOG": _scene_reader("scene.sog", lambda path: path.write_bytes(sog())),
    "SOG in a folder": Reader(_sog_folder, lambda root: _scene(root / "meta.json"), 0.5),
} | {
    f".ksplat, level {level}": _scene_reader(
        "scene.ksplat", lambda path, level=level: path.write_bytes(ksplat(level, make_scene(20, 1), 1))
    )
    for level in range(3)
}


# Clouds of points.

_POINTS = np.random.default_rng(0).normal(size=(9, 3)).round(3)
_COLORED = np.hstack([_POINTS, np.arange(27).reshape(9, 3)])


def _cloud(name: str, build: Callable[[Path], object]) -> Reader:
    def read(root: Path) -> Arrays:
        cloud = read_cloud(root / name)
        return cloud.points, cloud.colors

    return Reader(lambda root: build(root / name), read)


def _pcd(path: Path, data: str) -> None:
    head = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 9\n"
    rows = np.column_stack([_POINTS, np.arange(9)])
    text = "\n".join(" ".join(map(str, row)) for row in rows).encode()
    body = rows.astype("<f4").tobytes() if data == "binary" else text
    path.write_bytes(f"{head}HEIGHT 1\nPOINTS 9\nDATA {data}\n".encode() + body)


def _ply_cloud(path: Path, text: bool) -> None:
    rows = np.zeros(9, [*((axis, "f4") for axis in "xyz"), *((c, "u1") for c in ("red", "green", "blue"))])
    for axis, column in zip("xyz", _POINTS.T, strict=True):
        rows[axis] = column
    PlyData([PlyElement.describe(rows, "vertex")], text=text).write(str(path))


def _structured(path: Path) -> None:
    rows = np.zeros(9, [(axis, "f8") for axis in "xyz"])
    np.save(path, rows)


def _named(path: Path) -> None:
    """Columns with units, and decimal commas."""
    rows = "\n".join(";".join(map(str, row)) for row in _COLORED.tolist()).replace(".", ",")
    path.write_text(f"X (m);Y (m);Z (m);R;G;B\n{rows}\n")


CLOUDS = {
    "cloud, PLY": _cloud("points.ply", partial(_ply_cloud, text=False)),
    "cloud, PLY as text": _cloud("points.ply", partial(_ply_cloud, text=True)),
    "cloud, PCD": _cloud("points.pcd", partial(_pcd, data="binary")),
    "cloud, PCD as text": _cloud("points.pcd", partial(_pcd, data="ascii")),
    "cloud, .npy": _cloud("points.npy", lambda path: np.save(path, _COLORED)),
    "cloud, .npy with names": _cloud("points.npy", _structured),
    "cloud, .xyz": _cloud("points.xyz", lambda path: np.savetxt(path, _COLORED)),
    "cloud, .pts": _cloud("points.pts", lambda path: np.savetxt(path, _COLORED, header="9", comments="")),
    "cloud, .csv": _cloud("points.csv", lambda path: np.savetxt(path, _COLORED, delimiter=",")),
    "cloud, .csv with names": _cloud("points.csv", _named),
    "cloud, .txt with names": _cloud(
        "points.txt", lambda path: np.savetxt(path, _COLORED, header="X Y Z R G B", comments="//")
    ),
}


# Single pictures.


def _picture(name: str) -> Reader:
    def build(root: Path) -> None:
        Image.fromarray(picture(0)).save(root / name)

    def read(root: Path) -> Arrays:
        path = root / name
        picture_size(path), find_background([path])
        return (read_image(path, WIDTH, HEIGHT),)

    return Reader(build, read)


def _mask(image: Image.Image, read: Callable) -> Reader:
    return Reader(
        lambda root: image.save(root / "mask.png"), lambda root: (read(root / "mask.png", WIDTH, HEIGHT),)
    )


_LABELS = Image.fromarray(np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH).astype(np.uint8) % 5)
PICTURES = {f"picture, {name}": _picture(f"a.{name}") for name in ("png", "jpg", "tif", "bmp", "webp")} | {
    "mask": _mask(_LABELS, read_mask),
    "mask with a palette": _mask(_LABELS.convert("RGB").quantize(5), read_mask),
    "mask of shades": _mask(_LABELS, read_shades),
    "depth": Reader(
        lambda root: dots.save(root / "depth.png", deep()),
        lambda root: (read_depth(root / "depth.png", 0.001, WIDTH, HEIGHT),),
    ),
}


# Recordings and photographs.

_OWN_K = ReadOptions(K=K)


def _layout(
    build: Callable[[Path], object],
    read: Callable[[Path], Photographs | Sequence],
    share: float = 0.5,
    needs: str = "",
) -> Reader:
    return Reader(build, lambda root: _look(read(root)), share, needs)


def _push_t(root: Path) -> None:
    demo = root / "sample_demos/0"
    (demo / "videos").mkdir(parents=True)
    for name in "ab":
        record = {
            "serial": name,
            "K": [[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]],
            "resolution": [WIDTH, HEIGHT],
            "timestamps": [0.0, 0.1, 0.2],
        }
        (demo / f"videos/{name}.json").write_text(json.dumps(record))
        with VideoWriter(demo / f"videos/{name}.mp4", 10) as video:
            for t in range(3):
                video.write(picture(t))
    (demo / "cameras.json").write_text(json.dumps({name: {"X_WC": np.eye(4).tolist()} for name in "ab"}))


def _realsense(root: Path, compressed: bool) -> None:
    realsense(WIDTH, HEIGHT, frames=2).write(root / recordings.BAG, compressed)


def _bag(root: Path) -> Sequence:
    return open_sequence(root / recordings.BAG)


LAYOUTS = {
    "nerfstudio": _layout(photographs.build_transforms, open_photographs),
    "Blender": _layout(photographs.build_blender, open_photographs),
    "COLMAP text": _layout(photographs.build_colmap_text, open_photographs),
    "COLMAP binary": _layout(photographs.build_colmap_binary, open_photographs),
    "LLFF": _layout(photographs.build_llff, lambda root: read_llff(root, "endonerf")),
    "DyNeRF": _layout(photographs.build_dynerf, lambda root: read_dynerf(root, "endonerf"), 0.1),
    "Open3D RGB-D": _layout(recordings.build_open3d, lambda root: read_open3d(root, K)),
    "TUM RGB-D": _layout(recordings.build_tum, lambda root: open_sequence(root, _OWN_K), 0.3),
    "7-Scenes": _layout(recordings.build_seven_scenes, open_sequence, 0.3),
    "BOP": _layout(recordings.build_bop, open_sequence),
    "PARIS": _layout(recordings.build_paris, open_sequence),
    "Panoptic": _layout(recordings.build_panoptic, open_sequence),
    "Record3D": _layout(recordings.build_record3d, open_sequence, 0.5, "OpenEXR"),
    "RealSense": _layout(partial(_realsense, compressed=False), _bag, 0.5, "rosbags"),
    "RealSense, LZ4": _layout(partial(_realsense, compressed=True), _bag, 0.5, "rosbags"),
    "push-T": _layout(_push_t, open_sequence, 0.1),
    "EndoNeRF": _layout(surgery.build_endonerf, open_sequence),
    "EndoVis 2017": _layout(surgery.build_endovis17, open_sequence),
    "EndoVis 2018": _layout(surgery.build_endovis18, open_sequence),
    "frames with masks": _layout(surgery.build_clip, lambda root: open_sequence(root, _OWN_K)),
    "video": _layout(surgery.build_video, lambda root: open_sequence(root / "clip.mp4", _OWN_K), 0.1),
}
