"""Propagation of labels between neighbouring images, without weights: by optical flow and colour edges."""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int, Num
from scipy import ndimage
from skimage.color import rgb2lab
from skimage.segmentation import watershed

from gsjax.geometry.flow import seen_in_both
from gsjax.perception.optical_flow import DisFlow
from gsjax.perception.pictures import unit_floats

_UNKNOWN = -1


@dataclass(frozen=True)
class FlowPropagator:
    """Propagates labels from each image to the next along the optical flow, up to edges of colour.

    1. A pixel takes the label of its origin if forward and backward flow agree, the flow has no edge there,
       and the colour is about the same.
    2. The remaining pixels, along outlines of moving objects and in regions that were hidden or outside
       before, are filled by a watershed from the labelled ones, across the weakest colour edges first. This
       keeps outlines clean, and fills regions of similar colour.
    3. Pixels too far from any labelled pixel become background.

    An object that is hidden in one image is lost from then on, and neighbours have to be similar: frames of a
    video, or cameras a few degrees apart. There is no memory of an object's appearance.

    Attributes:
        flow: any `gsjax.methods.protocols.OpticalFlow`.
        max_color_change: largest CIELAB distance of equal colours, after a blur by one pixel.
        smoothing: standard deviation of the blur before colour edges are measured, pixels.
        reach: largest distance to which labels are filled, pixels.
    """

    flow: Callable[[np.ndarray, np.ndarray], np.ndarray] = field(default_factory=DisFlow)
    max_color_change: float = 10.0
    smoothing: float = 2.0
    reach: float = 16.0

    def __call__(
        self, images: Num[np.ndarray, "V H W 3"], labels: Int[np.ndarray, "rows columns"]
    ) -> Int[np.ndarray, "V H W"]:
        """Labels of all images; those of the first are returned unchanged.

        Args:
            images: RGB, uint8 or floats 0 to 1; neighbours should be similar.
            labels: labels of the first image, 0 for background.

        Raises:
            ValueError: labels and images differ in size, or the images are too small for the flow.
        """
        if labels.shape != images.shape[1:3]:
            raise ValueError(
                f"labels: expected shape {images.shape[1:3]} to match images, found {labels.shape}"
            )
        found, lab = [labels], rgb2lab(unit_floats(images[0]))
        for before, image in pairwise(images):
            lab_before, lab = lab, rgb2lab(unit_floats(image))
            backward = self.flow(image, before)
            certain = seen_in_both(backward, self.flow(before, image))
            carried = self._warped_labels(found[-1], backward, certain, lab_before, lab)
            found.append(self._filled(carried, lab))
        return np.stack(found)

    def _warped_labels(
        self,
        labels: Int[np.ndarray, "H W"],
        backward: Float[np.ndarray, "H W 2"],
        certain: Bool[np.ndarray, "H W"],
        lab_before: Float[np.ndarray, "H W 3"],
        lab: Float[np.ndarray, "H W 3"],
    ) -> Int[np.ndarray, "H W"]:
        """The label of each pixel's origin in the previous image, _UNKNOWN where that is uncertain."""
        rows, columns = np.nonzero(certain)
        steps = np.rint(backward[certain]).astype(int)
        origins = rows + steps[:, 1], columns + steps[:, 0]
        # Where flow fails, it is often zero in both directions, and therefore consistent.
        was, now = (ndimage.gaussian_filter(colors, (1, 1, 0)) for colors in (lab_before, lab))
        alike = np.linalg.norm(now[certain] - was[origins], axis=-1) <= self.max_color_change
        carried = np.full_like(labels, _UNKNOWN)
        carried[certain] = np.where(alike, labels[origins], _UNKNOWN)
        return carried

    def _filled(
        self, carried: Int[np.ndarray, "H W"], lab: Float[np.ndarray, "H W 3"]
    ) -> Int[np.ndarray, "H W"]:
        """Labels of all pixels, the unknown ones filled from the others."""
        if (carried == _UNKNOWN).all():
            return np.zeros_like(carried)
        edges = [ndimage.gaussian_gradient_magnitude(lab[..., i], self.smoothing) for i in range(3)]
        # The watershed fills pixels whose marker is 0.
        flooded = watershed(np.linalg.norm(edges, axis=0), carried - _UNKNOWN) + _UNKNOWN
        distance = np.asarray(ndimage.distance_transform_edt(carried == _UNKNOWN))
        return np.where(distance > self.reach, 0, flooded).astype(carried.dtype)
