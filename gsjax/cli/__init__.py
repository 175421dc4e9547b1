"""`gsjax COMMAND ...`: what can be done from a command line.

Commands are imported when they are called, so that `gsjax --help` answers at once.
"""

import os
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from importlib import import_module

from rich.console import Console

GROUPS = {
    "Look at data": {
        "info": ("gsjax.cli.info", "say what is understood of a recording or of photographs"),
        "poses": ("gsjax.cli.poses", "find where photographs or a video were taken, for fit"),
    },
    "Reconstruct": {
        "track": ("gsjax.cli.track", "follow the objects of a recording from RGB-D cameras"),
        "live": ("gsjax.cli.live", "follow objects while frames arrive, at a rate you name"),
        "fit": ("gsjax.cli.fit", "fit a static scene to posed photographs"),
        "parts": ("gsjax.cli.parts", "find the parts of a moving scene, and their joints"),
        "deform": ("gsjax.cli.deform", "reconstruct what deforms, from an endoscope say"),
    },
    "Give a meaning, and ask": {
        "distill": ("gsjax.cli.distill", "give the Gaussians of a run or a PLY file a meaning"),
        "query": ("gsjax.cli.query", "find what a text means: objects of a run, or Gaussians"),
        "ask": ("gsjax.cli.ask", "answer a question on a scene that deforms"),
        "grasp": ("gsjax.cli.grasp", "find the best grasp of what a text means, in every frame"),
    },
    "See and change": {
        "view": ("gsjax.cli.view", "look at a run or a PLY file in a browser"),
        "edit": ("gsjax.cli.edit", "change when, where and how parts move, and film it"),
    },
    "Judge and measure": {
        "eval": ("gsjax.cli.evaluate", "score a scene that was fitted, again or in more ways"),
        "compare": ("gsjax.cli.compare", "set runs side by side: scores, curves, pictures"),
        "experiment": ("gsjax.cli.experiment", "sweep what a claim rests on, and collect tables"),
        "bench": ("gsjax.cli.bench", "measure the rasterizer and every method's step here"),
    },
}
COMMANDS = {name: entry for group in GROUPS.values() for name, entry in group.items()}
"""Each command's module, which has `Options`, a dataclass or a union of them (subcommands), `run(options)`,
which returns the exit code, perhaps `HELP`, more to say of it, and perhaps `options_for(arguments)`: the
options where defaults depend on what is given, and the arguments that are left to parse."""


def entry() -> None:
    """The program. After Ctrl-C it leaves without waiting for XLA, which may still be compiling in a thread
    and would crash while Python takes it down. Where nobody reads on (`gsjax track --help | head`) it ends
    quietly, with the code of a program that SIGPIPE ended."""
    try:
        try:
            code = main()
        finally:
            sys.stdout.flush()  # later nobody could catch it
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left goes there
        code = 141
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
        known, meant = ", ".join(COMMANDS), get_close_matches(command, COMMANDS, 1)
        told = f"no command {command!r}; " + (f"did you mean {meant[0]}? There are" if meant else "there are")
        Console(stderr=True).print(f"[bold red]error:[/] {told}: {known}")
        return 2
    from gsjax.engine.interrupts import heard_interrupts

    try:
        with heard_interrupts():
            from gsjax.engine.program import run_politely

            return run_politely(command, rest, COMMANDS[command])
    except KeyboardInterrupt:
        Console(stderr=True).print("[bold red]stopped:[/] by Ctrl-C; what is on disk stays")
        return 130


_SHARED = {
    "--out RUN": "the folder of the run, with report.html and metrics.json",
    "--frames 0:60:2": "which frames or photographs, as Python slices them",
    "--cameras 0 1": "which cameras are looked through",
    "--eval-cameras 2": "which are held out, and only judge",
    "--scale 0.5": "pictures at half their width and height",
    "--preset NAME": "whose settings; any of them is an option too: --fit.steps",
    "--seed 1": "of all that is random",
    "--minutes 5": "stop then, with what there is",
    "--resume": "go on with a run that was stopped",
    "--overwrite": "replace a run that is finished",
}
"""Options that mean the same wherever they stand."""


def _print_help() -> None:
    """One page of 80 columns."""
    console = Console(highlight=False, soft_wrap=True)
    console.print("[bold]gsjax[/]: moving scenes from 3D Gaussians, in pure JAX")
    sections = {
        title: {f"gsjax {name}": does for name, (_, does) in group.items()} for title, group in GROUPS.items()
    }
    for title, rows in (*sections.items(), ("Options, the same wherever they stand", _SHARED)):
        console.print(f"\n[bold]{title}[/]")
        for name, does in rows.items():
            console.print(f"  [cyan]{name:<18}[/] {does}")
    console.print("\nAll options of one: [bold]gsjax track --help[/]. A first run, which needs no data:\n")
    console.print("  gsjax track simulated:tabletop --out runs/demo --frames 0:30")
    console.print("  gsjax view runs/demo")
