"""Frames as the tracker takes them: of the cameras that are followed with, shrunk, and mended."""

from dataclasses import dataclass

import equinox as eqx
from jaxtyping import Array, Int

from gsjax.geometry.cameras import NEAR
from gsjax.methods.track.config import TrackConfig
from gsjax.scene.frame import Frame, part_of, without_broken


@dataclass(frozen=True)
class FrameShape:
    """The form that all frames of a recording share.

    Attributes:
        cameras: how many there are.
        width, height: of a picture, pixels.
        near: what is nearer to a camera is not drawn, metres.
    """

    cameras: int
    width: int
    height: int
    near: float = NEAR


def shape_of(frame: Frame) -> FrameShape:
    """The form of a frame."""
    return FrameShape(len(frame.images), frame.cameras.width, frame.cameras.height, frame.cameras.near)


def prepared(frame: Frame, config: TrackConfig) -> tuple[Frame, Int[Array, ""]]:
    """The frame as the tracker sees it, and how many of its pixels were not finite.

    Args:
        frame: what all cameras saw, in floats or bytes.
        config: which cameras are followed with, and by how much pictures shrink.

    Raises:
        ValueError: there is no such camera, or nothing is left of the pictures.
    """
    frame = eqx.tree_at(lambda f: f.images, frame, frame.colors)
    return without_broken(part_of(frame, config.cameras, config.shrink))
