"""Packages of an extra, imported where they are needed; who lacks one is told how to install it."""

import shlex
import sys
from importlib import import_module
from types import ModuleType


class MissingExtra(ImportError):
    """A package of an extra is not installed. The message says who needs it and what to do."""


def load(module: str, extra: str, needed_by: str) -> ModuleType:
    """A module of a package that one extra of gsjax brings, imported now.

    Args:
        module: its dotted name.
        extra: the extra's name in pyproject.toml.
        needed_by: what needs it, as the user knows it: a command, an option, a model.

    Raises:
        MissingExtra: it is not installed, or something that it needs itself is not.
    """
    try:
        return import_module(module)
    except ImportError as error:
        missing = error.name or module.partition(".")[0]
        raise MissingExtra(
            f"{needed_by} needs {missing}, which is not installed: "
            f"{shlex.quote(sys.executable)} -m pip install 'gsjax[{extra}]'",
            name=missing,
        ) from error
