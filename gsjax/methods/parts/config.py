"""Settings of parts. The fields' docstrings become the command line's help."""

from dataclasses import dataclass, field, fields
from typing import Literal

import numpy as np

from gsjax.methods.settings import expect
from gsjax.scene.feature_grid import FeatureGridConfig


@dataclass(frozen=True)
class DiscoverConfig:
    """Settings of the initial masks."""

    most_parts: int = 31
    """Largest number of parts at any time, including pieces that have yet to be joined."""
    threshold: float = 0.06
    """Smallest difference of colours, from 0 to 1, that counts as a change."""
    frames: int = 16
    """Number of frames to compare with the anchor; with 1, as in the paper, the one that differs most."""
    moving: float = 0.5
    """Share of a Gaussian's pixels, over all cameras, that must change in half of the frames for the Gaussian
    to join the part that it touches, if no mask covers it."""
    difference: bool = True
    """Restrict parts to segments that changed (I_d); otherwise every segment may move."""
    depth: bool = True
    """Where cameras measure depth, do not take for motion what is only occluded by something that passes in
    front, or only lit differently, as in a shadow."""
    lift_iterations: int = 32
    """Optimisation steps that lift the masks to logits of Gaussians."""

    def __post_init__(self):
        counts = dict.fromkeys(("most_parts", "frames", "lift_iterations"), (1, np.inf))
        expect(self, "discover.", threshold=(1e-6, 1), moving=(1e-6, 1), **counts)


@dataclass(frozen=True)
class StreamConfig:
    """Settings of the optimisation of each frame's pose."""

    iterations: int = 60
    """Steps per frame."""
    coarse: float = 0.7
    """Share of the steps that use coarse pictures, of about 160x120 (half the size of smaller recordings);
    the others use pictures twice as large."""
    l1_weight: float = 0.8
    """Weight of L1 in the loss (lambda); the remainder is the weight of 1 - SSIM."""
    depth_weight: float = 0.1
    """Weight of the depth loss, for cameras that measure depth."""
    depth_limit: float = 0.05
    """Depth error at which the loss saturates, metres; a larger one means that another object is seen."""
    tear_weight: float = 0.05
    """Weight of the penalty on neighbours that move apart, in a frame's first step; it falls to a fifth by
    the last. It makes surfaces that no camera sees follow what they touch."""
    hold_weight: float = 0.01
    """Weight of the penalty on changes of the skinning weights: images of parts that have not moved yet
    provide only noise."""
    tear_scale: float = 0.5
    """Gap between neighbours at which half of the tear penalty is reached, pixels."""
    rate: float = 0.5
    """Learning rate of translations: distance that a part moves in a frame's first step, pixels."""
    turn_rate: float = 0.25
    """Learning rate of rotations: distance that a part's border moves, pixels. At a higher rate, parts that
    look alike from all sides drift."""
    final_rate: float = 0.05
    """Learning rates in a frame's last step, relative to its first."""
    field_rate: float = 1e-3
    """Learning rate of the skinning-weight field; 0.01 suits tables."""
    search: bool = True
    """Search for parts that jump farther than they are wide, before a frame's first step."""
    past: int = 1
    """Images of past frames in each step, from which only the weights learn (temporal consistency)."""
    blend: Literal["quaternion", "polar", "dual"] = "quaternion"
    """How rotations are blended for a Gaussian that follows several handles."""

    def __post_init__(self):
        weights = ("depth_weight", "tear_weight", "hold_weight")
        rates = ("rate", "turn_rate", "field_rate")
        expect(self, "stream.", iterations=(1, np.inf), past=(0, np.inf), final_rate=(1e-6, 1))
        expect(self, "stream.", **dict.fromkeys(("coarse", "l1_weight"), (0, 1)))
        expect(self, "stream.", **dict.fromkeys((*weights, *rates), (0, np.inf)))
        expect(self, "stream.", **dict.fromkeys(("depth_limit", "tear_scale"), (1e-9, np.inf)))


@dataclass(frozen=True)
class UnifyConfig:
    """Settings of joining and dividing parts."""

    every: int = 5
    """Number of frames between attempts to join or divide parts; 0: never."""
    least_cut: float = 8.0
    """Divide a part if the images pull its sides apart this many times more than chance would."""
    noise: float = 2.5
    """Tracking error, pixels; parts that have moved less are not compared yet."""
    tolerance: float = 0.15
    """Join parts whose motions differ by less than this share of the smaller motion, or by less than the
    tracking error."""
    least_gain: float = 0.01
    """At the end, join a part to another or to the background if the loss rises by at most this share."""

    def __post_init__(self):
        expect(self, "unify.", **{one.name: (0, np.inf) for one in fields(self)})


@dataclass(frozen=True)
class RefineConfig:
    """Settings of the final fit of the scene and all poses to all frames."""

    iterations: int | None = None
    """Steps (default: two for each picture, at least 400); with 0 the scene stays as fitted to the anchor
    frame, as in the paper."""
    rate: float = 0.05
    """Learning rate of the scene: distance that Gaussians move in the first step, pixels."""
    pose_rate: float = 0.3
    """Learning rate of the poses: distance that parts, and their borders, move in the first step, pixels."""

    def __post_init__(self):
        known = {} if self.iterations is None else {"iterations": (0, np.inf)}
        expect(self, "refine.", rate=(0, np.inf), pose_rate=(0, np.inf), **known)


@dataclass(frozen=True)
class PartsConfig:
    """Settings of parts. Distances in pixels are in those of pictures of about 320x240, or of the recording
    if it is smaller."""

    discover: DiscoverConfig = field(default_factory=DiscoverConfig)
    stream: StreamConfig = field(default_factory=StreamConfig)
    unify: UnifyConfig = field(default_factory=UnifyConfig)
    refine: RefineConfig = field(default_factory=RefineConfig)
    weights: Literal["grid", "table", "simplex"] = "grid"
    """Representation of the skinning weights: a hash grid over the scene, a table of logits, or a table of
    weights that are kept on the simplex."""
    grid: FeatureGridConfig = field(
        default_factory=lambda: FeatureGridConfig(
            levels=6, least_resolution=6, most_resolution=96, log2_entries=14, features=4, hidden=32
        )
    )
    """Hash grid of the skinning weights."""
    exposures: bool = True
    """Correct the pictures of each camera to the exposure and white balance of the scene."""
    absences: bool = True
    """Hide parts in frames from which they are absent: they have left, or have yet to appear."""
    headroom: float = 1.6
    """Capacity of a render plan, relative to what is needed."""
    seed: int = 0
    """Random seed."""

    def __post_init__(self):
        expect(self, headroom=(1, np.inf), seed=(0, np.inf))
