"""deformation.npz: what is written is what is read, and what a file may not be."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.engine.deform.file import StoredDeformation, read_deformation, write_deformation
from gsjax.engine.deform.teacher import Meaning
from gsjax.engine.distill.source import Source
from gsjax.io.checkpoints import load_checkpoint, load_metadata, save_checkpoint
from gsjax.methods.deform import DeformingScene, nodes_of
from gsjax.scene.deformation import DeformationConfig, init_deformation
from gsjax.scene.initialize import gaussians_from_points

SOURCE = Source("classes", {1: "tissue", 2: "tool"})


def stored(kind="hexplane", nodes=0, features=0, moves=True, rows=False):
    key = jax.random.key(3)
    points = np.random.default_rng(0).uniform(0, 1, (30, 3)).astype(np.float32)
    gaussians = gaussians_from_points(points, points)
    if features:
        values = jax.random.normal(key, (30, features))
        gaussians = gaussians.__class__(**vars(gaussians) | {"features": values})
    field = None
    if moves:
        config = DeformationConfig(kind, resolution=4, time_resolution=3, levels=2, channels=2, hidden=5)
        field = init_deformation(key, config, np.array([[0, 0, 0], [1, 1, 1]]), features)
        field = jax.tree.map(lambda leaf: leaf + 0.1 * jax.random.normal(key, leaf.shape), field)
    scene = DeformingScene(gaussians, field)
    meaning = None
    if features:
        meaning = Meaning(SOURCE, ("tissue", "tool"), np.eye(2, features), np.eye(5, features))
    moving = nodes_of(gaussians, nodes) if nodes else jnp.array([2, 5, 9]) if rows else None
    cameras = {"viewmats": np.tile(np.eye(4), (4, 1, 1)), "Ks": np.tile(np.diag([60.0, 60, 1]), (4, 1, 1))}
    frames = {"times": np.linspace(0, 1, 4), "frame_ids": np.arange(4) + 7, "seconds": 2.5}
    seen = {"size": (64, 52), "near": 0.02, "held_out": np.array([1])}
    return StoredDeformation(scene, moving, meaning, **frames, **cameras, **seen)


def leaves_of(given):
    """What the file has of it."""
    scene, meaning = given.scene, given.meaning
    vectors = () if meaning is None else (meaning.codebook, meaning.basis)
    return (scene.gaussians, scene.field, given.moving, given.viewmats, given.Ks, *vectors)


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"nodes": 8, "features": 3},
        {"kind": "mlp", "features": 2},
        {"kind": "voxels", "nodes": 5},
        {"moves": False},
        {"rows": True},
    ],
)
def test_what_is_written_is_what_is_read(given, tmp_path):
    first = stored(**given)
    write_deformation(tmp_path / "deformation.npz", first)
    again = read_deformation(tmp_path / "deformation.npz")
    assert again.names == first.names
    if first.meaning is not None:
        assert again.meaning.source == first.meaning.source
        np.testing.assert_array_equal(first.meaning.codebook, again.meaning.codebook)
        np.testing.assert_array_equal(first.meaning.basis, again.meaning.basis)
    for name in ("times", "frame_ids", "viewmats", "Ks", "held_out"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name), err_msg=name)
    for name in ("seconds", "size", "near", "meaning_changes"):
        assert getattr(first, name) == getattr(again, name)
    camera = again.camera(2)
    assert (camera.viewmat.shape, camera.width, camera.height, camera.near) == ((1, 4, 4), 64, 52, 0.02)
    for time in (0.0, 0.4):
        jax.tree.map(np.testing.assert_array_equal, first.at(time), again.at(time))
    assert jax.tree.structure(first.scene) == jax.tree.structure(again.scene)


def test_a_file_that_is_none(tmp_path):
    path = tmp_path / "deformation.npz"
    with pytest.raises(FileNotFoundError, match="gsjax deform"):
        read_deformation(path)
    path.write_bytes(b"no archive")
    with pytest.raises(ValueError, match="damaged"):
        read_deformation(path)
    save_checkpoint(path, {"a": jnp.zeros(3)}, {"format": 1})
    with pytest.raises(ValueError, match="expected what `gsjax deform` writes"):
        read_deformation(path)


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (lambda saved: saved[0].means.at[2, 1].set(jnp.nan), "finite"),
        (lambda saved: saved[2].indices.at[0, 0].set(99), "indices: expected 0 to 7"),
    ],
)
def test_a_file_with_what_no_scene_has(spoil, match, tmp_path):
    path, first = tmp_path / "deformation.npz", stored(nodes=8)
    write_deformation(path, first)
    saved = leaves_of(first)
    (gaussians, field, nodes, *cameras), about = load_checkpoint(path, saved)
    if "finite" in match:
        gaussians = gaussians.__class__(**vars(gaussians) | {"means": spoil(saved)})
    else:
        nodes = nodes._replace(indices=spoil(saved))
    save_checkpoint(path, (gaussians, field, nodes, *cameras), about)
    with pytest.raises(ValueError, match=match):
        read_deformation(path)


@pytest.mark.parametrize(
    ("told", "match"),
    [
        ({"meaning": {"source": SOURCE.plain(), "names": ["tissue"], "dimension": 5}}, "does not fit"),
        ({"meaning": {"source": {"kind": "x"}, "names": [], "dimension": 5}}, "expected what `gsjax deform`"),
        ({"meaning": None}, "does not fit"),
        ({"held_out": [1, 4]}, "held-out frames of these"),
        ({"size": [64, 0]}, "a size of pictures"),
        ({"size": [64]}, "expected what `gsjax deform` writes"),
        ({"seconds": float("nan")}, "finite"),
    ],
)
def test_a_file_that_tells_what_cannot_be(told, match, tmp_path):
    path, first = tmp_path / "deformation.npz", stored(features=3)
    write_deformation(path, first)
    save_checkpoint(path, leaves_of(first), load_metadata(path) | told)
    with pytest.raises(ValueError, match=match):
        read_deformation(path)
