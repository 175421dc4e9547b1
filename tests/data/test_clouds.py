import io

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from benchmarks.fuzz_files import bounded
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


BYTES = np.array([[255, 0, 51], [0, 102, 255]])


@pytest.mark.parametrize(
    ("names", "kind", "values"),
    [
        (("red", "green", "blue"), "u1", BYTES),
        (("red", "green", "blue"), "i1", BYTES.astype(np.uint8).view(np.int8)),
        (("red", "green", "blue"), "u2", 257 * BYTES),
        (("red", "green", "blue"), "u2", BYTES),
        (("red", "green", "blue"), "i4", BYTES),
        (("red", "green", "blue"), "u4", 16843009 * BYTES),
        (("red", "green", "blue"), "f4", BYTES),
        (("red", "green", "blue"), "f8", BYTES / 255),
        (("red", "green", "blue"), "f4", 257.0 * BYTES),
        (("r", "g", "b"), "u1", BYTES),
        (("R", "G", "B"), "u1", BYTES),
        (("Red", "Green", "Blue"), "f4", BYTES / 255),
        (("diffuse_red", "diffuse_green", "diffuse_blue"), "u1", BYTES),
        (("f_dc_0", "f_dc_1", "f_dc_2"), "f4", (BYTES / 255 - 0.5) / 0.28209479),
    ],
)
@pytest.mark.parametrize("text", [True, False])
def test_colours_of_other_tools(tmp_path, text, names, kind, values):
    layout = [*((axis, "f4") for axis in "xyz"), *((name, kind) for name in names), ("alpha", "u1")]
    rows = np.array([(*range(3), *color, 7) for color in values], layout)
    PlyData([PlyElement.describe(rows, "vertex")], text=text).write(tmp_path / "points.ply")
    np.testing.assert_allclose(read_cloud(tmp_path / "points.ply").colors, BYTES / 255, atol=1e-6)


@pytest.mark.parametrize(("name", "kind"), [("intensity", "u2"), ("scalar_Intensity", "f4")])
def test_intensities_are_grey(tmp_path, name, kind):
    rows = np.array(
        [(0, 0, 0, 65535), (0, 0, 1, 13107)], [("x", "f4"), ("y", "f4"), ("z", "f4"), (name, kind)]
    )
    PlyData([PlyElement.describe(rows, "vertex")]).write(tmp_path / "points.ply")
    np.testing.assert_allclose(read_cloud(tmp_path / "points.ply").colors, [[1, 1, 1], [0.2, 0.2, 0.2]])


PCD = """# .PCD v0.7
VERSION 0.7
FIELDS x y z {name}
SIZE 4 4 4 4
TYPE F f F {kind}
COUNT 1 1 1 1
WIDTH 2
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 2
DATA {data}
"""
POINTS = np.array([[1.0, 2.0, 3.0], [4.0, 5.5, 6.0]])


def lines_of(points, separator=" "):
    return "".join(separator.join(f"{value:g}" for value in row) + "\n" for row in points)


def packed(kind):
    return (BYTES @ [65536, 256, 1]).astype("<u4").view({"F": "<f4", "U": "<u4"}[kind])


def pcd_text(kind):
    rows = zip(POINTS, packed(kind), strict=True)
    return PCD.format(name="rgb", kind=kind, data="ascii") + "".join(
        f"{x:g} {y:g} {z:g} {color!r}\n" for (x, y, z), color in ((p, c.item()) for p, c in rows)
    )


def pcd_bytes(kind):
    layout = [("xyz", "<f4", 3), ("color", packed(kind).dtype)]
    rows = np.array([*zip(POINTS, packed(kind), strict=True)], layout)
    return PCD.format(name="rgb", kind=kind, data="binary").encode() + rows.tobytes()


def npy(array):
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


COLORED = np.concatenate([POINTS, BYTES], axis=1)
NORMALS = np.array([[0, 0, -1.0], [1, 0, 0]])


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.xyz", lines_of(COLORED)),
        ("a.txt", "\ufeffX Y Z R G B\n" + lines_of(COLORED)),
        ("a.csv", "//X,Y,Z,R,G,B\n" + lines_of(COLORED, ",")),
        ("a.asc", lines_of(np.concatenate([POINTS, NORMALS, BYTES], axis=1))),
        ("a.xyz", lines_of(np.concatenate([POINTS, BYTES, NORMALS], axis=1))),
        ("a.pts", "2\n" + lines_of(np.insert(COLORED, 3, -1200, axis=1))),
        ("a.npy", npy(COLORED)),
        ("a.npy", npy(np.concatenate([POINTS, BYTES / 255], axis=1))),
        ("a.pcd", pcd_text("F")),
        ("a.PCD", pcd_text("U")),
        ("a.pcd", pcd_bytes("F")),
        ("a.pcd", pcd_bytes("U")),
    ],
)
def test_points_in_other_files(tmp_path, name, content):
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    cloud = read_cloud(tmp_path / name)
    np.testing.assert_allclose(cloud.points, POINTS)
    np.testing.assert_allclose(cloud.colors, BYTES / 255, atol=1e-6)


def with_commas(text):
    return text.replace(".", ",")


DECIMAL = np.array([[1.5, 2.5, 3.5], [4.5, 5.5, 6.0]])


@pytest.mark.parametrize(
    "content",
    [
        with_commas(lines_of(DECIMAL, ";")),
        with_commas(lines_of(DECIMAL, " ")),
        with_commas(lines_of(DECIMAL, "\t")),
        "x;y;z\n" + with_commas(lines_of(DECIMAL, "; ")),
        '"1,5","2,5","3,5"\n"4,5","5,5","6"\n',
        '"x","y","z"\n"1.5","2.5","3.5"\n"4.5","5.5","6"\n',
        "id,x,y,z\n1,1.5,2.5,3.5\n2,4.5,5.5,6\n",
        "// z y x\n3.5 2.5 1.5\n6 5.5 4.5\n",
        "X [m], Y [m], Z [m], Error (px)\n1.5, 2.5, 3.5, 9\n4.5, 5.5, 6, 9\n",
        lines_of(DECIMAL).encode("utf-16"),
        "# a scan of the house\n1.5 2.5 3.5\n# a comment\n4.5 5.5 6\n",
        lines_of(DECIMAL).replace("\n", "\r\n"),
    ],
)
def test_text_of_any_system(tmp_path, content):
    (tmp_path / "a.csv").write_bytes(content if isinstance(content, bytes) else content.encode())
    cloud = read_cloud(tmp_path / "a.csv")
    np.testing.assert_allclose(cloud.points, DECIMAL)
    assert (cloud.colors == 0.5).all()


def test_colours_by_the_names_in_a_header(tmp_path):
    rows = np.concatenate([POINTS, NORMALS, BYTES[:, ::-1]], axis=1)
    (tmp_path / "a.txt").write_text("X;Y;Z;NX;NY;NZ;B;G;R\n" + lines_of(rows, ";"))
    np.testing.assert_allclose(read_cloud(tmp_path / "a.txt").colors, BYTES / 255)


@pytest.mark.parametrize("bracket", "([")
def test_brackets_that_are_never_closed_take_no_time(tmp_path, bracket):
    (tmp_path / "a.xyz").write_text(f"x y z {bracket * 200_000}\n1 2 3\n")
    with pytest.raises(DataError, match="a header of 4 names above rows of 3 numbers"), bounded():
        read_cloud(tmp_path / "a.xyz")


def test_files_without_colours_are_grey(tmp_path):
    (tmp_path / "a.xyz").write_text(lines_of(np.concatenate([POINTS, NORMALS], axis=1)))
    np.save(tmp_path / "a.npy", POINTS)
    for name in ("a.xyz", "a.npy"):
        assert (read_cloud(tmp_path / name).colors == 0.5).all()


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.xyz", "", "lines of text with x, y, z"),
        ("a.xyz", "1 2\n", "lines of text with x, y, z"),
        ("a.xyz", "1 2 3\n4 5\n", r"something else \(rows of 3 numbers, and of 2: 4 5\)"),
        ("a.xyz", "9\n  \n", "no row of numbers"),
        ("a.xyz", "1 2 3 tree\n", "could not convert string to float: 'tree'"),
        ("a.csv", "id,x,y,z,label\n1,1,2,3,\n", "a header of 5 names above rows of 4 numbers"),
        ("a.xyz", b"\0\0\0", "zero bytes"),
        ("a.npy", "no array", "an array with x, y, z"),
        ("a.npy", npy(np.array([{}])), "an array with x, y, z"),
        ("a.npy", npy(np.zeros(3)), "an array with x, y, z"),
        ("a.pcd", "", "a PCD file with x, y, z"),
        ("a.pcd", PCD.format(name="rgb", kind="F", data="ascii"), "a PCD file with x, y, z"),
        ("a.pcd", pcd_bytes("F")[:-3], "a PCD file with x, y, z"),
        ("a.pcd", pcd_bytes("F").replace(b"POINTS 2", b"POINTS 99999999999999999999"), "a PCD file"),
        ("a.pcd", PCD.format(name="rgb", kind="F", data="binary_compressed"), "save it as binary"),
        ("a.pcd", PCD.format(name="rgb", kind="Q", data="binary"), "a PCD file"),
        ("a.pcd", pcd_bytes("F").replace(b"COUNT 1", b"COUNT 0"), "COUNT 0 1 1 1"),
    ],
)
def test_other_files_that_are_no_points(tmp_path, name, content, says):
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(DataError, match=says):
        read_cloud(tmp_path / name)


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


@pytest.mark.parametrize("kind", ["F" + "9" * 5001, "F,F", "V"])
def test_a_pcd_of_no_type(tmp_path, kind):
    path = tmp_path / "points.pcd"
    path.write_text(PCD.format(name="rgb", kind=kind, data="ascii") + "1 2 3 4\n")
    with pytest.raises(DataError, match=r"TYPE and SIZE <[FV]") as refused:
        read_cloud(path)
    assert len(str(refused.value)) < 500
