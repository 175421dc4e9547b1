"""What a set of cameras observed at one moment: the form of input that all losses and methods share."""

from functools import partial
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from gsjax.geometry.cameras import Camera, resized
from gsjax.geometry.neighbors import ENDLESS, drop_flying_pixels

Seen = TypeVar("Seen")


class Frame(eqx.Module):
    """What C cameras saw at one moment; numpy arrays on the host, JAX arrays on the device.

    Attributes:
        images: RGB, floats from 0 to 1 or bytes from 0 to 255.
        depths: metres along the optical axis, 0 where unknown; None without depth cameras.
        cameras: C cameras (viewmat [C,4,4], K [C,3,3]), which may move from frame to frame.
        masks: the pixels that count; None if all do.
        time: when it was recorded, 0 to 1 over the recording; None for a static scene.
    """

    images: Float[Array | np.ndarray, "c height width 3"] | UInt8[Array | np.ndarray, "c height width 3"]
    depths: Float[Array | np.ndarray, "c height width"] | None
    cameras: Camera
    masks: Bool[Array | np.ndarray, "c height width"] | None = None
    time: Float[Array | np.ndarray, ""] | None = None

    @property
    def colors(self) -> Float[Array | np.ndarray, "c height width 3"]:
        """The images as floats, 0 to 1."""
        if jnp.issubdtype(self.images.dtype, jnp.floating):
            return self.images
        return self.images.astype(jnp.result_type(float)) / 255

    @property
    def known_depths(self) -> Float[np.ndarray, "c height width"]:
        """Depths of surfaces (`drop_flying_pixels`) within masks, else 0; 0 without depth. On the host."""
        if self.depths is None:
            return np.zeros(self.images.shape[:-1], np.float32)
        depths = drop_flying_pixels(np.asarray(self.depths))
        return depths if self.masks is None else np.where(np.asarray(self.masks), depths, 0)


def of_cameras(frame: Frame, which: slice | Int[Array | np.ndarray, "k"]) -> Frame:
    """The frame with only some of its cameras."""
    images, depths, cameras, masks = jax.tree.map(
        lambda a: a[which], (frame.images, frame.depths, frame.cameras, frame.masks)
    )
    return Frame(images, depths, cameras, masks, frame.time)


def one_camera(seen: Seen, c: int) -> Seen:
    """Camera `c` alone of a frame, or of a batch of cameras; the camera axis stays."""
    on_host = all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(seen))
    return _chosen(seen, slice(c, c + 1)) if on_host else _one_on_device(seen, c)


@partial(jax.jit, inline=True)
def _one_on_device(seen: Seen, c: Int[Array, ""] | int) -> Seen:
    return _chosen(seen, jnp.reshape(c, 1))


def _chosen(seen: Any, which: slice | Int[Array | np.ndarray, "k"]) -> Any:
    return of_cameras(seen, which) if isinstance(seen, Frame) else jax.tree.map(lambda a: a[which], seen)


def part_of(frame: Frame, cameras: tuple[int, ...] = (), shrink: int = 1) -> Frame:
    """The frame of some cameras (default: all), in smaller images.

    Colours are means over blocks of `shrink` by `shrink` pixels; depths and masks are those of a pixel in the
    middle of the block, since a mean of depths could lie between surfaces. Incomplete blocks at the right and
    bottom are left out.

    Raises:
        ValueError: there is no such camera, or nothing is left of the images.
    """
    if cameras:
        count = len(frame.images)
        if not all(0 <= camera < count for camera in cameras):
            raise ValueError(f"cameras: expected numbers from 0 to {count - 1}, found {cameras}")
        frame = of_cameras(frame, np.array(cameras))
    if shrink == 1:
        return frame
    height, width = (size // shrink for size in (frame.cameras.height, frame.cameras.width))
    if not (height and width):
        raise ValueError(
            f"shrink: expected at most the sides of the pictures, {frame.cameras.width}x"
            f"{frame.cameras.height}, found {shrink}"
        )
    images = frame.colors[:, : height * shrink, : width * shrink]
    images = images.reshape(-1, height, shrink, width, shrink, 3).mean((2, 4))
    middle = slice(shrink // 2, None, shrink)

    def picked(pixels):
        return None if pixels is None else pixels[:, middle, middle][:, :height, :width]

    smaller = resized(frame.cameras, 1 / shrink, width, height)
    return Frame(images, picked(frame.depths), smaller, picked(frame.masks), frame.time)


def with_black_gaps(frame: Frame) -> Frame:
    """The frame with black in pixels that do not count and are not finite, as they would spread where images
    are resized or compared in windows. On the host."""
    if frame.masks is None or not np.issubdtype(frame.images.dtype, np.floating):
        return frame
    gaps = ~np.asarray(frame.masks) & ~np.isfinite(frame.images).all(-1)
    images = np.where(gaps[..., None], 0, frame.images)
    return Frame(images, frame.depths, frame.cameras, frame.masks, frame.time)


def without_broken(frame: Frame) -> tuple[Frame, Int[Array, ""]]:
    """The frame with pixels that are not finite set to black and to depth 0, and depth that is not finite or
    is `ENDLESS` set to 0, as `Sequence` reads them; and their number. Such a pixel, or the square of its
    depth, would otherwise turn every sum that it enters into NaN."""
    frame = Frame(frame.colors, frame.depths, frame.cameras, frame.masks, frame.time)
    broken = dark = ~jnp.isfinite(frame.images).all(-1)
    if frame.depths is not None:
        broken = dark | ~(jnp.abs(frame.depths) < ENDLESS)
    count = broken.sum()

    def mended() -> Frame:
        images = jnp.where(dark[..., None], 0.0, frame.images)
        depths = None if frame.depths is None else jnp.where(broken, 0.0, frame.depths)
        return Frame(images, depths, frame.cameras, frame.masks, frame.time)

    # A branch: where there is nothing to mend, readers of the images are not slowed by a test of each pixel.
    return jax.lax.cond(count > 0, mended, lambda: frame), count
