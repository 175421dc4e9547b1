"""Atomic writes: a file is complete or does not exist."""

import json
import os

import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.io.atomic import atomic_write, write_json, write_new, write_npz


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_interrupted_write_leaves_the_old_file_and_no_litter(tmp_path, error):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def write_half():
        with atomic_write(path) as temporary:
            temporary.write_text("ne")
            raise error

    with pytest.raises(error):
        write_half()
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_folders_are_made_and_the_suffix_is_kept(tmp_path):
    with atomic_write(tmp_path / "deep" / "er" / "x.ply") as temporary:
        assert temporary.suffix == ".ply"
        temporary.write_text("whole")
    assert os.listdir(tmp_path / "deep" / "er") == ["x.ply"]


def test_errors_name_the_file_that_was_asked_for(tmp_path):
    with pytest.raises(FileNotFoundError) as caught, atomic_write(tmp_path / "x.ply") as temporary:
        temporary.read_bytes()
    assert caught.value.filename == str(tmp_path / "x.ply")


def test_a_new_file_takes_the_first_free_name(tmp_path):
    (tmp_path / "1").write_text("mine")
    names = [tmp_path / name for name in "123"]
    assert write_new(names, lambda path: path.write_text("new")) == tmp_path / "2"
    assert (tmp_path / "1").read_text() == "mine"

    def full(path):
        assert path.exists()  # the name is reserved
        raise OSError("no space")

    with pytest.raises(OSError, match="no space"):
        write_new(names, full)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1", "2"]
    with pytest.raises(FileExistsError, match="found none"):
        write_new(names[:2], full)


def test_json_holds_arrays_and_no_nan(tmp_path):
    value = {
        "a": jnp.arange(2),
        3: (np.float32(0.5), float("nan"), np.inf),
        "path": tmp_path,
        "b": np.bool_(True),
    }
    write_json(tmp_path / "a.json", value)
    loaded = json.loads((tmp_path / "a.json").read_text())
    assert loaded == {"a": [0, 1], "3": [0.5, None, None], "path": str(tmp_path), "b": True}
    with pytest.raises(TypeError):
        write_json(tmp_path / "b.json", {"a": object()})
    assert not (tmp_path / "b.json").exists()


def test_npz_needs_no_pickle(tmp_path):
    write_npz(tmp_path / "a.npz", {"values": np.arange(3), "name": np.array("text")})
    with np.load(tmp_path / "a.npz", allow_pickle=False) as archive:
        np.testing.assert_array_equal(archive["values"], [0, 1, 2])
        assert str(archive["name"]) == "text"
    with pytest.raises(ValueError, match=r"found Python objects in \['bad'\]"):
        write_npz(tmp_path / "b.npz", {"bad": np.array([{}])})
