"""Recordings with depth in every layout, scenes of Gaussians, and their faults."""

import json
import struct
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from gsjax.data import open_sequence, read_open3d, write_panoptic
from gsjax.data.simulated import tabletop
from gsjax.io.ply import read_ply, write_ply
from gsjax.scene.gaussians import Gaussians
from tests.data import dots
from tests.data.exports import write_exr, write_record3d
from tests.data.faults_of_photographs import build_transforms
from tests.data.faulty import (
    HEIGHT,
    NAN,
    SKEW,
    WIDTH,
    Damage,
    Fault,
    K,
    Layout,
    change,
    cut,
    deep,
    drawn,
    gone,
    holds,
    load_all,
    moved,
    picture,
    swap,
)
from tests.data.sensors import COLOR, DEPTH, Messages, realsense
from tests.data.written import write_bop, write_paris


def build_open3d(root: Path) -> None:
    blocks = []
    for i in range(3):
        dots.save(root / f"image/{i:05d}.png", picture(i))
        dots.save(root / f"depth/{i:05d}.png", deep())
        blocks.append(f"{i} {i} {i + 1}\n" + "\n".join(" ".join(map(str, row)) for row in moved(i)))
    (root / "trajectory.log").write_text("\n".join(blocks) + "\n")


OPEN3D = (
    Fault("trajectory cut off", cut("trajectory.log", 0.5), ("trajectory.log",)),
    Fault("no numbers", holds("trajectory.log", "none\n"), ("trajectory.log",)),
    Fault("no poses", holds("trajectory.log", ""), ("trajectory.log",)),
    Fault("NaN in a pose", swap("trajectory.log", "1.0", "nan"), ("00000.png",)),
    Fault("pose is not a rotation", swap("trajectory.log", "1.0", "3.0"), ("frame 0", "trajectory.log")),
    Fault("no images", gone(*(f"image/{i:05d}.png" for i in range(3))), ("DATA",)),
    Fault("depth image missing", gone("depth/00001.png"), ("00001.png",)),
    Fault("depth image cut off", cut("depth/00001.png"), ("depth/00001.png",)),
    Fault("8-bit depth", drawn("depth/00001.png", picture(0)[..., 0]), ("depth/00001.png",)),
    Fault("wrong size", drawn("image/00001.png", picture(0, 16, 12)), ("image/00001.png",)),
)


def build_tum(root: Path) -> None:
    for kind, image in (("rgb", np.full((480, 640, 3), 9, np.uint8)), ("depth", deep(640, 480))):
        image[:240] += 1
        for i in range(2):
            dots.save(root / f"{kind}/{i}.png", image)
        (root / f"{kind}.txt").write_text("".join(f"{i}.0 {kind}/{i}.png\n" for i in range(2)))
    (root / "groundtruth.txt").write_text("0.0 0 0 0 0 0 0 1\n1.0 1 0 0 0 0 0 1\n")


TUM = (
    Fault("list missing", gone("depth.txt"), ("depth.txt",)),
    Fault("line cut off", cut("rgb.txt", 0.65), ("rgb.txt", "line 2")),
    Fault("not text", holds("groundtruth.txt", b"\xff\xfe\x80"), ("groundtruth.txt",)),
    Fault("no poses", holds("groundtruth.txt", "# none\n"), ("groundtruth.txt",)),
    Fault("NaN in a pose", swap("groundtruth.txt", "1.0 1", "1.0 nan"), ("groundtruth.txt",)),
    Fault("quaternion not normalised", swap("groundtruth.txt", " 1\n", " 2\n"), ("groundtruth.txt",)),
    Fault("isolated timestamp", swap("depth.txt", "0.0 ", "50.0 "), ("DATA",)),
    Fault("clocks without overlap", holds("depth.txt", "50.0 depth/0.png\n51.0 depth/1.png\n"), ("DATA",)),
    Fault("image missing", gone("rgb/1.png"), ("rgb.txt",)),
    Fault("all images missing", gone("rgb/0.png", "rgb/1.png"), ("rgb.txt",)),
    Fault("image cut off", cut("rgb/1.png"), ("rgb/1.png",)),
    Fault("wrong size", drawn("rgb/0.png", picture(0)), ("rgb/0.png",)),
)


def build_seven_scenes(root: Path) -> None:
    image = np.full((480, 640, 3), 9, np.uint8)
    image[:240] += 1
    for i in range(2):
        dots.save(root / f"frame-{i:06d}.color.png", image)
        dots.save(root / f"frame-{i:06d}.depth.png", deep(640, 480))
        np.savetxt(root / f"frame-{i:06d}.pose.txt", moved(i))


POSE = "frame-000001.pose.txt"
SEVEN_SCENES = (
    Fault("pose cut off", cut(POSE), (POSE,)),
    Fault("words in a pose", holds(POSE, "one two\n"), (POSE,)),
    Fault("NaN in a pose", lambda root: np.savetxt(root / POSE, NAN), ("frame-000001",)),
    Fault("pose is not a rotation", lambda root: np.savetxt(root / POSE, SKEW), (POSE,)),
    Fault("image missing", gone("frame-000001.color.png"), ("frame-000001",)),
    Fault("no poses", gone("frame-000000.pose.txt", POSE), ("DATA",)),
    Fault("depth image cut off", cut("frame-000001.depth.png"), ("frame-000001.depth.png",)),
    Fault(
        "wrong intrinsics",
        lambda root: np.savetxt(root / "camera-intrinsics.txt", np.eye(3)),
        ("camera-intrinsics.txt",),
    ),
)


def build_bop(root: Path) -> None:
    write_bop(tabletop(frames=2, width=WIDTH, height=HEIGHT, cameras=1), root)


CAMERA, GT = "scene_camera.json", "scene_gt.json"
BOP = (
    Fault("not JSON", holds(CAMERA, b"\x80\x04"), (CAMERA,)),
    Fault("cut off", cut(GT), (GT,)),
    Fault("no frames", holds(CAMERA, "{}"), ("DATA",)),
    Fault(
        "frame that is not a number",
        change(CAMERA, lambda c: c.update(first=c.pop("0"))),
        (CAMERA, "first"),
    ),
    Fault("K of 8 numbers", change(CAMERA, lambda c: c["1"]["cam_K"].pop()), (CAMERA, "'1'")),
    Fault("focal length of 0", change(CAMERA, lambda c: c["1"].update(cam_K=[0] * 9)), (CAMERA, "frame 1")),
    Fault("depth_scale of 0", change(CAMERA, lambda c: c["0"].update(depth_scale=0)), (CAMERA, "'0'")),
    Fault(
        "NaN in a camera pose",
        change(CAMERA, lambda c: c["1"].update(cam_t_w2c=[NAN[0][0]] * 3)),
        (CAMERA,),
    ),
    Fault(
        "object pose is not a rotation",
        change(GT, lambda g: g["1"][0].update(cam_R_m2c=[1] * 9)),
        (GT, "frame 1"),
    ),
    Fault(
        "no camera poses",
        change(CAMERA, lambda c: [v.pop("cam_R_w2c") for v in c.values()]),
        (CAMERA,),
    ),
    Fault("frame without a camera pose", change(CAMERA, lambda c: c["1"].pop("cam_R_w2c")), ("000001",)),
    Fault("several scenes", lambda root: build_bop(root / "000002") or (root / CAMERA).unlink(), ("000002",)),
    Fault(
        "several cameras", lambda root: (root / CAMERA).rename(root / "scene_camera_rgb.json"), ("_rgb.json",)
    ),
    Fault("all images missing", gone("rgb/000000.png", "rgb/000001.png"), ("DATA",)),
    Fault("image missing", gone("rgb/000001.png"), ("000001",)),
    Fault("image cut off", cut("rgb/000001.png"), ("rgb/000001.png",)),
    Fault("depth image missing", gone("depth/000001.png"), ("000001",)),
    Fault("8-bit depth", drawn("depth/000001.png", picture(0)[..., 0]), ("depth/000001.png",)),
    Fault("frame without annotations", change(GT, lambda g: g.pop("1")), ("000001",)),
    Fault("object not in all frames", change(GT, lambda g: g["1"].pop()), (GT, "obj_000015")),
    Fault("mask missing", gone("mask_visib/000001_000002.png"), ("mask_visib", "000001_000002.png")),
    Fault("mask cut off", cut("mask_visib/000001_000002.png"), ("mask_visib/000001_000002.png",)),
)


def build_paris(root: Path) -> None:
    write_paris(tabletop(frames=2, width=WIDTH, height=HEIGHT, cameras=2), root)
    hinge = {"axis": {"o": [0, 0, 0], "d": [0, 0, 1]}, "type": "rotate", "rotate": {"l": 0, "r": 30}}
    (root / "trans.json").write_text(json.dumps({"trans_info": hinge}))


END = "end/camera_train.json"
PARIS = (
    Fault("no second state", gone(END), (END,)),
    Fault("not JSON", holds(END, b"\x80\x04"), (END,)),
    Fault("cut off", cut(END), (END,)),
    Fault("no K", change(END, lambda c: c.pop("K")), (END, "'K'")),
    Fault("NaN as focal length", change(END, lambda c: c["K"][0].__setitem__(0, NAN[0][0])), (END,)),
    Fault("pose of the wrong shape", change(END, lambda c: c["0001"].pop()), (END, "'0001'")),
    Fault("NaN in a pose", change(END, lambda c: c.update({"0001": NAN})), ("0001",)),
    Fault("pose is not a rotation", change(END, lambda c: c.update({"0001": SKEW})), (END, "0001")),
    Fault("all images missing", gone("end/train/0000.png", "end/train/0001.png"), ("end/train",)),
    Fault("image missing", gone("end/train/0001.png"), ("0001",)),
    Fault("image cut off", cut("end/train/0001.png"), ("end/train/0001.png",)),
    Fault("wrong size", drawn("end/train/0001.png", picture(0, 16, 12)), ("end/train/0001.png",)),
    Fault("no names in common", change(END, lambda c: [c.pop(k) for k in ("0000", "0001")]), ("DATA",)),
    Fault("depth image missing", gone("end/train/depth/0001.png"), ("depth/0001.png",)),
    Fault(
        "joint without an axis", change("trans.json", lambda t: t["trans_info"].pop("axis")), ("trans.json",)
    ),
    Fault(
        "NaN in a joint",
        change("trans.json", lambda t: t["trans_info"]["axis"].update(o=NAN[0][:3])),
        ("trans.json",),
    ),
    Fault(
        "axis of length 0",
        change("trans.json", lambda t: t["trans_info"]["axis"].update(d=[0, 0, 0])),
        ("trans.json",),
    ),
)


def build_panoptic(root: Path) -> None:
    write_panoptic(tabletop(frames=2, width=WIDTH, height=HEIGHT, cameras=2), root)


def entry(key: str, value: object) -> Damage:
    def edit(meta: dict) -> None:
        meta[key][1][1] = value

    return change("train_meta.json", edit)


PANOPTIC = (
    Fault("not JSON", holds("train_meta.json", b"\x80\x04"), ("train_meta.json",)),
    Fault("no cameras", change("train_meta.json", lambda m: m.update(cam_id=[[], []])), ("train_meta.json",)),
    Fault("NaN in a pose", entry("w2c", NAN), ("train_meta.json", "frame 1")),
    Fault("pose of the wrong shape", entry("w2c", [1, 2]), ("train_meta.json",)),
    Fault("focal length of 0", entry("k", np.diag([0, 1, 1]).tolist()), ("train_meta.json", "frame 1")),
    Fault("image missing", gone("ims/1/000001.png"), ("ims/1/000001.png",)),
    Fault("image cut off", cut("ims/1/000001.png"), ("ims/1/000001.png",)),
    Fault("8-bit depth", drawn("depth/1/000001.png", picture(0)[..., 0]), ("depth/1/000001.png",)),
)


def build_record3d(root: Path) -> None:
    write_record3d(root, tabletop(frames=1, width=WIDTH, height=HEIGHT, cameras=3), (16, 12))


def meta(key: str, value: object) -> Damage:
    return change("metadata.json", lambda m: m.update({key: value}))


def in_frame(key: str, value: object) -> Damage:
    return change("metadata.json", lambda m: m[key].__setitem__(1, value))


def claims_size(side: int) -> Damage:
    def damage(root: Path) -> None:
        window, claimed = (struct.pack("<4i", 0, 0, x, y) for x, y in ((15, 11), (side - 1, side - 1)))
        content = (root / EXR).read_bytes()
        assert window in content
        (root / EXR).write_bytes(content.replace(window, claimed, 1))

    return damage


def turned(root: Path) -> None:
    for n in range(3):
        dots.save(root / f"rgb/{n}.png", picture(n, HEIGHT, WIDTH))


EXR, META = "depth/1.exr", "metadata.json"
RECORD3D = (
    Fault("metadata missing", gone(META), (META,)),
    Fault("metadata cut off", cut(META), (META,)),
    Fault("metadata is a list", holds(META, "[]"), (META,)),
    Fault("no poses", change(META, lambda m: m.pop("poses")), (META, "poses")),
    Fault("malformed poses", meta("poses", [[1, 2], [3]]), (META, "poses")),
    Fault("quaternion not normalised", in_frame("poses", [0, 0, 0, 2, 0, 0, 0]), (META, "frame 1")),
    Fault("NaN in a pose", in_frame("poses", [np.nan] * 7), ("DATA",)),
    Fault("all poses zero, as with the front camera", meta("poses", [[0] * 7] * 3), ("DATA",)),
    Fault("more pictures than poses", change(META, lambda m: m["poses"].pop()), ("DATA",)),
    Fault("no image size", change(META, lambda m: m.pop("w")), (META, "w")),
    Fault("times that do not increase", in_frame("frameTimestamps", 0.0), ("DATA",)),
    Fault("depth missing", gone(EXR), ("DATA",)),
    Fault("depth cut off", cut(EXR), (EXR,)),
    Fault("depth in another format", holds(EXR, b"PK\3\4"), (EXR,)),
    Fault("depth that claims a huge size", claims_size(100_000), (EXR,)),
    Fault("integer depth", lambda root: write_exr(root / EXR, R=np.ones((12, 16), np.uint32)), (EXR,)),
    Fault("depth of the wrong shape", lambda r: write_exr(r / EXR, R=np.ones((16, 12), np.float32)), (EXR,)),
    Fault("image missing", gone("rgb/1.png"), ("DATA",)),
    Fault("image cut off", cut("rgb/1.png"), ("rgb/1.png",)),
    Fault("wrong size", drawn("rgb/1.png", picture(0, 16, 12)), ("rgb/1.png",)),
    Fault("pictures rotated by 90 degrees", turned, ("rgb/0.png",)),
)


BAG = "desk.bag"


def build_realsense(root: Path) -> None:
    realsense(WIDTH, HEIGHT, frames=2).write(root / BAG)


def recorded(edit: Callable[[Messages], object]) -> Damage:
    def damage(root: Path) -> None:
        messages = realsense(WIDTH, HEIGHT, frames=2)
        edit(messages)
        messages.write(root / BAG)

    return damage


def without(*topics: str) -> Damage:
    return recorded(lambda messages: [messages.topics.pop(topic) for topic in topics])


def colored(encoding: str, bytes_of_pixel: int) -> Damage:
    pixels = np.zeros((HEIGHT, WIDTH, bytes_of_pixel), np.uint8)
    return recorded(lambda messages: messages.images(COLOR, encoding, [(0.03, pixels)]))


def late(messages: Messages) -> None:
    depth = np.full((HEIGHT, WIDTH), 1500, np.uint16)
    messages.images(DEPTH, "mono16", [(0.034, depth), (0.09, depth)], unit=0.001)


REALSENSE = (
    Fault("another format", holds(BAG, b"PK\3\4"), (BAG,)),
    Fault("cut off", cut(BAG), (BAG,)),
    Fault("no depth", without(f"{DEPTH}/image/data"), (BAG, "Depth_0")),
    Fault("no intrinsics", without(f"{COLOR}/info/camera_info"), (BAG, "Color_0")),
    Fault("no camera poses", without(f"{COLOR}/tf/0", f"{DEPTH}/tf/0"), (BAG, "tf/0")),
    Fault("compressed colour", colored("MJPEG", 3), (BAG,)),
    Fault("rows that are too short", colored("rgb8", 2), (BAG,)),
    Fault(
        "image size that does not match",
        recorded(lambda messages: messages.info(COLOR, np.eye(3), size=(64, 48))),
        (BAG,),
    ),
    Fault(
        "quaternion not normalised",
        recorded(lambda messages: messages.place(COLOR, quat=(0.0, 0.0, 0.0, 2.0))),
        (BAG,),
    ),
    Fault("late depth", recorded(late), (BAG,)),
)


def build_gaussians(root: Path) -> None:
    random = np.random.default_rng(0)
    shapes = ((3,), (4,), (3,), (), (1, 3))
    values = (jnp.asarray(random.normal(size=(5, *shape)), jnp.float32) for shape in shapes)
    write_ply(root / "scene.ply", Gaussians(*values))


SCENE = "scene.ply"
GAUSSIANS = (
    Fault("missing", gone(SCENE), (SCENE,)),
    Fault("another format", holds(SCENE, b"PK\3\4"), (SCENE,)),
    Fault("cut off", cut(SCENE, 0.9), (SCENE,)),
    Fault(
        "point cloud",
        lambda root: build_transforms(root) or (root / "points.ply").rename(root / SCENE),
        (SCENE,),
    ),
    Fault("no vertices", holds(SCENE, "ply\nformat ascii 1.0\nelement face 0\nend_header\n"), (SCENE,)),
)

RECORDINGS = {
    "Open3D RGB-D": Layout(build_open3d, lambda r: load_all(read_open3d(r, K)), OPEN3D),
    "TUM RGB-D": Layout(build_tum, lambda r: load_all(open_sequence(r)), TUM),
    "7-Scenes": Layout(build_seven_scenes, lambda r: load_all(open_sequence(r)), SEVEN_SCENES),
    "BOP": Layout(build_bop, lambda r: load_all(open_sequence(r)), BOP),
    "PARIS": Layout(build_paris, lambda r: load_all(open_sequence(r)), PARIS),
    "Panoptic": Layout(build_panoptic, lambda r: load_all(open_sequence(r)), PANOPTIC),
    "Record3D": Layout(build_record3d, lambda r: load_all(open_sequence(r)), RECORD3D),
    "RealSense": Layout(build_realsense, lambda r: load_all(open_sequence(r / BAG)), REALSENSE),
    "PLY of Gaussians": Layout(build_gaussians, lambda r: read_ply(r / SCENE), GAUSSIANS),
}
