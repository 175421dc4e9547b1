"""How parts are found and followed. Comments become the command line's help."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from gsjax.methods.settings import expect
from gsjax.scene.feature_grid import FeatureGridConfig


@dataclass(frozen=True)
class DiscoverConfig:
    """How the first masks are made."""

    most_parts: int = 31
    """How many parts there may be at any time, pieces that are yet to be joined included."""
    threshold: float = 0.06
    """What counts as changed: a difference of colours from 0 to 1."""
    frames: int = 16
    """With how many frames the anchor is compared; 1 is the paper's: with the one that differs most."""
    difference: bool = True
    """Only what changed may move (I_d). Without, all that the segmenter tells apart does."""
    lift_iterations: int = 32
    """Steps by which masks become logits of Gaussians."""

    def __post_init__(self):
        expect(self, "discover.", most_parts=(1, np.inf), threshold=(1e-6, 1), frames=(1, np.inf))
        expect(self, "discover.", lift_iterations=(1, np.inf))


@dataclass(frozen=True)
class StreamConfig:
    """How each frame's pose is found."""

    iterations: int = 60
    """Steps a frame."""
    coarse: float = 0.7
    """Share of them that look at pictures of half the size."""
    l1_weight: float = 0.8
    """Lambda: of L1 in the loss; the rest is 1 - SSIM."""
    depth_weight: float = 0.1
    """Of the difference in depth, where cameras measure it."""
    depth_limit: float = 0.05
    """A difference beyond this is that of another thing, metres."""
    tear_weight: float = 0.05
    """Of neighbours that move apart, in a frame's first step; in its last a fifth. What no picture holds goes
    with what it touches."""
    hold_weight: float = 0.01
    """Of weights that change: of parts that have not moved yet pictures tell nothing, and noise much."""
    tear_scale: float = 0.5
    """How far apart is torn, pixels."""
    rate: float = 0.5
    """Of Adam: how far a part is moved in a frame's first step, pixels."""
    turn_rate: float = 0.25
    """Of Adam: how far its border is turned, pixels. Faster, what looks the same all around goes astray."""
    final_rate: float = 0.05
    """Of a frame's last step, over that of its first."""
    field_rate: float = 1e-3
    """Of Adam, for what weights are made of; 0.01 suits tables."""
    past: int = 1
    """How many frames of the past each step looks at too, from which only weights learn (temporal
    consistency)."""
    blend: Literal["quaternion", "polar", "dual"] = "quaternion"
    """Of rotations, where a Gaussian follows several handles."""

    def __post_init__(self):
        shares, weights = ("coarse", "l1_weight"), ("depth_weight", "tear_weight", "hold_weight")
        rates = ("rate", "turn_rate", "field_rate")
        expect(
            self,
            "stream.",
            iterations=(1, np.inf),
            past=(0, np.inf),
            final_rate=(1e-6, 1),
            **dict.fromkeys(shares, (0, 1)),
        )
        expect(self, "stream.", **dict.fromkeys((*weights, *rates), (0, np.inf)))
        expect(self, "stream.", **dict.fromkeys(("depth_limit", "tear_scale"), (1e-9, np.inf)))


@dataclass(frozen=True)
class UnifyConfig:
    """When parts become one, or two."""

    every: int = 5
    """Frames between looks; 0: never."""
    least_cut: float = 8.0
    """A part is divided where pictures pull its sides apart by so many times what chance would make."""
    noise: float = 2.5
    """What tracking errs by, pixels: what has moved less is not compared yet."""
    tolerance: float = 0.15
    """Parts whose motions differ by less than such a share of the lesser motion are one."""
    least_gain: float = 0.01
    """In the end a part joins another, or stands still, where pictures get worse by less than this share."""

    def __post_init__(self):
        names = ("every", "least_cut", "noise", "tolerance", "least_gain")
        expect(self, "unify.", **dict.fromkeys(names, (0, np.inf)))


@dataclass(frozen=True)
class RefineConfig:
    """How the scene and all poses are fitted to all frames, once the parts are known."""

    iterations: int = 400
    """Steps; with 0 the scene stays as the anchor frame shaped it, as in the paper."""
    rate: float = 0.05
    """Of Adam: how far Gaussians and parts are moved in a first step, pixels."""

    def __post_init__(self):
        expect(self, "refine.", **dict.fromkeys(("iterations", "rate"), (0, np.inf)))


@dataclass(frozen=True)
class PartsConfig:
    """How parts are found and followed."""

    discover: DiscoverConfig = field(default_factory=DiscoverConfig)
    stream: StreamConfig = field(default_factory=StreamConfig)
    unify: UnifyConfig = field(default_factory=UnifyConfig)
    refine: RefineConfig = field(default_factory=RefineConfig)
    weights: Literal["grid", "table", "simplex"] = "grid"
    """What skinning weights are made of: a hash grid over the scene, a row of logits for each Gaussian, or a
    row of weights, kept on the simplex."""
    grid: FeatureGridConfig = field(
        default_factory=lambda: FeatureGridConfig(
            levels=6, least_resolution=6, most_resolution=96, log2_entries=14, features=4, hidden=32
        )
    )
    """Of skinning weights."""
    headroom: float = 1.6
    """How many times as much as it needs a plan holds at first."""
    seed: int = 0
    """Of all that is random."""

    def __post_init__(self):
        expect(self, headroom=(1, np.inf), seed=(0, np.inf))
