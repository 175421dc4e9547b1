"""The canonical scene, from which a discovery of parts begins."""

from gsjax.data.photographs import Photographs
from gsjax.methods.fit import FitConfig, StartConfig, light_of, needed
from gsjax.scene.gaussians import Gaussians, take

FIT = FitConfig(steps=3_000, cap=15_000, sh_degree=0, depth_weight=0.5, start=StartConfig(count=10_000))
"""The default settings of its fit."""


def without_needless(photographs: Photographs, gaussians: Gaussians, config: FitConfig) -> Gaussians:
    """The Gaussians that some photograph needs, as `gsjax fit` leaves them.

    Args:
        photographs: that were fitted.
        gaussians: the scene.
        config: of the fit; its `prune` is the share of light below which one is not needed.
    """
    frames = [photographs.frame(i) for i in range(photographs.num)]
    mode = "antialiased" if config.antialiased else "classic"
    return take(gaussians, needed(light_of(gaussians, frames, mode), config.prune))
