"""Parts that were found, and their joints, against the true ones. What they are called does not matter.

How far points are off that found motions moved is told by `gsjax.metrics.tracking`, as are true labels.
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
    """How well two divisions agree on which pairs belong together (Hubert and Arabie 1985): 1 if on all, 0 as
    much as by chance, negative if less.

        (S - A B / C) / ((A + B) / 2 - A B / C)

    with S the pairs that are together in both, A and B those in one each, and C all pairs.

    Args:
        predicted, true: labels of the same Gaussians or pixels. Where the true one is -1, it is not known and
            not scored.

    Returns:
        1 where neither tells anything apart, or both everything; NaN for fewer than two labels.

    Raises:
        ValueError: the two differ in shape.
    """
    _, _, counts = _contingency(predicted, true)
    # In whole numbers, for pairs of pairs are too many for floats to tell apart.
    together = sum(comb(int(n), 2) for n in counts.ravel())
    found, real = (sum(comb(int(n), 2) for n in counts.sum(axis)) for axis in (1, 0))
    pairs = comb(int(counts.sum()), 2)
    if pairs == 0:
        return float("nan")
    most = (found + real) * pairs - 2 * found * real
    return 1.0 if most == 0 else 2 * (together * pairs - found * real) / most


class PartMatch(NamedTuple):
    """Which found part is which true one.

    Attributes:
        found: of each true label that has one, the label of its found part.
        ious: of each true label, its overlap with that part; 0 without one.
        surplus: labels of found parts that are no true one.
    """

    found: dict[int, int]
    ious: dict[int, float]
    surplus: tuple[int, ...]

    def mean_iou(self, labels: Iterable[int] | None = None) -> float:
        """Over true `labels` (all unless told; a large background says little of the parts), those that do
        not occur left out; NaN if none does."""
        values = [
            self.ious[label] for label in (self.ious if labels is None else labels) if label in self.ious
        ]
        return float(np.mean(values)) if values else float("nan")


def match_parts(predicted: Integer[np.ndarray, "..."], true: Integer[np.ndarray, "..."]) -> PartMatch:
    """The one-to-one matching of found parts and true ones whose IoUs sum up to the most (Kuhn's Hungarian
    method); what does not overlap is not matched.

    Args:
        predicted, true: labels of the same Gaussians or pixels. Where the true one is -1, it is not scored.

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
    """The labels that occur, found and true, and how often each meets each."""
    if predicted.shape != true.shape:
        raise ValueError(f"predicted: expected shape {true.shape} to match true, found {predicted.shape}")
    scored = true != IGNORED_LABEL
    found, i = np.unique(predicted[scored], return_inverse=True)
    real, j = np.unique(true[scored], return_inverse=True)
    counts = np.bincount(i * len(real) + j, minlength=len(found) * len(real))
    return found, real, counts.reshape(len(found), len(real))


class JointError(NamedTuple):
    """How far a joint that was found is from the true one. NaN for what the two kinds do not share.

    Attributes:
        same_kind: both slide, or both turn.
        axis_deg: angle between the axes' lines, 0 to 90 degrees.
        line_mm: of two hinges, how far the found line is from the true one beside the part.
        value_deg: of two hinges, mean over time of how far the angles since the anchor are apart.
        value_mm: of two slides, the same.
    """

    same_kind: bool
    axis_deg: float
    line_mm: float
    value_deg: float
    value_mm: float


def joint_error(found: Joint, true: Joint, middle: Float[np.ndarray, "3"], anchor: int = 0) -> JointError:
    """Compare two joints over the same moments.

    An axis and its opposite, with values of the opposite sign, are one joint; the found one is taken with the
    axis that is nearer to the true one. Values count from where the part stands in the canonical scene, which
    for the true joint may be ajar: so only differences to the anchor's are compared.

    Lines of hinges that are not quite parallel pass each other somewhere, be it far away, so the least
    distance of the two would not see half of the error. It is measured from the point of the true line that
    is nearest to the part.

    Args:
        middle: of the part, world, metres.
        anchor: the frame at which values count as 0.

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
