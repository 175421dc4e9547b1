"""PLY: scenes are read back as written, in the channel order of 3DGS; other files are refused."""

import io
import warnings

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement

from gsjax.geometry.spherical_harmonics import num_sh_bases
from gsjax.io.ply import PlyError, read_ply, write_ply
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.origin import in_world


def random_gaussians(count, degree=0, features=0, seed=0):
    rng = np.random.default_rng(seed)

    def draw(*shape):
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    rest = num_sh_bases(degree) - 1
    return Gaussians(
        means=draw(count, 3),
        quats=draw(count, 4),
        log_scales=draw(count, 3),
        logit_opacities=draw(count),
        sh0=draw(count, 1, 3),
        shN=draw(count, rest, 3) if rest else None,
        features=draw(count, features) if features else None,
    )


def assert_same(a, b):
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN", "features"):
        left, right = getattr(a, name), getattr(b, name)
        assert (left is None) == (right is None), name
        if left is not None:
            np.testing.assert_array_equal(left, right, err_msg=name)


@pytest.mark.thorough
@settings(max_examples=25, deadline=None)
@given(
    count=st.integers(0, 20), degree=st.integers(0, 3), features=st.integers(0, 4), seed=st.integers(0, 2**31)
)
def test_round_trip_is_exact(tmp_path_factory, count, degree, features, seed):
    path = tmp_path_factory.mktemp("ply") / "scene.ply"
    gaussians = random_gaussians(count, degree, features, seed)
    write_ply(path, gaussians)
    loaded, report = read_ply(path)
    assert_same(gaussians, loaded)
    assert (report.stored, report.culled, report.extra) == (count, 0, ())


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_f_rest_is_channel_major(tmp_path, degree):
    path = tmp_path / "scene.ply"
    gaussians = random_gaussians(3, degree)
    write_ply(path, gaussians)
    vertices = PlyData.read(str(path))["vertex"].data
    per_channel = num_sh_bases(degree) - 1
    for channel in range(3):
        for basis in range(per_channel):
            stored = vertices[f"f_rest_{channel * per_channel + basis}"]
            np.testing.assert_array_equal(stored, gaussians.shN[:, basis, channel])


@pytest.mark.parametrize("labels", [None, np.arange(1)])
def test_properties_are_floats_in_the_order_of_3dgs(tmp_path, labels):
    write_ply(tmp_path / "scene.ply", random_gaussians(1, degree=1), labels=labels)
    header = (tmp_path / "scene.ply").read_bytes().split(b"end_header")[0].decode()
    rest = [f"f_rest_{i}" for i in range(9)]
    assert [line for line in header.splitlines() if line.startswith("property")] == [
        f"property float {name}"
        for name in [
            *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
            *rest,
            *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
        ]
    ]


def test_trimesh_opens_it_as_points(tmp_path):
    gaussians = random_gaussians(9, degree=2)
    write_ply(tmp_path / "scene.ply", gaussians)
    opened = trimesh.load(tmp_path / "scene.ply")
    assert isinstance(opened, trimesh.PointCloud)
    np.testing.assert_array_equal(opened.vertices, gaussians.means)
    fields = opened.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(np.ravel(fields["opacity"]), gaussians.logit_opacities)
    np.testing.assert_array_equal(np.ravel(fields["scale_1"]), gaussians.log_scales[:, 1])


@pytest.mark.parametrize(("text", "byte_order"), [(True, "="), (False, ">"), (False, "<")])
def test_reads_ascii_and_both_byte_orders_with_extra_fields(tmp_path, text, byte_order):
    path = tmp_path / "scene.ply"
    gaussians = random_gaussians(7, degree=1)
    write_ply(path, gaussians)
    vertices = PlyData.read(str(path))["vertex"].data
    wider = np.empty(7, [*vertices.dtype.descr, ("confidence", "f8"), ("red", "u1")])
    for name in vertices.dtype.names:
        wider[name] = vertices[name]
    wider["confidence"], wider["red"] = 0.5, 7
    faces = np.empty(0, [("vertex_indices", "i4", (3,))])
    elements = [PlyElement.describe(wider, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements, text=text, byte_order=byte_order).write(str(path))
    loaded, report = read_ply(path)
    np.testing.assert_allclose(loaded.shN, gaussians.shN, rtol=1e-6)
    np.testing.assert_allclose(loaded.quats, gaussians.quats, rtol=1e-6)
    assert report.extra == ("confidence", "red")


def test_rows_that_cannot_be_drawn_are_culled_and_counted(tmp_path):
    gaussians = random_gaussians(6)
    gaussians = Gaussians(
        means=gaussians.means.at[1, 0].set(jnp.nan),
        quats=gaussians.quats.at[3].set(0.0),
        log_scales=gaussians.log_scales.at[4, 2].set(jnp.inf),
        logit_opacities=gaussians.logit_opacities,
        sh0=gaussians.sh0,
    )
    write_ply(tmp_path / "scene.ply", gaussians, labels=np.arange(6))
    with pytest.warns(UserWarning, match=r"scene\.ply: 3 of 6 Gaussians cannot be drawn .* are left out"):
        loaded, report = read_ply(tmp_path / "scene.ply")
    assert (report.stored, report.culled) == (6, 3)
    np.testing.assert_array_equal(report.labels, [0, 2, 5])
    np.testing.assert_array_equal(report.rows, [0, 2, 5])
    np.testing.assert_array_equal(loaded.means, gaussians.means[jnp.array([0, 2, 5])])


def changed(path, gaussians, **columns):
    """Writes a PLY of these Gaussians with the named properties replaced, in the types of `columns`."""
    write_ply(path, gaussians)
    old = PlyData.read(str(path), mmap=False)["vertex"].data
    types = {name: old.dtype[name] for name in old.dtype.names}
    types |= {name: column.dtype for name, column in columns.items()}
    new = np.empty(gaussians.num, list(types.items()))
    for name in types:
        new[name] = columns[name] if name in columns else old[name]
    PlyData([PlyElement.describe(new, "vertex")]).write(str(path))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_infinities_that_mean_something_are_drawn_as_what_they_mean(tmp_path, dtype):
    path, gaussians = tmp_path / "scene.ply", random_gaussians(5)
    logits = np.array([np.inf, -np.inf, 0.5, np.nan, 1e300 if dtype is np.float64 else np.inf], dtype)
    flat = np.array([0.0, 0, -np.inf, 0, -1], dtype)
    changed(path, gaussians, opacity=logits, scale_1=flat)
    with pytest.warns(UserWarning, match=r"1 of 5 .* cannot be drawn .* and 1 of 5 .* are invisible"):
        loaded, report = read_ply(path)
    assert (report.stored, report.culled, report.invisible) == (5, 1, 1)
    np.testing.assert_array_equal(report.rows, [0, 2, 4])
    np.testing.assert_allclose(loaded.opacities, [1, 0.62246, 1], atol=2e-6)
    np.testing.assert_allclose(loaded.scales[:, 1], [1, 0, np.exp(-1)], atol=1e-9)
    assert np.isfinite(loaded.log_scales).all()
    assert np.isfinite(loaded.logit_opacities).all()


@pytest.mark.parametrize(
    ("name", "value"), [("x", -np.inf), ("scale_0", np.inf), ("f_dc_1", np.inf), ("rot_0", -np.inf)]
)
def test_other_infinities_cannot_be_drawn(tmp_path, name, value):
    path = tmp_path / "scene.ply"
    changed(path, random_gaussians(2), **{name: np.array([0.5, value], np.float32)})
    with pytest.warns(UserWarning, match="1 of 2 Gaussians cannot be drawn"):
        assert read_ply(path)[1].culled == 1


UTM = np.array([500_000.0, 5_000_000.0, 300.0])


def test_places_far_from_0_are_written_as_double_and_read_relative_to_an_origin(tmp_path):
    path, gaussians = tmp_path / "scene.ply", random_gaussians(50)
    write_ply(path, gaussians, origin=UTM)
    stored = PlyData.read(str(path))["vertex"].data
    assert [stored.dtype[name].str for name in ("x", "z", "nx", "f_dc_0", "opacity")] == [
        *("<f8", "<f8", "<f4", "<f4", "<f4"),
    ]
    places = np.stack([stored[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(places, np.asarray(gaussians.means, np.float64) + UTM, rtol=0, atol=1e-8)
    with pytest.warns(UserWarning, match=r"reach 5e\+06, where float32 has steps of 0\.5; .* the origin \(5"):
        loaded, report = read_ply(path)
    assert report.origin is not None
    np.testing.assert_allclose(in_world(np.asarray(loaded.means), report.origin), places, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(report.places, places)


def test_a_place_that_is_not_finite_takes_no_digits_from_the_others(tmp_path):
    path, gaussians = tmp_path / "scene.ply", random_gaussians(50)
    gaussians = eqx.tree_at(lambda g: g.means, gaussians, gaussians.means.at[0, 0].set(jnp.nan))
    write_ply(path, gaussians, origin=UTM)
    assert PlyData.read(str(path))["vertex"].data.dtype["x"].str == "<f8"


def test_float32_far_from_0_is_said_to_have_lost_places(tmp_path):
    path, gaussians = tmp_path / "scene.ply", random_gaussians(50)
    places = (np.asarray(gaussians.means) + UTM).astype(np.float32)
    far = dict(zip("xyz", places.T, strict=True))
    changed(path, gaussians, **far)
    with pytest.warns(UserWarning, match="of float32, which has lost what is smaller than these steps"):
        loaded, report = read_ply(path)
    np.testing.assert_array_equal(in_world(np.asarray(loaded.means), report.origin), places)


def of_size(size, count):
    return {f"scale_{i}": np.full(count, np.log(size), np.float32) for i in range(3)}


@pytest.mark.parametrize("distance", [5, 20, 2000])
def test_only_what_float32_has_lost_is_said_to_be_lost(tmp_path, distance):
    """For a scene of some millimetres with Gaussians of 0.3 mm, float32 steps of 2e-6 m do not matter, but
    those of 1e-4 m do."""
    path, gaussians = tmp_path / "scene.ply", random_gaussians(50)
    places = (0.003 * np.asarray(gaussians.means) + [distance, 0, 0]).astype(np.float32)
    changed(path, gaussians, **dict(zip("xyz", places.T, strict=True)), **of_size(3e-4, 50))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        loaded, report = read_ply(path)
    said = "".join(str(warning.message) for warning in caught)
    assert ("relative to the origin" in said, "has lost" in said) == (distance > 10, distance > 1000)
    np.testing.assert_array_equal(in_world(np.asarray(loaded.means), report.origin), places)


def test_a_scene_is_no_smaller_than_its_gaussians(tmp_path):
    path = tmp_path / "scene.ply"
    at = {axis: np.float32([where]) for axis, where in zip("xyz", (200, 0, 0), strict=True)}
    changed(path, random_gaussians(1), **at, **of_size(3, 1))
    assert read_ply(path)[1].origin is None
    changed(path, random_gaussians(1), **at, **of_size(0.003, 1))
    with pytest.warns(UserWarning, match=r"relative to the origin \(200, 0, 0\)$"):
        assert read_ply(path)[1].origin is not None


def test_near_0_nothing_is_taken_off(tmp_path):
    path, gaussians = tmp_path / "scene.ply", random_gaussians(50)
    shift = np.array([10.0, 0, -20])
    write_ply(path, gaussians, origin=shift)
    loaded, report = read_ply(path)
    assert report.origin is None
    assert PlyData.read(str(path))["vertex"].data.dtype["x"] == np.float32
    np.testing.assert_allclose(loaded.means, gaussians.means + shift, atol=1e-5)


@pytest.mark.parametrize(
    ("comments", "antialiased"),
    [
        ([], None),
        (["Exported from Brush", "SH degree: 3", "SplatRenderMode: mip"], True),
        (["SplatRenderMode: default"], False),
        (["  SPLATRENDERMODE:  MIP  "], True),
        (["antialiased 1"], True),
        (["antialiased 0"], False),
        (["antialiased 1", "SplatRenderMode: default"], False),
        (["SplatRenderMode: default", "antialiased 1"], True),
        (["train_flags antialiasing"], True),
        (["not antialiased 1", "SplatRenderMode: banana"], False),
    ],
)
def test_comments_of_other_programs_say_how_to_draw(tmp_path, comments, antialiased):
    path = tmp_path / "scene.ply"
    write_ply(path, random_gaussians(2))
    ply = PlyData.read(str(path), mmap=False)
    PlyData(ply.elements, comments=comments).write(str(path))
    assert read_ply(path)[1].antialiased == antialiased


@pytest.mark.parametrize("antialiased", [True, False])
def test_how_to_draw_is_written_as_brush_writes_it(tmp_path, antialiased):
    path = tmp_path / "scene.ply"
    write_ply(path, random_gaussians(2), antialiased=antialiased)
    assert PlyData.read(str(path)).comments == (["SplatRenderMode: mip"] if antialiased else [])
    assert read_ply(path)[1].antialiased is (antialiased or None)


def test_labels_within_a_file_of_an_earlier_version_are_read(tmp_path):
    changed(tmp_path / "scene.ply", random_gaussians(3), label=np.array([2, 0, 1], np.int32))
    _, report = read_ply(tmp_path / "scene.ply")
    np.testing.assert_array_equal(report.labels, [2, 0, 1])
    assert report.extra == ()


def test_labels_of_an_earlier_scene_go_with_it(tmp_path):
    path = tmp_path / "scene.ply"
    write_ply(path, random_gaussians(3), labels=np.arange(3))
    write_ply(path, random_gaussians(3))
    assert read_ply(path)[1].labels is None
    assert [file.name for file in tmp_path.iterdir()] == ["scene.ply"]


def test_labels_beside_no_ply_are_kept(tmp_path):
    """They do not belong to a PLY that is being replaced."""
    (tmp_path / "scene_labels.npz").write_bytes(b"mine")
    write_ply(tmp_path / "scene.ply", random_gaussians(3))
    assert (tmp_path / "scene_labels.npz").read_bytes() == b"mine"


def test_a_write_that_fails_leaves_the_scene_before_with_its_labels(tmp_path, monkeypatch):
    path = tmp_path / "scene.ply"
    write_ply(path, random_gaussians(3), labels=np.arange(3))

    def full(*_):
        raise OSError("no space left")

    monkeypatch.setattr("gsjax.io.atomic.os.replace", full)
    with pytest.raises(OSError, match="no space left"):
        write_ply(path, random_gaussians(3, seed=1))
    np.testing.assert_array_equal(read_ply(path)[1].labels, [0, 1, 2])


@pytest.mark.parametrize("content", ["other length", "floats", "not an archive", "pickled"])
def test_labels_that_do_not_fit_are_left_out_with_a_warning(tmp_path, content):
    path, beside = tmp_path / "scene.ply", tmp_path / "scene_labels.npz"
    write_ply(path, random_gaussians(3))
    arrays = {"other length": np.arange(4), "floats": np.zeros(3), "pickled": np.array([{}, 1, 2])}
    beside.write_bytes(b"hello") if content not in arrays else np.savez(beside, labels=arrays[content])
    with pytest.warns(UserWarning, match=r"scene_labels\.npz: expected 3 integers .* they are left out"):
        assert read_ply(path)[1].labels is None


def test_labels_of_another_length_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"labels: expected integers of shape \[3\], found .* \(4,\)"):
        write_ply(tmp_path / "scene.ply", random_gaussians(3), labels=np.arange(4))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("keep", [0.99, 0.6, 0.1])
def test_a_file_cut_off_is_named(tmp_path, keep):
    path = tmp_path / "scene.ply"
    write_ply(path, random_gaussians(50))
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content))])
    with pytest.raises(PlyError, match=r"scene\.ply: expected a complete PLY file.*copy or export it again"):
        read_ply(path)


@pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04zip", b"\x80\x04pickle"])
def test_a_file_that_is_not_a_ply_is_named(tmp_path, content):
    path = tmp_path / "scene.ply"
    path.write_bytes(content)
    with pytest.raises(PlyError, match="expected a PLY file"):
        read_ply(path)


def test_a_header_that_promises_too_much_is_refused(tmp_path):
    path = tmp_path / "scene.ply"
    write_ply(path, random_gaussians(5))
    path.write_bytes(path.read_bytes().replace(b"element vertex 5", b"element vertex 99999999999999"))
    with pytest.raises(PlyError, match="cut off or damaged"):
        read_ply(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.ply"):
        read_ply(tmp_path / "nothing.ply")


@pytest.mark.parametrize(
    ("names", "advice"),
    [
        (["x", "y", "z"], "point cloud or a mesh"),
        (["x", "y", "z", "opacity", *(f"scale_{i}" for i in range(3))], "lacks a part of each Gaussian"),
        (["intensity"], "Gaussian splatting PLY format"),
        (["x", "y", "z", "scalar_opacity", "scalar_scale_0"], "begin with scalar_, as CloudCompare writes"),
        (["x", "y", "z", "scale_0", "scale_1"], "no third axis"),
    ],
)
def test_missing_properties_are_listed_with_advice(tmp_path, names, advice):
    vertices = np.zeros(2, [(name, "f4") for name in names])
    PlyData([PlyElement.describe(vertices, "vertex")]).write(str(tmp_path / "scene.ply"))
    with pytest.raises(PlyError, match=f"rot_3.*{advice}"):
        read_ply(tmp_path / "scene.ply")


def test_a_missing_vertex_element_is_reported(tmp_path):
    stream = io.BytesIO()
    PlyData([PlyElement.describe(np.zeros(1, [("a", "f4")]), "thing")]).write(stream)
    (tmp_path / "scene.ply").write_bytes(stream.getvalue())
    with pytest.raises(PlyError, match=r"element 'vertex'.*thing"):
        read_ply(tmp_path / "scene.ply")


def test_an_unusual_count_of_harmonics_is_refused(tmp_path):
    write_ply(tmp_path / "scene.ply", random_gaussians(2, degree=1))
    vertices = PlyData.read(str(tmp_path / "scene.ply"))["vertex"].data
    fewer = vertices[[name for name in vertices.dtype.names if name != "f_rest_8"]]
    packed = np.array(fewer.tolist(), dtype=[(name, "f4") for name in fewer.dtype.names])
    PlyData([PlyElement.describe(packed, "vertex")]).write(str(tmp_path / "scene.ply"))
    with pytest.raises(PlyError, match=r"0, 9, 24 or 45 properties f_rest_\*.*found 8"):
        read_ply(tmp_path / "scene.ply")
