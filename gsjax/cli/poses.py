"""`gsjax poses`: the cameras of photographs that come without poses."""

from gsjax.engine.poses import Options, run

__all__ = ["Options", "run"]
