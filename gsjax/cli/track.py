"""`gsjax track`: from a recording to a run folder."""

from gsjax.engine.track.run import Options, options_for, run

__all__ = ["Options", "options_for", "run"]
