import json

import cv2
import numpy as np
import pytest
from PIL import Image

from gsjax.data import DataError, DataWarning, open_photographs, read_transforms
from tests.data import dots

WIDTH, HEIGHT, FOCAL = 96, 72, 100.0
POINTS = np.array([[0.5, 0.25, 0.0], [-0.6, 0.3, 0.4], [0.2, -0.5, -0.5]])


def pose(x=0.0, y=0.0, z=4.0):
    """A pose in OpenGL axes: the camera looks along -z, with y up."""
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def pixel(point, eye, width=WIDTH, height=HEIGHT, focal=FOCAL):
    """The projection by hand: right of the axis is right in the photograph, above it is above."""
    right, up, back = point - eye
    return np.array([width / 2 + focal * right / -back, height / 2 - focal * up / -back])


class Folder:
    """Two photographs of three dots by a pinhole camera."""

    def __init__(self, root, size=(WIDTH, HEIGHT)):
        self.root = root
        self.meta = {
            "fl_x": FOCAL,
            "fl_y": FOCAL,
            "cx": size[0] / 2,
            "cy": size[1] / 2,
            "w": size[0],
            "h": size[1],
        }
        self.meta["frames"] = [self.add(f"images/{i}.png", (0.3 * i, 0.1 * i, 4.0), size) for i in range(2)]

    def add(self, name, eye, size=(WIDTH, HEIGHT), focal=FOCAL, ending=""):
        image = dots.draw(*size, [pixel(point, np.array(eye), *size, focal) for point in POINTS])
        dots.save(self.root / (name + ending), image)
        return {"file_path": name, "transform_matrix": pose(*eye).tolist()}

    def write(self, name="transforms.json"):
        (self.root / name).write_text(json.dumps(self.meta))

    def read(self, **options):
        self.write()
        return read_transforms(self.root, **options)


@pytest.fixture
def folder(tmp_path):
    return Folder(tmp_path / "garden")


def check_dots(scene, within=0.06):
    for i in range(scene.num):
        for point in POINTS:
            assert dots.offset(scene.image(i), dots.project(scene.Ks[i], scene.viewmats[i], point)) < within


def test_points_are_where_they_were_drawn(folder):
    scene = folder.read()
    assert (scene.name, scene.names) == ("garden", ("images/0.png", "images/1.png"))
    assert (scene.times, scene.splits, scene.cloud, scene.background) == (None, None, None, None)
    assert (scene.mask(0), scene.depth(0)) == (None, None)
    assert scene.where("image", 1) == str(folder.root / "images/1.png")
    np.testing.assert_allclose(dots.project(scene.Ks[0], scene.viewmats[0], POINTS[0]), [60.5, 29.75])
    check_dots(scene)


def test_angles_stand_for_focal_lengths(folder):
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        del folder.meta[key]
    folder.meta["camera_angle_x"] = 2 * np.arctan(WIDTH / 2 / FOCAL)
    check_dots(folder.read())
    folder.meta["camera_angle_y"] = 2 * np.arctan(HEIGHT / 2 / 50)
    np.testing.assert_allclose(np.diag(folder.read().Ks[0]), [FOCAL, 50, 1])


def test_each_frame_may_have_its_own_camera_and_size(folder):
    own = folder.add("images/2.png", (0, 0, 5), (120, 60), 150.0)
    folder.meta["frames"].append(own | {"fl_x": 150, "fl_y": 150, "w": 120, "h": 60, "cx": 60, "cy": 30})
    scene = folder.read()
    assert scene.sizes.tolist() == [[96, 72], [96, 72], [120, 60]]
    check_dots(scene)


def test_photographs_may_be_downscaled_copies(folder):
    folder.meta |= {key: 4 * folder.meta[key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
    check_dots(folder.read())
    check_dots(folder.read().scaled(0.7), within=0.2)
    folder.meta["h"] = WIDTH * 4
    with pytest.raises(DataError, match=r"transforms.json, frame 0: expected 384x384 pixels .*found 96x72"):
        folder.read()


@pytest.mark.parametrize("how", [{}, {"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}])
def test_distorted_photographs_are_straightened(folder, how):
    coeffs = (-0.03, 0.01, -0.002, 0.001) if how else (-0.2, 0.05, 0.003, -0.002)
    folder.meta |= dict(
        zip(("k1", "k2", "k3", "k4") if how else ("k1", "k2", "p1", "p2"), coeffs, strict=True)
    )
    folder.meta |= how
    K = np.array([[FOCAL, 0, WIDTH / 2 - 0.5], [0, FOCAL, HEIGHT / 2 - 0.5], [0, 0, 1]])  # OpenCV's
    for frame in folder.meta["frames"]:
        eye = np.array(frame["transform_matrix"])[:3, 3]
        rays = ((POINTS - eye) * [1, -1, -1]).reshape(-1, 1, 3)
        bend = cv2.fisheye.projectPoints if how else cv2.projectPoints
        pixels = bend(rays, np.zeros(3), np.zeros(3), K, np.array(coeffs))[0]
        dots.save(folder.root / frame["file_path"], dots.draw(WIDTH, HEIGHT, pixels.reshape(-1, 2) + 0.5))
        dots.save(folder.root / "mask.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
        dots.save(folder.root / "depth.png", np.full((HEIGHT, WIDTH), 1500, np.uint16))
        frame |= {"mask_path": "mask.png", "depth_file_path": "depth.png"}
    scene = folder.read()
    check_dots(scene, within=0.12)
    assert scene.mask(0).all()
    assert (scene.depth(1) == 1.5).all()


def test_masks_depths_splits_and_points(folder):
    half = np.zeros((HEIGHT, WIDTH), np.uint8)
    half[:, 50:] = 1
    depth = np.full((HEIGHT, WIDTH), 2000, np.uint16)
    depth[:2] = 0
    dots.save(folder.root / "masks/0.png", half)
    dots.save(folder.root / "depth/0.png", depth)
    folder.meta["frames"][0] |= {"mask_path": "masks/0.png", "depth_file_path": "depth/0.png"}
    folder.meta |= {"train_filenames": ["./images/1.png"], "val_filenames": ["images/0.png"]}
    folder.meta["ply_file_path"] = "sparse.ply"
    rows = "1 2 3 255 0 51\nnan 0 0 0 0 0\n4 5 6 0 0 0\n"
    head = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    colors = "".join(f"property uchar {color}\n" for color in ("red", "green", "blue"))
    (folder.root / "sparse.ply").write_text(head + colors + "end_header\n" + rows)
    scene = folder.read()
    np.testing.assert_array_equal(scene.mask(0), half > 0)
    assert set(np.unique(scene.depth(0))) == {0.0, 2.0}
    assert (scene.mask(1), scene.depth(1)) == (None, None)
    assert scene.splits == ("val", "train")
    np.testing.assert_allclose(scene.cloud.points, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(scene.cloud.colors, [[1, 0, 0.2], [0, 0, 0]])
    assert scene.where("depth", 0) == str(folder.root / "depth/0.png")
    assert folder.read(depth_unit_m=0.01).depth(0)[5, 5] == 20
    (folder.root / "sparse.ply").write_text(head + "end_header\n1 2 3\n4 5 6\n7 8 9\n")
    assert (folder.read().cloud.colors == 0.5).all()
    dots.save(folder.root / "depth/0.png", half)
    with pytest.raises(DataError, match=r"depth/0.png: expected depth as one 16-bit channel, found uint8"):
        scene.depth(0)
    (folder.root / "masks/0.png").unlink()
    with pytest.raises(DataError, match=r"masks/0.png: expected a mask, found no such file"):
        scene.mask(0)


def test_photographs_in_no_split_are_left_out_as_in_nerfstudio(folder):
    folder.meta["frames"] += [folder.add(f"images/{i}.png", (0.1 * i, 0, 4)) for i in (2, 3)]
    folder.meta |= {"train_filenames": ["images/1.png"], "test_filenames": ["./images/2.png"]}
    with pytest.warns(
        DataWarning, match="of 4 listed photographs, 2 in none of the train, val and test lists"
    ):
        scene = folder.read()
    assert (scene.names, scene.splits) == (("images/1.png", "images/2.png"), ("train", "test"))
    folder.meta["train_filenames"] = [f"images/{i}.png" for i in range(4)]
    assert folder.read().splits == ("train", "train", "test", "train")  # held-out photographs are not fitted
    folder.meta |= {"train_filenames": [], "test_filenames": []}
    assert folder.read().splits is None


def test_blender_leaves_out_extensions_and_has_times_and_transparency(tmp_path):
    folder = Folder(tmp_path / "lego")
    clear = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    clear[:] = 200, 100, 0, 51
    clear[:9] = 200, 100, 0, 255
    for number, split in enumerate(("train", "val", "test")):
        frame = folder.add(f"./{split}/r_0", (0.1 * number, 0, 4), ending=".png") | {"time": number / 2}
        folder.meta = {"camera_angle_x": 2 * np.arctan(WIDTH / 2 / FOCAL), "frames": [frame]}
        folder.write(f"transforms_{split}.json")
    scene = open_photographs(folder.root)
    assert scene.splits == ("train", "val", "test")
    assert scene.times.tolist() == [0, 0.5, 1]
    check_dots(scene)
    dots.save(folder.root / "train/r_0.png", clear)
    scene = read_transforms(folder.root)
    assert scene.background == (1, 1, 1)
    assert scene.image(0)[0, 0].tolist() == [200, 100, 0]
    assert scene.image(0)[20, 0].tolist() == [244, 224, 204]  # 0.2 of it, and 0.8 of white
    black = read_transforms(folder.root, background=(0, 0, 0.5))
    assert black.image(0)[20, 0].tolist() == [40, 20, 102]
    only = read_transforms(folder.root / "transforms_test.json")
    assert (only.num, only.splits) == (1, None)


def test_listed_photographs_without_file_or_pose_are_counted(folder):
    missing = [folder.meta["frames"][0] | {"file_path": f"images/gone{i}.png"} for i in range(4)]
    lost = folder.meta["frames"][0] | {"transform_matrix": np.full((4, 4), np.nan).tolist()}
    folder.meta["frames"] += [*missing, lost]
    files = r"of 7 listed photographs, 4 with no file \(images/gone0.png, .*, \.\.\.\)"
    with pytest.warns(DataWarning, match=rf"{files} and 1 without a finite pose"):
        assert folder.read().names == ("images/0.png", "images/1.png")
    folder.meta["frames"] = [*missing, lost]
    with pytest.raises(
        DataError, match=r"garden: expected a photograph with a pose, found 5 listed, 4 with no file"
    ):
        folder.read()


def test_exif_does_not_turn_a_photograph(folder):
    """Phones store the orientation in EXIF data; the calibration is for the stored pixels."""
    turned = Image.fromarray(np.tile(np.arange(WIDTH, dtype=np.uint8)[None, :, None] * 2, (HEIGHT, 1, 3)))
    exif = Image.Exif()
    exif[274] = 6
    for i, name in enumerate(("images/0.jpg", "images/1.png")):
        turned.save(folder.root / name, exif=exif)
        folder.meta["frames"][i]["file_path"] = name
    scene = folder.read()
    for i in range(2):
        assert scene.image(i).shape == (HEIGHT, WIDTH, 3)
        assert np.ptp(scene.image(i)[:, 50].astype(int)) < 5
        assert abs(int(scene.image(i)[0, 50, 0]) - 100) < 5


def with_frame(**changes):
    return lambda meta: meta["frames"][1].update(changes)


def with_all(**changes):
    return lambda meta: meta.update(changes)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (with_all(frames=[]), r"transforms.json: expected frames, a non-empty list, found none"),
        (with_all(frames={"a": 1}), r"expected frames, a non-empty list"),
        (with_all(frames=[3]), r"transforms.json, frame 0: expected file_path and transform_matrix, found 3"),
        (with_frame(file_path=None), r"frame 1: expected file_path"),
        (with_frame(transform_matrix=None), r"frame 1: expected transform_matrix, 4 rows of 4 numbers"),
        (with_frame(transform_matrix=[[1, 0], [0]]), r"4 rows of 4 numbers"),
        (with_frame(transform_matrix="eye"), r"4 rows of 4 numbers"),
        (
            with_frame(transform_matrix=np.zeros((4, 4)).tolist()),
            r"transforms.json, frame 1 \(images/1.png\): its last row is \[0. 0. 0. 0.\]. It must be a",
        ),
        (with_frame(transform_matrix=(2 * np.eye(4)).tolist()), r"frame 1 \(images/1.png\): its last row"),
        (
            with_frame(transform_matrix=np.diag([2.0, 2, 2, 1]).tolist()),
            r"1 \(images/1.png\): R is not a rot",
        ),
        (with_frame(fl_x=float("nan")), r"frame 1: expected fl_x, a number, found nan"),
        (with_frame(k1=float("inf")), r"frame 1: expected k1, a number, found inf"),
        (with_frame(cx="mid"), r"frame 1: expected cx, a number, found 'mid'"),
        (with_frame(time=[1]), r"frame 1: expected time, a number"),
        (with_frame(mask_path=3), r"frame 1: expected mask_path, a name, found 3"),
        (with_frame(depth_file_path=["a"]), r"frame 1: expected depth_file_path, a name"),
        (with_frame(fl_y=0), r"frame 1: expected focal lengths above 0, found 100 and 0"),
        (with_frame(fl_x=-1, k1=0.1), r"expected focal lengths above 0, found -1"),
        (with_frame(w=-96, h=-72), r"frame 1: expected a width and a height above 0, found -96x-72"),
        (with_frame(w=72, h=96), r"frame 1: expected 72x96 .*found 96x72.*rotated by 90 degrees"),
        (with_all(fl_x=None), r"frame 0: expected fl_x or camera_angle_x, found neither"),
        (
            with_all(camera_model="EQUIRECTANGULAR"),
            r"frame 0: .*OPENCV_FISHEYE, found EQUIRECTANGULAR. Undis",
        ),
        (with_all(camera_model=["OPENCV"]), r"expected camera_model to be one of .*found \['OPENCV'\]"),
        (with_all(k4=0.1), r"frame 0: expected k4 to be 0 except for a fisheye, found 0.1. Undistort"),
        (with_all(train_filenames=3), r"transforms.json: expected train_filenames, a list of names, found 3"),
        (with_all(test_filenames=[["a"]]), r"expected test_filenames, a list of names"),
        (
            with_all(val_filenames=["images/0.png"], test_filenames=["images/1.png"]),
            r"transforms.json: expected train_filenames as well as the other lists, found only val_filenames",
        ),
        (
            with_all(train_filenames=["images/0.png", "images/7.png"]),
            r"transforms.json: expected names of frames in train_filenames, .*found 1 that no frame has",
        ),
        (with_all(ply_file_path="gone.ply"), r"gone.ply: expected a point cloud, found no such file"),
        (with_all(ply_file_path=5), r"transforms.json: expected ply_file_path, the name of a file, found 5"),
        (with_all(ply_file_path=["a"]), r"transforms.json: expected ply_file_path, .* found \['a'\]"),
    ],
)
def test_faults_of_a_file(folder, change, says):
    change(folder.meta)
    with pytest.raises(ValueError, match=says):
        folder.read()


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("[]", r"expected frames, a non-empty list, found none"),
        ('{"frames": [', r"expected a JSON file, found bad JSON"),
        ("", r"expected a JSON file, found bad JSON"),
        (b"\xff\xfe\x80", r"expected a JSON file, found binary data"),
    ],
)
def test_invalid_files_are_refused(folder, content, says):
    folder.write()
    path = folder.root / "transforms.json"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(DataError, match=f"transforms.json: {says}"):
        read_transforms(folder.root)
    path.unlink()
    with pytest.raises(DataError, match=r"expected transforms.json or transforms_train.json, found images\."):
        read_transforms(folder.root)
    with pytest.raises(DataError, match=r"found nothing there"):
        read_transforms(folder.root / "nowhere")


def test_photographs_that_are_cut_off_or_change(folder):
    scene = folder.read()
    file = folder.root / "images/1.png"
    content = file.read_bytes()
    file.write_bytes(content[:-40])
    with pytest.raises(DataError, match=r"images/1.png: expected an image, found a file that is cut off"):
        scene.image(1)
    dots.save(file, np.zeros((10, 20, 3), np.uint8))
    with pytest.raises(DataError, match=r"images/1.png: expected 96x72 pixels, found 20x10"):
        scene.image(1)
    for bad in (b"", b"no image", content[:20]):
        file.write_bytes(bad)
        with pytest.raises(DataError, match=r"images/1.png: expected an image, found something else"):
            folder.read()


def test_the_fox(shared_data):
    with pytest.warns(DataWarning, match="of 67 listed photographs, 17 with no file"):
        scene = open_photographs(shared_data / "fox")
    assert scene.num == 50
    assert scene.scaled(0.1).image(0).shape == (192, 108, 3)
    centers = np.linalg.inv(scene.viewmats)[:, :3, 3]
    axes = scene.viewmats[:, 2, :3]  # cameras around an object face its centre
    assert (((centers.mean(0) + 5 * axes.mean(0) - centers) * axes).sum(-1) > 0).all()


def add_depth(folder, key, steps=1500):
    for i, frame in enumerate(folder.meta["frames"]):
        dots.save(folder.root / f"depth/{i}.png", np.full((HEIGHT, WIDTH), steps, np.uint16))
        frame[key] = f"depth/{i}.png"


@pytest.mark.parametrize("key", ["depth_path", "depth_file_path"])
@pytest.mark.parametrize("unit", ["integer_depth_scale", "depth_unit_scale_factor"])
def test_depth_of_instant_ngp_and_its_unit(folder, key, unit):
    add_depth(folder, key)
    folder.meta |= {unit: 0.002, "enable_depth_loading": True}
    np.testing.assert_allclose(folder.read().depth(1), 3.0)
    np.testing.assert_allclose(folder.read(depth_unit_m=0.004).depth(1), 6.0)  # the user knows better
    folder.meta["frames"][1][unit] = 0.001
    np.testing.assert_allclose(folder.read().depth(1), 1.5)
    folder.meta["enable_depth_loading"] = False
    assert folder.read().load_depth is None
    folder.meta[unit] = 0
    with pytest.raises(DataError, match=r"frame 0: expected integer_depth_scale or .* above 0, found 0"):
        folder.read()


def test_depth_of_instant_ngp_without_its_unit(folder):
    add_depth(folder, "depth_path")
    with pytest.warns(
        DataWarning, match=r"without integer_depth_scale: assuming 0.001 .*--read.depth-unit-m"
    ):
        scene = folder.read()
    np.testing.assert_allclose(scene.depth(0), 1.5)


def test_keys_that_look_like_data_are_named_if_they_are_not_read(folder):
    folder.meta["frames"][0] |= {"normal_path": "n.png", "colmap_im_id": 3, "sharpness": 40.0}
    folder.meta["frames"][1] |= {"extra": "images/0.png"}  # names a file
    folder.meta |= {"depth_scale": 5000, "k5": 0.1, "aabb_scale": 16, "scale": 0.3, "up": [0, 0, 1]}
    folder.meta |= {"applied_transform": np.eye(4)[:3].tolist(), "fps": 30, "tool": "mine"}
    with pytest.warns(
        DataWarning, match=r"transforms.json: these keys are not read: depth_scale, k5, "
    ) as seen:
        folder.read()
    assert "k5, normal_path (of 1 frames), extra (of 1 frames); give" in str(seen[0].message)
    assert len(seen) == 1


@pytest.mark.parametrize(("key", "model"), [("latlong", "LATLONG"), ("ftheta_p0", "FTHETA")])
def test_models_that_instant_ngp_marks_by_other_keys_are_refused(folder, key, model):
    folder.meta[key] = True
    with pytest.raises(DataError, match=rf"expected camera_model to be one of .*, found {model}"):
        folder.read()


def test_points_that_lie_beside_the_file(folder):
    (folder.root / "sparse_pc.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        "end_header\n1 2 3\n"
    )
    assert folder.read().cloud.points.tolist() == [[1, 2, 3]]
