"""`gsjax experiment`: runs or resumes the sweep that supports a claim, and collects its results."""

import contextlib
import json
from dataclasses import dataclass
from itertools import chain, compress
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table as Grid
from rich.text import Text

from gsjax.engine.experiments.cluster import PROCESSES, check_scheduler, run_on_cluster
from gsjax.engine.experiments.collect import collect, stdout
from gsjax.engine.experiments.local import run_here
from gsjax.engine.experiments.sweep import Cell, Experiment, experiment_names, in_words, read_experiment
from gsjax.engine.messages import Notes, describe, reason
from gsjax.engine.options import Common
from gsjax.engine.streams import say_error


@dataclass(frozen=True, kw_only=True)
class List(Common):
    """List the experiments, and the progress of each."""

    root: Path = Path("experiments")
    """Folder of the experiments: NAME/config.yaml, with the collected results beside it."""
    out: Path = Path("runs/experiments")
    """Folder for the record of each cell: NAME/ID.json."""


@dataclass(frozen=True, kw_only=True)
class Table(List):
    """Collect finished cells into tables, without running any."""

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """The experiment's folder below the root."""


@dataclass(frozen=True, kw_only=True)
class Run(Table):
    """Run the unfinished cells of an experiment, and collect the results. With --debug it stops at the first
    cell that fails."""

    seeds: Annotated[tuple[int, ...], tyro.conf.arg(metavar="SEED [SEED ...]")] = ()
    """Run only these of the config's seeds."""
    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="KEY=VALUE [KEY=VALUE ...]")] = ()
    """Run only cells whose options have these values; several values of one key are alternatives."""
    fresh: bool = False
    """Run finished cells again."""
    executor: Literal["local", "dask"] = "local"
    """Where cells run: in this process, one after the other, or on the workers of a Dask cluster."""
    scheduler: Annotated[str, tyro.conf.arg(metavar="processes|slurm|tcp://HOST:PORT")] = "processes"
    """For dask: processes on this machine; SLURM jobs, as configured under jobqueue.slurm in Dask's settings;
    or the address of a scheduler whose workers run in checkouts like this one."""
    workers: int | None = None
    """For dask: number of processes or jobs to start; default: one process per core."""


Options = List | Run | Table


def run(options: List | Run | Table) -> int:
    """List, run or collect; returns the exit code: 1 if a cell or the figure failed, 130 after Ctrl-C.

    Raises:
        ValueError, OSError: an option cannot be met; every cell that finished before is on disk.
    """
    if not isinstance(options, Table):
        return list_experiments(options)
    experiment = read_experiment(options.root, options.name, options.out)
    if isinstance(options, Run):
        return run_experiment(experiment, options)
    return collect(experiment, experiment.load()[1], options.debug)


def list_experiments(options: List) -> int:
    """Print one line per experiment. A broken one is reported and does not hide the others."""
    names, broken = experiment_names(options.root), False
    grid = Grid("name", "claim", "done", "", "when (UTC)", box=None, pad_edge=False, padding=(0, 3, 0, 0))
    for name in names:
        try:
            experiment = read_experiment(options.root, name, options.out)
            records = experiment.records()
        except (ValueError, OSError) as error:
            broken = True
            say_error(describe(error))
            continue
        done = f"{sum(map(experiment.is_done, records))} of {len(experiment.cells)}"
        failed = sum(record["error"] is not None for record in records)
        stale = sum(r["error"] is None and r["script"] != experiment.fingerprint for r in records)
        counts = ", ".join(f"{n} {word}" for n, word in ((failed, "failed"), (stale, "stale")) if n)
        when = max((r["finished"][:16].replace("T", " ") for r in records), default="–")
        grid.add_row(*map(Text, (name, experiment.config.claim.strip(), done, counts, when)))
    stdout().print(grid if names else Text(f"{options.root} has no NAME/config.yaml"))
    return 2 if broken else 0


def run_experiment(experiment: Experiment, options: Run) -> int:
    """Run the chosen, unfinished cells, then collect. Ctrl-C keeps finished cells."""
    console = Console(stderr=True, highlight=False)
    chosen = choose(experiment, options.seeds, options.only)
    script_run, figure = experiment.load()
    _check_executor(options)
    experiment.committed()  # if it cannot be read, fail now and not after hours
    left = [cell for cell in chosen if options.fresh or not experiment.is_done(experiment.own(cell))]
    if len(left) < len(chosen):
        console.print(f"{len(chosen) - len(left)} of {len(chosen)} cells are done; --fresh runs them again")
    words = TextColumn("{task.description}", markup=False)
    columns = (words, BarColumn(bar_width=None), MofNCompleteColumn(), TimeRemainingColumn())
    failed = []
    try:
        with Notes(console), Progress(*columns, console=console, expand=True) as progress:
            task = progress.add_task("cells", total=len(chosen), completed=len(chosen) - len(left))

            def say(what: str) -> None:
                progress.update(task, description=what)

            def forget() -> None:  # all at once, so that after Ctrl-C the rest goes on without --fresh
                for cell in left if options.fresh else ():
                    experiment.path(cell).unlink(missing_ok=True)

            if options.executor == "dask" and left:
                how = (options.scheduler, options.workers)
                finished = run_on_cluster(experiment, left, *how, say, forget, options.debug)
            else:
                forget()
                finished = run_here(experiment, left, script_run, say, options.debug)
            with contextlib.closing(finished):  # at once, also after Ctrl-C
                for cell, record in finished:
                    failed += [cell] if record["error"] else []
                    console.print(_line(cell, record), soft_wrap=not console.is_terminal)
                    progress.update(task, advance=1, description="cells")
        code = collect(experiment, figure, options.debug)
    except KeyboardInterrupt as interrupt:
        kept = sum(experiment.is_done(experiment.own(cell)) for cell in chosen)
        again = "the same command" + (" without --fresh" if options.fresh else "")
        after = f"by {reason(interrupt)} after {kept} of {len(chosen)} cells"
        say_error(f"{after}; {again} continues from there", word="stopped")
        return 130
    if failed:
        again = f"{len(failed)} of {len(chosen)} cells failed and will run again next time"
        say_error(f"{again}; the first one's traceback is in {experiment.path(failed[0])}")
        return 1
    return code


def _check_executor(options: Run) -> None:
    if options.executor == "dask":
        check_scheduler(options.scheduler, options.workers)
    elif options.workers is not None or options.scheduler != PROCESSES:
        given = "--workers" if options.workers is not None else "--scheduler"
        raise ValueError(f"{given}: expected --executor dask, found --executor local; leave {given} out")


def _line(cell: Cell, record: dict[str, Any]) -> Text:
    """The outcome of a cell."""
    if record["error"]:
        return Text.assemble(("failed", "bold red"), f"  {cell}  {record['error']}")
    return Text.assemble(("done  ", "green"), f"  {cell}  {record['seconds']:.1f} s")


def choose(experiment: Experiment, seeds: tuple[int, ...], only: tuple[str, ...]) -> list[Cell]:
    """The cells that `--seeds` and `--only` select, in order.

    Raises:
        ValueError: no cell has a key, or a value of it, or all of them together.
    """
    wanted: dict[str, set[str]] = {"seed": {str(seed) for seed in seeds}} if seeds else {}
    for text in only:
        key, sign, value = text.partition("=")
        if not sign:
            raise ValueError(f"--only: expected KEY=VALUE, found {text!r}")
        if value not in [cell.words.get(key) for cell in experiment.cells]:
            with contextlib.suppress(ValueError):  # 1e-3 and 0.001 are the same
                value = in_words(json.loads(value))
        wanted.setdefault(key, set()).add(value)
    words = [cell.words for cell in experiment.cells]
    for key, values in wanted.items():
        known = dict.fromkeys(w[key] for w in words if key in w)
        if not known:
            keys = ", ".join(dict.fromkeys(chain(*words)))
            raise ValueError(f"--only: {experiment.name} has no option {key!r}; it has {keys}")
        if missing := values - set(known):
            found = ", ".join(sorted(missing))
            raise ValueError(f"{experiment.name}: no cell has {key}={found}; it is one of {', '.join(known)}")
    fits = [all(w.get(key) in values for key, values in wanted.items()) for w in words]
    if not any(fits):
        raise ValueError(f"{experiment.name}: no cell has all of {' '.join(only)}")
    return list(compress(experiment.cells, fits))
