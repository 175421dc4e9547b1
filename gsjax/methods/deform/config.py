"""Configuration of a deforming scene, the two papers' recipes, and one for a camera around an object."""

from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

import numpy as np

from gsjax.methods.deform.graph import GraphConfig
from gsjax.methods.settings import expect
from gsjax.scene.deformation import DeformationConfig


@dataclass(frozen=True)
class DeformRatesConfig:
    """Learning rates of Adam."""

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
    """Learning rate of the vertices of the field's planes or voxels."""
    layers: float = 1e-3
    """Learning rate of the field's network."""
    twists: float = 1e-3
    """Learning rate of the poses, if they are refined: rotations in radians, translations in radii of the
    scene."""

    def __post_init__(self):
        expect(self, "rates.", **dict.fromkeys(vars(self), (0, np.inf)))


@dataclass(frozen=True)
class DeformWeightsConfig:
    """Weights of the losses."""

    dssim: float = 0.2
    """lambda of (1 - lambda) L1 + lambda D-SSIM (SurstSplat, eq. 13)."""
    depth: float = 1.0
    """Weight of the depth error, in radii of the scene; 0: depth is used for initialisation only."""
    feature: float = 1.0
    """Weight of the feature error, where there is a teacher (GaussianClin, eq. 10)."""
    plane_tv: float = 2e-4
    """Weight of the total variation of the field's spatial planes (4DGS)."""
    time_smoothness: float = 1e-3
    """Weight of second differences over time on the field's space-time planes (4DGS)."""
    time_sparsity: float = 1e-4
    """Weight of the distance of the space-time planes from 1, at which nothing moves (4DGS)."""
    rigidity: float = 1e-2
    """Weight of the deviation of neighbouring nodes from a rigid motion, so that what no camera sees moves
    with its surroundings (ARAP, as in SC-GS). Unused without nodes."""

    def __post_init__(self):
        expect(self, "weights.", **dict.fromkeys(vars(self), (0, np.inf)) | {"dssim": (0, 1)})


@dataclass(frozen=True)
class DeformConfig:
    """Configuration of the reconstruction of a deforming scene."""

    warmup: int = 1000
    """Steps in which only the canonical scene is optimised (GaussianClin, section A)."""
    iterations: int = 3000
    """Steps after the warm-up, in which scene and deformation are optimised jointly."""
    start_pixels: float = 1.3
    """Edge of the cubes in which the initial points are thinned to one Gaussian each, in pixels."""
    plane_depth: float = 1.0
    """Distance from the first camera to the plane on which a scene without depth is initialised, in the unit
    of the poses; it makes no difference if the camera is static."""
    hull_points: int = 20_000
    """Number of Gaussians of a scene that is initialised within its visual hull."""
    warmup_frames: Literal["first", "all"] = "first"
    """Frames of the warm-up: the one that the canonical scene is initialised from, or all. A scene that is
    initialised within its visual hull uses all."""
    refine_poses: bool = False
    """Optimize the poses of the cameras of all frames but the first."""
    nodes: int = 2048
    """Number of nodes at which the field is evaluated and whose values the Gaussians blend; 0: it is
    evaluated at every Gaussian, as in the papers."""
    moving_share: float = 1.0
    """Without nodes, the share of the Gaussians that still deform after a quarter of the joint steps: those
    that have moved farthest by then. The field is no longer evaluated at the others."""
    optimizer: Literal["adam", "adamw"] = "adam"
    """Adam, or AdamW with a weight decay of 1e-5."""
    schedule: Literal["exponential", "cosine"] = "exponential"
    """Decay of the learning rates over the steps: exponentially to a tenth, or along a cosine to zero."""
    deformation: DeformationConfig = field(default_factory=DeformationConfig)
    rates: DeformRatesConfig = field(default_factory=DeformRatesConfig)
    weights: DeformWeightsConfig = field(default_factory=DeformWeightsConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)
    channels: int = 16
    """Channels of a Gaussian's feature, where there is a teacher."""
    seed: int = 0
    """Seed of the initial values and of the order of frames."""

    def __post_init__(self):
        expect(
            self,
            warmup=(0, np.inf),
            iterations=(0, np.inf),
            start_pixels=(0.25, np.inf),
            plane_depth=(1e-6, np.inf),
            hull_points=(8, np.inf),
            channels=(1, 4096),
            nodes=(0, np.inf),
            moving_share=(1e-3, 1),
        )
        if self.nodes and self.moving_share < 1:
            raise ValueError(
                f"moving_share: expected 1 where the field is evaluated at nodes, found {self.moving_share}; "
                "set nodes to 0"
            )


PRESETS = MappingProxyType(
    {
        "clin": DeformConfig(
            deformation=DeformationConfig(rotation="add"), graph=GraphConfig(kind="similarity")
        ),
        "surst": DeformConfig(optimizer="adamw", schedule="cosine"),
        "around": DeformConfig(
            warmup=200,
            iterations=3800,
            optimizer="adamw",
            schedule="cosine",
            deformation=DeformationConfig(resolution=32, time_resolution=15),
            rates=DeformRatesConfig(
                means=1.6e-3, quats=3e-3, log_scales=1e-2, logit_opacities=5e-2, sh0=7.5e-3
            ),
        ),
    }
)
"""The two papers' recipes: GaussianClin (section A: Adam, 1k canonical and 3k joint iterations), and
SurstSplat (section 3: AdamW, cosine, weight decay 1e-5), both with the learning rates of
`DeformRatesConfig` instead of the papers' single ones. And this project's for a camera that goes around a
moving object: high learning rates, as random points in its hull have far to go; a short warm-up, as a long
one would blur what moves; and a field with few vertices, too coarse to fit the one view of each time
alone."""
