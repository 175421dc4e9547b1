"""How a run ends: what metrics.json says of that, its last files, its last lines, the program's exit code."""

from collections.abc import Callable
from typing import Any

from rich.console import Console
from rich.table import Table as Grid

from gsjax.engine.folder import RunFolder
from gsjax.engine.messages import reason


def ended(stopped: BaseException | None, *, report: bool = True) -> dict[str, Any]:
    """The part of metrics.json that says whether a run came to its end.

    Args:
        stopped: what ended it early, or None.
        report: whether it writes a report last, without which it is not finished.
    """
    why = None if stopped is None else reason(stopped)
    return {"complete": stopped is None, "report": report, "stopped": why}


def finish(
    folder: RunFolder, found: dict[str, Any], write_results: Callable[[RunFolder, dict[str, Any]], None]
) -> None:
    """Writes metrics.json, then the report, by which a run is finished; one that is complete keeps nothing to
    go on from.

    Args:
        folder: of the run.
        found: what metrics.json holds.
        write_results: writes plots and report.html.
    """
    folder.write_metrics(found)
    write_results(folder, found)
    if found["complete"]:
        folder.forget_resume()


def print_grid(folder: RunFolder, found: dict[str, Any], grid: Grid) -> None:
    """The run in a few lines, on stdout: those of the grid, whether it was stopped, where the report is.

    Args:
        folder: of the run.
        found: what metrics.json holds.
        grid: a row each, its head in bold.
    """
    if not found["complete"]:
        grid.add_row("[bold]stopped[/]", "[bold yellow]partial run; go on with --resume[/]")
    console = Console(highlight=False)
    console.print()
    console.print(grid)
    console.print(f"[bold]report[/]  {folder.report}", soft_wrap=True)


def exit_code(stopped: BaseException | None) -> int:
    """0, or 130 where Ctrl-C ended the run.

    Raises:
        BaseException: what else ended it early.
    """
    if stopped is None:
        return 0
    if isinstance(stopped, KeyboardInterrupt):
        return 130
    raise stopped
