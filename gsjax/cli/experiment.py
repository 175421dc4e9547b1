"""`gsjax experiment`: sweeps that support a claim, resumed where they stopped, and collected into tables."""

from gsjax.engine.experiments.run import Options, run

__all__ = ["Options", "run"]
