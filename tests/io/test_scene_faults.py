"""Truncated, mislabelled or malicious files of Gaussians are refused with a message, in bounded memory."""

import gzip
import io
import json
import struct
import tracemalloc
import zipfile
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gsjax.io.scene_file import SceneError
from gsjax.io.scenes import read_gaussians, write_gaussians
from gsjax.io.sog import _Meta
from tests.io.scenes_to_write import ROUNDING, assert_alike, ksplat, make_scene, picture, sog, spz, spz4

READ_BACK = sorted(ROUNDING)


@pytest.mark.parametrize(
    "change",
    [
        lambda pairs: pairs[0].__setitem__(1, 1 << 40),
        lambda pairs: pairs[0].__setitem__(0, 1 << 60),
        lambda pairs: pairs.pop(),
    ],
)
def test_an_spz_of_version_4_whose_table_lies(tmp_path, change):
    spz4(make_scene(50), tmp_path / "scene.spz", change)
    with pytest.raises(SceneError, match=r"scene\.spz: expected"):
        read_gaussians(tmp_path / "scene.spz")


def test_empty_entries_of_the_table_of_an_spz_are_skipped(tmp_path):
    spz4(make_scene(50), tmp_path / "scene.spz", lambda pairs: pairs.extend([[0, 0]] * 200))
    assert read_gaussians(tmp_path / "scene.spz")[0].num == 50


def refusal(path, data=None) -> str:
    """The message with which a file is refused; asserts that this needs less than 100 MB of new memory."""
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


def test_sizes_of_an_spz_of_version_4_are_compared_as_a_whole(tmp_path, monkeypatch):
    """Harmonics that are all 0 take next to no room in a file; its other arrays do."""
    path, scene = tmp_path / "scene.spz", make_scene(20_000, 3)
    scene = eqx.tree_at(lambda g: g.shN, scene, 0 * scene.shN)
    monkeypatch.setattr("gsjax.io.scene_file._SMALL", 1 << 19)
    spz4(scene, path)
    assert read_gaussians(path)[0].num == 20_000
    spz4(jax.tree.map(jnp.ones_like, scene), path)
    assert "20000 Gaussians of a size in keeping with its file, found 1300000 bytes from" in refusal(path)


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
        ("a.ksplat", b"\xff\xd8\xff\xe0", "found a JPEG picture. Give such a file, or export"),
        ("a.ply", b"\x89PNG\r\n\x1a\n", "found a PNG picture"),
        ("metrics.json", b'{"psnr": 20}', "found JSON, as a run has beside its scene"),
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
        ("a.spz", b"\x1f\x8b" + bytes(30), "expected a gzip stream, found a damaged one (Error"),
        ("a.sog", b"PK\3\4" + bytes(30), "found a file that cannot be unpacked (File is not a zip file). It"),
        ("a.spz", spz(4, 1 << 31), "a header of 32 bytes"),
        ("a.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 1099511627776\n"
         b"property float x\nend_header\n", "one that cannot be parsed"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 16777216\nproperty list uchar int l\n"
         b"end_header\n1 2\n", "86 bytes, where its header promises 33,554,513 or more"),
        ("a.ksplat", b"\0\1\0\0" + struct.pack("<I", 1 << 31) + bytes(4096), "2147483648 sections"),
        ("a.ksplat", b"\0\1\0\0" + struct.pack("<IIII", 1, 1, 1, 1) + bytes(4076)
         + struct.pack("<II", 1, 1 << 31) + bytes(1016), "section 0 with all its data"),
    ],
    ids=map(str, range(99)),  # not the bytes, some of which contain the time
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
        (lambda m: m["means"].update(files=["a" * 20000, "b"]), "names of files as means.files"),
        (lambda m: m["means"].update(files=["no.webp", "b"]), "expected no.webp in it, found means_l.webp"),
        (lambda m: m["means"].update(files=["meta.json", "means_u.webp"]), "picture as meta.json"),
        (lambda m: m["means"].update(mins=[0, None, 0]), "3 finite numbers as means.mins"),
        (lambda m: m["scales"].update(codebook=[1, 2]), "256 finite numbers as scales.codebook"),
        (lambda m: m["sh0"]["codebook"].__setitem__(1, None), "256 finite numbers as sh0.codebook"),
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
        ({"quats.webp": b"RIFF????WEBPVP8L"}, "picture as quats.webp, found data that cannot be decoded ("),
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


@pytest.mark.parametrize("key", ["scales", "sh0", "shN"])
def test_a_codebook_of_a_sog_that_begins_with_null_goes_on_backwards(key):
    """splat-transform wrote one for scenes with NaN; PlayCanvas's engine continues the other entries."""
    text = json.dumps({key: {"codebook": [None, *range(1, 256)]}}).encode()
    expected = 1 + (1 - 255) / 255
    assert _Meta(Path("scene.sog"), text).codebook(key).tolist() == [expected, *range(1, 256)]


def test_a_sog_whose_codebooks_begin_with_null_is_read(tmp_path):
    def change(meta):
        for key in ("scales", "sh0", "shN"):
            meta[key]["codebook"][0] = None

    (tmp_path / "scene.sog").write_bytes(sog(change))
    assert read_gaussians(tmp_path / "scene.sog")[0].num == 100


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
