"""The inputs of a rasterization in the one layout that projection, planning and painting share."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int


class Views(NamedTuple):
    """All inputs of a rasterization, as B scenes of C cameras."""

    means: Float[Array, "b n 3"]
    quats: Float[Array, "b n 4"]
    scales: Float[Array, "b n 3"]
    opacities: Float[Array, "b n"]
    colors: Float[Array, "b #c n ..."]
    features: Float[Array, "b n f"] | None
    viewmats: Float[Array, "b c 4 4"]
    Ks: Float[Array, "b c 3 3"]
    fisheye: Float[Array, "b c 4"] | None
    means2d_offset: Float[Array, "b c n 2"] | None
    backgrounds: Float[Array, "b c channels"] | None
    tile_mask: Bool[Array, "b c tiles"] | None
    reads: Int[Array, "b c tiles"] | None


def usable(views: Views) -> Bool[Array | np.ndarray, "b n"]:
    """Gaussians whose values can be drawn: squares that overflow would corrupt the gradients of others."""

    def paintable(a):
        a = a.astype(views.means.dtype)
        return (abs(a * a) < math.inf).all(axis=(1, *range(3, a.ndim)))

    colors = paintable(views.colors)
    return colors if views.features is None else colors & paintable(views.features[:, None])
