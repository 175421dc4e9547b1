"""Photographs in every layout, and their faults."""

import json
import shutil
import struct
from pathlib import Path

import numpy as np

from gsjax.data import open_photographs, read_dynerf, read_llff
from gsjax.io.video import VideoWriter
from tests.data import dots
from tests.data.faulty import (
    HEIGHT,
    NAN,
    SKEW,
    WIDTH,
    Fault,
    K,
    Layout,
    array,
    change,
    cut,
    deep,
    drawn,
    frame,
    gone,
    holds,
    load_all,
    moved,
    patch,
    picture,
    swap,
)

HEIC = b"\0\0\0\x18ftypheic" + bytes(99)

# nerfstudio, instant-ngp and Blender.


def build_transforms(root: Path) -> None:
    frames = []
    for i in range(3):
        dots.save(root / f"images/{i}.png", picture(i))
        dots.save(root / f"depth/{i}.png", deep())
        dots.save(root / f"masks/{i}.png", picture(i)[..., 0])
        beside = {"depth_file_path": f"depth/{i}.png", "mask_path": f"masks/{i}.png"}
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": moved(i).tolist()} | beside)
    meta = {"fl_x": K[0], "cx": K[2], "cy": K[3], "w": WIDTH, "h": HEIGHT, "ply_file_path": "points.ply"}
    (root / "transforms.json").write_text(json.dumps(meta | {"frames": frames}))
    head = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property float {c}\n" for c in "xyz")
    (root / "points.ply").write_text(head + "end_header\n1 2 3\n4 5 6\n")


TRANSFORMS = (
    Fault("not JSON", holds("transforms.json", "frames: 3"), ("transforms.json",)),
    Fault("cut off", cut("transforms.json"), ("transforms.json",)),
    Fault("no frames", change("transforms.json", lambda m: m.update(frames=[])), ("transforms.json",)),
    Fault("NaN in a pose", frame("transforms.json", 1, transform_matrix=NAN), ("images/1.png",)),
    Fault("pose is not a rotation", frame("transforms.json", 1, transform_matrix=SKEW), ("frame 1", "1.png")),
    Fault("pose of the wrong shape", frame("transforms.json", 1, transform_matrix=[1, 2]), ("frame 1",)),
    Fault("NaN as focal length", frame("transforms.json", 2, fl_x=float("nan")), ("frame 2",)),
    Fault("no focal length", change("transforms.json", lambda m: m.pop("fl_x")), ("transforms.json",)),
    Fault("unknown camera model", frame("transforms.json", 0, camera_model="X"), ("frame 0",)),
    Fault(
        "no train list",
        change("transforms.json", lambda m: m.update(test_filenames=["images/0.png"])),
        ("transforms.json",),
    ),
    Fault("photograph listed twice", frame("transforms.json", 1, file_path="./images/0.png"), ("images/0",)),
    Fault("unknown key", frame("transforms.json", 1, normal_path="n.png"), ("normal_path",)),
    Fault(
        "depth_path without a unit",
        frame("transforms.json", 1, depth_path="depth/1.png"),
        ("transforms.json", "integer_depth_scale"),
    ),
    Fault("photograph missing", gone("images/1.png"), ("images/1.png",)),
    Fault("all photographs missing", gone(*(f"images/{i}.png" for i in range(3))), ("images/0.png",)),
    Fault("image cut off", cut("images/1.png"), ("images/1.png",)),
    Fault("HEIC", holds("images/1.png", HEIC), ("images/1.png",)),
    Fault("not an image", holds("images/1.png", "text"), ("images/1.png",)),
    Fault("photograph of the wrong size", drawn("images/1.png", picture(1, 24, 32)), ("frame 1",)),
    Fault("depth image missing", gone("depth/1.png"), ("depth/1.png",)),
    Fault("8-bit depth", drawn("depth/1.png", picture(0)[..., 0]), ("depth/1.png",)),
    Fault("mask cut off", cut("masks/2.png"), ("masks/2.png",)),
    Fault("mask in colour", drawn("masks/2.png", picture(0)), ("masks/2.png",)),
    Fault("points missing", gone("points.ply"), ("points.ply",)),
    Fault("points cut off", cut("points.ply", 0.97), ("points.ply",)),
    Fault("points without coordinates", swap("points.ply", "float z", "float w"), ("points.ply",)),
    Fault("points not a PLY", holds("points.ply", b"PK\3\4"), ("points.ply",)),
)


def build_blender(root: Path) -> None:
    for s, split in enumerate(("train", "test")):
        frames = []
        for i in range(2):
            dots.save(root / f"{split}/r_{i}.png", picture(2 * s + i))
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": moved(i).tolist()})
        meta = {"camera_angle_x": 0.8, "frames": frames}
        (root / f"transforms_{split}.json").write_text(json.dumps(meta))


BLENDER = (
    Fault("not JSON", holds("transforms_test.json", b"\x93NUMPY"), ("transforms_test.json",)),
    Fault("no frames", change("transforms_train.json", lambda m: m.update(frames=[])), ("_train.json",)),
    Fault("angle is not a number", frame("transforms_train.json", 0, camera_angle_x="0.8"), ("frame 0",)),
    Fault("angle of 0", frame("transforms_test.json", 1, camera_angle_x=0), ("_test.json, frame 1",)),
    Fault("NaN in a pose", frame("transforms_train.json", 1, transform_matrix=NAN), ("train/r_1",)),
    Fault("photograph missing", gone("train/r_1.png"), ("train/r_1",)),
    Fault("image cut off", cut("train/r_1.png"), ("train/r_1.png",)),
)


# COLMAP.

NAMES = ("a.png", "b.png", "c.png")


def build_pictures(root: Path) -> None:
    for i, name in enumerate(NAMES):
        dots.save(root / "images" / name, picture(i))


def build_colmap_text(root: Path) -> None:
    build_pictures(root)
    sparse = root / "sparse/0"
    sparse.mkdir(parents=True)
    (sparse / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} {' '.join(map(str, K))}\n")
    lines = (f"{i} 1 0 0 0 {i} 0 0 1 {name}\n1 2 -1\n" for i, name in enumerate(NAMES))
    (sparse / "images.txt").write_text("".join(lines))
    (sparse / "points3D.txt").write_text("1 0 0 1 9 9 9 0.5 1 0\n")


def build_colmap_binary(root: Path) -> None:
    build_pictures(root)
    sparse = root / "sparse/0"
    sparse.mkdir(parents=True)
    (sparse / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, 1, WIDTH, HEIGHT, *K))
    images = (
        struct.pack("<i7di", i, 1, 0, 0, 0, i, 0, 0, 1) + name.encode() + struct.pack("<xQ", 0)
        for i, name in enumerate(NAMES)
    )
    (sparse / "images.bin").write_bytes(struct.pack("<Q", 3) + b"".join(images))
    (sparse / "points3D.bin").write_bytes(struct.pack("<QQ3d3BdQii", 1, 1, 0, 0, 1, 9, 9, 9, 0.5, 1, 1, 0))


TEXT = {name: f"sparse/0/{name}.txt" for name in ("cameras", "images", "points3D")}
BINARY = {name: f"sparse/0/{name}.bin" for name in ("cameras", "images", "points3D")}
COLMAP_TEXT = (
    Fault("list missing", gone(TEXT["images"]), ("sparse/0/images.txt",)),
    Fault("no cameras", holds(TEXT["cameras"], "# none\n"), ("cameras.txt",)),
    Fault("no photographs", holds(TEXT["images"], "# none\n"), ("images.txt",)),
    Fault("line cut off", cut(TEXT["cameras"], 0.2), ("cameras.txt, line 1",)),
    Fault("number missing", swap(TEXT["cameras"], " 12.0", ""), ("cameras.txt, line 1",)),
    Fault(
        "words instead of numbers",
        swap(TEXT["images"], "1 1 0 0 0", "1 1 0 zero 0"),
        ("images.txt, line 3",),
    ),
    Fault(
        "camera model unknown to OpenCV",
        swap(TEXT["cameras"], "PINHOLE 32 24", "FOV 32 24 30.0"),
        ("cameras.txt",),
    ),
    Fault("points cut off", swap(TEXT["images"], "1 2 -1", "1 2"), ("images.txt, line 2",)),
    Fault(
        "two reconstructions",
        lambda root: shutil.copytree(root / "sparse/0", root / "sparse/1"),
        ("sparse/0", "sparse/1"),
    ),
    Fault("NaN as focal length", swap(TEXT["cameras"], "30.0", "nan"), ("cameras.txt",)),
    Fault("NaN in a pose", swap(TEXT["images"], "1 1 0 0 0", "1 nan 0 0 0"), ("images.txt", "b.png")),
    Fault(
        "quaternion not normalised", swap(TEXT["images"], "1 1 0", "1 2 0"), ("images.txt, line 3", "b.png")
    ),
    Fault("point without colour", holds(TEXT["points3D"], "1 0 0 1\n"), ("points3D.txt, line 1",)),
    Fault("photograph missing", gone("images/b.png"), ("DATA/images", "b.png")),
    Fault("all photographs missing", gone(*(f"images/{n}" for n in NAMES)), ("DATA/images",)),
    Fault("image cut off", cut("images/b.png"), ("images/b.png",)),
    Fault("photograph of the wrong size", drawn("images/b.png", picture(1, 24, 32)), ("images/b.png",)),
)
COLMAP_BINARY = (
    Fault("list missing", gone(BINARY["images"]), ("sparse/0/images.bin",)),
    *(Fault(f"{name}.bin is cut off", cut(BINARY[name], 0.9), (f"{name}.bin",)) for name in BINARY),
    Fault("another format", holds(BINARY["images"], b"SQLite format 3\0" + bytes(99)), ("images.bin",)),
    Fault("no cameras", holds(BINARY["cameras"], bytes(8)), ("cameras.bin",)),
    Fault("no photographs", holds(BINARY["images"], bytes(8)), ("images.bin",)),
    Fault("camera model unknown to OpenCV", patch(BINARY["cameras"], 12, b"\x63"), ("cameras.bin",)),
    Fault("NaN in a pose", patch(BINARY["images"], 12, struct.pack("<d", np.nan)), ("images.bin", "a.png")),
    Fault(
        "quaternion not normalised",
        patch(BINARY["images"], 12, struct.pack("<d", 2)),
        ("images.bin", "a.png"),
    ),
    Fault("photograph missing", gone("images/b.png"), ("DATA/images", "b.png")),
)


# poses_bounds.npy.


def build_rows(root: Path, count: int) -> None:
    matrices = [np.column_stack([moved(i)[:3], [HEIGHT, WIDTH, K[0]]]) for i in range(count)]
    np.save(root / "poses_bounds.npy", [[*matrix.ravel(), 0.1, 9.0] for matrix in matrices])


def build_llff(root: Path) -> None:
    build_pictures(root)
    build_rows(root, 3)


def build_dynerf(root: Path) -> None:
    build_rows(root, 2)
    for i in range(2):
        with VideoWriter(root / f"cam{i:02d}.mp4", 30) as video:
            for t in range(3):
                video.write(picture(t))


def mirror(rows: np.ndarray) -> np.ndarray:
    rows = rows.copy()
    rows[1, 0] = -1
    return rows


def all_in_heic(root: Path) -> None:
    for path in (root / "images").iterdir():
        path.rename(path.with_suffix(".HEIC"))


ROWS = (
    Fault("cut off", cut("poses_bounds.npy"), ("poses_bounds.npy",)),
    Fault("not an array", holds("poses_bounds.npy", "1 2 3\n"), ("poses_bounds.npy",)),
    Fault("pickled objects", array("poses_bounds.npy", lambda a: a.astype(object)), ("poses_bounds.npy",)),
    Fault("wrong shape", array("poses_bounds.npy", lambda a: a[:, :16]), ("poses_bounds.npy",)),
    Fault("no rows", array("poses_bounds.npy", lambda a: a[:0]), ("poses_bounds.npy",)),
    Fault(
        "NaN", array("poses_bounds.npy", lambda a: a * [1, np.nan, *[1] * 15]), ("poses_bounds.npy", "row 0")
    ),
    Fault("mirror image", array("poses_bounds.npy", mirror), ("row 1", "poses_bounds.npy")),
    Fault("no focal length", array("poses_bounds.npy", lambda a: a * [*[1] * 14, 0, 1, 1]), ("row 0",)),
)
LLFF = (
    *ROWS,
    Fault("photograph missing", gone("images/b.png"), ("poses_bounds.npy", "DATA/images")),
    Fault("image cut off", cut("images/b.png"), ("images/b.png",)),
    Fault("another photograph in HEIC", holds("images/d.HEIC", HEIC), ("images", "d.HEIC")),
    Fault("all photographs in HEIC", all_in_heic, ("images", "a.HEIC")),
)
DYNERF = (
    Fault("cut off", cut("poses_bounds.npy"), ("poses_bounds.npy",)),
    Fault("video missing", gone("cam01.mp4"), ("poses_bounds.npy", "cam*.mp4")),
    Fault("not a video", holds("cam01.mp4", "text"), ("cam01.mp4",)),
)

PHOTOGRAPHS = {
    "nerfstudio": Layout(build_transforms, lambda r: load_all(open_photographs(r)), TRANSFORMS),
    "Blender": Layout(build_blender, lambda r: load_all(open_photographs(r)), BLENDER),
    "COLMAP text": Layout(build_colmap_text, lambda r: load_all(open_photographs(r)), COLMAP_TEXT),
    "COLMAP binary": Layout(build_colmap_binary, lambda r: load_all(open_photographs(r)), COLMAP_BINARY),
    "LLFF": Layout(build_llff, lambda r: load_all(read_llff(r, "endonerf")), LLFF),
    "DyNeRF": Layout(build_dynerf, lambda r: load_all(read_dynerf(r, "endonerf")), DYNERF),
}
