"""What is it worth to put outlines of flawed masks on edges of the picture, before any field learns them?"""

from pathlib import Path
from typing import Any

import numpy as np

from experiments.shared.fields import (
    NO_FLAWS,
    by_majority,
    codebook_of,
    fitted,
    flawed_teacher,
    labels_of,
    scored,
)

FEWEST = 40  # pixels of a thing in a photograph, for its mask to be judged


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """Flawed masks of articulated_0, snapped, as they are and lifted by a vote; and true ones, which a snap
    can only harm."""
    scene = fitted("articulated_0", folder, eval_cameras=(3, 8), frames="0:1")
    names, codes = codebook_of(scene.photographs)
    _, ids = flawed_teacher(scene, codes, seed, snap=options["reach"])
    _, true = flawed_teacher(scene, codes, seed, NO_FLAWS, snap=options["reach"])
    labels = [labels_of(scene.photographs, i) for i in scene.taught]
    return {
        **scored(scene, by_majority(scene, scene.taught, ids, len(names)), names),
        "masks_miou": _miou(ids, labels),
        "true_masks_miou": _miou(true, labels),
    }


def _miou(found: list[np.ndarray], true: list[np.ndarray]) -> float:
    """Over the things of each photograph; pixels of which nothing is said do not count."""
    ious = []
    for ours, theirs in zip(found, true, strict=True):
        known = ours >= 0
        for k in np.unique(theirs[known]):
            one, other = (ours == k) & known, (theirs == k) & known
            if k > 0 and other.sum() >= FEWEST:
                ious.append((one & other).sum() / (one | other).sum())
    return float(np.mean(ious))
