"""`gsjax distill`: a semantic field for a static scene, which `gsjax query` queries."""

from gsjax.engine.distill.run import Options, run
from gsjax.engine.teaching.cache import cache_folder

HELP = (
    " As in `gsjax distill RUN`, or, for the scene of another program, `gsjax distill scene.ply --images "
    "PHOTOGRAPHS --features FILES --out FIELD`. Outputs of encoders and segmenters are kept in "
    f"{cache_folder()}; delete that folder to have them computed again, or for its space."
)

__all__ = ["HELP", "Options", "run"]
