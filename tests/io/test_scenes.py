"""Files of Gaussians in every format are read back within the format's rounding, whatever their names."""

import gzip
import json
import struct

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gsjax.io.compressed_ply import write_compressed_ply
from gsjax.io.scene_file import columns_of
from gsjax.io.scenes import FORMATS, format_of, is_scene, read_gaussians, write_gaussians
from gsjax.scene.gaussians import take
from gsjax.scene.origin import in_world
from tests.io.scenes_to_write import ROUNDING, assert_alike, flat, ksplat, make_scene, spz, spz4

READ_BACK = sorted(ROUNDING)


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("ending", READ_BACK)
def test_what_is_written_is_read_back(tmp_path, ending, degree):
    scene = make_scene(300, degree)
    left_out = write_gaussians(tmp_path / f"scene{ending}", scene)
    back, report = read_gaussians(tmp_path / f"scene{ending}")
    assert (report.stored, report.culled) == (300, 0)
    if degree > ROUNDING[ending].degree:
        assert left_out == ("view-dependent colour",)
        scene = flat(scene)
    else:
        assert left_out == ()
    assert_alike(scene, back, ROUNDING[ending])


@pytest.mark.thorough
@pytest.mark.parametrize("ending", READ_BACK)
@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(count=st.integers(1, 600), seed=st.integers(0, 99), degree=st.integers(0, 3))
def test_any_number_is_read_back(tmp_path, ending, count, seed, degree):
    scene = make_scene(count, degree, seed)
    write_gaussians(tmp_path / f"scene{ending}", scene)
    back, _ = read_gaussians(tmp_path / f"scene{ending}")
    assert_alike(flat(scene) if ROUNDING[ending].degree == 0 else scene, back, ROUNDING[ending])


@pytest.mark.parametrize("ending", [e for e in READ_BACK if e != ".splat"])
def test_the_format_is_told_by_the_content(tmp_path, ending):
    scene = make_scene(20)
    write_gaussians(tmp_path / f"scene{ending}", scene)
    (tmp_path / f"scene{ending}").rename(tmp_path / "download.splat")
    assert_alike(scene, read_gaussians(tmp_path / "download.splat")[0], ROUNDING[ending])


@pytest.mark.parametrize("ending", READ_BACK)
def test_what_cannot_be_drawn_and_features_are_left_out_and_named(tmp_path, ending):
    scene = make_scene(5)
    scene = eqx.tree_at(lambda g: g.means, scene, scene.means.at[2, 1].set(np.nan))
    scene = eqx.tree_at(lambda g: g.features, scene, jnp.ones((5, 2)), is_leaf=lambda leaf: leaf is None)
    left_out = write_gaussians(tmp_path / f"scene{ending}", scene)
    assert left_out == ("what cannot be drawn, 1 of 5 Gaussians", "features")
    back, report = read_gaussians(tmp_path / f"scene{ending}")
    assert (back.num, report.stored, back.features) == (4, 4, None)


@pytest.mark.parametrize("ending", [".spz", ".sog"])
def test_antialiasing_is_said(tmp_path, ending):
    for antialiased in (False, True):
        assert write_gaussians(tmp_path / f"scene{ending}", make_scene(3), antialiased=antialiased) == ()
        assert read_gaussians(tmp_path / f"scene{ending}")[1].antialiased is antialiased
    said = write_gaussians(tmp_path / "scene.splat", make_scene(3), antialiased=True)
    assert said == ("that the scene is antialiased",)


@pytest.mark.parametrize("ending", READ_BACK)
def test_labels_are_written_beside_a_ply_and_named_elsewhere(tmp_path, ending):
    scene, labels = make_scene(5), np.array([3, 1, 0, 0, 2])
    scene = eqx.tree_at(lambda g: g.means, scene, scene.means.at[2, 1].set(np.nan))
    left_out = write_gaussians(tmp_path / f"scene{ending}", scene, labels=labels)
    _, report = read_gaussians(tmp_path / f"scene{ending}")
    if ending == ".ply":
        assert left_out == ("what cannot be drawn, 1 of 5 Gaussians",)
        np.testing.assert_array_equal(report.labels, [3, 1, 0, 2])
    else:
        assert left_out == ("what cannot be drawn, 1 of 5 Gaussians", "labels")
        assert write_gaussians(tmp_path / f"one{ending}", make_scene(5), labels=np.ones(5, int)) == ()
    with pytest.raises(ValueError, match=r"labels: expected one for each of 5 Gaussians, .* shape \(4,\)"):
        write_gaussians(tmp_path / f"scene{ending}", scene, labels=np.arange(4))


UTM = np.array([500_000.0, 5_000_000.0, 300.0])


@pytest.mark.filterwarnings("ignore:.*they are taken relative to the origin")
@pytest.mark.parametrize("ending", READ_BACK)
def test_an_origin_is_put_back_where_there_is_room_and_named_elsewhere(tmp_path, ending):
    scene = make_scene(50)
    left_out = write_gaussians(tmp_path / f"scene{ending}", scene, origin=UTM)
    back, report = read_gaussians(tmp_path / f"scene{ending}")
    if ending == ".ply":
        assert left_out == ()
        found = in_world(np.asarray(back.means), report.origin)
        np.testing.assert_allclose(found, np.asarray(scene.means) + UTM, rtol=0, atol=1e-6)
    else:
        assert left_out == ("the origin (500000, 5000000, 300), to which its places are relative",)
        assert report.origin is None
        assert_alike(scene, back, ROUNDING[ending])


def test_extremes_are_clipped_not_wrapped(tmp_path):
    scene = make_scene(4, 1)
    scene = eqx.tree_at(
        lambda g: (g.log_scales, g.logit_opacities, g.sh0, g.shN),
        scene,
        (
            jnp.asarray([[-30.0, 0, 0], [20, 0, 0], [0, 0, 0], [0, 0, 0]]),
            jnp.asarray([-200.0, 200, 0, 0]),
            scene.sh0.at[0].set(-90).at[1].set(90),
            scene.shN.at[0].set(-90).at[1].set(90),
        ),
    )
    wanted = columns_of(scene)
    for ending, (low, high), rest in (
        (".spz", (-10, 5.94), 1),
        (".compressed.ply", (-27.7, 20), 4),
        (".splat", (-27.7, 20), 0),
        (".sog", (-30, 20), 90),
    ):
        write_gaussians(tmp_path / f"scene{ending}", scene)
        found = columns_of(read_gaussians(tmp_path / f"scene{ending}")[0])
        rows = np.argsort(found.means[:, 0])[np.argsort(np.argsort(wanted.means[:, 0]))]
        np.testing.assert_allclose(found.log_scales[rows][:2, 0], (low, high), atol=0.1, err_msg=ending)
        np.testing.assert_allclose(found.opacities[rows][:2], (0, 1), atol=1e-5)
        colors = found.colors[rows]
        assert colors[0].max() < 0.01, ending
        assert colors[1].min() > 0.99, ending
        if rest:
            assert np.abs(np.abs(found.rest[rows][:2]) - rest).max() < 0.02 * rest, ending


def test_an_spz_holds_what_is_far_away_and_refuses_what_is_beyond(tmp_path):
    scene = make_scene(3)
    far = eqx.tree_at(lambda g: g.means, scene, scene.means.at[0, 0].set(5e6))
    write_gaussians(tmp_path / "scene.spz", far)
    back, _ = read_gaussians(tmp_path / "scene.spz")
    np.testing.assert_allclose(back.means, far.means, atol=1)
    beyond = eqx.tree_at(lambda g: g.means, scene, scene.means.at[0, 0].set(1e7))
    with pytest.raises(ValueError, match=r"within 8388607 units of the origin, .* found one at 1e\+07"):
        write_gaussians(tmp_path / "scene.spz", beyond)


def test_spz_of_version_2(tmp_path):
    """A file made by hand: x y z of quaternions as bytes, positions with 12 fractional bits."""
    positions = bytes([0, 16, 0, 0, 240, 255, 0, 8, 0])  # 1, -1, 0.5
    body = positions + bytes([51]) + bytes([128, 255, 0]) + bytes([160, 0, 255]) + bytes([255, 127, 128])
    (tmp_path / "scene.spz").write_bytes(gzip.compress(spz(2, 1, arrays=body)))
    found = columns_of(read_gaussians(tmp_path / "scene.spz")[0])
    np.testing.assert_allclose(found.means, [[1, 1, -0.5]], atol=1e-7)
    np.testing.assert_allclose(found.opacities, [0.2], atol=1e-6)
    np.testing.assert_allclose(found.log_scales, [[0, -10, 5.9375]], atol=1e-6)
    np.testing.assert_allclose(np.abs(found.quats), [[0, 1, 0, 0]], atol=0.01)


@pytest.mark.parametrize("degree", [0, 2])
def test_spz_of_version_4(tmp_path, degree):
    scene = make_scene(50, degree)
    spz4(scene, tmp_path / "scene.spz")
    back, report = read_gaussians(tmp_path / "scene.spz")
    assert report.antialiased
    assert_alike(scene, back, ROUNDING[".spz"])


@pytest.mark.parametrize("degree", range(3))
@pytest.mark.parametrize("level", range(3))
def test_ksplat(tmp_path, level, degree):
    scene = make_scene(45, degree)
    (tmp_path / "scene.ksplat").write_bytes(ksplat(level, scene, degree))
    back, _ = read_gaussians(tmp_path / "scene.ksplat")
    found, wanted = columns_of(back), columns_of(scene)
    np.testing.assert_allclose(found.means, wanted.means, atol=(1e-6, 3e-4, 3e-4)[level])
    np.testing.assert_allclose(found.log_scales, wanted.log_scales, atol=1e-3)
    np.testing.assert_allclose(found.colors, wanted.colors.clip(0, 1), atol=0.003)
    np.testing.assert_allclose(found.rest, wanted.rest, atol=(1e-6, 1e-3, 0.005)[level])
    np.testing.assert_allclose(np.abs(np.sum(found.quats * wanted.quats, axis=1)), 1, atol=1e-5)


def test_a_glb_beyond_4_gib_is_refused(tmp_path, monkeypatch):
    positions = np.broadcast_to(np.zeros(3, "<f4"), (2**29, 3))  # takes no memory
    monkeypatch.setattr("gsjax.io.glb._attributes", lambda _: {"POSITION": positions})
    with pytest.raises(ValueError, match=r"scene.glb: expected at most 4 GiB, .* found 6,442,450,944 bytes"):
        write_gaussians(tmp_path / "scene.glb", make_scene(2))


def test_glb_is_what_the_extension_says(tmp_path):
    scene = make_scene(7, 2)
    assert write_gaussians(tmp_path / "scene.glb", scene, origin=UTM) == ()
    data = (tmp_path / "scene.glb").read_bytes()
    magic, version, total, size, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, total, kind) == (b"glTF", 2, len(data), b"JSON")
    tree = json.loads(data[20 : 20 + size])
    (stored, kind), start = struct.unpack_from("<I4s", data, 20 + size), 28 + size
    assert (stored, kind) == (tree["buffers"][0]["byteLength"], b"BIN\0")
    primitive = tree["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse"
    columns = columns_of(scene)

    def attribute(name, width):
        accessor = tree["accessors"][primitive["attributes"][name]]
        view = tree["bufferViews"][accessor["bufferView"]]
        assert accessor["count"] == 7
        found = np.frombuffer(data, "<f4", 7 * width, start + view["byteOffset"])
        return found.reshape(7, width) if width > 1 else found

    assert tree["nodes"] == [{"mesh": 0, "rotation": [1, 0, 0, 0], "translation": [5e5, -5e6, -300]}]
    np.testing.assert_allclose(attribute("POSITION", 3), columns.means, atol=1e-6)
    np.testing.assert_allclose(tree["accessors"][0]["max"], columns.means.max(0), atol=1e-6)
    prefix = "KHR_gaussian_splatting:"
    np.testing.assert_allclose(attribute(f"{prefix}ROTATION", 4)[:, 3], columns.quats[:, 0], atol=1e-6)
    np.testing.assert_allclose(attribute(f"{prefix}SCALE", 3), np.exp(columns.log_scales), rtol=1e-6)
    np.testing.assert_allclose(attribute(f"{prefix}OPACITY", 1), columns.opacities, atol=1e-6)
    np.testing.assert_allclose(attribute(f"{prefix}SH_DEGREE_2_COEF_4", 3), columns.rest[:, 7], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "value", "having"),
    [("up", (0, 0, 1), ".html"), ("order", np.arange(3), ".compressed.ply, .sog")],
)
def test_options_that_a_format_lacks_are_refused(tmp_path, name, value, having):
    with pytest.raises(
        ValueError, match=rf"{name}: expected a format that has it \({having}\), found .*a.spz"
    ):
        write_gaussians(tmp_path / "a.spz", make_scene(3), **{name: value})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["scene.ksplat", "scene.obj", "scene", "scene.gltf"])
def test_endings_that_are_not_written(tmp_path, name):
    with pytest.raises(ValueError, match=r"expected one of the endings \.compressed\.ply, \.ply, \.splat"):
        write_gaussians(tmp_path / name, make_scene(3))


def test_endings(tmp_path):
    assert format_of("A.COMPRESSED.PLY") is FORMATS[".compressed.ply"]
    assert format_of("a.ply") is FORMATS[".ply"]
    assert [is_scene(name) for name in ("x/Y.SPZ", "a.ply", "a.html")] == [True, True, False]


def test_nothing_to_write(tmp_path):
    with pytest.raises(ValueError, match="expected Gaussians that can be drawn, found none of 0"):
        write_gaussians(tmp_path / "scene.spz", take(make_scene(3), np.zeros(0, int)))
    assert not list(tmp_path.iterdir())


def test_gaussians_of_one_place_are_written(tmp_path):
    scene = make_scene(10)
    scene = eqx.tree_at(lambda g: g.means, scene, jnp.ones((10, 3)))
    for ending in READ_BACK:
        write_gaussians(tmp_path / f"scene{ending}", scene)
        np.testing.assert_allclose(read_gaussians(tmp_path / f"scene{ending}")[0].means, 1, atol=1e-5)
    write_compressed_ply(tmp_path / "again.ply", scene)
    assert read_gaussians(tmp_path / "again.ply")[0].num == 10
