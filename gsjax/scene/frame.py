"""What a set of cameras sees at one moment, as arrays."""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.geometry.cameras import Camera, resized


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


Seen = TypeVar("Seen")


def one_camera(seen: Seen, c: int) -> Seen:
    """Of a pytree of which every array has a camera axis in front, camera `c` alone, with that axis."""
    return jax.tree.map(lambda a: a[c : c + 1], seen)


def part_of(frame: Frame, cameras: tuple[int, ...] = (), shrink: int = 1) -> Frame:
    """The frame of some cameras (all unless given), in smaller pictures.

    Colours are means over blocks of `shrink` by `shrink` pixels, depth is that of one pixel in the block's
    middle, for a mean would lie between surfaces. Rows and columns that fill no block are left out.

    Raises:
        ValueError: there is no such camera, or nothing is left of the pictures.
    """
    if cameras:
        count = len(frame.images)
        if not all(0 <= camera < count for camera in cameras):
            raise ValueError(f"cameras: expected numbers from 0 to {count - 1}, found {cameras}")
        frame = jax.tree.map(lambda a: a[np.array(cameras)], frame)
    if shrink == 1:
        return frame
    height, width = (size // shrink for size in (frame.cameras.height, frame.cameras.width))
    if not (height and width):
        raise ValueError(f"shrink: {shrink} leaves nothing of {frame.cameras.width}x{frame.cameras.height}")
    images = frame.images[:, : height * shrink, : width * shrink]
    images = images.reshape(-1, height, shrink, width, shrink, 3).mean((2, 4))
    middle = slice(shrink // 2, None, shrink)
    depths = None if frame.depths is None else frame.depths[:, middle, middle][:, :height, :width]
    return Frame(images, depths, resized(frame.cameras, 1 / shrink, width, height))


def without_broken(frame: Frame) -> tuple[Frame, Int[Array, ""]]:
    """The frame with pixels that are not finite made black and without depth, as `Sequence` reads them, and
    their number. Such a pixel would otherwise turn every sum that it enters into NaN."""
    broken = ~jnp.isfinite(frame.images).all(-1)
    if frame.depths is not None:
        broken |= ~jnp.isfinite(frame.depths)
    count = broken.sum()

    def mended() -> Frame:
        images = jnp.where(broken[..., None], 0.0, frame.images)
        depths = None if frame.depths is None else jnp.where(broken, 0.0, frame.depths)
        return Frame(images, depths, frame.cameras)

    # Where there is nothing to mend, what reads the images is not slowed by the question, pixel for pixel.
    return jax.lax.cond(count > 0, mended, lambda: frame), count
