"""`gsjax info`: what a dataset, a run or a file of Gaussians holds."""

from gsjax.engine.info import Options, run

__all__ = ["Options", "run"]
