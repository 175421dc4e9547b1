"""`gsjax deform`: a scene that deforms, seen by one moving camera, and what is what in it."""

from gsjax.engine.deform.run import Options, run
from gsjax.engine.options import preset_options
from gsjax.methods.deform import PRESETS

HELP = (
    " As in `gsjax deform DATASET --out RUN`. Masks show where tools are, which are left out unless --tools "
    "draw. Depth is the data's, else matched between two eyes; without either the scene begins within its "
    "visual hull, if the camera goes around it, or on a plane. The data's split is kept. "
    "One camera is learned from (--cameras; by default the first), one judges (--eval-cameras; the next)."
)

__all__ = ["HELP", "Options", "options_for", "run"]


def options_for(arguments: list[str]) -> tuple[type[Options], list[str]]:
    """The options, with the defaults of the preset named in the arguments."""
    return preset_options(Options, arguments, "deform", PRESETS)
