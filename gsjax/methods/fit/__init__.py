"""Reconstruction of a static scene from posed photographs: 3D Gaussian splatting (Kerbl et al. 2023) with a
fixed number of slots (3DGS-MCMC, Kheradmand et al. 2024).

    method = Fit(config)
    problem, run = method.start(frames, cloud)
    for now in drive(method, problem, run): ...

    config.py  settings                  start.py    the initial Gaussians
    model.py   the parameters of a fit   update.py   the loss, one step, and densification
    method.py  the method, for the loop  pruning.py  removal of unneeded Gaussians
    padding.py  padding of photographs of many sizes to a few
"""

from gsjax.geometry.extent import Extent, extent_of
from gsjax.methods.fit.config import (
    PRESETS,
    FitConfig,
    GrowthConfig,
    RatesConfig,
    SplitConfig,
    StartConfig,
)
from gsjax.methods.fit.method import Fit, Problem, refined_frames
from gsjax.methods.fit.model import Model
from gsjax.methods.fit.pruning import light_of, needed, prune
from gsjax.methods.fit.update import Batch, fit_loss, grow
from gsjax.methods.fit.update import fit_step as step

__all__ = [
    "PRESETS",
    "Batch",
    "Extent",
    "Fit",
    "FitConfig",
    "GrowthConfig",
    "Model",
    "Problem",
    "RatesConfig",
    "SplitConfig",
    "StartConfig",
    "extent_of",
    "fit_loss",
    "grow",
    "light_of",
    "needed",
    "prune",
    "refined_frames",
    "step",
]
