"""Checkpoints are loaded without a template; errors of damaged or foreign files say what is wrong."""

import json
import pickle
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from gsjax.io.checkpoints import CheckpointError, load_checkpoint, load_metadata, save_checkpoint
from gsjax.methods.fit import Fit, FitConfig, StartConfig
from gsjax.optim.method import Run
from gsjax.rasterize.plan import Plan
from gsjax.scene.gaussians import gaussians_from_activated


def state():
    gaussians = gaussians_from_activated(
        np.ones((4, 3)), np.ones((4, 4)), np.ones((4, 3)), np.full(4, 0.5), np.ones((4, 3))
    )
    return {
        "params": gaussians,
        "optimizer": optax.adam(1e-3).init(gaussians),
        "run": Run(gaussians, optax.EmptyState(), 3, {"a:b": Plan(8, 9, 4096, sh_degree=1)}),
        "method": Fit(FitConfig(steps=7, start=StartConfig(count=3))),
        "half": jnp.arange(3, dtype=jnp.bfloat16),
        "key": jax.random.key(3),
        "step": 7,
        "rate": 0.5,
        "host": np.arange(2),
        "name": "run",
        "nested": [(1, "a"), {"b": (jnp.ones(2), None)}],
        "ints": {3: True, 4: 1},
    }


def test_any_tree_comes_back_without_a_template(tmp_path):
    tree = state()
    save_checkpoint(tmp_path / "a.npz", tree, {"frame": 3, "note": "é"})
    loaded, metadata = load_checkpoint(tmp_path / "a.npz")
    assert metadata == load_metadata(tmp_path / "a.npz") == {"frame": 3, "note": "é"}
    assert list(loaded) == list(tree)
    assert eqx.tree_equal(loaded, tree)
    assert loaded["method"] == tree["method"]
    assert loaded["run"].plans == tree["run"].plans
    assert isinstance(loaded["optimizer"][0], optax.ScaleByAdamState)
    assert isinstance(loaded["host"], np.ndarray)
    assert isinstance(loaded["params"].means, jax.Array)
    assert loaded["half"].dtype == jnp.bfloat16


def test_numbers_of_numpy_come_back_as_such_also_as_keys(tmp_path):
    """As of `dict(zip(np.unique(labels), names))`."""
    tree = {"names": {np.int64(1): "cup", np.int64(2): "can", (np.int64(3), 4): np.float32(0.1)}}
    save_checkpoint(tmp_path / "a.npz", tree)
    loaded = load_checkpoint(tmp_path / "a.npz")[0]
    assert loaded == tree
    assert [type(value) for value in loaded["names"]] == [np.int64, np.int64, tuple]
    assert type(loaded["names"][3, 4]) is np.float32


class Foreign(NamedTuple):
    a: int


@dataclass
class AlsoForeign:
    a: int


@pytest.mark.parametrize("leaf", [jnp.sin, Foreign(1), AlsoForeign(1), object(), {1, 2}])
def test_what_cannot_be_made_again_is_refused_when_it_is_saved(tmp_path, leaf):
    with pytest.raises(TypeError, match="checkpoint: "):
        save_checkpoint(tmp_path / "a.npz", {"a": {"b": leaf}})
    assert not list(tmp_path.iterdir())


def with_header(path, change):
    """Rewrites a file with a changed header."""
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    header = json.loads(str(arrays.pop("__header__")))
    change(header)
    np.savez(path, **arrays, __header__=np.array(json.dumps(header)))


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("os:system", "not of gsjax, optax"),
        ("gsjax.cli.__main__:entry", "not of gsjax, optax"),
        ("gsjax.scene.gaussians:take", "expected a NamedTuple, dataclass or module"),
        ("gsjax.scene.gaussians:Gone", "not found"),
        ("gsjax.nowhere:Gone", "not found"),
        ("optax:adam", "expected a NamedTuple, dataclass or module"),
    ],
)
def test_only_types_that_hold_fields_are_made(tmp_path, name, says):
    path = tmp_path / "a.npz"
    save_checkpoint(path, Plan(8, 9, 4096))
    with_header(path, lambda header: header["tree"].update(type=name))
    with pytest.raises(CheckpointError, match=rf"a\.npz: .*{says}.*start again"):
        load_checkpoint(path)


def test_a_type_with_other_fields_than_then_is_named(tmp_path):
    path = tmp_path / "a.npz"
    save_checkpoint(path, Plan(8, 9, 4096))
    with_header(path, lambda header: header["tree"]["fields"].pop("eps2d"))
    with pytest.raises(CheckpointError, match=r"type Plan: its fields have changed \(eps2d\)"):
        load_checkpoint(path)


def test_what_it_says_of_itself_is_quoted_in_bounds(tmp_path):
    save_checkpoint(tmp_path / "a.npz", {"n": 1})
    with_header(tmp_path / "a.npz", lambda h: h.update(version=[0] * 10_000, tree={"of": "nothing"}))
    with pytest.raises(CheckpointError, match=r"found one of gsjax \[0, 0, .* that differs") as refused:
        load_checkpoint(tmp_path / "a.npz")
    assert len(str(refused.value)) < 1000
    np.savez(tmp_path / "c.npz", means=np.zeros(3))
    with pytest.raises(CheckpointError, match=r"it holds means, which gsjax.save did not write"):
        load_checkpoint(tmp_path / "c.npz")


def test_one_of_the_version_before_is_refused_in_a_sentence(tmp_path):
    path = tmp_path / "a.npz"
    save_checkpoint(path, jnp.ones(2))
    with_header(path, lambda header: header.update(format=1))
    with pytest.raises(CheckpointError, match=r"found format 1, written by another version.*start again"):
        load_checkpoint(path)


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.95])
def test_a_checkpoint_cut_off_is_named(tmp_path, keep):
    path = tmp_path / "a.npz"
    save_checkpoint(path, {"a": jnp.arange(1000.0)})
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content))])
    with pytest.raises(CheckpointError, match=r"a\.npz: expected a checkpoint.*truncated or damaged"):
        load_checkpoint(path)


def test_flipped_bytes_and_changed_values_are_found(tmp_path):
    path = tmp_path / "a.npz"
    save_checkpoint(path, {"a": jnp.arange(1000.0)})
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 0xFF
    (tmp_path / "flipped.npz").write_bytes(content)
    with pytest.raises(CheckpointError, match="damaged"):
        load_checkpoint(tmp_path / "flipped.npz")
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    (name,) = [name for name in arrays if name != "__header__"]
    arrays[name][0] = 5
    np.savez(path, **arrays)
    with pytest.raises(CheckpointError, match="matching checksum"):
        load_checkpoint(path)


def test_foreign_and_missing_files_are_named(tmp_path):
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(CheckpointError, match=r"text\.npz: expected a checkpoint"):
        load_checkpoint(tmp_path / "text.npz")
    np.savez(tmp_path / "arrays.npz", a=np.ones(2))
    with pytest.raises(CheckpointError, match=r"arrays\.npz: expected a checkpoint"):
        load_checkpoint(tmp_path / "arrays.npz")
    with pytest.raises(FileNotFoundError, match=r"none\.npz: expected a checkpoint, found no file"):
        load_checkpoint(tmp_path / "none.npz")


def test_a_pickle_is_never_opened(tmp_path):
    path = tmp_path / "a.npz"
    save_checkpoint(path, {"a": jnp.ones(2)})
    with np.load(path) as archive:
        header = archive["__header__"]
    np.savez(path, a=np.array([{"a": 1}], dtype=object), __header__=header)
    with pytest.raises(CheckpointError, match="cannot be read"):
        load_checkpoint(path)
    (tmp_path / "b.npz").write_bytes(pickle.dumps([1, 2]))
    with pytest.raises(CheckpointError, match="cannot be read"):
        load_checkpoint(tmp_path / "b.npz")
