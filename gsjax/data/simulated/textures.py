"""Procedural solid textures. Colours are specified in display space and mixed in linear light."""

from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates

GAMMA = 2.2
_CELLS = 64  # edge of the periodic noise block

Pattern = Literal["noise", "checker", "stripes", "label", "vessels"]


@dataclass(frozen=True)
class Texture:
    """Two colours and a pattern.

    Attributes:
        kind: "noise" (clouds), "checker", "stripes" (wavy bands along x, like wood), "label" (a printed band
            around z), or "vessels" (winding lines of the second colour, thick to thin, on clouds of both).
        colors: two RGB colours, 0 to 1.
        scale: size of the pattern in metres: period of the coarsest clouds, of a stripe, or of the thickest
            vessels, edge of a square, height of the label.
        seed: shifts the pattern.
        grain: strength of the overlaid fine noise, 0 to 1.
    """

    kind: Pattern
    colors: tuple[tuple[float, float, float], tuple[float, float, float]]
    scale: float
    seed: int = 0
    grain: float = 0.25


def albedo(texture: Texture, points: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "3 n"]:
    """Diffuse reflectance, linear, at points in the texture's own frame (metres)."""
    first, second = (np.array(color)[:, None] ** GAMMA for color in texture.colors)
    # The offset keeps pattern edges away from planes of symmetry, where faces of solids lie.
    offset = np.random.default_rng(texture.seed).uniform(0.1, 0.9, (3, 1)) * texture.scale
    match texture.kind:
        case "noise":
            mix = _smooth(_noise(points + offset, texture.scale))
        case "checker":
            cells = np.floor((points + offset) / texture.scale).astype(np.int64)
            mix = (cells.sum(0) % 2).astype(np.float64)
        case "stripes":
            stretched = (points + offset) * np.array([[0.25], [1.0], [1.0]])  # like wood grain
            phase = points[1] / texture.scale + 1.5 * _noise(stretched, 5 * texture.scale)
            mix = 0.5 + 0.5 * np.sin(2 * np.pi * phase)
        case "label":
            printed = _smooth(4 * (_noise(points + offset, 0.7 * texture.scale) - 0.5) + 0.5)
            mix = np.where(np.abs(points[2]) < 0.5 * texture.scale, printed, 0.0)
            edge = np.abs(np.abs(points[2]) - 0.5 * texture.scale) < 0.06 * texture.scale
            mix = np.where(edge, 1.0, mix)
        case "vessels":
            mix = _vessels(points + offset, texture.scale)
    fine = 1.0 + texture.grain * (2 * _noise(points + offset, 0.35 * texture.scale + 0.01) - 1)
    return np.clip((first + (second - first) * mix) * fine, 0.0, 1.0)


def _vessels(points, scale):
    """Level lines of noise at three scales."""
    mix = 0.5 * _smooth(_noise(points, 2 * scale))
    for share, half_width, darkness in ((1.0, 0.028, 0.7), (0.4, 0.05, 0.5), (0.16, 0.09, 0.35)):
        distance = np.abs(_noise(points + share * scale, share * scale) - 0.5) / half_width
        mix = mix + (1 - mix) * darkness * _smooth(1.5 - distance)
    return mix


def _smooth(x):
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3 - 2 * x)


def _noise(points, period):
    """Noise around 0.5 with detail down to period / 8."""
    block = _noise_block()
    coordinates = points * (8.0 / period)
    return map_coordinates(block, coordinates, order=1, mode="grid-wrap", prefilter=False)


@cache
def _noise_block() -> Float[np.ndarray, "cells cells cells"]:
    """Periodic noise with amplitudes that fall as f^-2.2 from 4 cycles per block, mean 0.5, mostly within 0
    and 1."""
    white = np.random.default_rng(0).normal(size=(_CELLS,) * 3)
    axis = np.fft.fftfreq(_CELLS, 1 / _CELLS)
    frequency = np.sqrt(sum(f**2 for f in np.meshgrid(axis, axis, axis, indexing="ij")))
    amplitude = np.where(frequency >= 4, np.maximum(frequency, 1) ** -2.2, 0.0)
    block = np.fft.ifftn(np.fft.fftn(white) * amplitude).real
    return 0.5 + 0.25 * block / block.std()
