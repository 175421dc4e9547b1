"""Damaged or malicious arrays, JSON and YAML: a short message, and no memory for sizes merely claimed."""

import tracemalloc
import zipfile

import numpy as np
import pytest

from gsjax.io.arrays import ArraysError, load_arrays
from gsjax.io.brief import brief
from gsjax.io.parsed import parse_json, parse_yaml


def npy(header: str, data: bytes = bytes(16)) -> bytes:
    return b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header.encode() + data


def head(shape: str, kind: str = "<f4") -> str:
    return f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n"


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x93NUMPY",
        npy("{'descr': '<f4', 'shape': (("),  # numpy raises a TokenError
        npy(head("(1099511627776,)")),
        npy(head("(1099511627776, 1099511627776)")),
        npy(head("(4611686018427387904, 0)")),
        npy(head("(5,)")),
        npy(head("(2,)", "|O"), b"\x80\x04cos\nsystem\n."),
        npy("[" * 3000),
        b"PK\3\4" + bytes(60),
    ],
    ids=map(str, range(10)),
)
def test_what_is_no_array_is_refused_in_bounds(tmp_path, content):
    (tmp_path / "a.npy").write_bytes(content)
    tracemalloc.start()
    try:
        with pytest.raises(ArraysError) as refused:
            load_arrays(tmp_path / "a.npy")
        assert tracemalloc.get_traced_memory()[1] < 1e7
    finally:
        tracemalloc.stop()
    assert 0 < len(str(refused.value)) < 500


def test_archives_of_other_files_and_bombs(tmp_path):
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("../x", "no array")
    with pytest.raises(ArraysError):
        load_arrays(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.npy", "w") as part:
        part.write(npy(head(f"({1 << 40},)"), bytes(1 << 20)))
    with pytest.raises(ArraysError, match="bytes for an array of shape"):
        load_arrays(path)
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]


def test_what_is_whole_is_read(tmp_path):
    rows = {"a": np.arange(6.0).reshape(2, 3), "b": np.array("text"), "c": np.zeros((0, 4), np.int8)}
    np.savez_compressed(tmp_path / "a.npz", **rows)
    np.save(tmp_path / "a.npy", rows["a"].T)
    found = load_arrays(tmp_path / "a.npz")
    assert found.keys() == rows.keys()
    assert all(np.array_equal(found[name], rows[name]) for name in rows)
    np.testing.assert_array_equal(load_arrays(tmp_path / "a.npy")[""], rows["a"].T)
    with pytest.raises(FileNotFoundError):
        load_arrays(tmp_path / "none.npy")


@pytest.mark.thorough
@pytest.mark.parametrize("parse", [parse_json, parse_yaml])
@pytest.mark.parametrize("text", ["[" * 100_000, "9" * 5000, '{"a": ', '"' + "x" * 100_000])
def test_text_that_is_too_deep_or_too_long(parse, text):
    with pytest.raises(ValueError) as refused:  # noqa: PT011 (only the length of the message counts)
        parse(text)
    assert 0 < len(str(refused.value)) < 500


def test_long_words_lose_their_middle():
    assert brief("a\n b") == "a b"
    long = brief("start " + "x" * 10**6 + " end")
    assert long.startswith("start x")
    assert long.endswith("x end")
    assert len(long) <= 400
