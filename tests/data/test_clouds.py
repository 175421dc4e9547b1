import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from gsjax.data import DataError
from gsjax.data.clouds import read_cloud

AXES = "property float x\nproperty float y\nproperty float z\n"


def header(count, properties=AXES, form="ascii"):
    return f"ply\nformat {form} 1.0\nelement vertex {count}\n{properties}end_header\n"


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize(("kind", "top"), [("u1", 255), ("f4", 1)])
def test_points_and_colours(tmp_path, text, kind, top):
    names = [("x", "f8"), ("y", "f8"), ("z", "f8"), *((color, kind) for color in ("red", "green", "blue"))]
    rows = [(1, 2, 3, top, 0, 0), (np.nan, 0, 0, 0, 0, 0), (4, 5, 6, 0, 0, top), (0, np.inf, 0, 0, 0, 0)]
    file = tmp_path / "points.ply"
    PlyData([PlyElement.describe(np.array(rows, names), "vertex")], text=text).write(file)
    cloud = read_cloud(file)
    np.testing.assert_allclose(cloud.points, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(cloud.colors, [[1, 0, 0], [0, 0, 1]])


def test_points_without_colour_are_grey(tmp_path):
    (tmp_path / "points.ply").write_text(header(1) + "1 2 3\n")
    assert read_cloud(tmp_path / "points.ply").colors.tolist() == [[0.5, 0.5, 0.5]]


@pytest.mark.parametrize(
    "content",
    [
        "",
        "no ply",
        header(2, "property float x\n") + "1\n2\n",
        header(0).replace("vertex", "face"),
        header(1, "property list uchar float x\nproperty float y\nproperty float z\n") + "2 1 2 3 4\n",
        header(2) + "1 2 3\n",
        header(1) + "a b c\n",
        header(-1),
        header("many"),
        header(9, form="binary_little_endian") + "\0\0\0",
        header(99999999999999, form="binary_little_endian") + "\0\0\0",
        header(10**30, form="binary_little_endian") + "\0\0\0",
        header(99999999999999999) + "1 2 3\n",
        header(10**30) + "1 2 3\n",
        header(1).removesuffix("end_header\n"),
        "ply\n\xff\xfe\n",
    ],
)
def test_files_that_are_no_points(tmp_path, content):
    file = tmp_path / "points.ply"
    file.write_bytes(content.encode("latin-1"))
    with pytest.raises(
        DataError, match=r"points.ply: expected a PLY file with x, y, z, found something else"
    ):
        read_cloud(file)
    with pytest.raises(DataError, match=r"expected a point cloud, found no such file"):
        read_cloud(tmp_path)
