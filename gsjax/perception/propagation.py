"""Labels of one picture carried to those beside it, without weights: by optical flow and edges of colour."""

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
    """Labels go from each picture to the next with the optical flow, and end where colour does.

    1. A pixel takes the label of the place it came from, if the way there and back ends where it began, the
       flow has no edge there, and the colour is about the same.
    2. The others, along the outlines of what moves, and what was hidden or outside before, are flooded from
       those that took one, over the weakest edges of colour first (watershed). So outlines do not fray, and
       regions of like colour are filled.
    3. What is too far from all that took one is background.

    So what is not seen for one picture is lost from there on, and neighbours must be alike: frames of a
    video, or cameras a few degrees apart. It remembers nothing of what an object looked like.

    Attributes:
        flow: any `gsjax.methods.protocols.OpticalFlow`.
        max_color_change: up to this difference of CIELAB, both blurred by a pixel, a colour is the same.
        smoothing: standard deviation of the blur before edges of colour are measured, pixels.
        reach: how far labels flood, pixels.
    """

    flow: Callable[[np.ndarray, np.ndarray], np.ndarray] = field(default_factory=DisFlow)
    max_color_change: float = 10.0
    smoothing: float = 2.0
    reach: float = 16.0

    def __call__(
        self, images: Num[np.ndarray, "V H W 3"], labels: Int[np.ndarray, "rows columns"]
    ) -> Int[np.ndarray, "V H W"]:
        """Labels of all pictures; those of the first are as given.

        Args:
            images: RGB, uint8 or floats 0 to 1; neighbours are alike.
            labels: of the first; 0 background.

        Raises:
            ValueError: the labels are not of the pictures' size, or the pictures are too small for the flow.
        """
        if labels.shape != images.shape[1:3]:
            raise ValueError(f"labels: expected shape {images.shape[1:3]} as images, found {labels.shape}")
        found, lab = [labels], rgb2lab(unit_floats(images[0]))
        for before, image in pairwise(images):
            lab_before, lab = lab, rgb2lab(unit_floats(image))
            came = self.flow(image, before)
            certain = seen_in_both(came, self.flow(before, image))
            found.append(self._flooded(self._carried(found[-1], came, certain, lab_before, lab), lab))
        return np.stack(found)

    def _carried(
        self,
        labels: Int[np.ndarray, "H W"],
        came: Float[np.ndarray, "H W 2"],
        certain: Bool[np.ndarray, "H W"],
        lab_before: Float[np.ndarray, "H W 3"],
        lab: Float[np.ndarray, "H W 3"],
    ) -> Int[np.ndarray, "H W"]:
        """The label of the place where each pixel was before, _UNKNOWN where that is not certain."""
        rows, columns = np.nonzero(certain)
        steps = np.rint(came[certain]).astype(int)
        origins = rows + steps[:, 1], columns + steps[:, 0]
        # Where flow fails, it often says that nothing moved, and the way back says so too.
        was, now = (ndimage.gaussian_filter(colors, (1, 1, 0)) for colors in (lab_before, lab))
        alike = np.linalg.norm(now[certain] - was[origins], axis=-1) <= self.max_color_change
        carried = np.full_like(labels, _UNKNOWN)
        carried[certain] = np.where(alike, labels[origins], _UNKNOWN)
        return carried

    def _flooded(
        self, carried: Int[np.ndarray, "H W"], lab: Float[np.ndarray, "H W 3"]
    ) -> Int[np.ndarray, "H W"]:
        """Labels of all pixels."""
        if (carried == _UNKNOWN).all():
            return np.zeros_like(carried)
        edges = [ndimage.gaussian_gradient_magnitude(lab[..., i], self.smoothing) for i in range(3)]
        # The watershed takes 0 for what is to be flooded.
        flooded = watershed(np.linalg.norm(edges, axis=0), carried - _UNKNOWN) + _UNKNOWN
        distance = ndimage.distance_transform_edt(carried == _UNKNOWN)
        return np.where(distance > self.reach, 0, flooded).astype(carried.dtype)
