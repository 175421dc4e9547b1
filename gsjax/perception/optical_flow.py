"""Optical flow without weights: dense inverse search (Kroeger, Timofte, Dai, Van Gool, ECCV 2016)."""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, Num

from gsjax.perception.pictures import to_bytes

_LEAST_SIDES = (8, 12)  # shorter and longer side, pixels; a patch has 8 by 8
_PRESETS = {
    "ultrafast": cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
    "fast": cv2.DISOPTICAL_FLOW_PRESET_FAST,
    "medium": cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
}


@dataclass(frozen=True)
class DisFlow:
    """DIS, OpenCV's implementation: a coarse-to-fine patch search, then variational refinement.

    It handles textured surfaces that move by up to about a tenth of the image's width. Every pixel has a
    flow, even if it is not visible in the other image: see `gsjax.geometry.flow.seen_in_both`.

    Attributes:
        preset: quality of the search; "medium" is the slowest.
    """

    preset: Literal["ultrafast", "fast", "medium"] = "medium"

    def __call__(
        self, image: Num[np.ndarray, "..."], other: Num[np.ndarray, "..."]
    ) -> Float[np.ndarray, "H W 2"]:
        """Displacement (x, y) of each pixel of `image` to `other`, pixels.

        Args:
            image, other: [H, W, 3], RGB, uint8 or floats 0 to 1.

        Raises:
            ValueError: the images differ in size, are not RGB, or are too small.
        """
        if image.ndim != 3 or image.shape[2] != 3:
            raise ValueError(f"image: expected shape [H, W, 3], RGB, found {image.shape}")
        if other.shape != image.shape:
            raise ValueError(f"other: expected shape {image.shape} to match image, found {other.shape}")
        if any(side < least for side, least in zip(sorted(image.shape[:2]), _LEAST_SIDES, strict=True)):
            shorter, longer = _LEAST_SIDES
            raise ValueError(
                f"image: expected at least {shorter} by {longer} pixels, found {image.shape[:2]}"
            )
        grey = [cv2.cvtColor(to_bytes(picture), cv2.COLOR_RGB2GRAY) for picture in (image, other)]
        return cv2.DISOpticalFlow_create(_PRESETS[self.preset]).calc(*grey, None)
