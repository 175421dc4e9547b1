"""Preparation of frames: only the tracked cameras, reduced in size, without pixels that are not finite."""

import warnings
from dataclasses import dataclass
from functools import partial

import jax
from jaxtyping import Array, Int

from gsjax.geometry.cameras import NEAR
from gsjax.methods.track.config import TrackConfig
from gsjax.scene.frame import Frame, part_of, without_broken


@dataclass(frozen=True)
class FrameShape:
    """The shape that all frames of a recording share.

    Attributes:
        cameras: number of cameras.
        width, height: size of the images, pixels.
        near: distance of the near plane, metres.
    """

    cameras: int
    width: int
    height: int
    near: float = NEAR


def expect_pinholes(frame: Frame) -> None:
    """Raises a ValueError if the frame's cameras are fisheyes, which the tracker does not support."""
    if frame.cameras.fisheye is not None:
        raise ValueError(
            "cameras: expected pinholes, found fisheyes, which the tracker cannot follow; undistort the "
            "pictures first"
        )


def prepared_first(frame: Frame) -> Frame:
    """The first frame, from which a scene starts, as floats and without pixels that are not finite; a warning
    reports their number. On the host.

    Raises:
        ValueError: the cameras are fisheyes.
    """
    expect_pinholes(frame)
    frame, broken = without_broken(frame)
    if broken:
        message = f"the first frame has {broken} pixels that are not finite, or endlessly far; ignored"
        warnings.warn(message, stacklevel=3)
    return frame


def shape_of(frame: Frame) -> FrameShape:
    """The shape of a frame."""
    return FrameShape(len(frame.images), frame.cameras.width, frame.cameras.height, frame.cameras.near)


@partial(jax.jit, static_argnums=1, inline=True)
def prepared(frame: Frame, config: TrackConfig) -> tuple[Frame, Int[Array, ""]]:
    """The frame of `config.cameras`, with images reduced by `config.shrink`, and the number of its pixels
    that were not finite.

    Raises:
        ValueError: a camera does not exist, or the reduced images would be empty.
    """
    return without_broken(part_of(frame, config.cameras, config.shrink))
