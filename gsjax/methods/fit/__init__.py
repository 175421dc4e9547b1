"""A static scene from posed photographs: 3D Gaussian splatting (Kerbl et al. 2023) with a fixed number of
slots (3DGS-MCMC, Kheradmand et al. 2024).

    problem, state = begin(views, config, cloud)
    for fitted in fit(problem, state): ...

    config.py  what can be set            start.py  the first Gaussians
    model.py   what a fit may change      step.py   the loss, and one step
    fit.py     the loop on the host       pruning.py  what no photograph needs
"""

from gsjax.methods.fit.config import (
    PRESETS,
    FitConfig,
    GrowthConfig,
    RatesConfig,
    SplitConfig,
    StartConfig,
)
from gsjax.methods.fit.method import FitState, Fitted, Problem, as_found, begin, fit
from gsjax.methods.fit.model import Model
from gsjax.methods.fit.pruning import light_of, needed
from gsjax.methods.fit.start import Extent, View, extent_of
from gsjax.methods.fit.update import Batch, Observation, fit_loss, fit_step, grow

__all__ = [
    "PRESETS",
    "Batch",
    "Extent",
    "FitConfig",
    "FitState",
    "Fitted",
    "GrowthConfig",
    "Model",
    "Observation",
    "Problem",
    "RatesConfig",
    "SplitConfig",
    "StartConfig",
    "View",
    "as_found",
    "begin",
    "extent_of",
    "fit",
    "fit_loss",
    "fit_step",
    "grow",
    "light_of",
    "needed",
]
