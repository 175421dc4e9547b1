"""Settings of the object-aware tracker, with their units and trade-offs."""

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from gsjax.methods.settings import ABOVE_ZERO, expect


@dataclass(frozen=True)
class StartConfig:
    """How the first frame becomes Gaussians."""

    object_pixels: float = 2.5
    """Width of the voxels in which one point of an object is kept, in pixels of the camera that saw it."""
    background_pixels: float = 6.0
    """The same for the background, which is only rendered."""
    max_extent: float = 0.35
    """Longest extent of a rigid object, metres. Longer ones (a robot arm) are tracked in parts."""
    part_size: float = 0.15
    """Approximate size of those parts, metres."""
    label_distance: float = 0.15
    """Longest path along a surface by which labels spread to points unseen by the mask's camera, metres."""
    label_step: float = 0.02
    """Points further apart than this do not share a surface, metres."""
    depth_gap: float = 0.015
    """Tolerance between the depth of a point and the depth image that shows it, metres."""
    iterations: int = 150
    """Photometric optimisation steps on the first frame."""

    def __post_init__(self):
        sizes = ("object_pixels", "background_pixels", "max_extent", "part_size")
        lengths = ("label_distance", "label_step", "depth_gap")
        expect(self, "track.start.", **dict.fromkeys(sizes + lengths, ABOVE_ZERO), iterations=(0, np.inf))


@dataclass(frozen=True)
class MatchConfig:
    """Template matching."""

    patch: int = 64
    """Edge of the template, pixels of the (possibly reduced) image."""
    radius: int = 24
    """Range of the search to each side, pixels of the reduced image."""
    min_score: float = 0.3
    """Smallest correlation of a match."""
    margin: int = 2
    """Pixels by which the object's mask is dilated: its outline against the surroundings is texture too."""
    max_residual: float = 0.03
    """If cameras disagree on the position by more than this, the best one alone decides, metres."""

    def __post_init__(self):
        expect(self, "track.match.", max_residual=ABOVE_ZERO, patch=(8, np.inf), radius=(1, np.inf))
        expect(self, "track.match.", margin=(0, np.inf), min_score=(-1, np.inf))


@dataclass(frozen=True)
class AlignConfig:
    """Direct alignment of points with the images, without rendering."""

    iterations: int = 4
    """Levenberg-Marquardt iterations per start; 0, with `reach` 0 and `turns` (), disables alignment."""
    color_scale: float = 0.1
    """Scale of the difference of log colours, which span about 0 to 1."""
    depth_scale: float = 0.01
    """Scale of the depth difference, metres."""
    centers: int = 64
    """Gaussians of a group whose centres are aligned."""
    center_weight: float = 1.0
    """Weight of a centre relative to a pixel. Centres prevent drift; pixels are closer in appearance to the
    new frame."""
    pixels: int = 96
    """Pixels aligned per group and camera: this many from the last frame and as many from the group's
    keyframe."""
    keyframe_turn: float = 0.4
    """Rotation at which a group's keyframe is replaced, radians; until then its weight fades to 0."""
    max_thickness: float = 0.06
    """Measured depth that differs from the model's by more than this belongs to another object, metres."""
    shading: float = 0.3
    """Weight of brightness relative to chroma, 0 to 1; low, because shading changes as objects turn. With 0.6
    a printed can that spins is followed more closely, but not found again where it is darker."""
    widen: float = 2.0
    """Factor on both scales while the start may be far off."""
    reach: float = 0.045
    """Radius in which shifts of a group are tried, metres."""
    spacing: float = 0.015
    """Distance between those shifts, metres."""
    everywhere: int | None = 2
    """Groups per frame for which rotations are tried or, if they may be lost, other places (which counts as
    two), worst residuals first; None: all. Shifts are tried for three times as many."""
    turns: tuple[float, ...] = (0.2, 0.6)
    """Angles by which the best start is rotated, both ways about each principal axis, radians."""
    max_step: float = 0.1
    """Longest step of one iteration, metres."""
    max_turn: float = 0.1
    """Largest rotation of one iteration, radians; 0, with refine.rotation_rate 0, allows translations
    only."""

    def __post_init__(self):
        scales = ("color_scale", "depth_scale", "max_thickness", "widen", "spacing", "max_step")
        shares = ("iterations", "center_weight", "reach", "keyframe_turn", "shading", "max_turn")
        expect(self, "track.align.", **dict.fromkeys(scales, ABOVE_ZERO))
        expect(self, "track.align.", **dict.fromkeys(shares, (0, np.inf)))
        expect(self, "track.align.", centers=(1, np.inf), pixels=(1, np.inf))
        if self.everywhere is not None:
            expect(self, "track.align.", everywhere=(0, np.inf))
        if not all(0 < turn <= math.pi for turn in self.turns):
            raise ValueError(f"track.align.turns: expected more than 0 and at most pi, found {self.turns}")


@dataclass(frozen=True)
class RefineConfig:
    """Photometric refinement of the group displacements D_k and the individual ones delta_i."""

    iterations: int = 10
    """Adam iterations per frame; 0 disables refinement."""
    translation_rate: float = 7e-4
    """Learning rate of D_k's translation, metres."""
    rotation_rate: float = 1e-2
    """Learning rate of D_k's rotation, radians."""
    delta_rate: float = 0.0
    """Learning rate of delta_i, metres; 0 keeps groups rigid."""
    delta_weight: float = 20.0
    """Weight of the mean |delta_i|^2 of a group, in units of delta_scale^2."""
    delta_scale: float = 0.004
    """Scale of the individual displacement of a Gaussian, metres."""
    background_rate: float = 0.0
    """Learning rate of displacements of the background's Gaussians, metres; 0 freezes them (the paper)."""
    depth_weight: float = 2.0
    """Weight of the depth difference (metres) relative to the colour difference (0 to 1)."""
    depth_limit: float = 0.05
    """Limit to which depth differences are truncated, metres."""
    color_limit: float = 0.3
    """Limit to which colour differences are truncated, 0 to 1."""

    def __post_init__(self):
        limits = ("delta_scale", "depth_limit", "color_limit")
        rates = ("translation_rate", "rotation_rate", "delta_rate", "background_rate")
        expect(self, "track.refine.", **dict.fromkeys(limits, ABOVE_ZERO))
        expect(self, "track.refine.", **dict.fromkeys(rates, (0, np.inf)), delta_weight=(0, np.inf))
        expect(self, "track.refine.", iterations=(0, np.inf), depth_weight=(0, np.inf))


@dataclass(frozen=True)
class GrowConfig:
    """Growth: surfaces that come into view join the object that they continue."""

    slots: int = 4096
    """Gaussians that may join over the whole recording; 0 disables growth."""
    candidates: int = 16
    """Pixels that are examined per frame."""
    reach: int = 6
    """Largest distance of those pixels from an object's outline, pixels."""
    min_gap: float = 0.008
    """Measured depth nearer than the model's by more than this is not explained by the model, metres."""
    distance: float = 0.012
    """Largest distance from a pixel to a Gaussian whose object it continues, metres."""
    color: float = 0.15
    """Largest difference of their colours, 0 to 1. The squares of distance and difference, each relative to
    its limit, add up; the Gaussian with the least sum wins, and may be of the background."""

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
    """Also start the alignment from the result of template matching."""
    warm_start: bool = True
    """Also use the last frame's motion: keep its delta_i, and try its D_k as one of the starts."""
    cameras: tuple[int, ...] = ()
    """Indices of the cameras to track with; default: all."""
    shrink: int = 1
    """Factor by which images are first downscaled along each axis, by averaging."""
    redraw: Literal["all", "moving"] = "moving"
    """What an update draws: the whole scene, or the moving Gaussians over a background that is drawn once."""
    coarseness: int = 2
    """With "moving": images shrink by this factor along each axis, and every coarseness^2-th Gaussian is
    drawn."""
    headroom: float = 1.5
    """Capacity of the rasterizer's plans relative to what is needed at first, 1 or more."""
    seed: int = 0
    """Seed of the random guesses of where a lost object may be."""

    def __post_init__(self):
        expect(self, "track.", headroom=(1, np.inf), coarseness=(1, np.inf), shrink=(1, np.inf))
        if self.coarseness > 1 and (self.redraw == "all" or self.matching):
            raise ValueError(
                "track.coarseness: expected 1 if redraw is all or matching is on, found "
                f"{self.coarseness}; set it to 1"
            )
        if self.redraw not in ("all", "moving"):
            raise ValueError(f"track.redraw: expected all or moving, found {self.redraw!r}")
        if self.redraw == "moving" and self.refine.iterations:
            raise ValueError(
                "track.redraw: expected all if refine.iterations is above 0, found moving; set "
                "refine.iterations to 0, or redraw to all and coarseness to 1"
            )


BALANCED = TrackConfig(
    align=AlignConfig(iterations=6, pixels=128, centers=128, everywhere=None),
    grow=GrowConfig(candidates=64),
    coarseness=1,
)
ACCURATE = replace(
    BALANCED,
    start=StartConfig(object_pixels=1.5, background_pixels=4.0),
    align=replace(BALANCED.align, pixels=192, centers=256),
    grow=GrowConfig(candidates=256),
)
PAPER = replace(ACCURATE, refine=RefineConfig(), matching=True, redraw="all")
PRESETS = {"fast": TrackConfig(), "balanced": BALANCED, "accurate": ACCURATE, "paper": PAPER}
"""`fast`, the default, is for 30 Hz on one core, and searches for two objects per update;
`balanced` and `accurate` align ever more points. `paper` has all stages of the paper, including template
matching and photometric refinement, which cost much and gain little: see docs/results-tracking.md."""
