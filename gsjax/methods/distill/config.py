"""What can be set of a feature field; the defaults are the paper's (section 4) where it says."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from gsjax.methods.settings import expect
from gsjax.scene.feature_grid import FeatureGridConfig

POOLS = (1, 2, 4, 8)


@dataclass(frozen=True)
class DistillRatesConfig:
    """Rates of Adam, which fall to a tenth over the iterations. The paper names none: at 0.4 times these
    small things are learned later, at three times these it diverges."""

    table: float = 2.5e-2
    """Of the entries of the hash grid, or of the Gaussians' own vectors."""
    layers: float = 5e-3
    """Of the network behind the grid."""
    lift: float = 5e-3
    """Of the 1x1 convolution to the teacher's channels."""

    def __post_init__(self):
        expect(self, "rates.", table=(0, np.inf), layers=(0, np.inf), lift=(0, np.inf))


@dataclass(frozen=True)
class DistillWeightsConfig:
    """What each loss counts in the sum (eq. 8)."""

    rec: float = 1000.0
    """Of the squared difference, a mean over the teacher's channels."""
    cos: float = 1.0
    """Of the angle."""
    contrast: float = 1.0
    """Of what pulls pixels of one thing together and those of others apart."""
    tv: float = 1.0
    """Of differences between neighbouring pixels."""
    map: float = 1.0
    """Of a pixel of a map beside one of a mask, where there are both."""

    def __post_init__(self):
        expect(self, "weights.", **dict.fromkeys(("rec", "cos", "contrast", "tv", "map"), (0, np.inf)))


@dataclass(frozen=True)
class DistillConfig:
    """How a feature field is distilled."""

    iterations: int = 1500
    """Steps, of one view each."""
    channels: int = 256
    """Numbers of a Gaussian's feature, which are rendered; the convolution makes the teacher's of them."""
    encoding: Literal["grid", "table"] = "grid"
    """A hash grid over the scene, or a vector of its own for each Gaussian."""
    grid: FeatureGridConfig = field(default_factory=FeatureGridConfig)
    """Sizes of the hash grid and its network."""
    rates: DistillRatesConfig = field(default_factory=DistillRatesConfig)
    weights: DistillWeightsConfig = field(default_factory=DistillWeightsConfig)
    contrast_after: float = 800 / 1500
    """Share of the iterations after which the contrast counts; before, features would be scattered."""
    contrast_gamma: float = 1.0
    """Of its kernel exp(-gamma |A - B|^2)."""
    contrast_pool: int = 4
    """Edge of the windows whose largest values it compares, pixels: 1, 2, 4 or 8."""
    contrast_patch: int = 32
    """Edge of the patch of such windows that a step looks at, 64 at most: each is held against each."""
    strip_megabytes: float = 256.0
    """Memory of a strip of features; larger images are drawn strip by strip, to the same result, and once
    more on the way back."""
    seed: int = 0
    """Of first values, of the order of views, and of patches."""

    def __post_init__(self):
        expect(
            self,
            iterations=(1, np.inf),
            channels=(1, 4096),
            contrast_after=(0, 1),
            contrast_gamma=(1e-6, np.inf),
            contrast_patch=(2, 64),
            strip_megabytes=(0.1, np.inf),
        )
        if self.contrast_pool not in POOLS:
            raise ValueError(f"contrast_pool: expected one of {POOLS}, found {self.contrast_pool}")
