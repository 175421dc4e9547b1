"""Features are read in the layouts of other tools; no code in a file is ever executed."""

import importlib.util
import io
import pickle
import zipfile

import numpy as np
import pytest

from gsjax.perception.feature_files import read_feature_folder
from gsjax.perception.torch_arrays import read_torch_array

RANDOM = np.random.default_rng(0)
MAP = RANDOM.normal(size=(3, 4, 5)).astype(np.float16)


class _Storage:
    """What torch's pickler writes in place of the numbers."""

    def __init__(self, kind: str, count: int):
        self.persistent_id = ("storage", _Global("torch", kind), "0", "cpu", count)


class _Global:
    """A module's global, pickled by name."""

    def __init__(self, module: str, name: str):
        self.module, self.name = module, name


class _Pickler(pickle._Pickler):
    """Writes the same as torch's pickler, without torch."""

    def persistent_id(self, obj):
        return obj.persistent_id if isinstance(obj, _Storage) else None

    def save(self, obj, save_persistent_id=True):
        if isinstance(obj, _Global):
            self.write(f"c{obj.module}\n{obj.name}\n".encode())
        elif isinstance(obj, _Call):
            self.save(obj.function)
            self.save(obj.arguments)
            self.write(pickle.REDUCE)
        else:
            super().save(obj, save_persistent_id)


class _Call:
    def __init__(self, function: _Global, *arguments):
        self.function, self.arguments = function, arguments


def tensor(array: np.ndarray, kind: str, offset: int = 0, shape=None, strides=None) -> _Call:
    """What torch writes for a tensor."""
    shape = array.shape if shape is None else shape
    strides = tuple(s // array.itemsize for s in array.strides) if strides is None else strides
    rebuild = _Global("torch._utils", "_rebuild_tensor_v2")
    hooks = _Call(_Global("collections", "OrderedDict"))
    return _Call(rebuild, _Storage(kind, array.size), offset, shape, strides, False, hooks)


def write_torch(path, described, numbers: bytes, packed: int = zipfile.ZIP_STORED) -> None:
    stream = io.BytesIO()
    _Pickler(stream, protocol=2).dump(described)
    with zipfile.ZipFile(path, "w", packed) as archive:
        archive.writestr("archive/data.pkl", stream.getvalue())
        archive.writestr("archive/byteorder", "little")
        archive.writestr("archive/data/0", numbers)


@pytest.mark.parametrize(
    ("kind", "dtype"), [("FloatStorage", np.float32), ("HalfStorage", np.float16), ("LongStorage", np.int64)]
)
def test_a_tensor_of_a_torch_file_is_read_without_torch(tmp_path, kind, dtype):
    array = (10 * RANDOM.normal(size=(3, 4, 5))).astype(dtype)
    write_torch(tmp_path / "a.pt", tensor(array, kind), array.tobytes())
    found = read_torch_array(tmp_path / "a.pt")
    np.testing.assert_array_equal(found, array)
    assert found.dtype == dtype
    turned = tensor(array, kind, offset=20, shape=(5, 2), strides=(1, 5))  # a view of a part of the array
    write_torch(tmp_path / "b.pt", turned, array.tobytes())
    np.testing.assert_array_equal(read_torch_array(tmp_path / "b.pt"), array[1, :2].T)


@pytest.mark.skipif(not importlib.util.find_spec("torch"), reason="torch is not installed")
def test_what_torch_writes_is_read(tmp_path):
    import torch

    for given in (torch.randn(3, 4), torch.randn(4, 5).half().T, torch.arange(10)[3:7], torch.zeros(0, 3)):
        torch.save(given, tmp_path / "a.pt")
        np.testing.assert_array_equal(read_torch_array(tmp_path / "a.pt"), given.numpy())


def test_a_pickle_that_would_run_something_is_refused_and_not_run(tmp_path):
    evil = _Call(_Global("os", "mkdir"), str(tmp_path / "was run"))
    inside = tensor(np.ones(3, np.float32), "FloatStorage")
    inside.arguments = (*inside.arguments[:-1], evil)
    for name, described in (("plain", evil), ("inside", inside)):
        write_torch(tmp_path / f"{name}.pt", described, np.ones(3, np.float32).tobytes())
        with pytest.raises(ValueError, match=r"found 'os.mkdir'; gsjax loads no pickles"):
            read_torch_array(tmp_path / f"{name}.pt")
    assert not (tmp_path / "was run").exists()


@pytest.mark.parametrize(
    "described",
    [
        {"a": 1},
        [1, 2],
        "text",
        tensor(np.ones(3, np.float32), "FloatStorage", shape=(4,)),
        tensor(np.ones(3, np.float32), "FloatStorage", offset=-1),
        tensor(np.ones(3, np.float32), "FloatStorage", strides=(10**9,)),
        tensor(np.ones(3, np.float32), "FloatStorage", shape=("x",)),
        tensor(np.ones(3, np.float32), "FloatStorage", shape=(10**12,), strides=(0,)),
        tensor(np.ones(3, np.float32), "FloatStorage", shape=(4,), strides=(0,)),
        tensor(np.ones(3, np.float32), "FloatStorage", shape=(0, 10**12, 10**12), strides=(1, 1, 1)),
        tensor(np.ones(3, np.float32), "FloatStorage", shape=(1,) * 80, strides=(1,) * 80),
        tensor(np.ones(3, np.float32), "DoubleStorage"),  # 12 bytes are not a whole number of doubles
        tensor(np.ones(3, np.float32), "BFloat16Storage"),
        _Call(_Global("collections", "OrderedDict")),
    ],
)
def test_anything_but_one_tensor_is_refused(tmp_path, described):
    write_torch(tmp_path / "a.pt", described, np.ones(3, np.float32).tobytes())
    with pytest.raises(ValueError, match=r"a\.pt: expected .* Save it again as \.npy"):
        read_torch_array(tmp_path / "a.pt")


def test_a_kind_of_storage_that_is_only_a_text_is_refused(tmp_path):
    described = tensor(np.ones(3, np.float32), "FloatStorage")
    described.arguments[0].persistent_id = ("storage", "torch FooStorage", "0", "cpu", 3)
    write_torch(tmp_path / "a.pt", described, np.ones(3, np.float32).tobytes())
    with pytest.raises(ValueError, match=r"a\.pt: expected one tensor .* found a storage 'torch FooStorage'"):
        read_torch_array(tmp_path / "a.pt")


def test_what_could_unpack_or_print_without_end_is_refused(tmp_path):
    zeros = np.zeros(10**6, np.float32)
    write_torch(tmp_path / "packed.pt", tensor(zeros, "FloatStorage"), zeros.tobytes(), zipfile.ZIP_DEFLATED)
    with pytest.raises(
        ValueError, match=r"packed\.pt: expected archive/data\.pkl uncompressed, as torch\.save writes it"
    ):
        read_torch_array(tmp_path / "packed.pt")
    write_torch(tmp_path / "long.pt", tuple(range(5000)), b"")
    with pytest.raises(ValueError, match=r"long\.pt: expected one tensor .* found a pickle of \d+ bytes"):
        read_torch_array(tmp_path / "long.pt")
    doubled = ("x",)
    for _ in range(200):  # 2^200 words when it is printed
        doubled = (doubled, doubled)
    write_torch(tmp_path / "deep.pt", _Call(doubled), b"")
    with pytest.raises(ValueError, match=r"deep\.pt: expected one tensor .* found a call of 'no function'"):
        read_torch_array(tmp_path / "deep.pt")


def test_files_of_other_kinds_are_refused(tmp_path):
    (tmp_path / "old.pt").write_bytes(b"\x80\x02")
    with pytest.raises(ValueError, match=r"old\.pt: expected a file of torch\.save"):
        read_torch_array(tmp_path / "old.pt")
    with zipfile.ZipFile(tmp_path / "empty.pt", "w") as archive:
        archive.writestr("readme", "nothing")
    with pytest.raises(ValueError, match=r"found no data\.pkl in it"):
        read_torch_array(tmp_path / "empty.pt")


def test_each_layout_is_recognised_by_its_files(tmp_path):
    for name in ("langsplat", "feature3dgs", "torch", "lerf", "plain", "archive", "masks"):
        (tmp_path / name).mkdir()
    ids = np.stack([np.full((6, 8), level) for level in range(4)])
    ids[0, 0, 0] = -1
    book = RANDOM.normal(size=(4, 5)).astype(np.float32)
    np.save(tmp_path / "langsplat/frame_1_s.npy", ids)
    np.save(tmp_path / "langsplat/frame_1_f.npy", book)
    np.save(tmp_path / "feature3dgs/frame_1_fmap_CxHxW.npy", np.moveaxis(MAP, -1, 0))
    channels_first = np.ascontiguousarray(np.moveaxis(MAP, -1, 0))
    described = tensor(channels_first, "HalfStorage")
    write_torch(tmp_path / "torch/frame_1_fmap_CxHxW.pt", described, channels_first.tobytes())
    np.save(tmp_path / "lerf/level_0.npy", MAP[None])
    np.save(tmp_path / "plain/frame_1.npy", MAP)
    np.savez(tmp_path / "archive/frame_1.npz", features=MAP)
    np.savez(tmp_path / "masks/frame_1.npz", ids=ids[0], codebook=book)

    for name in ("feature3dgs", "torch", "lerf", "plain", "archive"):
        (found,) = read_feature_folder(tmp_path / name, ["images/frame_1.jpg"])
        np.testing.assert_array_equal(found.map, MAP.astype(np.float32))
        assert found.dimension == 5
    for name in ("langsplat", "masks"):
        (found,) = read_feature_folder(tmp_path / name, ["images/frame_1.jpg"])
        np.testing.assert_array_equal(found.ids, ids[0])
        np.testing.assert_array_equal(found.codebook, book)
    (large,) = read_feature_folder(tmp_path / "langsplat", ["frame_1.png"], level="large")
    np.testing.assert_array_equal(large.ids, 3)
    (each,) = read_feature_folder(tmp_path / "langsplat", ["frame_1.png"], level="each")
    np.testing.assert_array_equal(each.ids, 0)
    np.testing.assert_array_equal(each.codebook, book[1:].reshape(1, -1))
    with pytest.raises(ValueError, match=r"frame_1\.npy: .* features on one level"):
        read_feature_folder(tmp_path / "plain", ["frame_1.png"], level="each")


def test_names_in_folders_are_found_too(tmp_path):
    (tmp_path / "3").mkdir()
    np.save(tmp_path / "3/000000.npy", MAP)
    (found,) = read_feature_folder(tmp_path, ["3/000000"])
    assert found.path == tmp_path / "3/000000.npy"


def test_a_file_that_several_pictures_would_share_is_refused(tmp_path):
    np.save(tmp_path / "000000.npy", MAP)
    (found,) = read_feature_folder(tmp_path, ["1/000000"])
    assert found.path == tmp_path / "000000.npy"
    with pytest.raises(
        ValueError, match=r"000000\.npy: .* 0/000000 and 1/000000 both match; .* a folder per camera"
    ):
        read_feature_folder(tmp_path, ["0/000000", "1/000000", "2/000000"])
    for camera in "01":
        (tmp_path / camera).mkdir()
        np.save(tmp_path / camera / "000000.npy", MAP)
    found = read_feature_folder(tmp_path, ["0/000000", "1/000000", "2/000000"])
    assert [one.path.parent.name for one in found] == ["0", "1", tmp_path.name]
    np.save(tmp_path / "a.npy", MAP)
    with pytest.raises(ValueError, match=r"a\.jpg and a\.png both match"):
        read_feature_folder(tmp_path, ["a.jpg", "a.png"])


def test_the_only_file_of_a_folder_may_hold_all_pictures(tmp_path):
    np.save(tmp_path / "dino.npy", np.stack([MAP, 2 * MAP]))
    (tmp_path / "dino.info").write_text("{}")
    found = read_feature_folder(tmp_path, ["0/a.jpg", "1/a.jpg"])
    np.testing.assert_array_equal(found[1].map, 2 * MAP.astype(np.float32))
    # Two of the three images are for training: LERF stores features of no others.
    of_two = read_feature_folder(tmp_path, ["a.jpg", "b.jpg", "c.jpg"], which=[0, 2])
    np.testing.assert_array_equal(of_two[1].map, 2 * MAP.astype(np.float32))
    with pytest.raises(ValueError, match=r"of 3 images, or of the 1 that are selected, found 2; .* order"):
        read_feature_folder(tmp_path, ["a.jpg", "b.jpg", "c.jpg"], which=[1])
    with pytest.raises(ValueError, match=r"dino\.npy: expected features of 3 images, found 2; .* order"):
        read_feature_folder(tmp_path, ["a.jpg", "b.jpg", "c.jpg"])
    np.save(tmp_path / "other.npy", np.stack([MAP, MAP]))
    with pytest.raises(
        FileNotFoundError, match=r"of the image 0/a\.jpg, .* in a\.npy .* found dino\.info, dino\.npy, other"
    ):
        read_feature_folder(tmp_path, ["0/a.jpg", "1/a.jpg"])


def bad_files(folder, kind):
    if kind == "object":
        np.save(folder / "a.npy", np.array([{"a": 1}], object), allow_pickle=True)
    elif kind == "flat":
        np.save(folder / "a.npy", MAP[0])
    elif kind == "words":
        np.save(folder / "a.npy", np.full((2, 2, 2), "x"))
    elif kind == "nan":
        np.save(folder / "a.npy", np.where(np.arange(5) == 2, np.nan, MAP))
    elif kind == "rows":
        np.savez(folder / "a.npz", ids=np.full((3, 4), 7), codebook=MAP[0])
    elif kind == "other":
        np.savez(folder / "a.npz", poses=MAP)
    elif kind == "broken":
        (folder / "a.npz").write_bytes(b"PK\x03\x04 not a zip")
    elif kind == "misnamed":
        np.savez(folder / "a.npz", features=MAP)
        (folder / "a.npz").rename(folder / "a.npy")
    elif kind == "cut off":
        np.save(folder / "a.npy", MAP)
        (folder / "a.npy").write_bytes((folder / "a.npy").read_bytes()[:-8])
    elif kind == "huge":
        header = {"descr": "<f4", "fortran_order": False, "shape": (2**70, 4, 5)}
        with (folder / "a.npy").open("wb") as file:
            np.lib.format.write_array_header_1_0(file, header)
    elif kind == "no archive":
        np.save(folder / "a.npy", MAP)
        (folder / "a.npy").rename(folder / "a.npz")
    elif kind == "no array":
        with zipfile.ZipFile(folder / "a.npz", "w") as archive:
            archive.writestr("features.npy", "text")
    elif kind == "object inside":
        np.savez(folder / "a.npz", features=np.array([{"a": 1}], object))
    elif kind == "secret":  # claims to be encrypted
        np.savez(folder / "a.npz", features=MAP)
        packed = bytearray((folder / "a.npz").read_bytes())
        packed[6] |= 1
        packed[packed.index(b"PK\x01\x02") + 8] |= 1
        (folder / "a.npz").write_bytes(packed)
    elif kind == "wrapped":
        np.savez(folder / "a.npz", ids=np.full((3, 4), 2**32), codebook=MAP[0])
    elif kind == "fractions":
        np.savez(folder / "a.npz", ids=np.full((3, 4), 0.5), codebook=MAP[0])
    elif kind == "dimension":
        np.save(folder / "a.npy", MAP)
        np.save(folder / "b.npy", MAP[..., :3])
    elif kind == "stack":
        np.save(folder / "level_0.npy", np.stack([MAP] * 3))


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        ("object", r"a\.npy: expected a plain array"),
        ("flat", r"a\.npy: expected numbers of shape \[h,w,C\], found float16 of shape \[4, 5\]"),
        ("words", r"a\.npy: expected numbers of shape \[h,w,C\], found <U1"),
        ("nan", r"a\.npy: expected finite numbers, found 12 that are NaN or infinite"),
        ("rows", r"a\.npz: expected rows -1 to 3, found 7 to 7"),
        ("other", r"a\.npz: expected features, or ids and codebook, found poses"),
        ("broken", r"a\.npz: expected plain arrays"),
        ("misnamed", r"a\.npy: expected a plain array, found an archive; name it a\.npz"),
        ("cut off", r"a\.npy: expected a plain array, found a file that cannot be read .* numpy\.save"),
        ("huge", r"a\.npy: expected a plain array, found a file that cannot be read"),
        ("no archive", r"a\.npz: expected plain arrays, found a file that cannot be read .* numpy\.savez"),
        ("no array", r"a\.npz: expected plain arrays, found a file that cannot be read"),
        ("object inside", r"a\.npz: expected plain arrays, found .* allow_pickle=False"),
        ("secret", r"a\.npz: expected plain arrays, found .* encrypted"),
        ("wrapped", r"a\.npz: expected rows -1 to 3, found 4294967296 to 4294967296"),
        ("fractions", r"a\.npz: expected rows of the codebook as whole numbers, found fractions"),
        ("dimension", r"b\.npy: expected features of 5 numbers as in a\.npy, found 3"),
        ("stack", r"level_0\.npy: expected features of 2 images, found 3"),
    ],
)
def test_files_that_do_not_hold_what_they_should_are_refused(tmp_path, kind, says):
    bad_files(tmp_path, kind)
    with pytest.raises(ValueError, match=says):
        read_feature_folder(tmp_path, ["a.jpg", "b.jpg"])


def test_an_archive_that_would_unpack_to_much_is_refused_and_not_unpacked(tmp_path, monkeypatch):
    monkeypatch.setattr("gsjax.perception.feature_files._LARGE", 10**5)
    np.savez_compressed(tmp_path / "a.npz", features=np.zeros((100, 100, 50), np.float32))
    with pytest.raises(ValueError, match=r"a\.npz: .*\d+ bytes that would unpack to 2000128"):
        read_feature_folder(tmp_path, ["a.jpg"])
    np.savez_compressed(tmp_path / "a.npz", features=MAP, unread=np.zeros(10**6, np.float32))
    (found,) = read_feature_folder(tmp_path, ["a.jpg"])
    np.testing.assert_array_equal(found.map, MAP.astype(np.float32))


def test_features_that_are_not_there_are_missed(tmp_path):
    with pytest.raises(FileNotFoundError, match="expected a folder of features"):
        read_feature_folder(tmp_path / "none", ["a.jpg"])
    np.save(tmp_path / "other.npy", MAP)
    with pytest.raises(FileNotFoundError, match=r"image a\.jpg, for example in a\.npy .* found other\.npy"):
        read_feature_folder(tmp_path, ["a.jpg"])
    with pytest.raises(ValueError, match="level: expected one of default, small, medium, large"):
        read_feature_folder(tmp_path, ["other.jpg"], level="huge")
