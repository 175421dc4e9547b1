"""`gsjax live`: follow objects while frames arrive, at the rate at which they do."""

from gsjax.engine.track.live import Options, run

__all__ = ["Options", "run"]
