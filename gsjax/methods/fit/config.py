"""Settings of a fit. The fields' docstrings become the command line's help."""

from dataclasses import dataclass, field, fields
from typing import Literal

import numpy as np

from gsjax.methods.settings import expect


@dataclass(frozen=True)
class StartConfig:
    """Settings of the initial Gaussians."""

    source: Literal["auto", "cloud", "depth", "matches", "random"] = "auto"
    """Source of the initial positions: the data's point cloud, its depth, points matched between photographs,
    or random points in front of the cameras. auto: the first of these that is available."""
    count: int = 20_000
    """Number of Gaussians, unless they are points of the data or matched points; from depth, up to one more
    per photograph."""
    opacity: float = 0.1
    """Initial opacity."""
    scale: float = 1.0
    """Initial scale, relative to the distance to the neighbours."""

    def __post_init__(self):
        expect(self, "start.", count=(1, np.inf), opacity=(1e-3, 0.999), scale=(1e-6, np.inf))


@dataclass(frozen=True)
class RatesConfig:
    """Learning rates of Adam, as in 3DGS."""

    means: float = 1.6e-4
    """Learning rate of the means, in scene radii; it falls to a hundredth by the end."""
    quats: float = 1e-3
    """Learning rate of the orientations."""
    log_scales: float = 5e-3
    """Learning rate of the logarithms of the scales."""
    logit_opacities: float = 5e-2
    """Learning rate of the logits of the opacities."""
    sh0: float = 2.5e-3
    """Learning rate of the view-independent part of the colours."""
    shN: float = 1.25e-4
    """Learning rate of the higher spherical harmonics."""
    exposures: float = 1e-3
    """Learning rate of each photograph's colour transform, if exposure is learned."""
    twists: float = 2e-4
    """Learning rate of the cameras' rotations (in radians) and translations (in scene radii); it falls to a
    hundredth by the end."""

    def __post_init__(self):
        expect(self, "rates.", **{field.name: (0, np.inf) for field in fields(self)})


@dataclass(frozen=True)
class GrowthConfig:
    """Relocation and growth (3DGS-MCMC)."""

    every: int = 100
    """Number of steps between relocations."""
    begin: int = 300
    """First step at which Gaussians are relocated."""
    end: float = 0.85
    """Share of all steps after which nothing is relocated."""
    factor: float = 1.05
    """Growth of the number of Gaussians at each relocation, up to the cap."""
    noise: float = 5e5
    """Noise on the positions of nearly transparent Gaussians, relative to the learning rate of the means and
    the square of their sizes, all in scene radii."""
    opacity_cost: float = 0.01
    """Weight of the mean opacity in the loss, which frees Gaussians that are not needed."""
    scale_cost: float = 0.01
    """Weight in the loss of the mean scale, which is measured in scene radii."""

    def __post_init__(self):
        expect(self, "growth.", every=(1, np.inf), begin=(0, np.inf), end=(0, 1), factor=(1, np.inf))
        expect(self, "growth.", **dict.fromkeys(("noise", "opacity_cost", "scale_cost"), (0, np.inf)))


@dataclass(frozen=True)
class SplitConfig:
    """Cloning, splitting and pruning (adaptive density control of 3DGS)."""

    every: int = 100
    """Number of steps between rounds of densification."""
    begin: int = 500
    """First step at which Gaussians are cloned or split."""
    end: float = 0.5
    """Share of all steps after which nothing is cloned or split."""
    pull: float = 2e-4
    """Mean gradient of a projected mean, per half image, above which a Gaussian is cloned or split."""
    large: float = 0.01
    """Scale above which a Gaussian is split instead of cloned, in scene radii."""
    too_large: float = 0.1
    """Scale above which a Gaussian is pruned, in scene radii; only after the first reset of opacities,
    because the background starts with a few large Gaussians."""
    reset_every: int = 3_000
    """Number of steps between resets of all opacities to 0.01; Gaussians that are not needed stay there."""

    def __post_init__(self):
        expect(self, "split.", every=(1, np.inf), begin=(0, np.inf), end=(0, 1), reset_every=(1, np.inf))
        expect(self, "split.", large=(0, np.inf), too_large=(0, np.inf))


@dataclass(frozen=True)
class FitConfig:
    """Settings of a fit."""

    steps: int = 7_000
    """Number of steps, each with one photograph."""
    cap: int = 60_000
    """Largest number of Gaussians."""
    strategy: Literal["relocate", "split"] = "relocate"
    """How Gaussians are added: transparent ones are relocated to opaque ones (3DGS-MCMC), or those whose
    projections have large gradients are cloned and split (3DGS)."""
    sh_degree: int = 1
    """Highest degree of the spherical harmonics, 0 to 3, by which colour depends on the viewing direction."""
    sh_every: int = 1_500
    """Number of steps after which the next degree is unlocked."""
    dssim_weight: float = 0.2
    """Share of D-SSIM in the loss; the remainder is L1."""
    depth_weight: float = 0.0
    """Weight of the depth loss, in scene radii, for photographs with depth."""
    coarse_until: float = 0.5
    """Share of the fit that uses smaller photographs, which are faster: a third of it at a quarter of the
    resolution, the rest at half."""
    antialiased: bool = False
    """Render with the opacity compensation of Mip-Splatting, for views from other distances."""
    background: Literal["data", "black", "white", "random"] = "data"
    """Colour behind the scene; data: the colour that the photographs were composited on, else black."""
    prune: float = 0.002
    """At the end of a command, and of the fits of `gsjax.parts`, remove the least needed Gaussians, which
    together contribute at most this share of the light of any photograph. After `gsjax.fit` call
    `gsjax.methods.fit.prune`."""
    exposure: bool = False
    """Learn an affine colour transform for each photograph, for sets of varying exposure or white balance."""
    refine_poses: bool = False
    """Learn corrections of the cameras' poses."""
    seed: int = 0
    """Random seed."""
    start: StartConfig = field(default_factory=StartConfig)
    rates: RatesConfig = field(default_factory=RatesConfig)
    growth: GrowthConfig = field(default_factory=GrowthConfig)
    split: SplitConfig = field(default_factory=SplitConfig)

    def __post_init__(self):
        expect(self, steps=(1, np.inf), cap=(1, np.inf), sh_degree=(0, 3), sh_every=(1, np.inf))
        expect(self, dssim_weight=(0, 1), depth_weight=(0, np.inf), coarse_until=(0, 1), prune=(0, 1))


PRESETS = {
    "quick": FitConfig(
        steps=1_500, cap=20_000, sh_degree=0, coarse_until=0.75, start=StartConfig(count=10_000)
    ),
    "classic": FitConfig(strategy="split", cap=200_000),
    "depth": FitConfig(depth_weight=0.5, start=StartConfig(source="depth")),
    "published": FitConfig(
        steps=30_000,
        cap=1_000_000,
        sh_degree=3,
        sh_every=1_000,
        coarse_until=0.0,
        start=StartConfig(count=100_000, opacity=0.5, scale=0.1),
        growth=GrowthConfig(begin=500, end=25 / 30),
    ),
}
"""Settings by name: a first look; the cloning and splitting of 3DGS; RGB-D; and settings close to those of
3DGS-MCMC, which need a GPU or a night."""
