"""Overlap of predicted and true label images, with pixels pooled over frames and cameras."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Bool, Integer

IGNORED_LABEL = -1
BOUNDARY_SHARE = 0.02  # width of a mask's boundary band, as a fraction of the image's diagonal


@dataclass
class LabelOverlap:
    """Pixel counts per label, accumulated over images.

    Pooling gives every pixel the same weight; in a mean of per-frame ratios, a sliver in one frame would
    count as much as the whole object in the next.

        IoU = sum |P and T| / sum |P or T|        Dice = 2 sum |P and T| / (sum |P| + sum |T|)
        precision = sum |P and T| / sum |P|       recall = sum |P and T| / sum |T|

    Attributes:
        intersections, predicted, true: number of pixels per label.
    """

    intersections: dict[int, int] = field(default_factory=dict)
    predicted: dict[int, int] = field(default_factory=dict)
    true: dict[int, int] = field(default_factory=dict)

    def add(self, predicted: Integer[np.ndarray, "..."], true: Integer[np.ndarray, "..."]) -> None:
        """Count one image [H, W]. Pixels whose true label is -1 are ignored; -1 predicts no label.

        Raises:
            ValueError: the two differ in shape.
        """
        predicted, true = np.asarray(predicted), np.asarray(true)
        if predicted.shape != true.shape:
            raise ValueError(f"predicted: expected shape {true.shape} to match true, found {predicted.shape}")
        scored = true != IGNORED_LABEL
        predicted, true = predicted[scored], true[scored]
        _count(self.intersections, predicted[predicted == true])
        _count(self.predicted, predicted[predicted != IGNORED_LABEL])
        _count(self.true, true)

    @property
    def labels(self) -> list[int]:
        """All labels that occurred, predicted or true, in ascending order."""
        return sorted(self.predicted.keys() | self.true.keys())

    def iou(self, label: int) -> float:
        """Intersection over union of one label; NaN where it never occurred."""
        both = self.intersections.get(label, 0)
        return _ratio(both, self.predicted.get(label, 0) + self.true.get(label, 0) - both)

    def dice(self, label: int) -> float:
        """Dice coefficient of one label, 2 IoU / (1 + IoU); NaN where it never occurred."""
        both = self.intersections.get(label, 0)
        return _ratio(2 * both, self.predicted.get(label, 0) + self.true.get(label, 0))

    def f1(self, label: int) -> float:
        """Harmonic mean of precision and recall of one label, which for pixels is Dice by another name; NaN
        where it never occurred."""
        both = self.intersections.get(label, 0)
        if not both:
            return 0.0 if label in self.labels else float("nan")
        precision, recall = both / self.predicted[label], both / self.true[label]
        return 2 * precision * recall / (precision + recall)

    @property
    def accuracy(self) -> float:
        """Fraction of the pixels whose label is correct; NaN without pixels."""
        return _ratio(sum(self.intersections.values()), sum(self.true.values()))

    def mean_iou(self, labels: Iterable[int] | None = None) -> float:
        """Mean IoU over `labels`, by default all that occurred; labels that never occurred are ignored."""
        return self.mean(self.iou, labels)

    def mean(self, score: Callable[[int], float], labels: Iterable[int] | None = None) -> float:
        """Mean over `labels` of another score of one label, such as `dice` or `f1`. The mean Dice is not the
        Dice of the mean: if classes differ, 2 mean IoU / (1 + mean IoU) is larger."""
        values = [score(label) for label in (self.labels if labels is None else labels)]
        values = [value for value in values if not np.isnan(value)]
        return float(np.mean(values)) if values else float("nan")


def iou_of_masks(predicted: np.ndarray, true: np.ndarray) -> float:
    """Intersection over union of two boolean masks of one shape; NaN where both are empty.

    Raises:
        ValueError: the two differ in shape.
    """
    overlap = LabelOverlap()
    overlap.add(np.asarray(predicted, bool).astype(np.int8), np.asarray(true, bool).astype(np.int8))
    return overlap.iou(1)


@dataclass
class MaskOverlap:
    """Pixel counts of one object's masks and of their boundaries, accumulated over images.

    Boundary IoU (Cheng et al., CVPR 2021) is the IoU of the pixels that lie within a mask and no farther than
    2 % of the image's diagonal from its outline. It is sensitive to the outline even of large objects.

    Attributes:
        both, either: number of pixels in the intersection and in the union of predicted and true mask.
        boundary_both, boundary_either: the same for the boundaries.
    """

    both: int = 0
    either: int = 0
    boundary_both: int = 0
    boundary_either: int = 0

    def add(self, predicted: Bool[np.ndarray, "h w"], true: Bool[np.ndarray, "h w"]) -> None:
        """Count one image.

        Raises:
            ValueError: the two differ in shape.
        """
        if predicted.shape != true.shape:
            raise ValueError(f"predicted: expected shape {true.shape} to match true, found {predicted.shape}")
        self.both += int((predicted & true).sum())
        self.either += int((predicted | true).sum())
        ours, theirs = boundary(predicted), boundary(true)
        self.boundary_both += int((ours & theirs).sum())
        self.boundary_either += int((ours | theirs).sum())

    @property
    def iou(self) -> float:
        """Intersection over union; NaN if all masks were empty."""
        return _ratio(self.both, self.either)

    @property
    def boundary_iou(self) -> float:
        """Intersection over union; NaN if all masks were empty."""
        return _ratio(self.boundary_both, self.boundary_either)


def boundary(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The pixels of a mask no farther from its outline than 2 % of the image's diagonal. The edge of the
    image counts as outline."""
    reach = max(1, round(BOUNDARY_SHARE * float(np.hypot(*mask.shape))))
    bordered = cv2.copyMakeBorder(mask.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    inner = cv2.erode(bordered, np.ones((3, 3), np.uint8), iterations=reach)[1:-1, 1:-1] > 0
    return mask & ~inner


def _count(counts: dict[int, int], labels: np.ndarray) -> None:
    for label, pixels in zip(*np.unique(labels, return_counts=True), strict=True):
        counts[int(label)] = counts.get(int(label), 0) + int(pixels)


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")
