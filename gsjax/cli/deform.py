"""`gsjax deform`: reconstruct a deforming scene seen by one moving camera, and learn what is what in it."""

from dataclasses import field, fields, make_dataclass
from typing import Annotated

import tyro

from gsjax.engine.deform import run as engine
from gsjax.engine.deform.run import Options
from gsjax.engine.options import preset_options
from gsjax.engine.program import parse_options
from gsjax.methods.deform import PRESETS

HELP = (
    " As in `gsjax deform DATASET --out RUN`. Masks show where tools are, which are left out unless --tools "
    "draw. Depth is the data's, else matched between two eyes; without either the scene begins within its "
    "visual hull, if the camera goes around it, or on a plane. The data's split is kept. "
    "One camera is learned from (--cameras; by default the first), one judges (--eval-cameras; the next)."
)

__all__ = ["HELP", "Options", "options_for", "run"]


def options_for(arguments: list[str]) -> tuple[type[Options], list[str]]:
    """The options, with the defaults of the preset named in the arguments, and the arguments themselves: if
    none is named, the recording determines the preset, and they are parsed again."""
    kind, arguments = preset_options(Options, arguments, "deform", PRESETS)
    words = field(default=tuple(arguments), kw_only=True)
    hidden = ("words", Annotated[tuple[str, ...], tyro.conf.Suppress], words)
    return make_dataclass("Options", [hidden], bases=(kind,), frozen=True), arguments


def run(options: Options) -> int:
    """Run the command; returns the exit code."""

    def by_preset(name: str) -> Options:
        words = [*getattr(options, "words", ()), "--preset", name]
        return _plain(parse_options("deform", words, (__name__, HELP)))

    return engine.run(_plain(options), by_preset)


def _plain(options: Options) -> Options:
    """The options without the arguments that they came from."""
    return Options(**{one.name: getattr(options, one.name) for one in fields(Options)})
