"""The end of a run: its status in metrics.json, its last files, the printed summary, and the exit code."""

from collections.abc import Callable
from typing import Any

from gsjax.engine.folder import RunFolder
from gsjax.engine.messages import reason
from gsjax.engine.report import write_report
from gsjax.engine.summary import Summary
from gsjax.engine.terminal import print_summary


def completion(stopped: BaseException | None, *, report: bool = True) -> dict[str, Any]:
    """The part of metrics.json that says whether a run was completed.

    Args:
        stopped: what ended it early, or None.
        report: whether it writes a report last; if so, it is unfinished until it has one.
    """
    why = None if stopped is None else reason(stopped)
    return {"complete": stopped is None, "report": report, "stopped": why}


def finish(
    folder: RunFolder, found: dict[str, Any], summarize: Callable[[RunFolder, dict[str, Any]], Summary]
) -> None:
    """Write metrics.json, then the report, which marks the run as finished, and print the summary. A complete
    run keeps nothing to resume from.

    Args:
        folder: of the run.
        found: the contents of metrics.json.
        summarize: folder, metrics -> the summary; it may draw plots into the folder.
    """
    folder.write_metrics(found)
    summary = summarize(folder, found)
    write_report(folder.report, summary)
    if found["complete"]:
        folder.forget_resume()
    print_summary(summary, folder.report)


def exit_code(stopped: BaseException | None) -> int:
    """0, or 130 where Ctrl-C or a signal ended the run.

    Raises:
        BaseException: anything else that ended it early.
    """
    if stopped is None:
        return 0
    if isinstance(stopped, KeyboardInterrupt):
        return 130
    raise stopped
