"""How a run ended: what metrics.json says of that, and the program's exit code."""

from typing import Any

from gsjax.cli.messages import reason


def ended(stopped: BaseException | None, *, report: bool = True) -> dict[str, Any]:
    """The part of metrics.json that says whether a run came to its end.

    Args:
        stopped: what ended it early, or None.
        report: whether it writes a report last, without which it is not finished.
    """
    why = None if stopped is None else reason(stopped)
    return {"complete": stopped is None, "report": report, "stopped": why}


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
