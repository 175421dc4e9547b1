"""What can be set of a deforming scene, and the two papers' recipes."""

from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

import numpy as np

from gsjax.methods.deform.graph import GraphConfig
from gsjax.methods.settings import expect
from gsjax.scene.deformation import DeformationConfig


@dataclass(frozen=True)
class DeformRatesConfig:
    """Rates of Adam, by which one step changes a number at most."""

    means: float = 1.6e-4
    """Of centres, in radii of the scene."""
    quats: float = 1e-3
    """Of orientations."""
    log_scales: float = 5e-3
    """Of logarithms of sizes."""
    logit_opacities: float = 2.5e-2
    """Of logits of opacities."""
    sh0: float = 2.5e-3
    """Of colours."""
    features: float = 2.5e-3
    """Of semantic features."""
    planes: float = 1e-2
    """Of what stands at the vertices of the field's planes or voxels."""
    layers: float = 1e-3
    """Of the field's network."""
    twists: float = 1e-3
    """Of poses, where they are refined: turns in radians, shifts in radii of the scene."""

    def __post_init__(self):
        expect(self, "rates.", **dict.fromkeys(vars(self), (0, np.inf)))


@dataclass(frozen=True)
class DeformWeightsConfig:
    """What each loss counts in the sum."""

    dssim: float = 0.2
    """lambda of (1 - lambda) L1 + lambda D-SSIM (papers/003, eq. 13)."""
    depth: float = 1.0
    """Of the difference in depth, in radii of the scene; 0: depth is for the start alone."""
    feature: float = 1.0
    """Of the difference in features, where there is a teacher (papers/004, eq. 10)."""
    plane_tv: float = 2e-4
    """Of differences between neighbours on the field's planes of space (4DGS)."""
    time_smoothness: float = 1e-3
    """Of second differences over time on the field's planes of time (4DGS)."""
    time_sparsity: float = 1e-4
    """Of how far the planes of time are from 1, where nothing moves (4DGS)."""

    def __post_init__(self):
        expect(self, "weights.", **dict.fromkeys(vars(self), (0, np.inf)))


@dataclass(frozen=True)
class DeformConfig:
    """How a deforming scene is reconstructed."""

    warmup: int = 1000
    """Steps in which the canonical scene learns alone (papers/004, section A)."""
    iterations: int = 3000
    """Steps after these, in which scene and deformation learn together."""
    start_pixels: float = 1.3
    """Edge of the cubes that are thinned to one of the first Gaussians, in pixels."""
    plane_depth: float = 1.0
    """Without depth the scene begins on a plane, so far before the first camera, in the unit of the poses; of
    no matter for a camera that stands still."""
    warmup_frames: Literal["first", "all"] = "first"
    """What the canonical scene learns from: the frame at which it begins, or all."""
    refine_poses: bool = False
    """Let cameras be turned and shifted from where they are said to be, all but the first look's."""
    nodes: int = 2048
    """Places that the field is asked about, whose answers Gaussians blend; 0: it is asked about every
    Gaussian, as the papers have it."""
    moving_share: float = 1.0
    """Without nodes, the share of the Gaussians that go on deforming after a quarter of the steps with
    deformation: those that moved farthest until then. The others stand still and cost the field nothing."""
    optimizer: Literal["adam", "adamw"] = "adam"
    """Adam, or AdamW, which also shrinks all numbers by 1e-5 of a rate."""
    schedule: Literal["exponential", "cosine"] = "exponential"
    """How rates fall over the steps: to a tenth, or along a cosine to nothing."""
    deformation: DeformationConfig = field(default_factory=DeformationConfig)
    rates: DeformRatesConfig = field(default_factory=DeformRatesConfig)
    weights: DeformWeightsConfig = field(default_factory=DeformWeightsConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)
    channels: int = 16
    """Numbers of a Gaussian's feature, where there is a teacher."""
    seed: int = 0
    """Of first values and of the order of frames."""

    def __post_init__(self):
        expect(
            self,
            warmup=(0, np.inf),
            iterations=(0, np.inf),
            start_pixels=(0.25, np.inf),
            plane_depth=(1e-6, np.inf),
            channels=(1, 4096),
            nodes=(0, np.inf),
            moving_share=(1e-3, 1),
        )
        if self.nodes and self.moving_share < 1:
            raise ValueError(
                f"moving_share: expected 1 with nodes, of which there are few, found {self.moving_share}; "
                "set nodes to 0"
            )


PRESETS = MappingProxyType(
    {
        "clin": DeformConfig(
            deformation=DeformationConfig(rotation="add"), graph=GraphConfig(kind="similarity")
        ),
        "surst": DeformConfig(optimizer="adamw", schedule="cosine"),
    }
)
"""The two papers' recipes: GaussianClin (papers/004, section A: Adam, 1k canonical and 3k joint iterations),
and SurstSplat (papers/003, section 3: AdamW, cosine, weight decay 1e-5)."""
