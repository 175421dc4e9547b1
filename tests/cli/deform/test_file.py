"""deformation.npz: it is read as it was written, and malformed files are refused."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.engine.deform.file import read_deformation, write_deformation
from gsjax.engine.teaching.source import Source
from gsjax.io.checkpoints import save_checkpoint
from gsjax.methods.deform import DeformingScene, DeformResult, Meaning, Timeline, nodes_of
from gsjax.scene.deformation import DeformationConfig, init_deformation
from gsjax.scene.initialize import gaussians_from_points

SOURCE = Source("classes", {1: "tissue", 2: "tool"})


def result(kind="hexplane", nodes=0, features=0, moves=True, rows=False):
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
    meaning = None
    if features:
        meaning = Meaning(SOURCE, ("tissue", "tool"), np.eye(2, features), np.eye(5, features))
    moving = nodes_of(gaussians, nodes) if nodes else jnp.array([2, 5, 9]) if rows else None
    cameras = {"viewmats": np.tile(np.eye(4), (4, 1, 1)), "Ks": np.tile(np.diag([60.0, 60, 1]), (4, 1, 1))}
    frames = {"times": np.linspace(0, 1, 4), "frame_ids": np.arange(4) + 7, "seconds": 2.5}
    seen = {"size": (64, 52), "near": 0.02, "held_out": np.array([1])}
    return DeformResult(
        DeformingScene(gaussians, field), moving, meaning, Timeline(**frames, **cameras, **seen)
    )


@pytest.mark.thorough
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
    first = result(**given)
    write_deformation(tmp_path / "deformation.npz", first)
    again = read_deformation(tmp_path / "deformation.npz")
    assert again.names == first.names
    if first.meaning is not None:
        assert again.meaning.source == first.meaning.source
        np.testing.assert_array_equal(first.meaning.codebook, again.meaning.codebook)
        np.testing.assert_array_equal(first.meaning.basis, again.meaning.basis)
        np.testing.assert_array_equal(first.query("Tool", 0.4), again.query("Tool", 0.4))
        np.testing.assert_array_equal(first.probabilities(), again.probabilities())
    for name, value in first.timeline._asdict().items():
        np.testing.assert_array_equal(value, getattr(again.timeline, name), err_msg=name)
    assert first.meaning_changes == again.meaning_changes
    camera = again.camera(2)
    assert (camera.viewmat.shape, camera.width, camera.height, camera.near) == ((1, 4, 4), 64, 52, 0.02)
    for time in (0.0, 0.4):
        jax.tree.map(np.testing.assert_array_equal, first.at(time), again.at(time))
    assert jax.tree.structure(first.scene) == jax.tree.structure(again.scene)


def test_a_result_without_features_means_nothing():
    with pytest.raises(ValueError, match="features: expected a scene that learned from a teacher"):
        result().query("tool")
    with pytest.raises(ValueError, match="features: expected a scene"):
        result().probabilities()


def test_features_of_a_result_are_those_of_its_scene():
    found = result(features=3, nodes=8)
    np.testing.assert_allclose(found.features_at([0.0, 0.7])[1], found.at(0.7).features, atol=1e-6)


def test_a_file_that_is_none(tmp_path):
    path = tmp_path / "deformation.npz"
    with pytest.raises(FileNotFoundError, match="gsjax deform"):
        read_deformation(path)
    path.write_bytes(b"no archive")
    with pytest.raises(ValueError, match="damaged"):
        read_deformation(path)
    save_checkpoint(path, {"a": jnp.zeros(3)})
    with pytest.raises(ValueError, match="expected what `gsjax deform` writes"):
        read_deformation(path)


def test_a_file_of_the_version_before_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "deformation.npz"
    monkeypatch.setattr("gsjax.io.checkpoints._FORMAT", 1)
    write_deformation(path, result())
    monkeypatch.undo()
    with pytest.raises(ValueError, match=r"format 2, found format 1.*reconstruct it again with this version"):
        read_deformation(path)


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (lambda r: replace(r, scene=_with_nan(r.scene)), "finite"),
        (
            lambda r: replace(r, moving=r.moving._replace(indices=r.moving.indices.at[0, 0].set(99))),
            "indices: ",
        ),
        (lambda r: replace(r, meaning=replace(r.meaning, names=("tissue",))), "a code for each name"),
        (lambda r: replace(r, meaning=_wider(r.meaning)), "a code for each name"),
        (lambda r: replace(r, scene=DeformingScene(_bare(r.scene.gaussians))), "a code for each name"),
        (lambda r: _with(r, held_out=np.array([1, 4])), "held-out frames of these"),
        (lambda r: _with(r, size=(64, 0)), "a size of pictures"),
        (lambda r: _with(r, times=np.zeros(3)), "a time, a number and a camera for each frame"),
        (lambda r: _with(r, seconds=float("nan")), "finite"),
    ],
)
def test_a_file_with_what_no_scene_has(spoil, match, tmp_path):
    path = tmp_path / "deformation.npz"
    write_deformation(path, spoil(result(nodes=8, features=3)))
    with pytest.raises(ValueError, match=f"{match}.*reconstruct it again"):
        read_deformation(path)


def _with_nan(scene):
    return eqx.tree_at(lambda s: s.gaussians.means, scene, scene.gaussians.means.at[2, 1].set(jnp.nan))


def _wider(meaning):
    return replace(meaning, codebook=np.eye(2, 4), basis=np.eye(5, 4))


def _bare(gaussians):
    return gaussians.__class__(**vars(gaussians) | {"features": None})


def _with(given, **changes):
    return replace(given, timeline=given.timeline._replace(**changes))


@pytest.mark.thorough
@pytest.mark.usefixtures("as_users_run")
@pytest.mark.parametrize("change", [{"timeline": 3}, {"meaning": 3}, {"moving": "x"}])
def test_parts_of_other_kinds(change, tmp_path):
    save_checkpoint(tmp_path / "deformation.npz", replace(result(), **change))
    with pytest.raises(ValueError, match=r"deformation.npz: expected the parts of a deforming scene, found"):
        read_deformation(tmp_path / "deformation.npz")
