"""`gsjax distill`: a semantic field for a static scene, which `gsjax query` queries."""

from gsjax.engine.distill.run import Options, run
from gsjax.engine.options import preset_options
from gsjax.engine.teaching.cache import cache_folder
from gsjax.methods.distill import PRESETS

_KEPT = cache_folder()
HELP = (
    " As in `gsjax distill RUN`, or, for the scene of another program, `gsjax distill scene.ply --images "
    "PHOTOGRAPHS --features FILES --out FIELD`. Outputs of encoders and segmenters are "
    + ("not kept, as this user has no home." if _KEPT is None else f"kept in {_KEPT}; ")
    + ("" if _KEPT is None else "delete that folder to have them computed again, or for its space.")
)

__all__ = ["HELP", "Options", "options_for", "run"]


def options_for(arguments: list[str]) -> tuple[type[Options], list[str]]:
    """The options, with the defaults of the preset that is named."""
    return preset_options(Options, arguments, "distill", PRESETS)
