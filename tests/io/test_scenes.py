"""Files of Gaussians of every format: what is written is read back within the format's rounding, whatever its
name; and what is cut off, mislabelled or made to harm is refused in a sentence, in little memory and time."""

import gzip
import io
import json
import struct
import tracemalloc
import zipfile
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from gsjax.io.codebooks import codebook, nearest, palette
from gsjax.io.compressed_ply import write_compressed_ply
from gsjax.io.scene_file import SceneError, columns_of
from gsjax.io.scenes import FORMATS, format_of, is_scene, read_gaussians, write_gaussians
from gsjax.scene.gaussians import take
from tests.io.scenes_to_write import ROUNDING, assert_alike, make_scene

READ_BACK = sorted(ROUNDING)


def flat(scene):
    """The scene without view-dependent colour."""
    return eqx.tree_at(lambda g: g.shN, scene, None, is_leaf=lambda leaf: leaf is None)


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


def spz(version, count, degree=0, flags=0, arrays=b"", bits=12):
    return struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, bits, flags, 0) + arrays


def test_spz_of_version_2(tmp_path):
    """x y z of quaternions as bytes; positions of 12 fractional bits; by hand."""
    positions = bytes([0, 16, 0, 0, 240, 255, 0, 8, 0])  # 1, -1, 0.5
    body = positions + bytes([51]) + bytes([128, 255, 0]) + bytes([160, 0, 255]) + bytes([255, 127, 128])
    (tmp_path / "scene.spz").write_bytes(gzip.compress(spz(2, 1, arrays=body)))
    found = columns_of(read_gaussians(tmp_path / "scene.spz")[0])
    np.testing.assert_allclose(found.means, [[1, 1, -0.5]], atol=1e-7)
    np.testing.assert_allclose(found.opacities, [0.2], atol=1e-6)
    np.testing.assert_allclose(found.log_scales, [[0, -10, 5.9375]], atol=1e-6)
    np.testing.assert_allclose(np.abs(found.quats), [[0, 1, 0, 0]], atol=0.01)


def spz4(scene, path, change=None):
    """An SPZ of version 4: the arrays of version 3, each in a frame of its own."""
    write_gaussians(path, scene)
    body = gzip.decompress(path.read_bytes())
    degree, bits = body[12], body[13]
    sizes = [scene.num * width for width in (9, 1, 3, 3, 4, 3 * (degree * (degree + 2)))]
    starts = 16 + np.concatenate([[0], np.cumsum(sizes)])
    arrays = [body[a:b] for a, b in pairwise(starts) if b > a]
    frames = [zstandard.ZstdCompressor().compress(array) for array in arrays]
    pairs = [[len(frame), len(array)] for frame, array in zip(frames, arrays, strict=True)]
    if change:
        change(pairs)
    table = b"".join(struct.pack("<QQ", *pair) for pair in pairs)
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, scene.num, degree, bits, 1, len(pairs), 40)
    path.write_bytes(head + b"extended" + table + b"".join(frames))


@pytest.mark.parametrize("degree", [0, 2])
def test_spz_of_version_4(tmp_path, degree):
    scene = make_scene(50, degree)
    spz4(scene, tmp_path / "scene.spz")
    back, report = read_gaussians(tmp_path / "scene.spz")
    assert report.antialiased
    assert_alike(scene, back, ROUNDING[".spz"])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda pairs: pairs[0].__setitem__(1, 1 << 40), "expected arrays of"),
        (lambda pairs: pairs[0].__setitem__(0, 1 << 60), "damaged|expected"),
        (lambda pairs: pairs.pop(), "expected arrays of"),
        (lambda pairs: pairs.extend([[0, 0]] * 200), "expected a table of 205 sizes|expected|found"),
    ],
)
def test_an_spz_of_version_4_whose_table_lies(tmp_path, change, says):
    spz4(make_scene(50), tmp_path / "scene.spz", change)
    try:
        read_gaussians(tmp_path / "scene.spz")
    except SceneError as error:
        assert "scene.spz: expected" in str(error)  # noqa: PT017 (a table with empty entries may be read)


def ksplat(level, scene, degree, bucket=7):
    """A .ksplat of two sections, the first empty; full buckets of 7 and a rest."""
    columns = columns_of(scene)
    types = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))[level]
    bands, count, block = degree * (degree + 2), scene.num, 5.0
    fields = [("means", types[0], 3), ("scales", types[1], 3), ("quats", types[1], 4), ("rgba", "u1", 4)]
    records = np.zeros(count, np.dtype([*fields, ("rest", types[2], (3 * bands,))]))
    full, left = divmod(count, bucket) if level else (0, 0)
    buckets = full + bool(left)
    centers = np.stack(
        [columns.means[i * bucket : (i + 1) * bucket].mean(0) for i in range(buckets)] or [[0] * 3]
    )
    means = columns.means
    if level:
        off = means - centers.astype("f4")[np.minimum(np.arange(count) // bucket, buckets - 1)]
        block = 2.1 * np.abs(off).max()
        means = np.round(off / (block / 2) * 32767 + 32767)
    records["means"], records["scales"], records["quats"] = means, np.exp(columns.log_scales), columns.quats
    records["rgba"] = np.round(np.column_stack([columns.colors, columns.opacities]).clip(0, 1) * 255)
    rest = [
        columns.rest[:, d**2 - 1 : (d + 1) ** 2 - 1].transpose(0, 2, 1).reshape(count, -1) for d in (1, 2, 3)
    ]
    rest = np.concatenate(rest, axis=1)[:, : 3 * bands]
    records["rest"] = np.round((rest + 1) / 2 * 255) if level == 2 else rest
    header = struct.pack("<4sIIIIHxx12xff", b"\0\1\0\0", 2, 2, count, count, level, -1.0, 1.0).ljust(
        4096, b"\0"
    )
    empty = struct.pack("<IIIIfHxxIIIIH", 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0).ljust(1024, b"\0")
    stored = (bucket, buckets, block, 12, 32767, 0, full, bool(left), degree)
    section = struct.pack("<IIIIfHxxIIIIH", count, count, *stored).ljust(1024, b"\0")
    data = struct.pack("<I", left) if left else b""
    data += centers.astype("<f4").tobytes() if level else b""
    return header + empty + section + data + records.tobytes()


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


def test_glb_is_what_the_extension_says(tmp_path):
    scene = make_scene(7, 2)
    assert write_gaussians(tmp_path / "scene.glb", scene) == ()
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

    np.testing.assert_allclose(attribute("POSITION", 3), columns.means, atol=1e-6)
    np.testing.assert_allclose(tree["accessors"][0]["max"], columns.means.max(0), atol=1e-6)
    prefix = "KHR_gaussian_splatting:"
    np.testing.assert_allclose(attribute(f"{prefix}ROTATION", 4)[:, 3], columns.quats[:, 0], atol=1e-6)
    np.testing.assert_allclose(attribute(f"{prefix}SCALE", 3), columns.log_scales, atol=1e-6)
    np.testing.assert_allclose(attribute(f"{prefix}OPACITY", 1), columns.opacities, atol=1e-6)
    np.testing.assert_allclose(attribute(f"{prefix}SH_DEGREE_2_COEF_4", 3), columns.rest[:, 7], atol=1e-6)


def test_a_page_stands_alone(tmp_path):
    up = (0.0, 0.0, 1.0)
    said = write_gaussians(tmp_path / "a <b> & $c.html", make_scene(5, 1), up=up, background=(1, 1, 1))
    assert said == ("view-dependent colour",)
    text = (tmp_path / "a <b> & $c.html").read_text()
    assert "<title>a &lt;b&gt; &amp; $c</title>" in text
    assert '"title": "a \\u003cb> & $c"' in text
    assert "default-src 'none'" in text
    assert not [word for word in ("http:", "https:", "//cdn", "import(", "fetch(") if word in text]


def test_only_a_page_has_an_up(tmp_path):
    with pytest.raises(
        ValueError, match=r"up: expected a page \(.html\), which alone has it, found .*scene.spz"
    ):
        write_gaussians(tmp_path / "scene.spz", make_scene(3), up=(0, 0, 1))


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


# what is refused


def refusal(path, data=None) -> str:
    """What is said of a file that must be refused, within 100 MB of new memory."""
    if data is not None:
        path.write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(SceneError) as refused:
            read_gaussians(path)
        assert tracemalloc.get_traced_memory()[1] < 1e8
    finally:
        tracemalloc.stop()
    assert str(refused.value).startswith(f"{path}: expected ")
    return str(refused.value)


@pytest.mark.parametrize("share", [0.0, 0.03, 0.5, 0.99])
@pytest.mark.parametrize("ending", [*READ_BACK, ".ksplat"])
def test_files_that_are_cut_off(tmp_path, ending, share):
    path = tmp_path / f"scene{ending}"
    if ending == ".ksplat":
        path.write_bytes(ksplat(1, make_scene(45), 0))
    else:
        write_gaussians(path, make_scene(101, 1))
    data = path.read_bytes()
    cut = int(share * len(data))
    refusal(path, data[: cut - (cut % 32 == 0 and cut > 0)])


@pytest.mark.parametrize(
    ("name", "data", "says"),
    [
        ("a.spz", b"glTF\2\0\0\0", "found glTF, which is only written"),
        ("a.ply", b"<!doctype html>", "a page or another text"),
        ("a.sog", b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
        ("a.ksplat", b"\xff\xd8\xff\xe0", r"one that starts with b'\xff\xd8\xff\xe0'"),
        ("a.splat", b"", "an empty one"),
        ("a.bin", bytes(64), r"one that starts with b'\x00\x00"),
        ("a.splat", b"once upon a time there was a scene" * 32, "with other values"),
        ("a.splat", np.random.default_rng(0).bytes(3200), "with other values"),
        ("a.splat", bytes(33), "found 33 bytes"),
        ("a.spz", spz(1, 1, arrays=bytes(50)), "found version 1"),
        ("a.spz", spz(3, 1, degree=4, arrays=bytes(500)), "degree 0 to 3, found degree 4"),
        ("a.spz", spz(3, 1 << 31, arrays=bytes(50)), "found 50 of"),
        ("a.spz", gzip.compress(spz(3, 1 << 31, 3)), "in keeping with its file, found 139586437120 bytes"),
        ("a.spz", gzip.compress(spz(3, 1, arrays=bytes(20 + (1 << 25)))), "found more behind them"),
        ("a.spz", gzip.compress(b"something else"), "which starts with b'NGSP'"),
        ("a.spz", spz(4, 1 << 31), "a header of 32 bytes"),
        ("a.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 1099511627776\n"
         b"property float x\nend_header\n", "one that cannot be parsed"),
        ("a.ksplat", b"\0\1\0\0" + struct.pack("<I", 1 << 31) + bytes(4096), "2147483648 sections"),
        ("a.ksplat", b"\0\1\0\0" + struct.pack("<IIII", 1, 1, 1, 1) + bytes(4076)
         + struct.pack("<II", 1, 1 << 31) + bytes(1016), "section 0 with all its data"),
    ],
)  # fmt: skip
def test_files_of_another_kind(tmp_path, name, data, says):
    assert says in refusal(tmp_path / name, data)


def test_an_spz_with_a_flipped_bit_is_found_by_its_checksum(tmp_path):
    write_gaussians(tmp_path / "scene.spz", make_scene(500))
    data = bytearray((tmp_path / "scene.spz").read_bytes())
    for place in (len(data) // 2, len(data) - 9, len(data) - 5):
        changed = data.copy()
        changed[place] ^= 4
        refusal(tmp_path / "scene.spz", bytes(changed))


def sog(change_meta=None, pictures=(), extra=()):
    """The bytes of a SOG of 100 Gaussians, changed."""
    stream = io.BytesIO()
    with TemporaryDirectory() as folder:
        write_gaussians(Path(folder) / "a.sog", make_scene(100, 1))
        with zipfile.ZipFile(Path(folder) / "a.sog") as source:
            files = {name: source.read(name) for name in source.namelist()}
    meta = json.loads(files["meta.json"])
    if change_meta:
        change_meta(meta)
    files |= {"meta.json": json.dumps(meta).encode(), **dict(pictures), **dict(extra)}
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as target:
        for name, data in files.items():
            target.writestr(name, data)
    return stream.getvalue()


def picture(width, height, kind="PNG"):
    stream = io.BytesIO()
    Image.new("RGBA", (width, height)).save(stream, kind, lossless=True)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda m: m.update(version=1), "expected version 2 of SOG, found version 1"),
        (lambda m: m.update(count=1 << 40), "a whole number, 0 to 268435456 as count in meta.json"),
        (lambda m: m.update(count=1 << 27), "expected 134217728 pixels in means_l.webp"),
        (lambda m: m.update(count=-1), "found -1"),
        (lambda m: m.update(count=True), "found True"),
        (lambda m: m.pop("means"), "2 names of files as means.files in meta.json, found None"),
        (lambda m: m["means"].update(files=["../../etc/passwd", "b"]), "names of files without a folder"),
        (lambda m: m["means"].update(files=["/etc/passwd", "b"]), "names of files without a folder"),
        (lambda m: m["means"].update(files=["..\\a", "b"]), "names of files without a folder"),
        (lambda m: m["means"].update(files=["no.webp", "b"]), "expected no.webp in it, found means_l.webp"),
        (lambda m: m["means"].update(files=["meta.json", "means_u.webp"]), "picture as meta.json"),
        (lambda m: m["means"].update(mins=[0, None, 0]), "3 finite numbers as means.mins"),
        (lambda m: m["scales"].update(codebook=[1, 2]), "256 finite numbers as scales.codebook"),
        (lambda m: m["shN"].update(bands=2), "expected 512 x 2 pixels in shN_centroids.webp, found 192 x 2"),
        (lambda m: m["shN"].update(count=3), "labels below 3 in shN_labels.webp, found"),
        (lambda m: m["shN"].update(count=1 << 17), "0 to 65536 as shN.count"),
    ],
)  # fmt: skip
def test_a_sog_whose_text_lies(tmp_path, change, says):
    assert says in refusal(tmp_path / "scene.sog", sog(change))


@pytest.mark.parametrize(
    ("pictures", "says"),
    [
        ({"quats.webp": picture(2, 2)}, "expected 100 pixels in quats.webp, one a Gaussian, found 4"),
        ({"quats.webp": b"RIFF????WEBPVP8L"}, "a WebP or PNG picture as quats.webp"),
        ({"quats.webp": picture(12000, 12000)}, "found 576000000 bytes from"),
        ({"quats.webp": picture(12000, 12000, "WEBP")}, "found 576000000 bytes from"),
        ({"meta.json": b"{" * 100000}, "expected JSON in meta.json"),
        ({"meta.json": b"[" * 100000}, "expected JSON in meta.json"),
        ({"meta.json": b"[]"}, "found version None"),
        ({"meta.json": bytes(1 << 27)}, "meta.json of a size in keeping with its file"),
    ],
)
def test_a_sog_with_other_pictures(tmp_path, pictures, says):
    assert says in refusal(tmp_path / "scene.sog", sog(pictures=pictures.items()))


def test_a_zip_of_something_else(tmp_path):
    with zipfile.ZipFile(tmp_path / "scene.sog", "w") as archive:
        archive.writestr("../../readme.txt", "hello")
    assert "expected meta.json in it, found ../../readme.txt" in refusal(tmp_path / "scene.sog")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["scene.sog"]


def test_a_sog_in_a_folder(tmp_path):
    with zipfile.ZipFile(io.BytesIO(sog())) as archive:
        archive.extractall(tmp_path / "scene")
    back, _ = read_gaussians(tmp_path / "scene" / "meta.json")
    assert_alike(make_scene(100, 1), back, ROUNDING[".sog"])
    (tmp_path / "scene" / "sh0.webp").unlink()
    assert "expected sh0.webp beside it, found no such file" in refusal(tmp_path / "scene" / "meta.json")


def test_no_file(tmp_path):
    for path, found in ((tmp_path / "none.spz", "no file"), (tmp_path, "a folder")):
        with pytest.raises(FileNotFoundError, match=f"expected a file of Gaussians, found {found}. Check"):
            read_gaussians(path)


@pytest.mark.parametrize("ending", [*READ_BACK, ".ksplat"])
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_changed_bytes_are_read_or_refused(tmp_path, ending, data):
    path = tmp_path / f"scene{ending}"
    scene = make_scene(20, 1)
    if ending == ".ksplat":
        path.write_bytes(ksplat(1, scene, 1))
    else:
        write_gaussians(path, scene)
    changed = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        changed[data.draw(st.integers(0, len(changed) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(changed))
    try:
        back, report = read_gaussians(path)
        assert back.num + report.culled == report.stored
    except SceneError as error:
        assert str(error).startswith(f"{path}: expected ")  # noqa: PT017


# codebooks


def test_a_codebook_of_few_values_is_exact():
    values = np.array([3.0, -1, 3, 7])
    book = codebook(values)
    assert len(book) == 256
    np.testing.assert_array_equal(book[nearest(book, values)], values)


def test_a_codebook_is_near_to_many_values():
    values = np.concatenate([np.random.default_rng(0).normal(size=20000), [30.0, -30.0]])
    book = codebook(values)
    errors = np.abs(book[nearest(book, values)] - values)
    assert np.sqrt(np.mean(errors**2)) < 0.015
    assert errors.max() < 0.5


def test_a_palette_is_exact_of_few_and_near_to_many():
    rng = np.random.default_rng(0)
    few = rng.normal(size=(50, 9))
    entries, labels = palette(few, 64)
    np.testing.assert_array_equal(entries[labels], few)
    many = rng.normal(size=(40, 9))[rng.integers(0, 40, 3000)] + rng.normal(0, 1e-3, (3000, 9))
    entries, labels = palette(many, 256)
    assert len(entries) <= 256
    assert np.abs(entries[labels] - many).max() < 0.01
    same, labels = palette(np.ones((300, 2)), 256)
    np.testing.assert_array_equal(same[labels], np.ones((300, 2)))


def test_gaussians_of_one_place_are_written(tmp_path):
    scene = make_scene(10)
    scene = eqx.tree_at(lambda g: g.means, scene, jnp.ones((10, 3)))
    for ending in READ_BACK:
        write_gaussians(tmp_path / f"scene{ending}", scene)
        np.testing.assert_allclose(read_gaussians(tmp_path / f"scene{ending}")[0].means, 1, atol=1e-5)
    write_compressed_ply(tmp_path / "again.ply", scene)
    assert read_gaussians(tmp_path / "again.ply")[0].num == 10
