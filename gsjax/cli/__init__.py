"""The command line, `gsjax COMMAND ...`.

Commands are imported when they are called, so that `gsjax --help` is fast.
"""

import gc
import os
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from importlib import import_module

from rich.console import Console

from gsjax.engine.streams import keep_streams_open, lost_output, say_error

GROUPS = {
    "Inspect data": {
        "info": ("gsjax.cli.info", "describe a dataset, a run or a file of Gaussians"),
        "poses": ("gsjax.cli.poses", "find the cameras of photographs or of a video, for fit"),
    },
    "Reconstruct": {
        "track": ("gsjax.cli.track", "track the objects of a recording from RGB-D cameras"),
        "live": ("gsjax.cli.live", "track objects while frames arrive, at a given rate"),
        "fit": ("gsjax.cli.fit", "fit a static scene to posed photographs"),
        "parts": ("gsjax.cli.parts", "find the parts of a moving scene, and their joints"),
        "deform": ("gsjax.cli.deform", "reconstruct a scene that deforms, as one camera sees it"),
    },
    "Distil and query": {
        "distill": ("gsjax.cli.distill", "distil a semantic field for a run or a file"),
        "query": ("gsjax.cli.query", "find what a text means: objects of a run, or Gaussians"),
        "ask": ("gsjax.cli.ask", "answer a question about a deforming scene"),
        "grasp": ("gsjax.cli.grasp", "find the best grasp of what a text means, in every frame"),
    },
    "View and edit": {
        "view": ("gsjax.cli.view", "view a run or a file of Gaussians in a browser"),
        "export": ("gsjax.cli.export", "write a scene in another format, or as a page"),
        "edit": ("gsjax.cli.edit", "change when, where and how parts move, and film it"),
    },
    "Evaluate and measure": {
        "eval": ("gsjax.cli.evaluate", "score a fitted scene again, or with more metrics"),
        "compare": ("gsjax.cli.compare", "compare runs side by side: scores, curves, pictures"),
        "experiment": ("gsjax.cli.experiment", "run the sweep behind a claim, and collect its tables"),
        "bench": ("gsjax.cli.bench", "benchmark the rasterizer and every method's step"),
    },
}
COMMANDS = {name: entry for group in GROUPS.values() for name, entry in group.items()}
"""Each command's module and description. The module has `Options`, a dataclass or a union of them
(subcommands), and `run(options)`, which returns the exit code; optionally `HELP`, a further description; and
optionally `options_for(arguments)`, for defaults that depend on the arguments, which returns the class of
options and the arguments to parse."""


def entry() -> None:
    """The entry point of the program. After Ctrl-C or an error it exits without waiting for XLA, which may
    still be compiling in a thread and would crash as Python shuts down. Output that nobody can receive
    (`gsjax fit ... | head`) neither ends a run nor changes its exit code; output lost to a full disk causes a
    warning."""
    # JAX's traces are many long-lived objects: to scan them for garbage again and again, and once more at
    # exit, takes a second of a short run.
    gc.set_threshold(100_000, 50, 50)
    # gsjax itself reports what is wrong with a picture or a video, because it knows the file.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # FFmpeg's quiet
    # XLA's alarm about slow compilation asks for a bug report; gsjax itself says when it compiles.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    keep_streams_open()
    try:
        code = main()
    finally:
        if why := lost_output():
            say_error(f"standard output could not be written ({why})", word="warning")
    if code not in (0, 3):
        sys.stderr.flush()
        os._exit(code)
    gc.freeze()
    sys.exit(code)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code.

    0: done. 1: a fault of gsjax. 2: the user's mistake, reported in a sentence. 3: done, but nothing was
    found (no feasible grasp). 130: stopped by Ctrl-C, SIGTERM or SIGHUP.

    Args:
        arguments: command and options (default: those of the process).
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
        hint = f"did you mean {meant[0]}? There are" if meant else "there are"
        say_error(f"no command {command!r}; {hint}: {known}")
        return 2
    from gsjax.engine.interrupts import handled_interrupts

    try:
        with handled_interrupts():
            from gsjax.engine.program import run_command

            return run_command(command, rest, COMMANDS[command])
    except KeyboardInterrupt as interrupt:
        from gsjax.engine.messages import reason

        say_error(f"by {reason(interrupt)}; files on disk are kept", word="stopped")
        return 130


_SHARED = {
    "--out RUN": "the folder of the run, with report.html and metrics.json",
    "--frames 0:60:2": "frames or photographs to use, as a Python slice",
    "--cameras 0 1": "cameras to use",
    "--eval-cameras 2": "cameras to hold out for evaluation",
    "--scale 0.5": "pictures at half their width and height",
    "--preset NAME": "default settings; each is an option too: --fit.steps",
    "--seed 1": "random seed",
    "--minutes 5": "be done within this time, with the result by then",
    "--resume": "resume a run that was stopped",
    "--overwrite": "replace a finished run",
}
"""Options that mean the same in all commands."""


def _print_help() -> None:
    """One page of 80 columns."""
    console = Console(highlight=False, soft_wrap=True)
    console.print("[bold]gsjax[/]: moving scenes from 3D Gaussians, in pure JAX")
    sections = {
        title: {f"gsjax {name}": does for name, (_, does) in group.items()} for title, group in GROUPS.items()
    }
    for title, rows in (*sections.items(), ("Options with the same meaning in all commands", _SHARED)):
        console.print(f"\n[bold]{title}[/]")
        for name, does in rows.items():
            console.print(f"  [cyan]{name:<18}[/] {does}")
    console.print("\nAll options of a command: [bold]gsjax track --help[/]. A first run, without data:\n")
    console.print("  gsjax track simulated:tabletop --out runs/demo --frames 0:30")
    console.print("  gsjax view runs/demo")
