"""`gsjax parts`: find the parts of a moving scene recorded by synchronised cameras."""

from gsjax.engine.parts.run import Options, run

__all__ = ["Options", "run"]
