"""`gsjax parts`: find the parts of a moving scene in a recording by synchronised cameras."""

from gsjax.engine.parts.run import Options, run

__all__ = ["Options", "run"]
