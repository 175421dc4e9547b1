"""Scores of parts and joints that were found, against the true ones. The values of labels are arbitrary.

For true labels, and for the error of points moved by the found motions, see `gsjax.metrics.tracking`.
"""

from collections.abc import Iterable
from math import comb
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Integer
from scipy.optimize import linear_sum_assignment

from gsjax.geometry.joints import Joint
from gsjax.metrics.segmentation import IGNORED_LABEL


def adjusted_rand_index(predicted: Integer[np.ndarray, "..."], true: Integer[np.ndarray, "..."]) -> float:
    """The adjusted Rand index (Hubert and Arabie 1985): agreement of two labelings on which pairs belong
    together. 1 is perfect agreement, 0 is chance, and negative values are below chance.

        (S - A B / C) / ((A + B) / 2 - A B / C)

    with S the pairs together in both labelings, A and B those together in one labeling each, and C all pairs.

    Args:
        predicted, true: labels of the same Gaussians or pixels. Entries whose true label is -1 (unknown) are
            not scored.

    Returns:
        1 if both labelings put everything together or everything apart; NaN for fewer than two labels.

    Raises:
        ValueError: the two differ in shape.
    """
    _, _, counts = _contingency(predicted, true)
    # In integers, because counts of pairs of pairs exceed the precision of floats.
    together = sum(comb(int(n), 2) for n in counts.ravel())
    found, real = (sum(comb(int(n), 2) for n in counts.sum(axis)) for axis in (1, 0))
    pairs = comb(int(counts.sum()), 2)
    if pairs == 0:
        return float("nan")
    most = (found + real) * pairs - 2 * found * real
    return 1.0 if most == 0 else 2 * (together * pairs - found * real) / most


class PartMatch(NamedTuple):
    """The assignment of found parts to true ones.

    Attributes:
        found: the label of the found part for each true label that was matched.
        ious: IoU of each true label with its found part; 0 if unmatched.
        surplus: labels of found parts that match no true part.
    """

    found: dict[int, int]
    ious: dict[int, float]
    surplus: tuple[int, ...]

    def mean_iou(self, labels: Iterable[int] | None = None) -> float:
        """Mean IoU over the true `labels`, by default all; a large background dilutes the score of the parts.
        Labels that do not occur are ignored; NaN if none occurs."""
        values = [
            self.ious[label] for label in (self.ious if labels is None else labels) if label in self.ious
        ]
        return float(np.mean(values)) if values else float("nan")


def match_parts(predicted: Integer[np.ndarray, "..."], true: Integer[np.ndarray, "..."]) -> PartMatch:
    """The one-to-one matching of found to true parts with the largest sum of IoUs (the Hungarian method).
    Parts that do not overlap are not matched.

    Args:
        predicted, true: labels of the same Gaussians or pixels; those whose true label is -1 are not scored.

    Raises:
        ValueError: the two differ in shape.
    """
    found, real, counts = _contingency(predicted, true)
    ious = counts / np.maximum(counts.sum(1, keepdims=True) + counts.sum(0, keepdims=True) - counts, 1)
    pairs = [
        (i, j) for i, j in zip(*linear_sum_assignment(ious, maximize=True), strict=True) if ious[i, j] > 0
    ]
    matched = {int(real[j]): int(found[i]) for i, j in pairs}
    return PartMatch(
        matched,
        {int(label): 0.0 for label in real} | {int(real[j]): float(ious[i, j]) for i, j in pairs},
        tuple(label for label in found.tolist() if label not in matched.values()),
    )


def _contingency(
    predicted: np.ndarray, true: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Integer[np.ndarray, "found real"]]:
    """The found and the true labels that occur, and the contingency table of the two."""
    if predicted.shape != true.shape:
        raise ValueError(f"predicted: expected shape {true.shape} to match true, found {predicted.shape}")
    scored = true != IGNORED_LABEL
    found, i = np.unique(predicted[scored], return_inverse=True)
    real, j = np.unique(true[scored], return_inverse=True)
    counts = np.bincount(i * len(real) + j, minlength=len(found) * len(real))
    return found, real, counts.reshape(len(found), len(real))


class JointError(NamedTuple):
    """Error of a found joint against the true one. NaN where a quantity does not apply to both joints.

    Attributes:
        same_kind: both are prismatic, or both revolute.
        axis_deg: angle between the two axes as undirected lines, 0 to 90 degrees.
        line_mm: for revolute joints, distance between the two axes next to the part, millimetres.
        value_deg: for revolute joints, mean absolute error over time of the angle since the anchor, degrees.
        value_mm: for prismatic joints, the same of the displacement, millimetres.
    """

    same_kind: bool
    axis_deg: float
    line_mm: float
    value_deg: float
    value_mm: float


def joint_error(found: Joint, true: Joint, middle: Float[np.ndarray, "3"], anchor: int = 0) -> JointError:
    """Compare two joints over the same frames.

    An axis and its opposite, with values of opposite sign, describe the same joint; the found joint is taken
    with the axis closer to the true one. Values are relative to the part's pose in the canonical scene, where
    the true joint may be ajar, so only differences from the anchor's value are compared.

    The axes of two nearly parallel hinges approach each other somewhere, possibly far away, so their smallest
    distance would miss half of the error. The distance is therefore measured from the point on the true axis
    that is nearest to the part.

    Args:
        found, true: the joints.
        middle: centre of the part, world, metres.
        anchor: the frame at which values are taken as 0.

    Raises:
        ValueError: the joints have different numbers of frames.
    """
    if found.values.shape != true.values.shape:
        raise ValueError(
            f"found: expected {len(true.values)} values like the true joint, found {len(found.values)}"
        )
    missing = float("nan")
    cosine, sine = float(found.axis @ true.axis), float(np.linalg.norm(np.cross(found.axis, true.axis)))
    angle = float(np.degrees(np.arctan2(sine, abs(cosine))))
    if found.kind != true.kind:
        return JointError(False, angle, missing, missing, missing)
    sign = -1.0 if cosine < 0 else 1.0
    gaps = sign * (found.values - found.values[anchor]) - (true.values - true.values[anchor])
    gap = float(np.abs(gaps).mean())
    if true.kind == "prismatic":
        return JointError(True, angle, missing, missing, 1000 * gap)
    beside = true.point + (middle - true.point) @ true.axis * true.axis
    line = 1000 * float(np.linalg.norm(np.cross(beside - found.point, found.axis)))
    return JointError(True, angle, line, float(np.degrees(gap)), missing)
