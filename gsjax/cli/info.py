"""`gsjax info`: what a recording or a set of photographs holds."""

from gsjax.engine.info import Options, run

__all__ = ["Options", "run"]
