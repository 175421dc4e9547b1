import random
import re
import shutil

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from gsjax.data import DataError, DataWarning, open_photographs, read_colmap
from tests.data import dots

pycolmap = pytest.importorskip("pycolmap")

WIDTH, HEIGHT = 96, 72
POINTS = np.array([[0.5, 0.25, 0.0], [-0.6, 0.3, 0.4], [0.2, -0.4, -0.5], [0.0, 0.0, 0.1]])
COLORS = np.array([[255, 0, 0], [0, 102, 0], [0, 0, 255], [51, 51, 51]], np.uint8)
NAMES = ("day/b 2.png", "a.png", "c.png")  # of images 7, 8, 9
CENTER = (49.0, 35.0)
MODELS = {
    "SIMPLE_PINHOLE": (90, *CENTER),
    "PINHOLE": (90, 94, *CENTER),
    "SIMPLE_RADIAL": (90, *CENTER, -0.2),
    "RADIAL": (90, *CENTER, -0.2, 0.05),
    "OPENCV": (90, 94, *CENTER, -0.2, 0.05, 0.004, -0.003),
    "OPENCV_FISHEYE": (90, 94, *CENTER, -0.03, 0.02, -0.01, 0.002),
    "FULL_OPENCV": (90, 94, *CENTER, 0.1, 0.02, 0.002, 0.001, 0.01, 0.3, 0.05, 0.01),
    "SIMPLE_RADIAL_FISHEYE": (90, *CENTER, -0.05),
    "RADIAL_FISHEYE": (90, *CENTER, -0.05, 0.02),
    "SIMPLE_FISHEYE": (90, *CENTER),
    "FISHEYE": (90, 94, *CENTER),
}


def build(root, form="bin", model="PINHOLE", params=None, place="sparse/0", points=POINTS, scale=1):
    """Three photographs of some dots by one camera, written and projected by COLMAP."""
    camera = pycolmap.Camera(
        model=model, width=WIDTH, height=HEIGHT, params=params or MODELS[model], camera_id=3
    )
    made = pycolmap.Reconstruction()
    made.add_camera_with_trivial_rig(camera)
    for i, name in enumerate(NAMES):
        turn = Rotation.from_euler("xyz", [0.1 * i, 0.05, 0.2 * i]).as_quat()
        motion = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), np.array([0.1 * i, 0.0, 3.0]))
        pixels = camera.img_from_cam(motion * POINTS)
        seen = pixels if i < 2 else np.zeros((0, 2))  # the last has an empty line of points
        image = pycolmap.Image(name=name, keypoints=seen, camera_id=3, image_id=7 + i)
        made.add_image_with_trivial_frame(image, motion)
        dots.save(root / "images" / name, dots.draw(WIDTH, HEIGHT, pixels))
    for i, point in enumerate(points):
        track = pycolmap.Track()
        track.add_element(7, i)
        made.add_point3D(point, track, COLORS[i])
    if scale > 1:  # as if the photographs had been downscaled after the reconstruction
        camera = made.cameras[3]
        camera.width, camera.height, camera.params = scale * WIDTH, scale * HEIGHT, scale * camera.params
    folder = root / place
    folder.mkdir(parents=True, exist_ok=True)
    made.write_text(folder) if form == "txt" else made.write_binary(folder)
    return made


@pytest.fixture(params=["bin", "txt"])
def form(request):
    return request.param


@pytest.mark.parametrize("model", MODELS)
def test_it_is_as_colmap_says(tmp_path, form, model):
    made = build(tmp_path / "room", form, model)
    scene = read_colmap(tmp_path / "room")
    assert (scene.name, scene.names) == ("room", tuple(sorted(NAMES)))
    for i, name in enumerate(scene.names):
        truth = made.find_image_with_name(name).cam_from_world().matrix()
        np.testing.assert_allclose(scene.viewmats[i][:3], truth, atol=1e-12)
        for point in POINTS:
            assert dots.offset(scene.image(i), dots.project(scene.Ks[i], scene.viewmats[i], point)) < 0.12
    if model.endswith("PINHOLE"):
        np.testing.assert_array_equal(scene.Ks[0], made.camera(3).calibration_matrix())
    order = np.argsort(scene.cloud.points[:, 0])
    np.testing.assert_array_equal(scene.cloud.points[order], POINTS[np.argsort(POINTS[:, 0])])
    np.testing.assert_allclose(scene.cloud.colors[order], COLORS[np.argsort(POINTS[:, 0])] / 255)


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_places(tmp_path, form, place):
    build(tmp_path, form, place=place)
    assert open_photographs(tmp_path).num == 3


def test_photographs_may_be_smaller_and_elsewhere(tmp_path, form):
    build(tmp_path, form, scale=4)
    shutil.move(tmp_path / "images", tmp_path / "images_4")
    scene = read_colmap(tmp_path, "images_4")
    np.testing.assert_allclose(scene.Ks[0], [[90, 0, 49], [0, 94, 35], [0, 0, 1]])
    assert dots.offset(scene.image(0), dots.project(scene.Ks[0], scene.viewmats[0], POINTS[0])) < 0.06
    with pytest.raises(
        DataError, match=r"0: expected registered photographs that .*, found 3 registered, 3 not in"
    ):
        read_colmap(tmp_path)
    dots.save(tmp_path / "images_4/a.png", np.zeros((96, 72, 3), np.uint8))
    with pytest.raises(
        DataError, match=r"a.png: expected 384x288 pixels .*found 72x96.*rotated by 90 degrees"
    ):
        read_colmap(tmp_path, "images_4")


def test_masks(tmp_path, form):
    build(tmp_path, form, "OPENCV")
    half = np.full((HEIGHT, WIDTH), 255, np.uint8)
    half[:, :40] = 0
    dots.save(tmp_path / "masks/a.png", half)
    dots.save(tmp_path / "masks/day/b 2.png.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    scene = read_colmap(tmp_path)
    assert scene.mask(0)[:, 45:].all()
    assert not scene.mask(0)[:, :35].any()
    assert scene.mask(1) is None
    assert not scene.mask(2).any()
    assert scene.where("mask", 2).endswith("b 2.png.png")


def test_exif_does_not_turn_a_photograph(tmp_path, form):
    """COLMAP calibrates the pixels as they are stored."""
    build(tmp_path, form)
    exif = Image.Exif()
    exif[274] = 6
    with Image.open(tmp_path / "images/a.png") as picture:
        picture.save(tmp_path / "images/a.png", exif=exif)
    scene = read_colmap(tmp_path)
    assert dots.offset(scene.image(0), dots.project(scene.Ks[0], scene.viewmats[0], POINTS[0])) < 0.06


def test_photographs_without_file_or_pose_are_counted(tmp_path):
    build(tmp_path, "txt")
    images = tmp_path / "sparse/0/images.txt"
    lines = images.read_text().splitlines()
    for i, line in enumerate(lines):
        if line.endswith(" c.png"):
            lines[i] = "9 0 0 0 0 1 2 3 3 c.png"  # no rotation
    images.write_text("\n".join(lines))
    (tmp_path / "images/a.png").unlink()
    with pytest.warns(
        DataWarning, match=r"of 3 .* 1 not in .* and 1 without a finite pose in images.txt \(c.png\)"
    ):
        assert read_colmap(tmp_path).names == ("day/b 2.png",)
    start = next(i for i, line in enumerate(lines) if line.endswith(" c.png"))
    images.write_text(lines[start] + "\n\n")
    with pytest.raises(DataError, match=r"1 registered, 1 without a finite pose .*Did the reconstruction"):
        read_colmap(tmp_path)


def test_points_may_be_missing_or_none(tmp_path, form):
    build(tmp_path, form, points=())
    assert read_colmap(tmp_path).cloud.points.shape == (0, 3)
    (tmp_path / f"sparse/0/points3D.{form}").unlink()
    assert read_colmap(tmp_path).cloud is None
    (tmp_path / f"sparse/0/images.{form}").unlink()
    with pytest.raises(DataError, match=r"expected cameras.bin or cameras.txt in sparse/0, sparse or here"):
        read_colmap(tmp_path)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_binary_files_that_are_cut_off_anywhere(tmp_path, name):
    build(tmp_path)
    file = tmp_path / f"sparse/0/{name}.bin"
    content = file.read_bytes()
    for length in range(len(content)):
        file.write_bytes(content[:length])
        with pytest.raises(
            DataError, match=rf"{name}.bin: expected a (complete )?COLMAP file, found .*truncated"
        ):
            read_colmap(tmp_path)


@pytest.mark.filterwarnings("ignore::gsjax.data.DataWarning")
@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.slow
def test_damaged_files_are_reported_or_read(tmp_path, form, name):
    """Whichever byte changes, the reader returns something of the right shape, or names the file."""
    build(tmp_path, form, "OPENCV")
    file = tmp_path / f"sparse/0/{name}.{form}"
    content, dice = file.read_bytes(), random.Random(0)
    messages = []
    for _ in range(150):
        damaged = bytearray(content)
        damaged[dice.randrange(len(content))] = dice.randrange(256)
        shorter = dice.randrange(len(content)) if form == "txt" and dice.random() < 0.3 else None
        file.write_bytes(damaged[:shorter])
        try:
            assert 1 <= read_colmap(tmp_path).num <= 3
        except ValueError as error:
            messages.append(str(error))
    assert 5 <= len(messages) < 150
    assert all(str(tmp_path) in text or text.startswith(("viewmat of ", "K of ")) for text in messages)


@pytest.mark.parametrize(
    ("model", "params", "number"),
    [
        ("FOV", (90, 94, *CENTER, 0.5), "FOV"),
        ("THIN_PRISM_FISHEYE", (90, 94, *CENTER, *[0.01] * 8), "THIN_PRISM_FISHEYE"),
        ("EUCM", (90, 94, *CENTER, 0.5, 1.0), "id 16"),
    ],
)
def test_models_that_opencv_does_not_have(tmp_path, form, model, params, number):
    build(tmp_path, form, model, params)
    found = model if form == "txt" else number
    with pytest.raises(
        DataError, match=rf"cameras.{form}: expected .*, found {found}\. .*Run COLMAP's image_und"
    ):
        read_colmap(tmp_path)


def swap(old, new, count=1):
    return lambda text: text.replace(old, new, count)


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("cameras", swap("PINHOLE", "MAGIC"), r"found MAGIC. Run COLMAP's image_undistorter"),
        (
            "cameras",
            swap("PINHOLE 96 72", "PINHOLE 96"),
            r"cameras.txt, line 4: expected 4 parameters of PINHOLE, .* 3",
        ),
        (
            "cameras",
            swap("96 72", "96 wide"),
            r"line 4: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, found '3 PINH",
        ),
        ("cameras", swap("96 72", "0 0"), r"a.png: expected a width and a height above 0, found 0x0"),
        (
            "cameras",
            swap("90 94", "nan 94"),
            r"finite parameters with a positive focal length, found PINHOLE \[nan",
        ),
        ("cameras", swap("90 94", "90 -94"), r"positive focal length, found PINHOLE \[90.0, -94.0"),
        (
            "cameras",
            swap("3 PINHOLE", "4 PINHOLE"),
            r"images.txt: expected one of the cameras \[4\], found 3 for a.png",
        ),
        ("cameras", lambda text: "", r"cameras.txt: expected at least one entry, found none"),
        (
            "images",
            lambda text: "# none\n",
            r"images.txt: expected at least one entry, found none. Did the reconstruction fail",
        ),
        ("images", swap(" a.png", ""), r"images.txt, line 7: expected IMAGE_ID QW .*NAME, found '8 "),
        ("images", swap(" 3 a.png", " x a.png"), r"images.txt, line 7: expected IMAGE_ID"),
        (
            "images",
            lambda text: re.sub(r"\n8 .* 3 a.png", "\n8 2 0 0 0 1 2 3 3 a.png", text),
            r"images.txt, line 7, a.png: expected a quaternion of length 1, found one of length 2",
        ),
        (
            "points3D",
            lambda text: text + "5 1 2 3\n",
            r"points3D.txt, line 8: expected POINT3D_ID X Y Z R G B ERROR",
        ),
        ("points3D", lambda text: text + "5 1 2 z 4 5 6 7\n", r"points3D.txt, line 8: .*found '5 1 2 z"),
    ],
)
def test_what_is_wrong_with_text(tmp_path, name, change, says):
    build(tmp_path, "txt")
    file = tmp_path / f"sparse/0/{name}.txt"
    file.write_text(change(file.read_text()))
    with pytest.raises(DataError, match=says):
        read_colmap(tmp_path)


@pytest.mark.parametrize(
    ("name", "at", "raw", "says"),
    [
        (
            "cameras",
            12,
            b"\x63",
            r"cameras.bin: expected one of the camera model ids \[0, 1, .*found id 99\. The file may",
        ),
        ("cameras", 0, b"\xff" * 8, r"cameras.bin: .*found 18446744073709551615 items announced in 64 bytes"),
        ("cameras", 16, b"\0" * 8, r"a.png: expected a width and a height above 0, found 0x72"),
        ("images", 0, b"\xff" * 7, r"images.bin: .*items announced in \d+ bytes"),
        ("images", 0, b"\0", r"images.bin: expected at least one entry, found none"),
        ("points3D", 6, b"\x01", r"points3D.bin: .*items announced"),
    ],
)
def test_what_is_wrong_with_bytes(tmp_path, name, at, raw, says):
    build(tmp_path)
    file = tmp_path / f"sparse/0/{name}.bin"
    content = bytearray(file.read_bytes())
    content[at : at + len(raw)] = raw
    file.write_bytes(content)
    with pytest.raises(DataError, match=says):
        read_colmap(tmp_path)


def test_what_is_transparent_is_white_as_the_background(tmp_path, form):
    build(tmp_path, form, "OPENCV")
    assert read_colmap(tmp_path).background is None
    clear = np.full((HEIGHT, WIDTH, 4), (255, 0, 255, 0), np.uint8)
    clear[:, :30] = 10, 20, 30, 255
    dots.save(tmp_path / "images/c.png", clear)
    scene = read_colmap(tmp_path)
    assert scene.background == (1, 1, 1)
    assert scene.image(1)[20, 5].tolist() == [10, 20, 30]
    assert (scene.image(1)[:, 40:] == 255).all()
    assert scene.image(0).max() > 200


def test_the_folder_of_the_reconstruction_alone_points_above(tmp_path):
    build(tmp_path)
    with pytest.raises(
        DataError, match=rf"Give the folder above, which has them: {re.escape(str(tmp_path))}\."
    ):
        open_photographs(tmp_path / "sparse/0")
