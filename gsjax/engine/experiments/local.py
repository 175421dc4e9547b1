"""Running cells in this process, one after the other."""

import contextlib
import copy
import json
import shutil
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

from gsjax.engine import machine
from gsjax.engine.experiments.records import read_record
from gsjax.engine.experiments.sweep import RESERVED, Cell, Experiment
from gsjax.engine.interrupts import raised_again
from gsjax.engine.locks import locked
from gsjax.engine.messages import describe
from gsjax.io.atomic import write_json
from gsjax.optim.compiler import forget_programs


def run_here(
    experiment: Experiment,
    cells: Sequence[Cell],
    script_run: Callable,
    say: Callable[[str], Any],
    debug: bool = False,
) -> Iterator[tuple[Cell, dict[str, Any]]]:
    """Run cells in order, and yield each with its record, which is on disk by then.

    Args:
        experiment: the experiment.
        cells: the cells to run.
        script_run: `run(options, seed, folder)` of the script.
        say: called with the cell in progress.
        debug: whether exceptions of cells are passed on.
    """
    for cell in cells:
        say(str(cell))
        with locked(experiment.cells_folder, cell.id):  # others may run other cells
            record = run_cell(experiment, cell, script_run, experiment.cells_folder, debug)
        yield cell, record


def run_cell(
    experiment: Experiment, cell: Cell, script_run: Callable, cells_folder: Path, debug: bool = False
) -> dict[str, Any]:
    """Run one cell and write its record, even if it fails; only Ctrl-C leaves none. Returns the record.

    Args:
        experiment: the experiment.
        cell: the cell.
        script_run: `run(options, seed, folder)` of the script. The folder is the cell's own, and new.
        cells_folder: gets the record, ID.json, and the cell's folder, ID.
        debug: whether its exceptions are passed on.
    """
    folder, path = cells_folder / cell.id, cells_folder / f"{cell.id}.json"
    shutil.rmtree(folder, ignore_errors=True)  # an interrupted run may have left something
    folder.mkdir(parents=True, exist_ok=True)
    made_with = experiment.made_with
    forget_programs()  # of earlier cells
    result, error, trace, begun = None, None, [], perf_counter()
    try:
        with raised_again():  # by a run in the script, which catches Ctrl-C
            result = script_run(copy.deepcopy(cell.options), cell.seed, folder)
        _check_result(result, cell)
    except (Exception, SystemExit) as failure:
        if debug:
            raise
        kind = type(failure).__name__
        result, error = None, f"{kind}: {describe(failure)}".removesuffix(f": {kind}")
        trace = traceback.format_exc().splitlines()
    outcome = {"result": result, "traceback": trace, "seconds": perf_counter() - begun}
    # The machine is described after the script ran, because the script may configure JAX.
    record = experiment.new_record(cell, error, **outcome, machine=machine.describe())
    write_json(path, record | {"gsjax": made_with})
    with contextlib.suppress(OSError):  # the script has left files in it
        folder.rmdir()
    return read_record(path)  # as later runs will read it: arrays are lists, NaN is null


def _check_result(result: Any, cell: Cell) -> None:
    """Raises a TypeError unless the result is a dict that JSON can hold, without reserved names."""
    if not isinstance(result, Mapping):
        raise TypeError(f"run() returned {type(result).__name__}, expected a dict of named figures")
    for key, value in result.items():
        if not isinstance(key, str) or key in (*RESERVED, *cell.options):
            raise TypeError(f"run() returned {key!r}, expected a name other than seed, seconds or an option")
        try:
            json.dumps(value, default=lambda array: array.tolist())
        except (TypeError, ValueError, AttributeError) as error:
            found = f"{key!r} of type {type(value).__name__}"
            raise TypeError(f"run() returned {found}, expected numbers, text, or lists of them") from error
