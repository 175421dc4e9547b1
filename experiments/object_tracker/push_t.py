"""The tracker on real input without depth: a Franka pushes a T-block (the push_t recording).

    python -m experiments.object_tracker.push_t RECORDING --stride 4

Tracks the first seven seconds with the first two cameras, starting from the recording's own shapes, and
compares the rendered silhouette of the block with the pixels of its colour in all three. The robot hides
part of the block, and the colour mask ends where the robot begins, so 1 is out of reach; a block that never
moved from its first pose is scored beside it. Writes push_t.json beside this file.
"""

import json
from pathlib import Path
from typing import Annotated

import cv2
import jax
import numpy as np
import tyro

import gsjax
from gsjax.engine import machine
from gsjax.engine.track.tracking import track
from gsjax.methods.track import Pose, first_pose, render_labels, scene_from_shapes
from gsjax.metrics.segmentation import iou_of_masks

SPECK = 100  # pixels: smaller patches of the colour are not the block


def block_pixels(image: np.ndarray) -> np.ndarray:
    """Pixels of the block's orange: H < 14 or > 174, S > 140, V > 120 in OpenCV's HSV."""
    hue, saturation, value = np.moveaxis(cv2.cvtColor(image, cv2.COLOR_RGB2HSV), -1, 0)
    orange = ((hue < 14) | (hue > 174)) & (saturation > 140) & (value > 120)
    _, patches, stats, _ = cv2.connectedComponentsWithStats(orange.astype(np.uint8))
    return orange & (stats[patches, cv2.CC_STAT_AREA] >= SPECK)


def main(
    recording: Annotated[Path, tyro.conf.Positional],
    stride: int = 4,
    seconds: float = 7.0,
    tracked: tuple[int, ...] = (0, 1),
) -> None:
    """Track, score and write the result.

    Args:
        recording: the push_t folder.
        stride: every n-th frame of about 18 ms is taken.
        seconds: length of the part that is used, from the start.
        tracked: ids of the cameras that the tracker sees; the others are only scored.
    """
    whole = gsjax.open_sequence(recording)
    length = int((whole.times < whole.times[0] + seconds).sum())
    judged = whole.select(slice(0, length, stride))
    seen = judged.select(cameras=tracked)
    first = seen.frame(0)
    scene = scene_from_shapes(judged.models, first)
    start = first_pose(scene)
    plan = gsjax.plan_render(scene.gaussians, judged.frame(0).cameras, headroom=2.0)
    draw = jax.jit(lambda pose, frame: render_labels(scene, pose, frame, plan).features)

    def silhouettes(pose: Pose, t: int) -> np.ndarray:
        return np.asarray(draw(pose, judged.frame(t)))[..., 1] > 0.5

    def score(pose: Pose, t: int) -> list[float]:
        drawn = silhouettes(pose, t)
        return [iou_of_masks(drawn[c], block_pixels(judged.image(t, c))) for c in range(judged.num_cameras)]

    moving, still, updates = [score(start, 0)], [score(start, 0)], []
    frames = (seen.frame(t) for t in range(1, seen.num_frames))
    for t, now in enumerate(track(scene, first, frames), start=1):
        moving.append(score(now.result.pose, t))
        still.append(score(start, t))
        updates.append(now.seconds)
        print(f"{judged.times[t] - judged.times[0]:5.2f} s  IoU {np.round(moving[-1], 3)}", flush=True)

    result = {
        "iou": dict(zip(map(str, judged.camera_ids), np.mean(moving, axis=0).round(4).tolist(), strict=True)),
        "iou_standing_still": dict(
            zip(map(str, judged.camera_ids), np.mean(still, axis=0).round(4).tolist(), strict=True)
        ),
        "tracked_cameras": list(tracked),
        "frames": judged.num_frames,
        "stride": stride,
        "update_s_median": round(float(np.median(updates)), 3),
        "update_s_p95": round(float(np.quantile(updates, 0.95)), 3),
        "machine": machine.in_words(machine.describe()),
    }
    (Path(__file__).parent / "push_t.json").write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    tyro.cli(main)
