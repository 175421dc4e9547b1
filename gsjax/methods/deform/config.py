"""Settings of a deforming scene, and the two papers' recipes."""

from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

import numpy as np

from gsjax.methods.deform.graph import GraphConfig
from gsjax.methods.settings import expect
from gsjax.scene.deformation import DeformationConfig


@dataclass(frozen=True)
class DeformRatesConfig:
    """Learning rates of Adam: the most by which a step changes a number."""

    means: float = 1.6e-4
    """Learning rate of the centres, in radii of the scene."""
    quats: float = 1e-3
    """Learning rate of the orientations."""
    log_scales: float = 5e-3
    """Learning rate of the logarithms of sizes."""
    logit_opacities: float = 2.5e-2
    """Learning rate of the logits of opacities."""
    sh0: float = 2.5e-3
    """Learning rate of the colours."""
    features: float = 2.5e-3
    """Learning rate of the semantic features."""
    planes: float = 1e-2
    """Learning rate of the values at vertices of the field's planes or voxels."""
    layers: float = 1e-3
    """Learning rate of the field's network."""
    twists: float = 1e-3
    """Learning rate of the poses, where they are refined: rotations in radians, shifts in radii."""

    def __post_init__(self):
        expect(self, "rates.", **dict.fromkeys(vars(self), (0, np.inf)))


@dataclass(frozen=True)
class DeformWeightsConfig:
    """Weights of the losses."""

    dssim: float = 0.2
    """lambda of (1 - lambda) L1 + lambda D-SSIM (SurstSplat, eq. 13)."""
    depth: float = 1.0
    """Weight of the difference in depth, in radii of the scene; 0: depth serves the start alone."""
    feature: float = 1.0
    """Weight of the difference in features, where there is a teacher (GaussianClin, eq. 10)."""
    plane_tv: float = 2e-4
    """Weight of differences between neighbours on the field's planes of space (4DGS)."""
    time_smoothness: float = 1e-3
    """Weight of second differences over time on the field's planes of time (4DGS)."""
    time_sparsity: float = 1e-4
    """Weight of the distance of the planes of time from 1, where nothing moves (4DGS)."""

    def __post_init__(self):
        expect(self, "weights.", **dict.fromkeys(vars(self), (0, np.inf)))


@dataclass(frozen=True)
class DeformConfig:
    """How a deforming scene is reconstructed."""

    warmup: int = 1000
    """Steps in which the canonical scene learns alone (GaussianClin, section A)."""
    iterations: int = 3000
    """Steps after these, in which scene and deformation learn together."""
    start_pixels: float = 1.3
    """Edge of the cubes that are thinned to one of the first Gaussians, in pixels."""
    plane_depth: float = 1.0
    """Distance from the first camera to the plane on which the scene begins without depth, in the unit of the
    poses; it makes no difference to a camera that stands still."""
    warmup_frames: Literal["first", "all"] = "first"
    """Frames that the canonical scene learns from: the one at which it begins, or all."""
    refine_poses: bool = False
    """Rotate and shift the cameras of all frames but the first from their given poses."""
    nodes: int = 2048
    """Places at which the field is evaluated, whose values Gaussians blend; 0: it is evaluated at every
    Gaussian, as in the papers."""
    moving_share: float = 1.0
    """Without nodes, the share of the Gaussians that go on deforming after a quarter of the steps with
    deformation: those that moved farthest by then. The others stand still and cost the field nothing."""
    optimizer: Literal["adam", "adamw"] = "adam"
    """Adam, or AdamW, which also shrinks all numbers by 1e-5 of a rate."""
    schedule: Literal["exponential", "cosine"] = "exponential"
    """How rates fall over the steps: to a tenth, or along a cosine to nothing."""
    deformation: DeformationConfig = field(default_factory=DeformationConfig)
    rates: DeformRatesConfig = field(default_factory=DeformRatesConfig)
    weights: DeformWeightsConfig = field(default_factory=DeformWeightsConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)
    channels: int = 16
    """Channels of a Gaussian's feature, where there is a teacher."""
    seed: int = 0
    """Seed of the first values and of the order of frames."""

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
"""The two papers' recipes: GaussianClin (section A: Adam, 1k canonical and 3k joint iterations), and
SurstSplat (section 3: AdamW, cosine, weight decay 1e-5)."""
