"""The readers that benchmarks/fuzz_files.py tries: for each, files that it reads, and how they are opened.

What is opened is also looked at, for pictures are read late. The files are those of the tests of readers.
"""

import gzip
import io
import json
import zipfile
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import yaml
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
from gsjax.data.files import background_behind, picture_size, read_depth, read_image
from gsjax.data.masks import read_mask, read_shades
from gsjax.data.text import decoded
from gsjax.engine.deform.file import origin_of, read_deformation, write_deformation
from gsjax.engine.distill.file import read_field
from gsjax.engine.folder import SIGNATURE
from gsjax.engine.parts.saved import read_parts
from gsjax.engine.records import read_record
from gsjax.engine.teaching.source import Source
from gsjax.engine.track.saved import read_tracking
from gsjax.io.checkpoints import load_checkpoint, load_metadata, save_checkpoint
from gsjax.io.labels import write_labels
from gsjax.io.scenes import read_gaussians, write_gaussians
from gsjax.io.video import VideoWriter
from gsjax.methods.deform import DeformingScene, DeformResult, Timeline
from gsjax.methods.distill import DistillResult, FeatureField
from gsjax.methods.parts.timeline import parse_script
from gsjax.perception.feature_files import read_feature_folder
from tests.data import dots
from tests.data import faults_of_photographs as photographs
from tests.data import faults_of_recordings as recordings
from tests.data import faults_of_surgery as surgery
from tests.data.faulty import HEIGHT, WIDTH, K, deep, picture
from tests.io.scenes_to_write import ksplat, make_scene, sog, spz, spz4

Arrays = Iterable[np.ndarray | None]


class Reader(NamedTuple):
    """A reader.

    Attributes:
        build: writes files that it reads into a folder.
        open: reads them, and returns what has to be finite.
        share: of the cases, where each takes long.
    """

    build: Callable[[Path], object]
    open: Callable[[Path], Arrays]
    share: float = 1.0


def _look(data: Photographs | Sequence) -> Arrays:
    if isinstance(data, Photographs):
        data.image(0), data.mask(0)
        cloud = () if data.cloud is None else (data.cloud.points, data.cloud.colors)
        return data.Ks, data.viewmats, data.depth(0), *cloud
    last = data.num_cameras - 1
    data.image(0, 0), data.image(0, last), data.mask(0, 0)
    return data.Ks, data.viewmats, data.times, data.depth(0, 0)


# Files of Gaussians.


def _scene(path: Path) -> Arrays:
    scene, _ = read_gaussians(path)
    return scene.means, scene.quats, scene.log_scales, scene.logit_opacities, scene.sh0, scene.shN


def _scene_reader(name: str, build: Callable[[Path], object]) -> Reader:
    return Reader(lambda root: build(root / name), lambda root: _scene(root / name), 0.5)


def _written(path: Path) -> None:
    write_gaussians(path, make_scene(20, 1))


def _labelled(path: Path) -> None:
    _written(path)
    write_labels(path, np.arange(20))


def _ascii_ply(path: Path) -> None:
    _written(path)
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
    "compressed PLY": _scene_reader("scene.compressed.ply", _written),
    ".splat": _scene_reader("scene.splat", _written),
    "SPZ 2": _scene_reader("scene.spz", _spz2),
    "SPZ 3": _scene_reader("scene.spz", _written),
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
}


# Single pictures.


def _picture(name: str) -> Reader:
    def build(root: Path) -> None:
        Image.fromarray(picture(0)).save(root / name)

    def read(root: Path) -> Arrays:
        path = root / name
        picture_size(path), background_behind([path])
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
    build: Callable[[Path], object], read: Callable[[Path], Photographs | Sequence], share: float = 0.5
) -> Reader:
    return Reader(build, lambda root: _look(read(root)), share)


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
    "Panoptic": _layout(recordings.build_panoptic, open_sequence),
    "push-T": _layout(_push_t, open_sequence, 0.1),
    "EndoNeRF": _layout(surgery.build_endonerf, open_sequence),
    "EndoVis 2017": _layout(surgery.build_endovis17, open_sequence),
    "EndoVis 2018": _layout(surgery.build_endovis18, open_sequence),
    "frames with masks": _layout(surgery.build_clip, lambda root: open_sequence(root, _OWN_K)),
    "video": _layout(surgery.build_video, lambda root: open_sequence(root / "clip.mp4", _OWN_K), 0.1),
}


# What runs keep.


def _checkpoint(root: Path) -> None:
    tree = {"scene": make_scene(5), "steps": 3, "rows": [np.arange(4), (1.0, None, "x")]}
    save_checkpoint(root / "state.npz", tree, {"kind": "fit"})


def _restored(root: Path) -> Arrays:
    load_metadata(root / "state.npz")
    load_checkpoint(root / "state.npz")
    return ()


def _fit_run(root: Path) -> None:
    _settings(root, {"data": "photographs", "fit": {"antialiased": False}, "test_every": 8, "seed": 0})
    metrics = {"dataset": "photographs", "size": [8, 8], "photographs": 2, "views": [], "seconds": 1.0}
    metrics |= {"steps": 10, "num_gaussians": 20, "machine": {}, "complete": True}
    (root / "metrics.json").write_text(json.dumps(metrics))
    row = json.dumps({"step": 1, "seconds": 0.5, "alive": 20, "test_psnr": 20.0})
    (root / "metrics.jsonl").write_text(f"{row}\n{row}\n")


def _settings(root: Path, settings: dict) -> None:
    (root / "config.yml").write_text(f"{SIGNATURE}\n{yaml.safe_dump(settings)}")


def _record(root: Path) -> Arrays:
    read_record(root)
    return ()


def _trajectory(root: Path) -> None:
    _written(root / "scene.ply")
    np.savez(
        root / "trajectory.npz",
        means=np.zeros((2, 20, 3), np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (2, 10, 1)),
        normals=np.zeros((20, 3), np.float32),
        labels=np.arange(20) % 2,
        label_ids=np.arange(2),
        lost=np.zeros((2, 1), bool),
        turn_known=np.ones((2, 1), bool),
    )


def _tracking(root: Path) -> Arrays:
    tracking = read_tracking(root)
    return [tracking.scene.gaussians.means, tracking.scene.normals]


def _parts_run(root: Path) -> None:
    _written(root / "scene.ply")
    _settings(root, {"parts": {"stream": {"blend": "quaternion"}}})
    rows = [{"part": part, "name": f"part {part}", "true_name": None} for part in range(2)]
    (root / "metrics.json").write_text(json.dumps({"parts": rows, "frames": {"followed": 3}}))
    np.savez(
        root / "parts.npz",
        anchor=np.array(1),
        weights=np.full((20, 2), 0.5),
        centres=np.zeros((2, 3)),
        times=np.arange(3.0),
        R=np.tile(np.eye(3), (3, 2, 1, 1)),
        t=np.zeros((3, 2, 3)),
    )


def _parts(root: Path) -> Arrays:
    layer, _ = read_parts(root)
    return [layer.scene.gaussians.means, layer.scene.weights, *jax.tree.leaves(layer.trajectory)]


def _deforming(root: Path) -> None:
    cameras = {"viewmats": np.tile(np.eye(4), (3, 1, 1)), "Ks": np.tile(np.diag([60.0, 60, 1]), (3, 1, 1))}
    frames = {"times": np.linspace(0, 1, 3), "frame_ids": np.arange(3), "seconds": 2.5}
    seen = {"size": (64, 52), "near": 0.02, "held_out": np.array([1])}
    timeline = Timeline(**frames, **cameras, **seen)
    result = DeformResult(DeformingScene(make_scene(5), None), None, None, timeline)
    write_deformation(root / "deformation.npz", result, np.array([1e6, 0, 0]))


def _deformation(root: Path) -> Arrays:
    result, origin = read_deformation(root / "deformation.npz"), origin_of(root / "deformation.npz")
    return result.scene.gaussians.means, result.timeline.viewmats, origin


def _field(root: Path) -> None:
    field = FeatureField(jnp.eye(3), jnp.ones((4, 3)))
    about = {"file": "scene.ply", "sha256": "0", "num_gaussians": 3, "photographs": None}
    DistillResult(field, None, Source("classes", {1: "tool"}), about).write(root / "field.npz")


def _features_of_field(root: Path) -> Arrays:
    return jax.tree.leaves(read_field(root / "field.npz").field)


_SCRIPT = """fps: 15
edits:
  - {op: speed, parts: [drawer], factor: 0.5}
  - {op: move, parts: [2], by: [0, 0, 0.1], from: 0.2}
"""


def _script(root: Path) -> Arrays:
    path = root / "edit.yml"
    try:
        parse_script(decoded(path.read_bytes()))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error  # as `gsjax edit` does
    return ()


def _codebook(root: Path) -> None:
    ids = np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) % 3
    np.savez(root / "a.npz", ids=ids, codebook=np.ones((3, 4), np.float32))


def _langsplat(root: Path) -> None:
    np.save(root / "a_s.npy", np.zeros((4, HEIGHT, WIDTH), np.int32))
    np.save(root / "a_f.npy", np.ones((3, 4), np.float32))


def _features(build: Callable[[Path], object]) -> Reader:
    def read(root: Path) -> Arrays:
        found = read_feature_folder(root, ["a.png"])
        return [array for each in found for array in (each.map, each.codebook)]

    return Reader(build, read)


_MAP = np.random.default_rng(0).normal(size=(6, 8, 4)).astype(np.float32)
KEPT = {
    "checkpoint": Reader(_checkpoint, _restored),
    "run of fit": Reader(_fit_run, _record),
    "tracked poses": Reader(_trajectory, _tracking, 0.5),
    "run of parts": Reader(_parts_run, _parts, 0.3),
    "deforming scene": Reader(_deforming, _deformation, 0.5),
    "field": Reader(_field, _features_of_field, 0.5),
    "script of edits": Reader(lambda root: (root / "edit.yml").write_text(_SCRIPT), _script, 0.1),
    "features, .npy": _features(lambda root: np.save(root / "a.npy", _MAP)),
    "features, .npz": _features(lambda root: np.savez_compressed(root / "a.npz", features=_MAP)),
    "features, a codebook": _features(_codebook),
    "features, LangSplat": _features(_langsplat),
    "features, LERF": _features(lambda root: np.save(root / "level_0.npy", _MAP[None])),
}

READERS = SCENES | CLOUDS | PICTURES | LAYOUTS | KEPT
