"""`gsjax parts`: from synchronised cameras to the parts of a moving scene."""

from gsjax.engine.parts.run import Options, run

__all__ = ["Options", "run"]
