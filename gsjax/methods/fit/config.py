"""How a scene is fitted to photographs. Comments become the command line's help."""

from dataclasses import dataclass, field, fields
from typing import Literal

import numpy as np

from gsjax.methods.settings import expect


@dataclass(frozen=True)
class StartConfig:
    """Where the first Gaussians are."""

    source: Literal["auto", "cloud", "depth", "matches", "random"] = "auto"
    """The data's points, its depth, what photographs are found to share, or random places before cameras;
    auto takes the first that there is."""
    count: int = 20_000
    """How many, where they are not the data's own points."""
    opacity: float = 0.1
    """Of all of them; more where depth says that something is there."""
    scale: float = 1.0
    """Of all of them, in distances to their neighbours."""

    def __post_init__(self):
        expect(self, "start.", count=(1, np.inf), opacity=(1e-3, 0.999), scale=(1e-6, np.inf))


@dataclass(frozen=True)
class RatesConfig:
    """Learning rates of Adam, as in 3DGS."""

    means: float = 1.6e-4
    """Of places, in radii of the scene; it falls to a hundredth by the end."""
    quats: float = 1e-3
    """Of orientations."""
    log_scales: float = 5e-3
    """Of logarithms of sizes."""
    logit_opacities: float = 5e-2
    """Of logits of opacities."""
    sh0: float = 2.5e-3
    """Of colours, as far as they are the same from all sides."""
    shN: float = 1.25e-4
    """Of the rest of colours."""
    exposures: float = 1e-3
    """Of each photograph's map of colours, where exposure is learned."""
    twists: float = 2e-4
    """Of the cameras' turns, radians, and shifts, radii of the scene; it falls to a hundredth by the end."""

    def __post_init__(self):
        expect(self, "rates.", **{field.name: (0, np.inf) for field in fields(self)})


@dataclass(frozen=True)
class GrowthConfig:
    """Relocation and growth (3DGS-MCMC)."""

    every: int = 100
    """Steps between relocations."""
    begin: int = 300
    """The first of them."""
    end: float = 0.85
    """Share of all steps after which nothing is relocated."""
    factor: float = 1.05
    """How many times as many Gaussians there may be after each, up to the cap."""
    noise: float = 5e5
    """Of the walk of what is almost transparent, in rates of the means."""
    opacity_cost: float = 0.01
    """Weight of the mean opacity in the loss, which frees what is not needed."""
    scale_cost: float = 0.01
    """Weight of the mean scale, in radii of the scene."""

    def __post_init__(self):
        expect(self, "growth.", every=(1, np.inf), begin=(0, np.inf), end=(0, 1), factor=(1, np.inf))
        expect(self, "growth.", **dict.fromkeys(("noise", "opacity_cost", "scale_cost"), (0, np.inf)))


@dataclass(frozen=True)
class SplitConfig:
    """Cloning, splitting and pruning (adaptive density control of 3DGS)."""

    every: int = 100
    """Steps between them."""
    begin: int = 500
    """The first of them."""
    end: float = 0.5
    """Share of all steps after which nothing is cloned or split."""
    pull: float = 2e-4
    """Mean gradient of a projected mean, by half a picture, above which there are too few Gaussians."""
    large: float = 0.01
    """Scale above which one is split and not cloned, in radii of the scene."""
    too_large: float = 0.1
    """Scale above which one is pruned, once opacities were lowered: the background begins few and large."""
    reset_every: int = 3_000
    """Steps after which all opacities are lowered to 0.01: what is not needed stays there."""

    def __post_init__(self):
        expect(self, "split.", every=(1, np.inf), begin=(0, np.inf), end=(0, 1), reset_every=(1, np.inf))
        expect(self, "split.", large=(0, np.inf), too_large=(0, np.inf))


@dataclass(frozen=True)
class FitConfig:
    """How a scene is fitted."""

    steps: int = 7_000
    """How many photographs are looked at, one a step."""
    cap: int = 60_000
    """How many Gaussians there may be."""
    strategy: Literal["relocate", "split"] = "relocate"
    """Where more Gaussians come from: those that became transparent move to where opacity is (3DGS-MCMC), or
    those whose projections are pulled hard are cloned and split (3DGS)."""
    sh_degree: int = 1
    """The highest degree of the spherical harmonics, 0 to 3: how colour depends on the direction."""
    sh_every: int = 1_500
    """Steps after which the next degree is unlocked."""
    dssim_weight: float = 0.2
    """Share of D-SSIM in the loss; the rest is L1."""
    depth_weight: float = 0.0
    """Weight of the difference in depth, in radii of the scene, where photographs have depth."""
    coarse_until: float = 0.5
    """Share of the fit that looks at smaller photographs, which take less time: of a quarter of the size, and
    from a third of it on of half the size."""
    antialiased: bool = False
    """Draw with Mip-Splatting's compensation, for views from other distances."""
    background: Literal["data", "black", "white", "random"] = "data"
    """Colour behind the scene; data: what the photographs were composited on, else black."""
    prune: float = 0.002
    """In the end, Gaussians that are needed least are left out, as many as together send at most this share
    of the light into any photograph."""
    exposure: bool = False
    """Learn an affine map of colours for each photograph, where exposure or white balance differ."""
    refine_poses: bool = False
    """Learn how far each camera stands from where the data says."""
    seed: int = 0
    """Of all that is random."""
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
"""Settings by name: for a first look, with 3DGS's cloning and splitting, for RGB-D, and about those of
3DGS-MCMC, which ask for a GPU or a night."""
