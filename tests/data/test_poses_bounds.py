import cv2
import numpy as np
import pytest

from gsjax.data import DataError, DataWarning, read_dynerf, read_llff
from gsjax.data.poses_bounds import _read_rows
from gsjax.geometry.cameras import look_at
from tests.data import dots

WIDTH, HEIGHT, FOCAL = 96, 72, 100.0
POINTS = np.array([[0.5, 0.25, 0.0], [-0.6, 0.3, 0.4], [0.2, -0.5, -0.5]])
AXES = ("llff", "endonerf")
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])


def row(viewmat, axes, hwf=(HEIGHT, WIDTH, FOCAL)):
    """A row by definition: the columns of R are the camera's axes in the world, t is its position."""
    right, down, forward = viewmat[:3, :3]
    columns = {"llff": (down, right, -forward), "endonerf": (right, -down, -forward)}[axes]
    eye = -viewmat[:3, :3].T @ viewmat[:3, 3]
    return [*np.stack([*columns, eye, hwf], axis=-1).ravel(), 0.5, 9.0]


VIEWMATS = [look_at(np.array([0.5 * i, -4.0, 0.3 + i]), np.zeros(3)) for i in range(3)]


def build(root, axes, hwf=(HEIGHT, WIDTH, FOCAL), name="poses_bounds.npy"):
    root.mkdir(exist_ok=True)
    np.save(root / name, np.array([row(viewmat, axes, hwf) for viewmat in VIEWMATS]))
    for i, viewmat in enumerate(VIEWMATS):
        image = dots.draw(WIDTH, HEIGHT, [dots.project(K, viewmat, point) for point in POINTS])
        dots.save(root / f"images/{i:03d}.png", image)
    return root


def farthest(scene):
    return max(
        dots.offset(scene.image(i), dots.project(scene.Ks[i], scene.viewmats[i], point))
        for i in range(scene.num)
        for point in POINTS
    )


@pytest.mark.parametrize("axes", AXES)
@pytest.mark.parametrize("name", ["poses_bounds.npy", "pose_bounds.npy"])
def test_points_are_where_they_were_drawn(tmp_path, axes, name):
    scene = read_llff(build(tmp_path / "fern", axes, name=name), axes)
    assert (scene.name, scene.names) == ("fern", ("000.png", "001.png", "002.png"))
    np.testing.assert_allclose(scene.viewmats, VIEWMATS, atol=1e-12)
    np.testing.assert_allclose(scene.Ks[0], K)
    assert farthest(scene) < 0.06
    with pytest.raises(
        ValueError, match=r"axes must be the meaning .*'llff' \(down.*'endonerf' .*; got 'opengl'"
    ):
        _read_rows(tmp_path / "fern", "opengl")  # type checkers reject it, as do annotations under test


def test_the_other_axes_are_another_scene(tmp_path):
    right, wrong = (read_llff(build(tmp_path / "fern", "llff"), axes) for axes in AXES)
    assert np.abs(right.viewmats - wrong.viewmats).max() > 0.5


def test_photographs_may_be_smaller(tmp_path):
    scene = read_llff(build(tmp_path, "llff", hwf=(4 * HEIGHT, 4 * WIDTH, 4 * FOCAL)), "llff")
    np.testing.assert_allclose(scene.Ks[1], K)
    assert farthest(scene) < 0.06
    (tmp_path / "images").rename(tmp_path / "images_4")
    assert read_llff(tmp_path, "llff", "images_4").num == 3
    with pytest.raises(DataError, match=r"poses_bounds.npy: expected 3 photographs in .*images, .*found 0"):
        read_llff(tmp_path, "llff")
    dots.save(tmp_path / "images_4/001.png", np.zeros((WIDTH, HEIGHT, 3), np.uint8))
    with pytest.raises(
        DataError, match=r"001.png: expected 384x288 pixels .*found 72x96.*rotated by 90 degrees"
    ):
        read_llff(tmp_path, "llff", "images_4")


def test_more_or_fewer_photographs_than_rows(tmp_path):
    build(tmp_path, "llff")
    dots.save(tmp_path / "images/003.jpg", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    with pytest.raises(
        DataError, match=r"expected 3 photographs in .*, one per row, found 4\. Give the name of their folder"
    ):
        read_llff(tmp_path, "llff")
    for name in ("001.png", "003.jpg"):
        (tmp_path / f"images/{name}").unlink()
    with pytest.raises(DataError, match="found 2"):
        read_llff(tmp_path, "llff")


def changed(index, value):
    def change(rows):
        rows[1, index] = value
        return rows

    return change


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda rows: rows[:, :15], r"expected one array \[N,17\] of numbers, found shape \(3, 15\)"),
        (lambda rows: rows[0], r"found shape \(17,\)"),
        (lambda rows: rows[:0], r"found shape \(0, 17\)"),
        (lambda rows: rows.astype(str), r"found shape \(3, 17\) of <U"),
        (lambda rows: rows.astype(object), r"expected plain arrays, found bad data"),
        (changed(3, np.nan), r"expected finite numbers, found NaN or infinity in row 1"),
        (changed(16, np.inf), r"found NaN or infinity in row 1"),
        (
            changed(14, 0),
            r"expected height, width and focal length above 0, found \[72.0, 96.0, 0.0\] in row 1",
        ),
        (changed(4, -72), r"found \[-72.0, 96.0, 100.0\] in row 1"),
        (changed(4, 96), r"001.png: expected 96x96 pixels or a downscaled copy, found 96x72"),
        (changed([0, 5, 10], 0), r"pose of row 1 of .*poses_bounds.npy: R is not a rotation"),
        (changed([0, 1, 2, 5, 6, 7, 10, 11, 12], 0), r"pose of row 1 of .*: R is not a rotation"),
        (
            lambda rows: rows * np.where(np.arange(17) % 5 == 0, -1, 1),
            r"row 0 of .*reflection.*Is axes set",
        ),
    ],
)
def test_faults_of_a_file(tmp_path, change, says):
    build(tmp_path, "llff")
    file = tmp_path / "poses_bounds.npy"
    np.save(file, change(np.load(file)), allow_pickle=True)
    with pytest.raises(ValueError, match=says):
        read_llff(tmp_path, "llff")


def test_files_that_are_not_arrays(tmp_path):
    build(tmp_path, "llff")
    file = tmp_path / "poses_bounds.npy"
    content = file.read_bytes()
    for length in (0, 3, 20, 100, 130, len(content) - 1):
        file.write_bytes(content[:length])
        with pytest.raises(DataError, match=r"poses_bounds.npy: expected plain arrays, found bad data"):
            read_llff(tmp_path, "llff")
    file.write_bytes(content.replace(b"(3, 17)", b"(999999999999, 17)").replace(b" " * 11 + b"\n", b"\n"))
    with pytest.raises(DataError, match=r"poses_bounds.npy: expected plain arrays, found bad data"):
        read_llff(tmp_path, "llff")
    with file.open("wb") as several:
        np.savez(several, a=np.zeros(3))
    with pytest.raises(DataError, match="found several arrays"):
        read_llff(tmp_path, "llff")
    file.unlink()
    with pytest.raises(DataError, match=r"expected poses_bounds.npy, found no such file"):
        read_llff(tmp_path, "llff")


def film(path, frames, size=(WIDTH, HEIGHT)):
    """Frame t has grey level 20 + 40 t."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 25, size)
    for t in range(frames):
        writer.write(np.full((size[1], size[0], 3), 20 + 40 * t, np.uint8))
    writer.release()


def test_dynerf(tmp_path):
    build(tmp_path, "llff", hwf=(2 * HEIGHT, 2 * WIDTH, 2 * FOCAL))
    for camera, frames in ((0, 5), (3, 4), (11, 5)):
        film(tmp_path / f"cam{camera:02d}.mp4", frames)
    sequence = read_dynerf(tmp_path)
    assert (sequence.camera_ids, sequence.num_frames) == ((0, 3, 11), 4)
    np.testing.assert_allclose(sequence.times, np.arange(4) / 25)
    np.testing.assert_allclose(sequence.viewmats[2], VIEWMATS, atol=1e-12)
    np.testing.assert_allclose(sequence.Ks[3, 1], K)
    with pytest.warns(UserWarning, match="all of one colour"):
        assert abs(sequence.image(2, 1).mean() - 100) < 4
    film(tmp_path / "cam03.mp4", 4, size=(48, 36))
    with pytest.raises(DataError, match=r"cam03.mp4: expected 96x72 as in cam00.mp4, found 48x36"):
        read_dynerf(tmp_path)
    (tmp_path / "cam03.mp4").write_bytes(b"no film")
    with pytest.raises(DataError, match=r"cam03.mp4: expected a video, found a file that does not open"):
        read_dynerf(tmp_path)
    (tmp_path / "cam03.mp4").unlink()
    with pytest.raises(
        DataError, match=r"poses_bounds.npy: expected 3 videos cam\*.mp4, one per row, found 2"
    ):
        read_dynerf(tmp_path)


def test_the_tissue(shared_data):
    """The endoscope looks at the tissue: its tracked vertices lie in front of it, many of them in view."""
    scene = read_llff(shared_data / "tissue_0", "endonerf")
    vertices = np.load(shared_data / "tissue_0/truth.npz")["verts"]
    for i in (0, 30):
        local = vertices[i] @ scene.viewmats[i][:3, :3].T + scene.viewmats[i][:3, 3]
        assert (local[:, 2] > 0).all()
        pixels = local @ scene.Ks[i].T
        inside = (pixels[:, :2] > 0).all(-1) & (pixels[:, :2] < local[:, 2:] * scene.sizes[i]).all(-1)
        assert inside.mean() > 0.3


def test_what_is_transparent_is_white_as_the_background(tmp_path):
    root = build(tmp_path / "fern", "llff")
    assert read_llff(root, "llff").background is None
    clear = np.full((HEIGHT, WIDTH, 4), (255, 0, 255, 0), np.uint8)
    clear[:9] = 10, 20, 30, 255
    dots.save(root / "images/001.png", clear)
    scene = read_llff(root, "llff")
    assert scene.background == (1, 1, 1)
    assert (scene.image(1)[0, 0].tolist(), scene.image(1)[9:].min()) == ([10, 20, 30], 255)


def test_photographs_in_formats_that_are_not_read(tmp_path):
    root = build(tmp_path / "fern", "llff")
    (root / "images/003.HEIC").write_bytes(b"")
    with pytest.warns(DataWarning, match=r"of 4 pictures, 1 in a format .*\(HEIC: 003.HEIC\) are left out"):
        assert read_llff(root, "llff").num == 3
    for photograph in (root / "images").glob("*.png"):
        photograph.rename(photograph.with_suffix(".DNG"))
    with pytest.raises(DataError, match=r"images: expected pictures, found 4 in a format that is not read"):
        read_llff(root, "llff")
