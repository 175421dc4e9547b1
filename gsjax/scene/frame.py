"""What a set of cameras sees at one moment, as arrays."""

import equinox as eqx
from jaxtyping import Array, Float

from gsjax.geometry.cameras import Camera


class Frame(eqx.Module):
    """What C cameras see at one moment.

    Attributes:
        images: RGB, 0 to 1.
        depths: metres, 0 where unknown; None without depth cameras.
        cameras: C cameras (viewmat [C,4,4], K [C,3,3]), which may move from frame to frame.
        weights: how much each pixel counts, 0 to 1; None counts all.
    """

    images: Float[Array, "c height width 3"]
    depths: Float[Array, "c height width"] | None
    cameras: Camera
    weights: Float[Array, "c height width"] | None = None
