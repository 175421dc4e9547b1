"""`gsjax grasp`: the best antipodal grasp of the object named by a text, in every frame of a run."""

from gsjax.engine.track.grasp import Options, run

__all__ = ["Options", "run"]
