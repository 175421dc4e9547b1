"""The scene that a field is distilled for, and its photographs: those of a run, or given along with a file of
another program."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from gsjax.data.open import ReadOptions
from gsjax.data.origin import relative_to_origin
from gsjax.data.photographs import Photographs, photographs_of
from gsjax.engine.files import read_arrays, relative_to_scene, reopen
from gsjax.engine.folder import expect_run
from gsjax.engine.options import HeldOutFrames, Selection
from gsjax.engine.photographs import choose_photographs, photographs_of_run, smaller, split
from gsjax.engine.records import read_record
from gsjax.io.scene_file import SceneReport
from gsjax.io.scenes import read_gaussians
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.origin import about

Read = tuple[Gaussians, SceneReport]
_AGAIN = "run it again with this version of gsjax"
_OF_PHOTOGRAPHS = ("frames", "cameras", "eval_cameras", "test_every", "read")  # a run has chosen these


@dataclass(frozen=True)
class SceneAndImages:
    """A static scene, and where its photographs are."""

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|FILE")]
    """Folder of a run of `gsjax fit`, `gsjax track` (its first frame) or `gsjax parts` (its canonical frame);
    or a file of Gaussians from any program (.ply, .spz, .sog, .splat, .ksplat), with --images and --out."""
    images: str | None = None
    """Photographs of a file's scene, with poses in its coordinates; --frames, --cameras, --eval-cameras
    and --test-every select among them. For a run: the current folder of its photographs, if they were
    moved."""


@dataclass(frozen=True)
class SceneOptions(HeldOutFrames, Selection, SceneAndImages):
    """A scene, and which photographs of it."""


@dataclass(frozen=True, eq=False)
class FieldScene:
    """A static scene and its photographs.

    Attributes:
        file: the file of Gaussians.
        gaussians: the scene.
        photographs: of the scene, posed as it was fitted.
        taught: indices of the training photographs.
        held_out: indices of those that are only used for scores.
        rasterize_mode: as the scene was fitted: "classic" or "antialiased".
    """

    file: Path
    gaussians: Gaussians
    photographs: Photographs
    taught: list[int]
    held_out: list[int]
    rasterize_mode: str = "classic"


def open_field_scene(options: SceneOptions, read_scene: Read | None = None) -> FieldScene:
    """The scene and its photographs.

    Args:
        options: which scene and photographs.
        read_scene: its Gaussians and the report about them, if they were read already.

    Raises:
        ValueError, OSError: they do not exist, or options are given that the run has already settled.
    """
    path = options.scene
    if path.is_file():
        if options.images is None:
            raise ValueError(
                f"{path}: a file of Gaussians has no photographs; give a folder of them with --images"
            )
        chosen = {name: getattr(options, name) for name in ("frames", "cameras", "eval_cameras")}
        scene = scene_of_file(path, options.images, options.read, options.test_every, read_scene, **chosen)
    else:
        expect_run(path, "`gsjax fit`, `gsjax track` or `gsjax parts`, or a file of Gaussians")
        given = [n for n in _OF_PHOTOGRAPHS if getattr(options, n) != getattr(SceneOptions(path), n)]
        if given:
            flag = f"--{given[0].replace('_', '-')}"
            raise ValueError(
                f"{flag}: {path} is a run, whose photographs are already selected and split; leave it out"
            )
        scene = scene_of_run(path, options.images, read_scene)
    if not scene.gaussians.num:
        raise ValueError(f"{scene.file}: expected Gaussians, found none")
    return scaled(scene, options.scale)


def scene_of_run(path: Path, images: str | None = None, read_scene: Read | None = None) -> FieldScene:
    """The scene of a run of `gsjax fit`, `gsjax track` (its first frame) or `gsjax parts` (its canonical
    frame).

    Args:
        path: the run's folder.
        images: where its photographs are now (default: where they were).
        read_scene: its Gaussians and the report about them, if they were read already.

    Raises:
        FileNotFoundError, ValueError: there is no such run, or it has no scene, or no photographs that can be
            read.
    """
    if (path / "canonical" / "scene.ply").is_file():
        return scene_of_run(path / "canonical", images, read_scene)
    record = read_record(path)
    file = path / "scene.ply"
    if not file.is_file():
        raise FileNotFoundError(
            f"{path}: expected a scene.ply, found none: the run is still going on, or failed"
        )
    gaussians, report = _read(file) if read_scene is None else read_scene
    if record.kind in ("track", "parts"):
        if images is not None:
            raise ValueError(f"--images: a run of `gsjax {record.kind}` knows its recording; leave it out")
        recording, _ = reopen(path / "config.yml", _AGAIN)
        at = 0
        if record.kind == "parts":
            at = int(read_arrays(path / "parts.npz", ("anchor",), _AGAIN)["anchor"])
        first = relative_to_scene(recording, report.origin).judged.select(frames=slice(at, at + 1))
        indices, count = list(range(first.num_cameras)), recording.tracked.num_cameras
        return FieldScene(file, gaussians, photographs_of(first), indices[:count], indices[count:])
    if record.kind != "fit":
        raise ValueError(
            f"{path}: expected a run of `gsjax fit`, `gsjax track` or `gsjax parts`, found one of `gsjax "
            f"{record.kind}`; name another, or its scene.ply with --images"
        )
    photographs = photographs_of_run(record.config, images)
    photographs = relative_to_origin(with_learned_poses(photographs, path), report.origin)
    mode = "antialiased" if record.config["fit"].get("antialiased") else "classic"
    return FieldScene(file, gaussians, photographs, *_split(photographs, record.config["test_every"]), mode)


def with_learned_poses(photographs: Photographs, path: Path) -> Photographs:
    """The photographs with the poses that the fit in a folder refined, if it did.

    Raises:
        ValueError: cameras.npz is not as the fit wrote it.
    """
    file = path / "cameras.npz"
    if not file.is_file():
        return photographs
    arrays = read_arrays(file, ("names", "viewmats"), _AGAIN)
    found = dict(zip(arrays["names"].tolist(), arrays["viewmats"], strict=True))
    posed = zip(photographs.names, photographs.viewmats, strict=True)
    viewmats = [about(found[name], photographs.origin) if name in found else given for name, given in posed]
    return replace(photographs, viewmats=np.stack(viewmats).astype(np.float64))


def scene_of_file(
    file: Path,
    images: str,
    read: ReadOptions,
    test_every: int,
    read_scene: Read | None = None,
    **chosen,
) -> FieldScene:
    """A file of Gaussians with photographs of the same world.

    Args:
        file: the scene.
        images: a dataset.
        read: options of its reader.
        test_every: hold out every n-th photograph where the data has no split.
        read_scene: its Gaussians and the report about them, if they were read already.
        **chosen: as for `choose_photographs`.

    Raises:
        SceneError, DataError, ValueError: one of them cannot be read.
    """
    gaussians, report = _read(file) if read_scene is None else read_scene
    photographs = relative_to_origin(choose_photographs(images, read, **chosen), report.origin)
    mode = "antialiased" if report.antialiased else "classic"
    return FieldScene(file, gaussians, photographs, *_split(photographs, test_every), mode)


def scaled(scene: FieldScene, scale: float) -> FieldScene:
    """The scene with smaller photographs.

    Raises:
        ValueError: `scale` is not above 0 and at most 1, or leaves next to nothing of them.
    """
    return replace(scene, photographs=smaller(scene.photographs, scale))


def _split(photographs: Photographs, every: int) -> tuple[list[int], list[int]]:
    chosen, held_out = split(photographs, every)
    return chosen.tolist(), held_out.tolist()


def _read(file: Path) -> Read:
    gaussians, report = read_gaussians(file)
    return jax.tree.map(jnp.asarray, gaussians), report
