"""What experiments with feature fields share: fitted scenes, teachers with a segmenter's flaws, and scores
against true labels, of pixels and of Gaussians."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from experiments.shared.commands import succeeded
from experiments.shared.recordings import recorded
from gsjax.data.photographs import Photographs
from gsjax.data.simulated.flawed_masks import Flaws, flawed_masks
from gsjax.engine.distill.scene import FieldScene, scene_of_run
from gsjax.engine.distill.scores import ClassScores, class_maps, classes_of
from gsjax.engine.drive import drive
from gsjax.engine.fit.run import Options as FitOptions
from gsjax.engine.fit.run import run as run_fit
from gsjax.engine.folder import is_finished
from gsjax.geometry.cameras import pixels_of
from gsjax.methods.distill import (
    Distill,
    DistillConfig,
    FeatureField,
    Problem,
    Teacher,
    frozen_views,
    full_table,
    teacher_of_objects,
    voted_labels,
)
from gsjax.methods.fit import PRESETS
from gsjax.optim.compiler import host_options
from gsjax.optim.method import Run
from gsjax.perception.codebook import ClassCodebook
from gsjax.perception.outlines import snap_outlines
from gsjax.rasterize.frozen import paint
from gsjax.scene.feature_grid import Located, locate
from gsjax.scene.gaussians import Gaussians

TRUE_WITHIN = 0.015  # metres between a Gaussian's centre and the depth where its label is taken
_OPAQUE = 0.5
_LEAST_VOTES = 1
NO_FLAWS = Flaws(outline=0, merged=0.0, split=0.0, missing=0.0, smallest=0)


def fitted(
    name: str, folder: Path, eval_cameras: tuple[int, ...] = (), preset: str = "depth", **options: Any
) -> FieldScene:
    """The first frame of a recording, fitted by `gsjax fit` once for all experiments."""
    path = folder.parents[1] / "field_scenes" / name
    if not is_finished(path):
        options.setdefault("fit", PRESETS[preset])
        run_fit(FitOptions(str(recorded(name)), path, eval_cameras=eval_cameras, overwrite=True, **options))
    return scene_of_run(path)


def first_tracked(
    name: str, folder: Path, cameras: tuple[int, ...], mask_camera: int, eval_cameras: tuple[int, ...]
) -> FieldScene:
    """The scene that `gsjax track` starts from, for few cameras: one Gaussian for each depth point."""
    path = folder.parents[1] / "field_scenes" / f"{name}_tracked"
    if not is_finished(path):
        words = ["track", recorded(name), "--out", path, "--frames", "0:2", "--overwrite"]
        words += [
            "--preset",
            "accurate",
            "--mask-camera",
            mask_camera,
            "--cameras",
            *cameras,
            "--eval-cameras",
            *eval_cameras,
        ]
        succeeded(*words)
    return scene_of_run(path)


def articulated(folder: Path) -> FieldScene:
    """The first frame of articulated_0, fitted to eight of its cameras."""
    return fitted("articulated_0", folder, eval_cameras=(3, 8), frames="0:1")


def codebook_of(photographs: Photographs) -> tuple[dict[int, str], Float[np.ndarray, "k d"]]:
    """Names of the labels 0 to K, the background included, and their codes."""
    there = {int(v) for i in range(photographs.num) for v in np.unique(labels_of(photographs, i))}
    known = {label: photographs.label_names.get(label, f"object {label}") for label in range(max(there) + 1)}
    names = known | {0: "background"}
    encoder = ClassCodebook({label + 1: name for label, name in names.items()})
    return names, np.stack([encoder.embed_text(name) for name in names.values()])


def flawed_teacher(
    scene: FieldScene,
    codes: np.ndarray,
    seed: int,
    flaws: Flaws | None = None,
    scale: float = 1.0,
    snap: int = 0,
) -> tuple[Teacher, list[np.ndarray]]:
    """Simulated output of a segmenter and an encoder for a scene's photographs.

    Outlines are snapped to edges within `snap` pixels, then masks are scaled down by `scale`.

    Returns:
        the teacher; and, for a vote of labels, the code that each pixel's embedding is nearest to.
    """
    found = flawed_masks([labels_of(scene.photographs, i) for i in scene.taught], codes, seed, flaws)
    images = (scene.photographs.image(i) for i in scene.taught)
    found = found._replace(
        labels=[snap_outlines(one, image, snap) for one, image in zip(found.labels, images, strict=True)]
    )
    if scale < 1:
        sizes = scene.photographs.scaled(scale).sizes[scene.taught].tolist()
        small = [
            cv2.resize(one.astype(np.int32), size, interpolation=cv2.INTER_NEAREST_EXACT)
            for one, size in zip(found.labels, sizes, strict=True)
        ]
        found = found._replace(labels=small)
    nearest = [(rows @ codes.T).argmax(axis=1) for rows in found.embeddings]
    ids = [
        np.where(one < 0, -1, near[np.maximum(one, 0)])
        for one, near in zip(found.labels, nearest, strict=True)
    ]
    return teacher_of_objects(found.labels, found.embeddings), ids


def labels_of(photographs: Photographs, i: int) -> Int[np.ndarray, "h w"]:
    labels = photographs.labels(i)
    assert labels is not None
    return np.asarray(labels, np.int64)


@dataclass(frozen=True, eq=False)
class Learned:
    """A distilled field.

    Attributes:
        field, located: arguments of queries.
        seconds: time of the steps, without compiling.
        compile_seconds: time of compiling.
        memory_mb: memory of a compiled step: its arguments and temporaries.
        trained: number of trained parameters.
        losses: means over the last steps.
    """

    field: FeatureField
    located: Located | None
    seconds: float
    compile_seconds: float
    memory_mb: float
    trained: int
    losses: dict[str, float]


def learned(scene: FieldScene, which: Any, teacher: Teacher, config: DistillConfig) -> Learned:
    """Distil a field from some photographs."""
    cameras = [scene.photographs.camera(i) for i in which]
    method = Distill(config)
    ticks = drive(method, *method.start(scene.gaussians, cameras, teacher, scene.rasterize_mode))
    seconds, compiling, infos = 0.0, 0.0, []
    for now in ticks:
        seconds, compiling = seconds + now.seconds, compiling + now.compile_seconds
        infos = [*infos[-19:], jax.device_get(now.info)]
    assert not any(info["skipped"] for info in infos)
    problem, last = ticks.problem, ticks.run
    field = full_table(last.params, problem.rows)
    located = None if problem.rows is None else locate(field.encoding, jnp.asarray(scene.gaussians.means))
    names = [name for name in infos[0] if name not in ("skipped", "overflow", "needed")]
    return Learned(
        field,
        located,
        seconds,
        compiling,
        step_memory_mb(method, problem, last),
        sum(leaf.size for leaf in jax.tree.leaves(last.params)),
        {name: float(np.mean([info[name] for info in infos])) for name in names},
    )


def step_memory_mb(method: Distill, problem: Problem, run: Run) -> float:
    """Memory of a compiled step's arguments and temporaries."""
    advance = jax.jit(method.step.update, compiler_options=host_options(), donate_argnums=(0, 1))
    given = (run.params, run.state, problem.views[0])
    lowered = advance.lower(*given, step=jnp.asarray(0), key=jax.random.key(0))
    needed = lowered.compile().memory_analysis()
    assert needed is not None
    return (needed.argument_size_in_bytes + needed.temp_size_in_bytes) / 2**20


def scored(
    scene: FieldScene,
    of_gaussians: Int[np.ndarray, "n"],
    names: dict[int, str],
    by_field: tuple[FeatureField, Located | None, np.ndarray] | None = None,
) -> dict[str, Any]:
    """Masks of the held-out views and selections of Gaussians against the truth: means over all objects, the
    background left out.

    Args:
        scene: with held-out photographs.
        of_gaussians: the label of each Gaussian; -1 none.
        names: of labels.
        by_field: a field and the codes of the labels, for the query per pixel.
    """
    photographs = scene.photographs
    views = frozen_views(
        scene.gaussians, [photographs.camera(i) for i in scene.held_out], scene.rasterize_mode
    )
    scores, inside, covered = ClassScores(names), ClassScores(names), []
    for view, i in zip(views, scene.held_out, strict=True):
        if by_field is not None:
            by_pixel, in_space = class_maps(by_field[0], by_field[1], view, by_field[2], of_gaussians)
        else:
            share = np.asarray(paint(view[0], jax.nn.one_hot(of_gaussians, len(names)), view[1])[0])
            in_space = np.where(share.max(-1) > _OPAQUE, share.argmax(-1), -1)
            by_pixel = np.full_like(in_space, -1)
        true, drawn = labels_of(photographs, i), _drawn(scene, view)
        scores.add(by_pixel, in_space, true)
        inside.add(*(np.where(drawn, one, -1) for one in (by_pixel, in_space, true)))
        covered.append(drawn)
    rows = [row for row in scores.rows() if row["label"] != 0]
    found: dict[str, Any] = {f"m{name}": _mean([row[name] for row in rows]) for name in _NAMES}
    found |= {
        "covered": float(np.mean(covered)),
        "inside_miou_2d": _mean([row["iou_2d"] for row in inside.rows() if row["label"] != 0]),
        "inside_miou_3d": _mean([row["iou_3d"] for row in inside.rows() if row["label"] != 0]),
        "things": [f"{row['class']}: {row['iou_2d']:.2f} / {row['iou_3d']:.2f}" for row in rows],
    }
    if photographs.load_depth is None:  # where a Gaussian truly belongs is known by depth alone
        return found
    truth = true_labels(scene.gaussians, photographs)
    ious = {k: _iou(of_gaussians == k, truth == k, truth >= 0) for k in names if k and (truth == k).any()}
    hidden = _hidden(scene, truth)
    kept = [((of_gaussians == k) & one).sum() / one.sum() for k, one in hidden.items() if one.any()]
    return found | {
        "gaussian_iou": _mean(list(ious.values())),
        "hidden_recall": _mean(kept),
        "of_gaussians": [f"{names[k]}: {iou:.2f}" for k, iou in ious.items()],
    }


def _drawn(scene: FieldScene, view: Any) -> Bool[np.ndarray, "h w"]:
    """Pixels in which a view shows the scene at all."""
    return np.asarray(paint(view[0], jnp.ones((scene.gaussians.num, 1)), view[1])[1]) > _OPAQUE


_NAMES = ("iou_2d", "iou_3d", "boundary_iou_2d", "boundary_iou_3d")


def of_field(found: Learned, codes: np.ndarray) -> Int[np.ndarray, "n"]:
    """The label that each Gaussian is nearest to."""
    return classes_of(found.field, found.located, codes)


def by_majority(scene: FieldScene, which: Any, ids: list[np.ndarray], count: int) -> Int[np.ndarray, "n"]:
    """Labels of Gaussians by a majority vote of the pixels' labels."""
    cameras = [scene.photographs.camera(i) for i in which]
    views = frozen_views(scene.gaussians, cameras, scene.rasterize_mode)
    best, votes = voted_labels(views, ids, count, scene.gaussians.num)
    return np.where(votes > 0, best, -1)


def true_labels(gaussians: Gaussians, photographs: Photographs) -> Int[np.ndarray, "n"]:
    """The mask value at each Gaussian's centre, if the depth there is within 15 mm of it: a majority vote
    over the cameras, -1 where no camera sees it."""
    votes = np.zeros((gaussians.num, 256), np.int32)
    for i in range(photographs.num):
        label, seen = _seen(gaussians, photographs, i)
        np.add.at(votes, (np.flatnonzero(seen), label[seen]), 1)
    return np.where(votes.sum(1) >= _LEAST_VOTES, votes.argmax(1), -1)


def _seen(
    gaussians: Gaussians, photographs: Photographs, i: int
) -> tuple[Int[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """The mask value under each centre, and whether the centre lies where the depth is."""
    camera, depth = photographs.camera(i), photographs.depth(i)
    assert depth is not None
    pose = np.asarray(camera.viewmat), np.asarray(camera.K)
    x, y, z, inside = pixels_of(np.asarray(gaussians.means), *pose, camera.width, camera.height)
    close = inside & (depth[y, x] > 0) & (np.abs(depth[y, x] - z) < TRUE_WITHIN)
    return labels_of(photographs, i)[y, x], close


def _hidden(scene: FieldScene, truth: Int[np.ndarray, "n"]) -> dict[int, Bool[np.ndarray, "n"]]:
    """For each object, the Gaussians that the first held-out camera does not see."""
    _, seen = _seen(scene.gaussians, scene.photographs, scene.held_out[0])
    return {int(k): (truth == k) & ~seen for k in np.unique(truth) if k > 0}


def _iou(found: np.ndarray, true: np.ndarray, known: np.ndarray) -> float:
    found, true = found & known, true & known
    return float((found & true).sum() / max(1, (found | true).sum()))


def _mean(values: list[float]) -> float | None:
    known = [float(value) for value in values if value is not None and np.isfinite(value)]
    return float(np.mean(known)) if known else None
