import shutil
import struct
import sys
import tracemalloc
import zipfile

import numpy as np
import pytest

from gsjax.data import (
    DataError,
    DataWarning,
    ReadOptions,
    open_photographs,
    open_sequence,
    read_record3d,
)
from gsjax.data.exr import read_exr_depth
from gsjax.data.simulated import tabletop
from gsjax.extras import MissingExtra
from tests.data import dots
from tests.data.exports import write_exr, write_record3d
from tests.data.faulty import change

pytest.importorskip("OpenEXR", reason="depth by Record3D is in OpenEXR files: pip install 'gsjax[record3d]'")
WIDTH, HEIGHT, DEPTH = 48, 36, (16, 12)


@pytest.fixture(scope="module")
def seen():
    return tabletop(frames=1, width=WIDTH, height=HEIGHT, cameras=4)


@pytest.fixture(scope="module")
def sound(seen, tmp_path_factory):
    root = tmp_path_factory.mktemp("record3d") / "desk"
    write_record3d(root, seen, DEPTH)
    return root


@pytest.fixture
def folder(sound, tmp_path):
    return shutil.copytree(sound, tmp_path / "desk")


def edit(folder, **changes):
    change("metadata.json", lambda meta: meta.update(changes))(folder)


def drop(folder, *keys):
    change("metadata.json", lambda meta: [meta.pop(key) for key in keys])(folder)


def test_frames_and_cameras_are_those_that_were_written(sound, seen):
    sequence = open_sequence(sound)
    assert (sequence.name, sequence.camera_ids, sequence.frame_ids) == ("desk", (0,), (0, 1, 2, 3))
    np.testing.assert_allclose(sequence.times, np.arange(4) / 10)
    np.testing.assert_allclose(sequence.viewmats[:, 0], seen.viewmats[0], atol=1e-9)
    np.testing.assert_allclose(sequence.Ks[:, 0], seen.Ks[0])
    for n in range(4):
        np.testing.assert_array_equal(sequence.image(n, 0), seen.image(0, n))
    assert sequence.where("depth", 2, 0).endswith("depth/2.exr")
    assert sequence.where("image", 2, 0).endswith("rgb/2.png")


def test_depth_is_that_of_the_pixel_it_was_measured_in(sound, seen):
    """Each block of 3x3 pixels shares the depth measured at its middle one."""
    depth, exact = open_sequence(sound).depth(1, 0), seen.depth(0, 1)
    np.testing.assert_array_equal(depth[1::3, 1::3], exact[1::3, 1::3])
    np.testing.assert_array_equal(depth, np.repeat(np.repeat(exact[1::3, 1::3], 3, 0), 3, 1))
    assert depth.dtype == np.float32


def test_a_recording_is_also_photographs(sound):
    photographs = open_photographs(sound)
    assert photographs.num == 4
    assert photographs.depth(3).shape == (HEIGHT, WIDTH)


@pytest.mark.parametrize("place", [".", "EXR_RGBD", "desk", "desk/EXR_RGBD"])
def test_places(sound, tmp_path, place):
    root = tmp_path / "export"
    shutil.copytree(sound, root / place)
    assert open_sequence(root).name == ("export" if place in (".", "EXR_RGBD") else "desk")


def test_metadata_beside_the_folder_and_without_an_extension(sound, tmp_path):
    shutil.copytree(sound, tmp_path / "EXR_RGBD")
    (tmp_path / "EXR_RGBD/metadata.json").rename(tmp_path / "metadata")
    assert open_sequence(tmp_path).num_frames == 4
    (tmp_path / "metadata").unlink()
    with pytest.raises(DataError, match=r"metadata.json: expected Record3D's metadata, found no such file"):
        open_sequence(tmp_path)


def test_several_recordings(sound, tmp_path):
    for name in ("desk", "sofa"):
        shutil.copytree(sound, tmp_path / name)
    with pytest.raises(DataError, match=r"expected one recording by .*found 2 \(desk, sofa\). Give one"):
        open_sequence(tmp_path)


def test_metadata_of_old_versions_have_one_K_and_a_rate(folder, seen):
    drop(folder, "perFrameIntrinsicCoeffs", "frameTimestamps", "initPose")
    sequence = read_record3d(folder)
    np.testing.assert_allclose(sequence.Ks[3, 0], seen.Ks[0, 0])
    np.testing.assert_allclose(sequence.times, np.arange(4) / 10)
    drop(folder, "fps")
    np.testing.assert_allclose(read_record3d(folder).times, np.arange(4) / 30)


def test_each_frame_has_its_own_intrinsics(folder):
    edit(folder, perFrameIntrinsicCoeffs=[[40 + n, 41 + n, 24 + n, 18] for n in range(4)])
    K = read_record3d(folder).Ks[2, 0]
    np.testing.assert_array_equal(K, [[42, 0, 26], [0, 43, 18], [0, 0, 1]])


def test_intrinsics_follow_pictures_that_were_downscaled(folder, seen):
    for n in range(4):
        dots.save(folder / f"rgb/{n}.png", seen.image(0, n)[::2, ::2])
    sequence = read_record3d(folder)
    assert (sequence.width, sequence.height) == (WIDTH // 2, HEIGHT // 2)
    np.testing.assert_allclose(sequence.Ks[:, 0], np.diag([0.5, 0.5, 1]) @ seen.Ks[0])
    assert sequence.depth(0, 0).shape == (HEIGHT // 2, WIDTH // 2)


def test_counts_that_differ(folder):
    """Three of the six frames are complete."""
    (folder / "depth/1.exr").unlink()
    change("metadata.json", lambda meta: meta["poses"].extend([meta["poses"][0]] * 2))(folder)
    edit(folder, perFrameIntrinsicCoeffs=[], frameTimestamps=[])
    says = r"desk: 3 of 6 frames are left out: 1 without depth \(1\), 2 without a picture \(4, 5\)"
    with pytest.warns(DataWarning, match=says):
        assert read_record3d(folder).frame_ids == (0, 2, 3)


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("poses", [0.0] * 7, "1 without a pose"),
        ("poses", [None] * 7, "1 without a pose"),
        ("perFrameIntrinsicCoeffs", [None] * 4, "1 without intrinsics"),
        ("frameTimestamps", 0.1, "1 without a later time"),
    ],
)
def test_a_frame_that_lacks_something_is_left_out(folder, key, value, says):
    change("metadata.json", lambda meta: meta[key].__setitem__(2, value))(folder)
    with pytest.warns(DataWarning, match=rf"1 of 4 frames are left out: {says} \(2\)"):
        assert read_record3d(folder).frame_ids == (0, 1, 3)


def test_lists_that_end_early(folder):
    change("metadata.json", lambda meta: meta["frameTimestamps"].pop())(folder)
    change("metadata.json", lambda meta: meta["perFrameIntrinsicCoeffs"].__delitem__(slice(2, None)))(folder)
    with pytest.warns(DataWarning, match=r"2 of 4 frames are left out: 2 without intrinsics \(2, 3\)"):
        assert read_record3d(folder).frame_ids == (0, 1)


def test_depth_of_another_shape(folder):
    write_exr(folder / "depth/0.exr", R=np.ones((16, 12), np.float32))
    with pytest.raises(DataError, match=r"0.exr: expected depth of the shape of .*48x36.*found 12x16"):
        read_record3d(folder).depth(0, 0)


def test_what_was_not_measured_is_invalid(folder):
    depth = np.full((12, 16), 2, np.float32)
    depth[0, :3] = np.nan, np.inf, 0
    write_exr(folder / "depth/0.exr", R=depth)
    np.testing.assert_array_equal(read_record3d(folder).depth(0, 0)[0, 1:13:3], [0, 0, 0, 2])


def test_options_without_use_are_refused(sound):
    with pytest.raises(ValueError, match=r"options for Record3D data .*found --read.depth-unit-m"):
        open_sequence(sound, ReadOptions(depth_unit_m=0.001))


def test_the_internal_format_is_refused_with_what_to_export(tmp_path):
    file = tmp_path / "desk.r3d"
    with zipfile.ZipFile(file, "w") as packed:
        packed.writestr("metadata", "{}")
        packed.writestr("rgbd/0.depth", b"bvx2")
    says = r"found an .*r3d file, whose depth is not read. In Record3D choose .*EXR \+ RGB sequence"
    with pytest.raises(DataError, match=says):
        open_sequence(file)
    with zipfile.ZipFile(file) as packed:
        packed.extractall(tmp_path / "unpacked")
    with pytest.raises(DataError, match=says):
        open_photographs(tmp_path / "unpacked")


def test_the_extra_is_named_where_it_is_missing(sound, monkeypatch):
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(MissingExtra, match=r"a recording by Record3D needs .*'gsjax\[record3d\]'"):
        open_sequence(sound)


@pytest.mark.parametrize("type_", [np.float32, np.float16])
@pytest.mark.parametrize("names", [("anything",), ("R", "G", "B"), ("A", "Z")])
def test_the_channel_with_depth(tmp_path, names, type_):
    depths = {name: np.full((5, 7), i + 1, type_) for i, name in enumerate(names)}
    write_exr(tmp_path / "0.exr", **depths)
    depth = read_exr_depth(tmp_path / "0.exr")
    assert depth.dtype == np.float32
    np.testing.assert_array_equal(depth, 2 if "Z" in names else 1)


@pytest.mark.parametrize("compression", ["NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "DWAA", "DWAB"])
def test_every_compression_is_read_and_its_end_is_found(tmp_path, compression):
    import OpenEXR

    depth, file = np.random.default_rng(0).random((300, 9), np.float32), tmp_path / "0.exr"
    header = {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION"), "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"R": depth}).write(str(file))
    np.testing.assert_allclose(read_exr_depth(file), depth, atol=0.05)
    content = file.read_bytes()
    for length in (len(content) - 1, len(content) // 2, 330):
        file.write_bytes(content[:length])
        with pytest.raises(DataError, match="found a file that is cut off"):
            read_exr_depth(file)


def test_damage_is_told_in_the_message_alone(tmp_path, capfd):
    """Nothing is printed to stdout, which other programs may parse."""
    write_exr(tmp_path / "0.exr", R=np.ones((300, 300), np.float32))
    content = bytearray((tmp_path / "0.exr").read_bytes())
    content[-20:-10] = b"x" * 10
    (tmp_path / "0.exr").write_bytes(content)
    with pytest.raises(DataError, match=r"0.exr: expected depth .*, found bad data \(.*\). Fetch"):
        read_exr_depth(tmp_path / "0.exr")
    assert capfd.readouterr().out == ""


def damaged(file, old, new):
    content = file.read_bytes()
    assert old in content
    file.write_bytes(content.replace(old, new, 1))


@pytest.mark.parametrize("side", [100_000, 2**31 - 1])
def test_a_size_that_no_camera_has_takes_no_memory(folder, side):
    file = folder / "depth/0.exr"
    damaged(file, struct.pack("<4i", 0, 0, 15, 11), struct.pack("<4i", 0, 0, side - 1, side - 1))
    sequence = read_record3d(folder)
    tracemalloc.start()
    with pytest.raises(DataError, match=rf"depth of at most 16,777,216 values, found {side}x{side} pixels"):
        sequence.depth(0, 0)
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()


@pytest.mark.parametrize(
    ("channels", "says"),
    [
        ({"R": np.ones((12, 16), np.uint32)}, "found integers in R"),
        ({"A": np.ones((12, 16), np.float32), "B": np.ones((12, 16), np.float32)}, "the channels A, B"),
    ],
)
def test_files_without_depth(tmp_path, channels, says):
    write_exr(tmp_path / "0.exr", **channels)
    with pytest.raises(DataError, match=f"0.exr: expected floats in one channel.*{says}"):
        read_exr_depth(tmp_path / "0.exr")


def test_a_file_without_channels(tmp_path):
    write_exr(tmp_path / "0.exr", R=np.ones((12, 16), np.float32))
    only = b"R\0" + struct.pack("<iIii", 2, 0, 1, 1)
    damaged(tmp_path / "0.exr", only, bytes(len(only)))
    with pytest.raises(DataError, match=r"found no channel\. Export"):
        read_exr_depth(tmp_path / "0.exr")


def test_damage_anywhere_in_a_header_is_told_in_one_message(sound, tmp_path):
    """A change of any byte of the header gives depth or a DataError."""
    content, file = (sound / "depth/0.exr").read_bytes(), tmp_path / "0.exr"
    refused = 0
    for at in range(330):
        file.write_bytes(content[:at] + bytes([content[at] ^ 0x41]) + content[at + 1 :])
        try:
            read_exr_depth(file)
        except DataError:
            refused += 1
    assert refused > 100
