"""All readers that benchmarks/fuzz_files.py tries: those of data, and those of files that runs write."""

import json
import socket
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import yaml

from benchmarks.readers_of_data import CLOUDS, LAYOUTS, PICTURES, SCENES, Arrays, Reader, written
from gsjax.data.text import decoded
from gsjax.engine import locks
from gsjax.engine.checkpoint import write_field
from gsjax.engine.deform.file import read_deformation, read_metadata, write_deformation
from gsjax.engine.distill.file import read_field
from gsjax.engine.folder import SIGNATURE
from gsjax.engine.locks import LOCK
from gsjax.engine.parts.saved import read_parts
from gsjax.engine.records import read_record
from gsjax.engine.teaching.source import Source
from gsjax.engine.track.saved import read_tracking
from gsjax.io.checkpoints import load_checkpoint, load_metadata, save_checkpoint
from gsjax.methods.deform import DeformingScene, DeformResult, Timeline
from gsjax.methods.distill import DistillResult, FeatureField
from gsjax.methods.parts.timeline import parse_script
from gsjax.perception.feature_files import read_feature_folder
from tests.data.faulty import HEIGHT, WIDTH
from tests.io.scenes_to_write import make_scene


def _checkpoint(root: Path) -> None:
    tree = {"scene": make_scene(5), "steps": 3, "rows": [np.arange(4), (1.0, None, "x")]}
    save_checkpoint(root / "state.npz", tree, {"kind": "fit"})


def _restored(root: Path) -> Arrays:
    load_metadata(root / "state.npz")
    load_checkpoint(root / "state.npz")
    return ()


def _fit_run(root: Path) -> None:
    _settings(root, {"data": "photographs", "fit": {"antialiased": False}, "test_every": 8, "seed": 0})
    metrics = {"dataset": "photographs", "size": [8, 8], "photographs": 2, "views": [], "seconds": 1.0}
    metrics |= {"steps": 10, "num_gaussians": 20, "machine": {}, "complete": True}
    (root / "metrics.json").write_text(json.dumps(metrics))
    row = json.dumps({"step": 1, "seconds": 0.5, "alive": 20, "test_psnr": 20.0})
    (root / "metrics.jsonl").write_text(f"{row}\n{row}\n")


def _settings(root: Path, settings: dict) -> None:
    (root / "config.yml").write_text(f"{SIGNATURE}\n{yaml.safe_dump(settings)}")


def _record(root: Path) -> Arrays:
    read_record(root)
    return ()


def _trajectory(root: Path) -> None:
    written(root / "scene.ply")
    np.savez(
        root / "trajectory.npz",
        means=np.zeros((2, 20, 3), np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (2, 10, 1)),
        normals=np.zeros((20, 3), np.float32),
        labels=np.arange(20) % 2,
        label_ids=np.arange(2),
        lost=np.zeros((2, 1), bool),
        turn_known=np.ones((2, 1), bool),
    )


def _tracking(root: Path) -> Arrays:
    tracking, _ = read_tracking(root)
    return [tracking.scene.gaussians.means, tracking.scene.normals]


def _parts_run(root: Path) -> None:
    written(root / "scene.ply")
    _settings(root, {"parts": {"stream": {"blend": "quaternion"}}})
    rows = [{"part": part, "name": f"part {part}", "true_name": None} for part in range(2)]
    (root / "metrics.json").write_text(json.dumps({"parts": rows, "frames": {"followed": 3}}))
    np.savez(
        root / "parts.npz",
        anchor=np.array(1),
        weights=np.full((20, 2), 0.5),
        centres=np.zeros((2, 3)),
        times=np.arange(3.0),
        R=np.tile(np.eye(3), (3, 2, 1, 1)),
        t=np.zeros((3, 2, 3)),
    )


def _parts(root: Path) -> Arrays:
    layer, *_ = read_parts(root)
    return [layer.scene.gaussians.means, layer.scene.weights, *jax.tree.leaves(layer.trajectory)]


def _deforming(root: Path) -> None:
    cameras = {"viewmats": np.tile(np.eye(4), (3, 1, 1)), "Ks": np.tile(np.diag([60.0, 60, 1]), (3, 1, 1))}
    frames = {"times": np.linspace(0, 1, 3), "frame_ids": np.arange(3), "seconds": 2.5}
    seen = {"size": (64, 52), "near": 0.02, "held_out": np.array([1])}
    timeline = Timeline(**frames, **cameras, **seen)
    result = DeformResult(DeformingScene(make_scene(5), None), None, None, timeline)
    write_deformation(root / "deformation.npz", result, np.array([1e6, 0, 0]))


def _deformation(root: Path) -> Arrays:
    path = root / "deformation.npz"
    result, beside = read_deformation(path), read_metadata(path)
    return result.scene.gaussians.means, result.timeline.viewmats, beside.origin


def _field(root: Path) -> None:
    field = FeatureField(jnp.eye(3), jnp.ones((4, 3)))
    about = {"file": "scene.ply", "sha256": "0", "num_gaussians": 3, "photographs": None}
    write_field(root / "field.npz", DistillResult(field, None, Source("classes", {1: "tool"}), about))


def _features_of_field(root: Path) -> Arrays:
    return jax.tree.leaves(read_field(root / "field.npz").field)


_SCRIPT = """fps: 15
edits:
  - {op: speed, parts: [drawer], factor: 0.5}
  - {op: move, parts: [2], by: [0, 0, 0.1], from: 0.2}
"""


def _script(root: Path) -> Arrays:
    path = root / "edit.yml"
    try:
        parse_script(decoded(path.read_bytes()))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error  # as `gsjax edit` does
    return ()


def _codebook(root: Path) -> None:
    ids = np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) % 3
    np.savez(root / "a.npz", ids=ids, codebook=np.ones((3, 4), np.float32))


def _langsplat(root: Path) -> None:
    np.save(root / "a_s.npy", np.zeros((4, HEIGHT, WIDTH), np.int32))
    np.save(root / "a_f.npy", np.ones((3, 4), np.float32))


def _features(build: Callable[[Path], object]) -> Reader:
    def read(root: Path) -> Arrays:
        found = read_feature_folder(root, ["a.png"])
        return [array for each in found for array in (each.map, each.codebook)]

    return Reader(build, read)


def _lock(root: Path) -> None:
    """A shared lock held by the first process of this machine, which is always running."""
    there = {"pid": 1, "host": socket.gethostname(), "since": "2026-01-01 00:00:00", "shared": True}
    (root / LOCK).write_text(json.dumps(there) + "\n")


def _locked(root: Path) -> Arrays:
    """Take a shared lock without locks of the file system, so that only the list in the file decides."""
    with mock.patch.object(locks, "fcntl", None), locks.locked(root, shared=True):
        return ()


_MAP = np.random.default_rng(0).normal(size=(6, 8, 4)).astype(np.float32)
KEPT = {
    "checkpoint": Reader(_checkpoint, _restored),
    "run of fit": Reader(_fit_run, _record),
    "tracked poses": Reader(_trajectory, _tracking, 0.5),
    "run of parts": Reader(_parts_run, _parts, 0.3),
    "deforming scene": Reader(_deforming, _deformation, 0.5),
    "field": Reader(_field, _features_of_field, 0.5),
    "lock of a folder": Reader(_lock, _locked),
    "script of edits": Reader(lambda root: (root / "edit.yml").write_text(_SCRIPT), _script, 0.1),
    "features, .npy": _features(lambda root: np.save(root / "a.npy", _MAP)),
    "features, .npz": _features(lambda root: np.savez_compressed(root / "a.npz", features=_MAP)),
    "features, a codebook": _features(_codebook),
    "features, LangSplat": _features(_langsplat),
    "features, LERF": _features(lambda root: np.save(root / "level_0.npy", _MAP[None])),
}

READERS = SCENES | CLOUDS | PICTURES | LAYOUTS | KEPT
