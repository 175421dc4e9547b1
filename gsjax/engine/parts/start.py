"""The fit of the canonical scene, in which parts are discovered."""

from gsjax.methods.fit import FitConfig, StartConfig

FIT = FitConfig(steps=3_000, cap=15_000, sh_degree=0, depth_weight=0.5, start=StartConfig(count=10_000))
"""Its default settings."""
