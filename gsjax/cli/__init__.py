"""`gsjax COMMAND ...`: what can be done from a command line.

Commands are imported when they are called, so that `gsjax --help` answers at once.
"""

import os
import sys
from collections.abc import Sequence
from importlib import import_module

from rich.console import Console
from rich.table import Table

COMMANDS = {
    "track": ("gsjax.cli.track.command", "follow the objects of a recording, and report on it"),
    "live": ("gsjax.cli.track.live", "follow objects while frames arrive, at a rate you name"),
    "fit": ("gsjax.cli.fit.command", "fit a static scene to posed photographs, and report on it"),
    "parts": (
        "gsjax.cli.parts.command",
        "find the parts of a moving scene from several cameras, and their joints",
    ),
    "deform": (
        "gsjax.cli.deform.command",
        "reconstruct what deforms, from an endoscope say, with its meaning",
    ),
    "edit": ("gsjax.cli.parts.edit", "change when, where and how parts of a run move, and film it"),
    "distill": ("gsjax.cli.distill.command", "give the Gaussians of a scene a meaning, to be asked by query"),
    "eval": ("gsjax.cli.fit.evaluate", "score a scene that was fitted, again or in more ways"),
    "compare": ("gsjax.cli.compare.command", "set runs side by side: scores, curves, pictures, settings"),
    "poses": ("gsjax.cli.poses", "find where photographs or a video were taken, for gsjax fit"),
    "info": ("gsjax.cli.info.command", "say what is understood of a recording"),
    "view": ("gsjax.cli.view.command", "look at a run or a PLY file in a browser"),
    "query": ("gsjax.cli.query.command", "find what a text means: objects of a run, or Gaussians by a field"),
    "ask": ("gsjax.cli.deform.ask", "answer a question on a scene that deforms, in plain English"),
    "grasp": ("gsjax.cli.track.grasp", "find the best grasp of the object that a text means, in every frame"),
    "experiment": ("gsjax.cli.experiment.command", "sweep what a claim rests on, and collect it into tables"),
    "bench": ("gsjax.cli.bench", "measure the rasterizer and every method's step on this machine"),
}
"""Each command's module, which has `Options`, a dataclass or a union of them (subcommands), `run(options)`,
which returns the exit code, perhaps `HELP`, more to say of it, and perhaps `options_for(arguments)`: the
options where defaults depend on what is given, and the arguments that are left to parse."""


def entry() -> None:
    """The program. After Ctrl-C it leaves without waiting for XLA, which may still be compiling in a thread
    and would crash while Python takes it down."""
    code = main()
    if code == 130:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command that `arguments` (those of the process unless given) ask for; returns the exit code.

    0: done. 1: a fault of gsjax. 2: the user's mistake, said in a sentence. 3: done, but what was looked for
    is not there (no feasible grasp). 130: Ctrl-C.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    command, rest = (arguments[0], arguments[1:]) if arguments else ("--help", [])
    if command in ("-h", "--help"):
        _print_help()
        return 0
    if command == "--version":
        print("gsjax", import_module("gsjax").__version__)
        return 0
    if command not in COMMANDS:
        known = ", ".join(COMMANDS)
        Console(stderr=True).print(f"[bold red]error:[/] no command {command!r}; there are: {known}")
        return 2
    from gsjax.cli.interrupts import heard_interrupts

    try:
        with heard_interrupts():
            from gsjax.cli.messages import run_politely

            return run_politely(command, rest, COMMANDS[command])
    except KeyboardInterrupt:
        Console(stderr=True).print("[bold red]stopped:[/] by Ctrl-C; what is on disk stays")
        return 130


def _print_help() -> None:
    console = Console(highlight=False)
    console.print("[bold]gsjax[/]: moving scenes from 3D Gaussians, in pure JAX\n")
    table = Table.grid(padding=(0, 3, 0, 2))
    for name, (_, does) in COMMANDS.items():
        table.add_row(f"[bold cyan]gsjax {name}[/]", does)
    console.print(table)
    console.print(
        "\nEach has its own options: [bold]gsjax track --help[/]. A first run, which needs no data:\n"
    )
    console.print("  gsjax track simulated:tabletop --out runs/demo --frames 0:30")
