"""What a set of cameras sees at one moment, as arrays."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from gsjax.geometry.cameras import Camera


class Frame(eqx.Module):
    """What C cameras see at one moment.

    Attributes:
        images: RGB, 0 to 1.
        depths: metres, 0 where unknown; None without depth cameras.
        cameras: C cameras (viewmat [C,4,4], K [C,3,3]), which may move from frame to frame.
    """

    images: Float[Array, "c height width 3"]
    depths: Float[Array, "c height width"] | None
    cameras: Camera


def without_broken(frame: Frame) -> tuple[Frame, Int[Array, ""]]:
    """The frame with pixels that are not finite made black and without depth, as `Sequence` reads them, and
    their number. Such a pixel would otherwise turn every sum that it enters into NaN."""
    broken = ~jnp.isfinite(frame.images).all(-1)
    if frame.depths is not None:
        broken |= ~jnp.isfinite(frame.depths)
    images = jnp.where(broken[..., None], 0.0, frame.images)
    depths = None if frame.depths is None else jnp.where(broken, 0.0, frame.depths)
    return Frame(images, depths, frame.cameras), broken.sum()
