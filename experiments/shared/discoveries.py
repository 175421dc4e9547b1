"""What experiments with parts share: a canonical scene for many settings, and the scores of `gsjax parts`."""

import hashlib
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Float, Int

from gsjax.data import Sequence
from gsjax.engine.fit.run import Options as FitOptions
from gsjax.engine.fit.run import run as run_fit
from gsjax.engine.folder import is_finished
from gsjax.engine.parts.run import Options
from gsjax.engine.parts.run import run as run_parts
from gsjax.engine.parts.saved import open_parts_run
from gsjax.engine.parts.start import FIT as FIT  # for settings that differ from it in one thing
from gsjax.engine.parts.views import part_views
from gsjax.engine.recording import parse_frames
from gsjax.methods.parts import PartsConfig, Start, begin, choose_anchor
from gsjax.metrics.temporal import temporal_scores
from gsjax.metrics.tracking import relative_motion
from gsjax.perception.optical_flow import DisFlow
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.handles import HandlePose

FOUND_IOU = 0.5


def canonical_of(options: Options, folder: Path) -> Path:
    """The run of `gsjax fit` at the options' anchor, made once for several cells; beside `folder`.

    Args:
        options: of `gsjax parts`, with an anchor.
        folder: of a cell.
    """
    assert options.anchor is not None
    frame = range(sys.maxsize)[parse_frames(options.frames)][options.anchor]  # of the data
    wanted = f"{options.dataset} {options.cameras} {options.eval_cameras} {frame} {options.fit}"
    wanted += f" {options.scale} {options.read}"
    path = folder.parent / f"canonical-{hashlib.sha256(wanted.encode()).hexdigest()[:8]}"
    if not is_finished(path):
        run_fit(
            FitOptions(
                options.dataset,
                path,
                frames=f"{frame}:{frame + 1}",
                cameras=options.cameras,
                eval_cameras=options.eval_cameras,
                scale=options.scale,
                overwrite=True,
                read=options.read,
                fit=options.fit,
            )
        )
    return path


def discovered(options: Options) -> dict[str, Any]:
    """One row of results of `gsjax parts`: parts, motion and joints against the truth, and pictures.

    `true_found` counts true parts that a found one overlaps by half (IoU of Gaussians), `joints` the true
    joints whose kind was found. Errors are means over the true parts that overlap with a found one at all; a
    part that does not shows in `parts` and in the Rand index only.
    """
    run_parts(options)
    found = json.loads((options.out / "metrics.json").read_text())
    matched = [row for row in found["parts"] if row.get("true_name")]
    whole = [row for row in matched if row["iou"] >= FOUND_IOU]
    jointed = [row for row in matched if row.get("same_kind")]
    points = [row["median_point_error_mm"] for row in matched]
    turning = [row for row in jointed if row["kind"] == "revolute"]
    row = {
        "ari": found["ari"],
        "parts": found["num_parts"],
        "true_found": None if found["ari"] is None else len(whole),
        "point_mm": float(np.mean(points)) if points else None,
        "worst_point_mm": max(points, default=None),
        "joints": len(jointed),
        "axis_deg": float(np.mean([row["axis_deg"] for row in turning])) if turning else None,
        "gaussians": found["num_gaussians"],
        "update_s": found["update_s"]["median"],
        "minutes": (found["seconds"]["total"] - found["seconds"].get("canonical", 0.0)) / 60,
        "skipped": found["skipped"],
        "found": [
            f"{row.get('true_name') or '-'}: {row['gaussians']} Gaussians, {row['kind']}"
            for row in found["parts"]
        ],
    }
    for kind, name in (("held_out", "held_out"), ("tracked", "train")):
        row |= {f"{name}_psnr": found[kind]["psnr"], f"{name}_ssim": found[kind]["ssim"]}
    return row


def steadiness(folder: Path) -> dict[str, Any]:
    """Temporal stability of the run's video of the first held-out camera, against the recording's."""
    run = open_parts_run(folder)
    camera = run.camera(None)
    videos: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for views in part_views(run.layer.scene, run.layer.trajectory, run.recording, run.blend):
        view = next(view for view in views if view.camera == camera)
        for video, picture in zip(videos, (view.render, view.image), strict=True):
            video.append(picture)
    found = temporal_scores(*(np.stack(video) for video in videos), optical_flow=DisFlow())
    return {name: found[name] for name in ("t_ssim_gap", "flow_warp_error", "flow_warp_share")}


def with_parts(options: Options, **sections: dict[str, Any]) -> Options:
    """Options with other settings, such as `stream={"past": 0}`; `top={...}` sets those outside sections."""
    parts = replace(options.parts, **sections.pop("top", {}))
    for name, values in sections.items():
        parts = replace(parts, **{name: replace(getattr(parts, name), **values)})
    return replace(options, parts=parts)


def pose_from(motions: Float[np.ndarray, "P 4 4"], centers: Float[np.ndarray, "P 3"]) -> HandlePose:
    """The pose of handles at `centers` that moves the canonical scene by these rigid motions."""
    centers = np.asarray(centers, np.float64)
    shifts = np.einsum("pij,pj->pi", motions[:, :3, :3], centers) + motions[:, :3, 3] - centers
    quats = jaxlie.SO3.from_matrix(jnp.asarray(motions[:, :3, :3], jnp.float32)).wxyz
    return HandlePose(quats, jnp.asarray(shifts, jnp.float32))


def start_from_truth(
    sequence: Sequence, gaussians: Gaussians, anchor: int, config: PartsConfig
) -> tuple[Start, Float[np.ndarray, "T P 4 4"], Int[np.ndarray, "labels"]]:
    """A discovery that starts from true masks of what moves.

    Returns:
        the start, the true motion of each of its handles relative to the canonical scene, and the handle of
        each mask label, 0 where there is none.
    """
    truth = sequence.truth
    motions = [relative_motion(truth.poses[:, k], anchor) for k in range(len(truth.label_ids))]
    moving = [k for k, motion in enumerate(motions) if np.abs(motion - np.eye(4)).max() > 1e-3]
    masks = np.stack([sequence.mask(anchor, c) for c in range(sequence.num_cameras)])
    slots = np.zeros(max(int(masks.max()), int(truth.label_ids.max())) + 1, int)
    slots[truth.label_ids[moving]] = np.arange(1, len(moving) + 1)
    pieces = slots[np.maximum(masks, 0)]
    config = replace(config, discover=replace(config.discover, most_parts=len(moving)))
    chosen = choose_anchor(sequence.image, sequence.num_frames, sequence.num_cameras, anchor)
    start = begin(sequence, gaussians, chosen, pieces > 0, config, None, jax.random.key(0), masks=pieces)
    still = np.broadcast_to(np.eye(4), motions[0].shape)
    return start, np.stack([still, *(motions[k] for k in moving)], axis=1), slots
