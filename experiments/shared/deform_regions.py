"""Meanings on simulated tissue: regions that deform with it, and a teacher that errs.

It stands in for a foundation model: labels of pixels are taken from the simulation's truth, and then made
wrong in a known share of blocks.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int
from scipy.spatial import cKDTree

from experiments.shared.deforming import Dataset, Reconstructed, lifted, seen_as
from gsjax.engine.deform.scores import classes_of_pixels
from gsjax.metrics.features import feature_psnr
from gsjax.metrics.segmentation import LabelOverlap

BACKGROUND = 0
REGIONS = 5  # of the tissue, beside the background
_SEEDS_UV = np.array([[0.2, 0.25], [0.75, 0.2], [0.5, 0.5], [0.2, 0.8], [0.8, 0.75]])
_NEAREST = 4  # vertices, between which a pixel's place on the tissue lies
CLASSES = REGIONS + 1
BLOCK_PX = 16


def region_map(data: Dataset, t: int) -> Int[np.ndarray, "h w"]:
    """Labels of the left eye's pixels: 0 the background, 1 to 5 regions of the tissue (the nearest of five
    places on its uv map), -1 the tool."""
    frame = data.frame(t)
    seen, viewmat, K = frame.depths[0], frame.cameras.viewmat[0], frame.cameras.K[0]
    height, width = seen.shape
    high, wide = data.truth["seg"][t].shape
    seg = data.truth["seg"][t][np.ix_(np.arange(height) * high // height, np.arange(width) * wide // width)]
    tissue = (seg == 1) & (seen > 0)
    points = lifted(seen, tissue, viewmat, K)
    apart, which = cKDTree(data.truth["verts"][t]).query(points, k=_NEAREST)
    weights = 1 / np.maximum(apart, 1e-9) ** 2
    uv = (data.truth["uv"][which] * weights[..., None]).sum(axis=1) / weights.sum(axis=1, keepdims=True)
    regions = np.full((height, width), -1, np.int32)
    regions[seg == 0] = BACKGROUND
    regions[tissue] = 1 + np.linalg.norm(uv[:, None] - _SEEDS_UV, axis=-1).argmin(axis=1)
    return regions


def with_errors(
    regions: Int[np.ndarray, "h w"],
    share: float,
    rng: np.random.Generator,
    block: int = BLOCK_PX,
    classes: int = CLASSES,
) -> Int[np.ndarray, "h w"]:
    """Regions with the labels of a share of blocks replaced, like a segmenter's errors: in whole patches that
    differ from frame to frame."""
    height, width = regions.shape
    rows, columns = -(-height // block), -(-width // block)
    wrong = rng.random((rows, columns)) < share
    added = rng.integers(1, classes, (rows, columns))
    spread = np.kron(np.where(wrong, added, 0), np.ones((block, block), int))[:height, :width]
    return np.where(regions < 0, regions, (regions + spread) % classes).astype(np.int32)


def meanings(found: Reconstructed, data: Dataset, codes: np.ndarray) -> dict[str, float]:
    """Scores of the held-out frames: PSNR of features against the teacher's without errors, IoU of classes (a
    mean over classes, pooled over frames), its spread over frames, and the share of right pixels."""
    overlap, each, psnrs, right = LabelOverlap(), [], [], []
    for t in data.test:
        true = region_map(data, t)
        features = seen_as(found, data.frame(t)).features
        psnrs.append(feature_psnr(np.asarray(features), codes[np.maximum(true, 0)], true >= 0))
        named = np.asarray(classes_of_pixels(features, jnp.asarray(codes, features.dtype)))
        overlap.add(named, true)
        one = LabelOverlap()
        one.add(named, true)
        each.append(one.mean_iou(range(CLASSES)))
        right.append((named == true)[true >= 0].mean())
    return {
        "f_psnr": float(np.mean(psnrs)),
        "iou": overlap.mean_iou(range(CLASSES)),
        "iou_spread": float(np.std(each)),
        "accuracy": float(np.mean(right)),
    }
