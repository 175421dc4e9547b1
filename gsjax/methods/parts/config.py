"""Settings of parts. Comments become the command line's help."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from gsjax.methods.settings import expect
from gsjax.scene.feature_grid import FeatureGridConfig


@dataclass(frozen=True)
class DiscoverConfig:
    """The first masks."""

    most_parts: int = 31
    """Largest number of parts at any time, pieces that are yet to be joined included."""
    threshold: float = 0.06
    """Least difference of colours, from 0 to 1, that counts as a change."""
    frames: int = 16
    """Number of frames that the anchor is compared with; 1, the paper's, takes the one that differs most."""
    difference: bool = True
    """Only what changed may move (I_d). Without it, everything that the segmenter finds may."""
    lift_iterations: int = 32
    """Steps that lift masks to logits of Gaussians."""

    def __post_init__(self):
        expect(self, "discover.", most_parts=(1, np.inf), threshold=(1e-6, 1), frames=(1, np.inf))
        expect(self, "discover.", lift_iterations=(1, np.inf))


@dataclass(frozen=True)
class StreamConfig:
    """The pose of each frame."""

    iterations: int = 60
    """Steps a frame."""
    coarse: float = 0.7
    """Share of them that use pictures of half the size."""
    l1_weight: float = 0.8
    """Weight of L1 in the loss (lambda); the rest is 1 - SSIM."""
    depth_weight: float = 0.1
    """Weight of the difference in depth, where cameras measure it."""
    depth_limit: float = 0.05
    """Largest difference in depth that counts, metres; a larger one is that of another thing."""
    tear_weight: float = 0.05
    """Weight of neighbours that move apart, in a frame's first step; in its last a fifth. By it, what no
    picture shows goes with what it touches."""
    hold_weight: float = 0.01
    """Weight of changes of skinning weights: of parts that have not moved yet, pictures tell only noise."""
    tear_scale: float = 0.5
    """Gap between neighbours that counts as torn by half, pixels."""
    rate: float = 0.5
    """Learning rate of translations: how far a part moves in a frame's first step, pixels."""
    turn_rate: float = 0.25
    """Learning rate of rotations: how far a part's border turns, pixels. With a higher rate, what looks the
    same all around goes astray."""
    final_rate: float = 0.05
    """Learning rates of a frame's last step, over those of its first."""
    field_rate: float = 1e-3
    """Learning rate of the field of skinning weights; 0.01 suits tables."""
    past: int = 1
    """Pictures of past frames in each step, from which only weights learn (temporal consistency)."""
    blend: Literal["quaternion", "polar", "dual"] = "quaternion"
    """Blend of rotations, where a Gaussian follows several handles."""

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
    """Parts that become one, or two."""

    every: int = 5
    """Frames from one such time to the next; 0: never."""
    least_cut: float = 8.0
    """A part is divided where pictures pull its sides apart by this many times what chance would make."""
    noise: float = 2.5
    """Error of tracking, pixels: what has moved less is not compared yet."""
    tolerance: float = 0.15
    """Parts whose motions differ by less than this share of the lesser motion are one."""
    least_gain: float = 0.01
    """In the end a part joins another, or stands still, where pictures get worse by less than this share."""

    def __post_init__(self):
        names = ("every", "least_cut", "noise", "tolerance", "least_gain")
        expect(self, "unify.", **dict.fromkeys(names, (0, np.inf)))


@dataclass(frozen=True)
class RefineConfig:
    """The fit of the scene and all poses to all frames, once the parts are known."""

    iterations: int = 400
    """Steps; with 0 the scene stays as the anchor frame shaped it, as in the paper."""
    rate: float = 0.05
    """Learning rate: how far Gaussians and parts move in the first step, pixels."""

    def __post_init__(self):
        expect(self, "refine.", **dict.fromkeys(("iterations", "rate"), (0, np.inf)))


@dataclass(frozen=True)
class PartsConfig:
    """Settings of parts."""

    discover: DiscoverConfig = field(default_factory=DiscoverConfig)
    stream: StreamConfig = field(default_factory=StreamConfig)
    unify: UnifyConfig = field(default_factory=UnifyConfig)
    refine: RefineConfig = field(default_factory=RefineConfig)
    weights: Literal["grid", "table", "simplex"] = "grid"
    """The field of skinning weights: a hash grid over the scene, a row of logits for each Gaussian, or a row
    of weights, kept on the simplex."""
    grid: FeatureGridConfig = field(
        default_factory=lambda: FeatureGridConfig(
            levels=6, least_resolution=6, most_resolution=96, log2_entries=14, features=4, hidden=32
        )
    )
    """The grid of skinning weights."""
    headroom: float = 1.6
    """How many times as much as is needed a plan holds."""
    seed: int = 0
    """Seed of all that is random."""

    def __post_init__(self):
        expect(self, headroom=(1, np.inf), seed=(0, np.inf))
