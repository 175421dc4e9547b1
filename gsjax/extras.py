"""Imports of packages from optional extras, with installation instructions if one is missing."""

import shlex
import sys
from importlib import import_module
from types import ModuleType


class MissingExtra(ImportError):
    """A package of an extra is not installed. The message says what needs it and how to install it."""


def load(module: str, extra: str, needed_by: str) -> ModuleType:
    """Import a module from a package that belongs to an extra of gsjax.

    Args:
        module: dotted name of the module.
        extra: name of the extra in pyproject.toml.
        needed_by: what needs the module, in the user's terms: a command, an option, a model.

    Raises:
        MissingExtra: the package or one of its own dependencies is not installed.
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
