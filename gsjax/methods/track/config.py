"""The settings of the object-aware tracker, with their units and what they trade."""

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from gsjax.methods.settings import ABOVE_ZERO, expect


@dataclass(frozen=True)
class StartConfig:
    """How the first frame becomes Gaussians."""

    object_pixels: float = 1.5
    """Width of the voxels that keep one point of an object each, in pixels of the camera that saw it."""
    background_pixels: float = 4.0
    """The same for the background, which is only rendered."""
    max_extent: float = 0.35
    """Objects longer than this are seldom rigid (a robot arm): they are followed in parts, metres."""
    part_size: float = 0.15
    """About how large those parts are, metres."""
    label_distance: float = 0.15
    """A point unseen by the mask's camera takes the nearest label along the surface up to here, metres."""
    label_step: float = 0.02
    """Points further apart than this are on no common surface, metres."""
    depth_gap: float = 0.015
    """How far a point's depth may be from the depth image and still be what the image shows, metres."""
    iterations: int = 150
    """Photometric optimisation steps on the first frame."""

    def __post_init__(self):
        sizes = ("object_pixels", "background_pixels", "max_extent", "part_size")
        lengths = ("label_distance", "label_step", "depth_gap")
        expect(self, "track.start.", **dict.fromkeys(sizes + lengths, ABOVE_ZERO), iterations=(0, np.inf))


@dataclass(frozen=True)
class MatchConfig:
    """Template matching: where has each object gone?"""

    patch: int = 64
    """Edge of the template, pixels of the (possibly reduced) image."""
    radius: int = 24
    """How far the template is searched to each side, pixels of the reduced image."""
    min_score: float = 0.3
    """A correlation below this moves nothing."""
    margin: int = 2
    """Pixels by which the object's mask is grown: an outline against its surroundings is texture too."""
    max_residual: float = 0.03
    """Cameras that disagree on where the object is by more than this lose to the best of them, metres."""

    def __post_init__(self):
        expect(self, "track.match.", max_residual=ABOVE_ZERO, patch=(8, np.inf), radius=(1, np.inf))
        expect(self, "track.match.", margin=(0, np.inf), min_score=(-1, np.inf))


@dataclass(frozen=True)
class AlignConfig:
    """Direct alignment of pixels, before anything is rendered."""

    iterations: int = 6
    """Levenberg-Marquardt iterations a start; with 0, `reach` 0 and `turns` () alignment is left out."""
    color_scale: float = 0.1
    """A difference of log colours that is large; they span about 0 to 1."""
    depth_scale: float = 0.01
    """A depth difference that is large, metres."""
    centers: int = 256
    """Gaussians of a group whose centres are aligned."""
    center_weight: float = 1.0
    """Weight of a centre beside a pixel. Centres prevent drift; pixels look more like the new frame."""
    pixels: int = 192
    """Pixels of the last frame that stand for a group in each camera, and as many of its keyframe."""
    keyframe_turn: float = 0.4
    """The keyframe counts less as a group turns, and beyond this turn the last frame replaces it, radians."""
    max_thickness: float = 0.06
    """Measured depth further than this from the model's is not of the same object, metres."""
    shading: float = 0.3
    """Weight of brightness beside chroma, 0 to 1. What turns is lit differently."""
    widen: float = 2.0
    """Factor on both scales while the start may be far off."""
    reach: float = 0.045
    """How far a group is looked for by shifting it as it is, metres ..."""
    spacing: float = 0.015
    """... in steps of this length, metres."""
    everywhere: int | None = None
    """Groups that are looked for everywhere around in a frame, those first that agree worst; None: all."""
    turns: tuple[float, ...] = (0.2, 0.6)
    """Turns by which the best start is varied, to either side about each principal axis, radians."""
    max_step: float = 0.1
    """Longest step of one iteration, metres."""
    max_turn: float = 0.1
    """Longest turn of one iteration, radians; 0, with refine.rotation_rate 0, is the paper's translation."""

    def __post_init__(self):
        scales = ("color_scale", "depth_scale", "max_thickness", "widen", "spacing", "max_step")
        shares = ("iterations", "center_weight", "reach", "keyframe_turn", "shading", "max_turn")
        expect(self, "track.align.", **dict.fromkeys(scales, ABOVE_ZERO))
        expect(self, "track.align.", **dict.fromkeys(shares, (0, np.inf)))
        expect(self, "track.align.", centers=(1, np.inf), pixels=(1, np.inf))
        if self.everywhere is not None:
            expect(self, "track.align.", everywhere=(0, np.inf))
        if not all(0 < turn <= math.pi for turn in self.turns):
            raise ValueError(f"track.align.turns: expected more than 0, pi at most, found {self.turns}")


@dataclass(frozen=True)
class RefineConfig:
    """Photometric refinement of the group displacements D_k and the individual ones delta_i."""

    iterations: int = 10
    """Adam iterations a frame; 0 leaves refinement out."""
    translation_rate: float = 7e-4
    """Learning rate of D_k's translation, metres."""
    rotation_rate: float = 1e-2
    """Learning rate of D_k's rotation, radians."""
    delta_rate: float = 0.0
    """Learning rate of delta_i, metres; 0 keeps groups rigid."""
    delta_weight: float = 20.0
    """Weight of the mean |delta_i|^2 of a group, in units of delta_scale^2."""
    delta_scale: float = 0.004
    """A displacement of its own that is large for a Gaussian, metres."""
    background_rate: float = 0.0
    """Learning rate of displacements of the background's Gaussians, metres; 0 freezes them (the paper)."""
    depth_weight: float = 2.0
    """Weight of the depth difference in metres beside the colour difference (0 to 1)."""
    depth_limit: float = 0.05
    """Depth differences beyond this are of something else, metres."""
    color_limit: float = 0.3
    """Colour differences beyond this are of something else, 0 to 1."""

    def __post_init__(self):
        limits = ("delta_scale", "depth_limit", "color_limit")
        rates = ("translation_rate", "rotation_rate", "delta_rate", "background_rate")
        expect(self, "track.refine.", **dict.fromkeys(limits, ABOVE_ZERO))
        expect(self, "track.refine.", **dict.fromkeys(rates, (0, np.inf)), delta_weight=(0, np.inf))
        expect(self, "track.refine.", iterations=(0, np.inf), depth_weight=(0, np.inf))


@dataclass(frozen=True)
class GrowConfig:
    """Surfaces that come into view join the object that they continue."""

    slots: int = 4096
    """Gaussians that may join over the whole recording; 0 leaves growing out."""
    candidates: int = 256
    """Pixels that are examined in a frame."""
    reach: int = 6
    """How far from an object's outline they may be, pixels."""
    min_gap: float = 0.008
    """Depth measured this much nearer than the model is not explained by it, metres."""
    distance: float = 0.012
    """How near a pixel must be to a Gaussian to continue its object, metres ..."""
    color: float = 0.15
    """... and in colour, 0 to 1. Both count together, and the background's Gaussians compete."""

    def __post_init__(self):
        expect(self, "track.grow.", **dict.fromkeys(("min_gap", "distance", "color"), ABOVE_ZERO))
        expect(self, "track.grow.", slots=(0, np.inf), candidates=(1, np.inf), reach=(0, np.inf))


@dataclass(frozen=True)
class TrackConfig:
    """The object-aware tracker (Object-Aware Gaussian Splatting for Robotic Manipulation), stage by stage."""

    start: StartConfig = field(default_factory=StartConfig)
    match: MatchConfig = field(default_factory=MatchConfig)
    align: AlignConfig = field(default_factory=AlignConfig)
    refine: RefineConfig = field(default_factory=lambda: RefineConfig(iterations=0))
    grow: GrowConfig = field(default_factory=GrowConfig)
    matching: bool = False
    """Look for each object by template matching first. Without, it is found from where it was."""
    warm_start: bool = True
    """Begin with the last frame's motion: delta_i as it was, and D_k as one of the places to look first."""
    cameras: tuple[int, ...] = ()
    """Cameras of the frame to track with, counted from 0; default: all."""
    shrink: int = 1
    """Pictures are averaged over blocks of this many pixels each way before anything else."""
    redraw: Literal["all", "moving"] = "moving"
    """What an update draws: the whole scene, or what moves over a background that is drawn once and kept."""
    coarseness: int = 1
    """With "moving": pictures shrink by this factor each way, and every coarseness^2-th Gaussian is drawn."""
    headroom: float = 1.5
    """Room in the rasterizer's plan for what the motion will add."""
    seed: int = 0
    """Seed of the random places where what is lost is looked for."""

    def __post_init__(self):
        expect(self, "track.", headroom=(1, np.inf), coarseness=(1, np.inf), shrink=(1, np.inf))
        if self.coarseness > 1 and (self.redraw == "all" or self.matching):
            raise ValueError(
                f"track.coarseness: expected 1 unless redraw is moving and matching off, found "
                f"{self.coarseness}"
            )
        if self.redraw not in ("all", "moving"):
            raise ValueError(f"track.redraw: expected all or moving, found {self.redraw!r}")
        if self.redraw == "moving" and self.refine.iterations:
            raise ValueError(
                "track.redraw: expected all where refine.iterations is above 0, found moving; set "
                "refine.iterations to 0, or draw all"
            )


PAPER = TrackConfig(refine=RefineConfig(), matching=True, redraw="all")
BALANCED = TrackConfig(
    start=StartConfig(object_pixels=2.5, background_pixels=6.0),
    align=AlignConfig(pixels=128, centers=128),
    grow=GrowConfig(candidates=64),
)
FAST = replace(
    BALANCED,
    align=AlignConfig(iterations=4, pixels=96, centers=64, everywhere=2),
    grow=GrowConfig(candidates=16),
    coarseness=2,
)
PRESETS = {"accurate": TrackConfig(), "balanced": BALANCED, "fast": FAST, "paper": PAPER}
"""`accurate`, `balanced` and `fast` align pixels, with ever fewer of them; `fast` is for 30 Hz on one core,
and searches everywhere for two objects in an update. `paper` has all of the paper's stages, template matching
and photometric refinement too, which cost much and gain little: see docs/results-tracking.md."""
