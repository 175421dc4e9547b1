"""`gsjax fit`: fit a static scene to posed photographs."""

from gsjax.engine.fit.run import Options, run
from gsjax.engine.options import preset_options
from gsjax.methods.fit import PRESETS

HELP = " The frames of a recording are used as photographs of one scene."

__all__ = ["HELP", "Options", "options_for", "run"]


def options_for(arguments: list[str]) -> tuple[type[Options], list[str]]:
    """The options, with the defaults of the preset that is named."""
    return preset_options(Options, arguments, "fit", PRESETS)
