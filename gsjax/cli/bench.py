"""`gsjax bench`: run the benchmark suite of a checkout on this machine."""

from gsjax.engine.bench import Options, run

__all__ = ["Options", "run"]
