"""Recordings in the layouts of other programs, written from simulated ones, for tests of readers."""

import json

import numpy as np

from gsjax.geometry.cameras import OPENGL_TO_OPENCV
from tests.data import dots


def write_bop(sequence, root, *, posed=True):
    """Writes the first camera's view as a BOP scene with the true object poses; depth is in 0.1 mm."""
    cameras, annotations = {}, {}
    for t, number in enumerate(sequence.frame_ids):
        name, viewmat, mask = f"{number:06d}", sequence.viewmats[t, 0], sequence.mask(t, 0)
        dots.save(root / f"rgb/{name}.png", sequence.image(t, 0))
        dots.save(root / f"depth/{name}.png", np.round(1e4 * sequence.depth(t, 0)).astype(np.uint16))
        K = sequence.Ks[t, 0] - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        cameras[str(number)] = {"cam_K": K.ravel().tolist(), "depth_scale": 0.1}
        if posed:
            cameras[str(number)] |= _moved("w2c", viewmat)
        annotations[str(number)] = []
        for i, label in enumerate(sequence.truth.label_ids.tolist()):
            dots.save(
                root / f"mask_visib/{name}_{i:06d}.png", np.where(mask == label, 255, 0).astype(np.uint8)
            )
            pose = viewmat @ sequence.truth.poses[t, i]
            annotations[str(number)].append({"obj_id": 10 + label} | _moved("m2c", pose))
    (root / "scene_camera.json").write_text(json.dumps(cameras))
    (root / "scene_gt.json").write_text(json.dumps(annotations))


def _moved(what, pose):
    return {
        f"cam_R_{what}": pose[:3, :3].ravel().tolist(),
        f"cam_t_{what}": (1000 * pose[:3, 3]).tolist(),
    }


def write_paris(sequence, root, *, split="train"):
    """Writes the first and last frames as two states, with depth; unlabelled pixels are transparent."""
    for state, t in (("start", 0), ("end", sequence.num_frames - 1)):
        cameras = {"K": sequence.Ks[t, 0].tolist()}
        for c in range(sequence.num_cameras):
            alpha = np.where(sequence.mask(t, c) > 0, 255, 0).astype(np.uint8)
            dots.save(root / f"{state}/{split}/{c:04d}.png", np.dstack([sequence.image(t, c), alpha]))
            depth = np.round(1000 * sequence.depth(t, c)).astype(np.uint16)
            dots.save(root / f"{state}/{split}/depth/{c:04d}.png", depth)
            pose = np.linalg.inv(sequence.viewmats[t, c]) @ OPENGL_TO_OPENCV
            cameras[f"{c:04d}"] = pose.tolist()
        (root / f"{state}/camera_{split}.json").write_text(json.dumps(cameras))
