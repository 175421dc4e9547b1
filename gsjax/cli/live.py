"""`gsjax live`: track objects while frames arrive, at the rate at which they arrive."""

from gsjax.engine.track.live import Options, run

__all__ = ["Options", "run"]
