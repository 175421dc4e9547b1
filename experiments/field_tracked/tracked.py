"""Do features that are distilled once stay with their objects while the tracker moves the Gaussians?"""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from experiments.shared.commands import succeeded
from experiments.shared.fields import NO_FLAWS, codebook_of, flawed_teacher, learned, of_field
from experiments.shared.recordings import recorded
from gsjax.data.simulated.flawed_masks import Flaws
from gsjax.engine.distill.scene import scene_of_run
from gsjax.engine.distill.scores import ClassScores, class_maps
from gsjax.engine.folder import is_finished
from gsjax.engine.track.saved import open_run
from gsjax.methods.distill import DistillConfig, FeatureField, features_of, frozen_views
from gsjax.methods.track import place
from gsjax.scene.gaussians import Gaussians

CAMERAS, MASK_CAMERA, HELD_OUT, EVERY = (0, 1), 1, (2,), 6


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """Track a recording with the field of its first frame, and score labels and features against the true
    masks of a held-out camera; for comparison, the same with Gaussians that never move."""
    path = folder.parents[1] / "field_scenes" / f"{options['recording']}_all"
    if not is_finished(path):
        words = ["track", recorded(options["recording"]), "--out", path, "--overwrite"]
        words += [
            "--preset",
            "accurate",
            "--mask-camera",
            MASK_CAMERA,
            "--cameras",
            *CAMERAS,
            "--eval-cameras",
            *HELD_OUT,
        ]
        succeeded(*words)
    first, saved = scene_of_run(path), open_run(path)
    names, codes = codebook_of(first.photographs)
    teacher, _ = flawed_teacher(first, codes, seed, NO_FLAWS if options["masks"] == "true" else Flaws())
    found = learned(first, first.taught, teacher, DistillConfig(iterations=options["iterations"], seed=seed))
    carried = FeatureField(features_of(found.field, found.located), found.field.lift)  # a row a Gaussian
    of_gaussians = of_field(found, codes)
    rows, totals, left, right = [], ClassScores(names), ClassScores(names), []
    recording = saved.recording.judged
    still = frozen_views(_placed(saved, 0), _cameras(recording.select(frames=slice(0, 1)))[-1:])[0]
    unmoved = class_maps(carried, None, still, codes, of_gaussians)
    for t in range(0, saved.tracking.num_frames, EVERY):
        gaussians = _placed(saved, t)
        assert gaussians.num == len(of_gaussians)
        at_t, sequence = ClassScores(names), recording.select(frames=slice(t, t + 1))
        view = frozen_views(gaussians, _cameras(sequence)[-1:])[0]
        maps = class_maps(carried, None, view, codes, of_gaussians)
        true = np.asarray(sequence.mask(0, sequence.num_cameras - 1), np.int64)
        drawn = maps[0] >= 0
        inside = [np.where(drawn, one, -1) for one in (*maps, true)]
        at_t.add(*inside)
        totals.add(*inside)
        left.add(*(np.where(unmoved[0] >= 0, one, -1) for one in (*unmoved, true)))
        right.append(float((maps[0] == true)[drawn].mean()))
        things = [row for row in at_t.rows() if row["label"] != 0]
        rows.append(float(np.nanmean([row["iou_3d"] for row in things])))
    jax.clear_caches()
    things = [row for row in totals.rows() if row["label"] != 0]
    return {
        "first_miou": rows[0],
        "last_miou": rows[-1],
        "least_miou": min(rows),
        "miou_2d": float(np.nanmean([row["iou_2d"] for row in things])),
        "miou_3d": float(np.nanmean([row["iou_3d"] for row in things])),
        "unmoved_miou": float(np.nanmean([row["iou_3d"] for row in left.rows() if row["label"] != 0])),
        "pixels_right": float(np.mean(right)),
        "things": [f"{row['class']}: {row['iou_2d']:.2f} / {row['iou_3d']:.2f}" for row in things],
        "over_time": [f"{value:.3f}" for value in rows],
        "minutes": (found.seconds + found.compile_seconds) / 60,
        "update_hz": saved.tracking.hz,
    }


def _placed(saved: Any, t: int) -> Gaussians:
    """The scene as the tracker had it at a frame."""
    return eqx.tree_at(
        lambda g: g.features, place(*saved.tracking.at(t)), None, is_leaf=lambda leaf: leaf is None
    )


def _cameras(sequence: Any) -> list[Any]:
    from gsjax.data.photographs import photographs_of

    photographs = photographs_of(sequence)
    return [photographs.camera(i) for i in range(photographs.num)]
