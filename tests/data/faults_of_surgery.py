"""Recordings of surgery, and their faults."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from gsjax.data import ReadOptions, open_sequence
from gsjax.io.video import VideoWriter
from tests.data import dots
from tests.data.faults_of_photographs import ROWS, build_rows
from tests.data.faulty import (
    HEIGHT,
    WIDTH,
    Damage,
    Fault,
    K,
    Layout,
    array,
    change,
    cut,
    drawn,
    gone,
    holds,
    load_all,
    picture,
    swap,
)

TOOL = np.where(np.arange(WIDTH) < WIDTH // 4, 255, 0).astype(np.uint8) * np.ones((HEIGHT, 1), np.uint8)


def every(folder: str, edit: Callable[[np.ndarray], np.ndarray]) -> Damage:
    """Damage that edits each picture in a folder."""

    def damage(root: Path) -> None:
        for path in (root / folder).iterdir():
            dots.save(path, edit(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))

    return damage


def only_one(root: Path) -> None:
    for path in root.glob("**/00[12].png"):
        path.unlink()
    np.save(root / "poses_bounds.npy", np.load(root / "poses_bounds.npy")[:1])


def build_endonerf(root: Path) -> None:
    build_rows(root, 3)
    deep = np.linspace(600, 8000, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH).astype(np.uint16)
    for t in range(3):
        dots.save(root / f"right/images/{t:03d}.png", picture(t + 3))
        for folder, image in (("images", picture(t)), ("masks", TOOL), ("depth", deep)):
            dots.save(root / f"{folder}/{t:03d}.png", image)
    (root / "meta.json").write_text(json.dumps({"fps": 25, "baseline_m": 0.004}))


ENDONERF = (
    *(fault for fault in ROWS if fault.what in ("cut off", "wrong shape", "NaN", "mirror image")),
    Fault(
        "poses in millimetres",
        array(
            "poses_bounds.npy",
            lambda rows: rows * [1000 if i in (3, 8, 13, 15, 16) else 1 for i in range(17)],
        ),
        ("poses_bounds.npy", "pose_unit_m"),
    ),
    Fault("frame missing", gone("images/001.png"), ("poses_bounds.npy", "DATA/images")),
    Fault("image cut off", cut("images/001.png"), ("images/001.png",)),
    Fault("sizes differ", drawn("images/001.png", picture(0, 16, 12)), ("images/001.png",)),
    Fault("single frame", only_one, ("images/000.png",)),
    Fault("mask missing", gone("masks/001.png"), ("DATA/masks",)),
    Fault("mask in colour", drawn("masks/001.png", picture(0)), ("masks/001.png",)),
    Fault("inverted masks", every("masks", lambda mask: 255 - mask), ("DATA/masks", "--read.tool black")),
    Fault("all masks show only the tool", every("masks", lambda mask: mask | 255), ("DATA/masks",)),
    Fault("depth image missing", gone("depth/001.png"), ("DATA/depth",)),
    Fault("depth all 0", every("depth", lambda depth: 0 * depth), ("DATA/depth",)),
    Fault("8-bit depth", drawn("depth/000.png", TOOL), ("depth/000.png",)),
    Fault(
        "wrong depth unit",
        change("meta.json", lambda m: m.update(depth_unit_m=1e-6)),
        ("depth/000.png",),
    ),
    Fault("right frame missing", gone("right/images/001.png"), ("right/images",)),
    Fault(
        "no baseline", change("meta.json", lambda m: m.pop("baseline_m")), ("DATA/right", "--read.baseline-m")
    ),
    Fault("frame rate of 0", change("meta.json", lambda m: m.update(fps=0)), ("meta.json", "fps")),
    Fault("meta.json is a list", holds("meta.json", "[]"), ("meta.json",)),
    Fault(
        "ground truth too short",
        lambda r: np.savez(r / "truth.npz", verts=np.zeros((2, 5, 3))),
        ("truth.npz",),
    ),
)


def build_endovis17(root: Path) -> None:
    calibration = f"Width: {WIDTH}\nHeight: {HEIGHT} // pixels\nExtrinsic-Omega: 0 0 0\nExtrinsic-T: -4 0 0\n"
    for eye, folder in enumerate(("left_frames", "right_frames")):
        calibration += f"Camera-{eye}-F: 30 30\nCamera-{eye}-C: 15.5 11.5\nCamera-{eye}-K: 0 0 0 0 0\n"
        for t in range(3):
            dots.save(root / f"{folder}/frame00{t}.png", picture(t + 3 * eye))
            dots.save(root / f"{TRUE}/frame00{t}.png", TOOL // 25)
    (root / "camera_calibration.txt").write_text(calibration)


TRUE = "ground_truth/Left_Prograsp_Forceps_labels"
ENDOVIS_17 = (
    Fault("no calibration", gone("camera_calibration.txt"), ("camera_calibration.txt", "--read.K")),
    Fault("binary data", holds("camera_calibration.txt", b"\xff\xfe\x80"), ("camera_calibration.txt",)),
    Fault(
        "NaN as focal length",
        swap("camera_calibration.txt", "F: 30", "F: nan"),
        ("camera_calibration.txt", "Camera-0-F"),
    ),
    Fault(
        "right eye without a pose",
        holds(
            "camera_calibration.txt",
            "Width: 32\nHeight: 24\nCamera-0-F: 9 9\nCamera-0-C: 1 1\nCamera-0-K: 0 0 0 0 0\n",
        ),
        ("DATA/right_frames", "camera_calibration.txt"),
    ),
    Fault(
        "lens distortion",
        swap("camera_calibration.txt", "Camera-0-K: 0", "Camera-0-K: -0.9"),
        ("camera_calibration.txt", "Camera-0-K"),
    ),
    Fault("no frames", gone(*(f"left_frames/frame00{t}.png" for t in range(3))), ("DATA/left_frames",)),
    Fault("frame missing", gone("left_frames/frame001.png"), ("DATA/right_frames", "left_frames")),
    Fault("image cut off", cut("left_frames/frame001.png"), ("left_frames/frame001.png",)),
    Fault(
        "sizes differ",
        drawn("right_frames/frame001.png", picture(0, 16, 12)),
        ("right_frames/frame001.png",),
    ),
    Fault("mask missing", gone(f"{TRUE}/frame001.png"), (TRUE, "frame001.png")),
    Fault("wrong size", drawn(f"{TRUE}/frame001.png", TOOL[:9]), (f"{TRUE}/frame001.png",)),
    Fault(
        "unknown instrument",
        lambda root: (root / TRUE).rename(root / "ground_truth/Spoon_labels"),
        ("ground_truth/Spoon_labels",),
    ),
)


def build_endovis18(root: Path) -> None:
    build_endovis17(root)
    shutil.rmtree(root / "ground_truth")
    for t in range(3):
        dots.save(
            root / f"labels/frame00{t}.png", np.where(TOOL[..., None] > 0, [0, 255, 0], 0).astype(np.uint8)
        )
    classes = [{"name": "tissue", "color": [0, 0, 0]}, {"name": "instrument-shaft", "color": [0, 255, 0]}]
    (root / "labels.json").write_text(json.dumps(classes))


ENDOVIS_18 = (
    Fault("no colour names", gone("labels.json"), ("labels.json",)),
    Fault("names without colours", holds("labels.json", '[{"name": "tissue"}]'), ("labels.json",)),
    Fault(
        "colours without names",
        drawn("labels/frame001.png", picture(0)),
        ("labels/frame001.png", "labels.json"),
    ),
    Fault("mask missing", gone("labels/frame001.png"), ("DATA/labels", "frame001.png")),
    Fault("image cut off", cut("labels/frame001.png"), ("labels/frame001.png",)),
)


def build_clip(root: Path) -> None:
    for t in range(3):
        dots.save(root / f"images/{t:03d}.png", picture(t))
        dots.save(root / f"masks/{t:03d}.png", TOOL)


FRAMES_WITH_MASKS = (
    Fault("sizes differ", drawn("images/001.png", picture(0, 16, 12)), ("images/001.png",)),
    Fault(
        "unpadded numbers",
        lambda root: [(root / f"images/00{i}.png").rename(root / f"images/{i * 5}.png") for i in (1, 2)],
        ("DATA/images", "5.png after 10.png"),
    ),
    Fault("single frame", lambda r: [p.unlink() for p in r.glob("*/00[12].png")], ("images/000.png",)),
    Fault("mask missing", gone("masks/001.png"), ("DATA/masks",)),
    Fault("inverted masks", every("masks", lambda mask: 255 - mask), ("DATA/masks", "--read.tool black")),
    Fault("all masks show only the tool", every("masks", lambda mask: mask | 255), ("DATA/masks",)),
    Fault("depth, but no poses", lambda root: (root / "depth").mkdir(), ("DATA", "poses_bounds.npy")),
)


def build_video(root: Path) -> None:
    with VideoWriter(root / "clip.mp4", 30) as video:
        for t in range(3):
            video.write(picture(t))


VIDEO = (
    Fault("not a video", holds("clip.mp4", "text"), ("clip.mp4",)),
    Fault("no video", gone("clip.mp4"), ("clip.mp4",)),
    Fault("cut off", cut("clip.mp4"), ("clip.mp4",)),
)

OPTIONS = ReadOptions(K=K)
SURGERY = {
    "EndoNeRF": Layout(build_endonerf, lambda r: load_all(open_sequence(r)), ENDONERF),
    "EndoVis 2017": Layout(build_endovis17, lambda r: load_all(open_sequence(r)), ENDOVIS_17),
    "EndoVis 2018": Layout(build_endovis18, lambda r: load_all(open_sequence(r)), ENDOVIS_18),
    "frames with masks": Layout(build_clip, lambda r: load_all(open_sequence(r, OPTIONS)), FRAMES_WITH_MASKS),
    "video": Layout(build_video, lambda r: load_all(open_sequence(r / "clip.mp4", OPTIONS)), VIDEO),
}
