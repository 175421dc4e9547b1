"""The canonical scene, from which a discovery of parts begins."""

from gsjax.methods.fit import FitConfig, StartConfig

FIT = FitConfig(steps=3_000, cap=15_000, sh_degree=0, depth_weight=0.5, start=StartConfig(count=10_000))
"""The default settings of its fit."""
