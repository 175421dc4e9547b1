"""Checkpoints: any pytree is restored exactly; damaged or mismatched files are refused with the reason."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from gsjax.io.checkpoints import CheckpointError, load_checkpoint, save_checkpoint
from gsjax.scene.gaussians import gaussians_from_activated


def state():
    gaussians = gaussians_from_activated(
        np.ones((4, 3)), np.ones((4, 4)), np.ones((4, 3)), np.full(4, 0.5), np.ones((4, 3))
    )
    return {
        "params": gaussians,
        "optimizer": optax.adam(1e-3).init(gaussians),
        "half": jnp.arange(3, dtype=jnp.bfloat16),
        "key": jax.random.key(3),
        "step": 7,
        "rate": 0.5,
        "host": np.arange(2),
        "name": "run",
        "function": jnp.sin,
        "nothing": None,
    }


def test_any_tree_comes_back(tmp_path):
    tree = state()
    save_checkpoint(tmp_path / "a.npz", tree, {"frame": 3, "note": "é"})
    like = tree | {"step": 0, "half": jnp.zeros(3, jnp.bfloat16), "key": jax.random.key(0)}
    loaded, metadata = load_checkpoint(tmp_path / "a.npz", like)
    assert metadata == {"frame": 3, "note": "é"}
    assert eqx.tree_equal(loaded, tree)
    assert loaded["step"] == 7
    assert isinstance(loaded["host"], np.ndarray)
    assert loaded["half"].dtype == jnp.bfloat16


def test_specs_are_enough_to_load(tmp_path):
    params = state()["params"]
    save_checkpoint(tmp_path / "a.npz", params)
    loaded, _ = load_checkpoint(tmp_path / "a.npz", jax.eval_shape(lambda: params))
    assert eqx.tree_equal(loaded, params)


def test_what_does_not_fit_is_named(tmp_path):
    save_checkpoint(tmp_path / "a.npz", {"a": jnp.ones(3), "b": jnp.ones(2)})
    with pytest.raises(CheckpointError, match=r"a\.npz.*missing \[\"\['c'\]\"\], unexpected \[\"\['b'\]\"\]"):
        load_checkpoint(tmp_path / "a.npz", {"a": jnp.ones(3), "c": jnp.ones(2)})
    with pytest.raises(CheckpointError, match=r"\['a'\]: expected float32\[4\], found float32\[3\]"):
        load_checkpoint(tmp_path / "a.npz", {"a": jnp.ones(4), "b": jnp.ones(2)})
    with pytest.raises(CheckpointError, match=r"\['b'\]: expected int32\[2\], found float32\[2\]"):
        load_checkpoint(tmp_path / "a.npz", {"a": jnp.ones(3), "b": jnp.ones(2, int)})
    with pytest.raises(CheckpointError, match=r"\['b'\]: expected float, found float32\[2\]"):
        load_checkpoint(tmp_path / "a.npz", {"a": jnp.ones(3), "b": 1.0})


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.95])
def test_a_checkpoint_cut_off_is_named(tmp_path, keep):
    path = tmp_path / "a.npz"
    save_checkpoint(path, {"a": jnp.arange(1000.0)})
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content))])
    with pytest.raises(CheckpointError, match=r"a\.npz: expected a checkpoint.*cut off or damaged"):
        load_checkpoint(path, {"a": jnp.zeros(1000)})


def test_flipped_bytes_and_changed_values_are_found(tmp_path):
    path = tmp_path / "a.npz"
    save_checkpoint(path, {"a": jnp.arange(1000.0)})
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 0xFF
    (tmp_path / "flipped.npz").write_bytes(content)
    with pytest.raises(CheckpointError, match="damaged"):
        load_checkpoint(tmp_path / "flipped.npz", {"a": jnp.zeros(1000)})
    with np.load(path) as archive:
        arrays = dict(archive)
    np.savez(tmp_path / "edited.npz", **arrays | {"['a']": np.zeros(1000, np.float32)})
    with pytest.raises(CheckpointError, match="matching checksum"):
        load_checkpoint(tmp_path / "edited.npz", {"a": jnp.zeros(1000)})


def test_foreign_and_missing_files_are_named(tmp_path):
    np.savez(tmp_path / "foreign.npz", a=np.ones(3))
    with pytest.raises(CheckpointError, match="cannot be read as one"):
        load_checkpoint(tmp_path / "foreign.npz", {"a": jnp.ones(3)})
    np.save(tmp_path / "array.npy", np.ones(3))
    with pytest.raises(CheckpointError, match="cannot be read as one"):
        load_checkpoint(tmp_path / "array.npy", {"a": jnp.ones(3)})
    with pytest.raises(FileNotFoundError, match=r"none\.npz"):
        load_checkpoint(tmp_path / "none.npz", {})


def test_a_pickle_is_never_opened(tmp_path):
    np.save(tmp_path / "evil.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(CheckpointError):
        load_checkpoint(tmp_path / "evil.npy", {"a": jnp.ones(3)})


def test_metadata_that_json_cannot_hold_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(TypeError):
        save_checkpoint(tmp_path / "a.npz", {"a": jnp.ones(1)}, {"x": object()})
    assert not list(tmp_path.iterdir())
