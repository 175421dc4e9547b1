"""deformation.npz: a scene that deforms, apart from the recording that it was learned from."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.engine.deform.teacher import Meaning
from gsjax.engine.distill.source import Source
from gsjax.engine.messages import Notes
from gsjax.geometry.cameras import Camera
from gsjax.io.checkpoints import load_checkpoint, load_metadata, save_checkpoint
from gsjax.methods.deform import DeformingScene, Moving
from gsjax.scene.deformation import DeformationConfig, Nodes, init_deformation
from gsjax.scene.gaussians import Gaussians

NAME = "deformation.npz"
_FORMAT = 4  # 1 had no cameras, 2 neither rows nor units, 3 no teachers but classes
_AGAIN = "reconstruct it again with this version of gsjax"


@dataclass(frozen=True, eq=False)
class StoredDeformation:
    """A deforming scene as it lies on disk.

    Attributes:
        scene: canonical Gaussians, and the field that moves them; None of a scene that stands still.
        moving: what the field is asked about: nodes, some Gaussians, or all.
        meaning: what features say; None without.
        times: of the recording's frames, 0 to 1.
        frame_ids: what the recording calls these.
        seconds: that the recording lasts.
        viewmats: of the camera that was learned from, in each frame: world to camera, OpenCV axes.
        Ks: its intrinsics, pixels.
        size: width and height of its pictures, pixels.
        near: what is nearer to it is not drawn, metres.
        held_out: which of the frames nothing was learned from.
        metric: whether lengths are metres.
    """

    scene: DeformingScene
    moving: Moving
    meaning: Meaning | None
    times: Float[np.ndarray, "T"]
    frame_ids: Int[np.ndarray, "T"]
    seconds: float
    viewmats: Float[np.ndarray, "T 4 4"]
    Ks: Float[np.ndarray, "T 3 3"]
    size: tuple[int, int]
    near: float
    held_out: Int[np.ndarray, "held"]
    metric: bool = True

    def at(self, time: float) -> Gaussians:
        """The scene at a time, 0 to 1."""
        return _at(self.scene, self.moving, jnp.asarray(time, jnp.float32))

    def camera(self, frame: int) -> Camera:
        """The camera at a frame, 0 to T - 1, as a batch of one."""
        viewmat, K = (jnp.asarray(a[frame], jnp.float32)[None] for a in (self.viewmats, self.Ks))
        return Camera(viewmat, K, *self.size, self.near)

    @property
    def names(self) -> tuple[str, ...]:
        """Of what features tell apart; none without."""
        return () if self.meaning is None else self.meaning.names

    @property
    def meaning_changes(self) -> bool:
        """Whether features are not the same at all times."""
        return self.scene.field is not None and self.scene.field.config.feature


@jax.jit
def _at(scene: DeformingScene, moving: Moving, time: Float[Array, ""]) -> Gaussians:
    return scene.at(time, moving)


def write_deformation(path: Path, stored: StoredDeformation) -> None:
    """Writes it; atomic."""
    gaussians, field, moving = stored.scene.gaussians, stored.scene.field, stored.moving
    meaning, vectors, said = stored.meaning, (), None
    if meaning is not None:
        vectors = (meaning.codebook, meaning.basis)
        dimension = len(meaning.basis)
        said = {"source": meaning.source.plain(), "names": meaning.names, "dimension": dimension}
    nodes = moving if isinstance(moving, Nodes) else None
    about: dict[str, Any] = {
        "format": _FORMAT,
        "gaussians": {name: list(leaf.shape) for name, leaf in vars(gaussians).items() if leaf is not None},
        "field": None if field is None else {"config": asdict(field.config), "bounds": field.bounds},
        "nodes": None if nodes is None else [len(nodes.rows), nodes.indices.shape[1]],
        "rows": None if moving is None or nodes is not None else len(moving),
        "meaning": said,
        "times": stored.times.tolist(),
        "frame_ids": stored.frame_ids.tolist(),
        "seconds": stored.seconds,
        "size": stored.size,
        "near": stored.near,
        "held_out": stored.held_out.tolist(),
        "metric": stored.metric,
    }
    numbers = tuple(np.asarray(a, np.float64) for a in (stored.viewmats, stored.Ks, *vectors))
    save_checkpoint(path, (*jax.device_get((gaussians, field, moving)), *numbers), about)


def read_deformation(path: Path) -> StoredDeformation:
    """The inverse of `write_deformation`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is none of these, or numbers in it are not finite.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a scene that `gsjax deform` wrote, found no file")
    about = load_metadata(path)
    try:
        if about["format"] != _FORMAT:
            raise ValueError(f"format {about['format']}")
        like = _like(about)
        said = about["meaning"]
        source = None if said is None else Source.of(said["source"])
        names = () if said is None else tuple(map(str, said["names"]))
        times, frame_ids = np.array(about["times"], float), _whole(about["frame_ids"])
        seconds, near, held_out = float(about["seconds"]), float(about["near"]), _whole(about["held_out"])
        (width, height), metric = _whole(about["size"]).tolist(), bool(about["metric"])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: expected what `gsjax deform` writes, found {error!r}; {_AGAIN}") from error
    (gaussians, field, moving, viewmats, Ks, *vectors), _ = load_checkpoint(path, like)
    scene = DeformingScene(gaussians, field)
    meaning = None if source is None else Meaning(source, names, *vectors)
    if len(times) != len(frame_ids) or not len(times):
        raise ValueError(f"{path}: expected a time for each frame; {_AGAIN}")
    if min(width, height) < 1 or not set(held_out) <= set(range(len(times))):
        raise ValueError(f"{path}: expected a size of pictures, and held-out frames of these; {_AGAIN}")
    numbers = (scene, moving, viewmats, Ks, vectors, times, np.array([seconds, near]))
    for leaf in jax.tree.leaves(eqx.filter(numbers, eqx.is_inexact_array)):
        if not np.isfinite(np.asarray(leaf)).all():
            raise ValueError(f"{path}: expected finite numbers, found others; {_AGAIN}")
    _check_moving(path, moving, gaussians.num)
    cameras = (viewmats, Ks, (width, height), near)
    told = (meaning, times, frame_ids, seconds)
    return StoredDeformation(scene, moving, *told, *cameras, held_out, metric)


def warn_of_partial(path: Path, notes: Notes) -> None:
    """Warns where the run in a folder was stopped before its end."""
    try:
        found = json.loads((path / "metrics.json").read_text(encoding="utf-8"))
        steps = found["steps"] if not found["complete"] else None
    except (OSError, ValueError, KeyError, TypeError):
        return
    if steps is not None:
        notes.warn(f"{path} is a partial run of {steps} steps; gsjax deform goes on with --resume")


def _whole(values: list[int]) -> Int[np.ndarray, "n"]:
    return np.array(values, int).reshape(-1)


def _like(about: Mapping[str, Any]) -> Any:
    """A tree of the stored one's form."""
    shapes = {name: tuple(map(int, shape)) for name, shape in about["gaussians"].items()}
    features, nodes = shapes.get("features", (0, 0))[1], about["nodes"]

    def made():
        gaussians = Gaussians(**{name: jnp.zeros(shape) for name, shape in shapes.items()})
        field = None
        if about["field"] is not None:
            config = DeformationConfig(**about["field"]["config"])
            field = init_deformation(jax.random.key(0), config, np.array(about["field"]["bounds"]), features)
        if nodes is None:
            rows = about["rows"]
            return gaussians, field, None if rows is None else jnp.zeros(int(rows), jnp.int32)
        places, blended = map(int, nodes)
        whole = jnp.zeros((shapes["means"][0], blended), jnp.int32)
        rows = jnp.zeros(places, jnp.int32)
        return gaussians, field, Nodes(rows, whole, jnp.zeros(whole.shape))

    frames, said, vectors = len(about["times"]), about["meaning"], ()
    if said is not None:  # of no scene without features
        vectors = (np.zeros((len(said["names"]), features)), np.zeros((int(said["dimension"]), features)))
    return (*eqx.filter_eval_shape(made), np.zeros((frames, 4, 4)), np.zeros((frames, 3, 3)), *vectors)


def _check_moving(path: Path, moving: Moving, count: int) -> None:
    if moving is None:
        return
    asked = {"rows": (moving.rows if isinstance(moving, Nodes) else moving, count)}
    if isinstance(moving, Nodes):
        asked["indices"] = (moving.indices, len(moving.rows))
    for name, (array, most) in asked.items():
        if array.min() < 0 or array.max() >= most:
            raise ValueError(f"{path}: {name}: expected 0 to {most - 1}, found others; {_AGAIN}")
