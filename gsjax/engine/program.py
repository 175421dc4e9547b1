"""Runs a command: parses its options, and turns a user's mistake into one sentence."""

from dataclasses import fields
from importlib import import_module
from pathlib import Path
from shutil import get_terminal_size
from textwrap import fill
from typing import Any

from gsjax.engine.machine import compute_on_host, keep_to_cores, missing_device
from gsjax.engine.messages import describe
from gsjax.engine.streams import say_error
from gsjax.extras import MissingExtra

# ValueError covers DataError and PlyError, and every check of an argument.
USER_ERRORS = (ValueError, OSError, MissingExtra)
_ON_HOST = ("info", "poses", "compare")  # an accelerator would not help them, and is not required
_FETCHED = ("http", "https", "ftp", "s3", "gs")
_COMPILE_ANEW = ("bench", "experiment")  # they measure compile time, and may set up JAX themselves


def run_command(command: str, arguments: list[str], entry: tuple[str, str]) -> int:
    """Parse the options of a command and run it. A user's mistake becomes a sentence and exit code 2.

    Args:
        command: its name.
        arguments: the arguments after the name.
        entry: its module, and what it does.
    """
    try:
        options = parse_options(command, arguments, entry)
        keep_to_cores(getattr(options, "cores", None))  # before JAX counts them
        compiler = import_module("gsjax.optim.compiler")
        compiler.keep_freed_memory()
        if command in _ON_HOST:
            compute_on_host()
        if command not in _COMPILE_ANEW:
            compiler.keep_programs()
            if missing := missing_device():  # before anything is read, or an earlier run replaced
                say_error(missing)
                return 2
        return import_module(entry[0]).run(options)
    except Exception as error:
        if "--debug" in arguments:
            raise
        mistake = describe(error) if isinstance(error, USER_ERRORS) else missing_device()
        if mistake is not None:
            say_error(mistake)
            return 2
        fault = f"a fault of gsjax itself: {type(error).__name__}: {describe(error)}"
        say_error(f"{fault}. Please report it with the output of --debug")
        return 1


def parse_options(command: str, arguments: list[str], entry: tuple[str, str]) -> Any:
    """The options of a command, without running it.

    Args:
        command, arguments, entry: as for `run_command`.

    Raises:
        ValueError: an option does not exist, or one that takes a list has no values.
        SystemExit: the arguments are invalid, or ask for help; the message is printed.
    """
    import tyro

    from gsjax.engine.usage import expect_known, plain_help, without_commas

    module, does = entry
    chosen = import_module(module)
    options_for = getattr(chosen, "options_for", lambda given: (chosen.Options, given))
    kind, arguments = options_for(arguments)
    expect_known(kind, command, arguments)
    arguments = without_commas(kind, arguments)
    indent = "  "  # without it tyro joins the lines into one
    about = f"{does[0].upper()}{does[1:]}." + getattr(chosen, "HELP", "")
    options = tyro.cli(
        kind,
        prog=f"gsjax {command}",
        description=fill(about, get_terminal_size().columns, initial_indent=indent, subsequent_indent=indent),
        args=arguments,
        config=(tyro.conf.FlagCreatePairsOff,),
        registry=plain_help(),
    )
    _expect_values(options, arguments)
    _expect_paths(options)
    return options


def _expect_paths(options: Any) -> None:
    """Raises a ValueError for a URL where a path is expected."""
    for field in fields(options):
        value = getattr(options, field.name)
        if isinstance(value, Path) or field.name in ("dataset", "path"):
            scheme, colon, rest = str(value).partition(":/")
            if colon and scheme.lower() in _FETCHED:
                address = f"{scheme}://{rest.lstrip('/')}"
                raise ValueError(f"{address}: expected a path, found an address; download it first")


def _expect_values(options: Any, arguments: list[str]) -> None:
    """Raises a ValueError for a list without values, where the default would mean all."""
    given = {argument.replace("_", "-") for argument in arguments}
    for field in fields(options):
        flag = "--" + field.name.replace("_", "-")
        if getattr(options, field.name) == field.default == () and flag in given:
            raise ValueError(f"{flag}: expected one value or more, found none")
