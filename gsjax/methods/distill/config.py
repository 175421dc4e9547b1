"""Configuration of a feature field; the defaults are those of FD-3DGS, section 4, where it states them."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from gsjax.methods.settings import expect
from gsjax.scene.feature_grid import FeatureGridConfig

POOLS = (1, 2, 4, 8)


@dataclass(frozen=True)
class DistillRatesConfig:
    """Learning rates of Adam, which decay to a tenth over the iterations. The paper states none: at 0.4 times
    these, small objects are learned later; at three times these, training diverges."""

    table: float = 2.5e-2
    """Learning rate of the entries of the hash grid, or of the vectors per Gaussian."""
    layers: float = 5e-3
    """Learning rate of the network behind the grid."""
    lift: float = 5e-3
    """Learning rate of the 1x1 convolution to the teacher's channels."""

    def __post_init__(self):
        expect(self, "rates.", **dict.fromkeys(vars(self), (0, np.inf)))


@dataclass(frozen=True)
class DistillWeightsConfig:
    """Weights of the losses (FD-3DGS, eq. 8)."""

    rec: float = 1000.0
    """Weight of the squared error, a mean over the teacher's channels."""
    cos: float = 1.0
    """Weight of 1 - cosine."""
    contrast: float = 1.0
    """Weight of the contrastive loss: pixels of one object attract, pixels of different objects repel."""
    tv: float = 1.0
    """Weight of the total variation of the rendered features."""
    map: float = 1.0
    """Weight of a pixel of a map relative to a pixel of a mask, for a teacher with both."""

    def __post_init__(self):
        expect(self, "weights.", **dict.fromkeys(vars(self), (0, np.inf)))


@dataclass(frozen=True)
class SolveConfig:
    """Configuration of the solution for a vector per Gaussian by linear least squares."""

    iterations: int = 4
    """Iterations of conjugate gradients, each a pass over all views, after the vote."""
    smoothness: float = 0.1
    """Weight of the squared difference of neighbours in space, relative to the mean number of pixels that
    show a Gaussian."""
    neighbors: int = 8
    """Number of neighbours of each Gaussian."""
    energy: float = 0.9999
    """Share of the squared length of the teacher's features that the solution's channels retain. There are at
    most `channels`."""

    def __post_init__(self):
        expect(self, "solve.", iterations=(1, np.inf), smoothness=(0, np.inf), neighbors=(1, 64))
        expect(self, "solve.", energy=(1e-6, 1))


@dataclass(frozen=True)
class DistillConfig:
    """Configuration of a distillation."""

    start: Literal["random", "vote", "solve"] = "random"
    """What training begins with: random values; a vote, in which each Gaussian has the mean feature of the
    pixels that show it; or the least-squares solution, the vectors whose renderings fit the teacher's
    features best."""
    solve: SolveConfig = field(default_factory=SolveConfig)
    """Settings of the vote or the solution."""
    iterations: int = 1500
    """Number of training steps, of one view each; 0: the vectors of the start are the field."""
    channels: int = 256
    """Channels of a Gaussian's feature; the convolution maps them to the teacher's channels."""
    encoding: Literal["grid", "table"] = "grid"
    """A hash grid over the scene, or a separate vector for each Gaussian (table)."""
    grid: FeatureGridConfig = field(default_factory=FeatureGridConfig)
    """Sizes of the hash grid and its network."""
    rates: DistillRatesConfig = field(default_factory=DistillRatesConfig)
    """Learning rates."""
    weights: DistillWeightsConfig = field(default_factory=DistillWeightsConfig)
    """Weights of the losses."""
    contrast_after: float = 800 / 1500
    """Fraction of the steps after which the contrastive loss is added; earlier it would scatter features."""
    contrast_gamma: float = 1.0
    """Gamma of the contrastive kernel exp(-gamma |A - B|^2)."""
    contrast_pool: int = 4
    """Edge of the max-pooling windows of the contrastive loss, pixels: 1, 2, 4 or 8."""
    contrast_patch: int = 32
    """Edge of the patch of a step, in windows, at most 64: all pairs of windows are compared."""
    strip_megabytes: float = 256.0
    """Memory of a strip of features. Larger images are rendered strip by strip, with the same result, and
    again in the backward pass."""
    seed: int = 0
    """Seed of the initial values, the order of views, and the patches."""

    def __post_init__(self):
        expect(
            self,
            iterations=(0, np.inf),
            channels=(1, 4096),
            contrast_after=(0, 1),
            contrast_gamma=(1e-6, np.inf),
            contrast_patch=(2, 64),
            strip_megabytes=(0.1, np.inf),
        )
        if self.start == "random" and not self.iterations:
            raise ValueError(
                "iterations: expected at least 1 where the start is random, found 0, by which nothing is "
                "learned; start with vote or solve"
            )
        if self.contrast_pool not in POOLS:
            raise ValueError(f"contrast_pool: expected one of {POOLS}, found {self.contrast_pool}")


PRESETS = {
    "vote": DistillConfig(start="vote", iterations=0),
    "solve": DistillConfig(start="solve", iterations=0),
    "field": DistillConfig(start="solve", iterations=60),
    "paper": DistillConfig(),
}
"""Settings by name, the fastest first: the mean of the pixels that show each Gaussian; the least-squares
solution; a hash grid that is trained from that solution; and the training of FD-3DGS."""
