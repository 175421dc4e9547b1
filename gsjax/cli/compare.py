"""`gsjax compare`: runs of one command side by side, by their scores and settings."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gsjax.engine.compare.comparison import compare
from gsjax.engine.compare.pictures import shows_the_same
from gsjax.engine.compare.results import FOLDERS, as_json, summarize
from gsjax.engine.folder import expect_replaceable, is_nonempty, is_run
from gsjax.engine.locks import lock, releasing_locks
from gsjax.engine.options import Common
from gsjax.engine.records import read_record
from gsjax.engine.report import write_report
from gsjax.engine.terminal import print_summary
from gsjax.io.atomic import write_json

_JSON = "comparison.json"


@dataclass(frozen=True)
class Options(Common):
    """Options of `gsjax compare`."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN RUN [RUN ...]")]
    """Folders of runs of one command: `gsjax fit`, `track`, `parts`, `distill` or `deform`."""
    out: Path | None = None
    """Folder for comparison.json and report.html, with curves and pictures. It must be new, empty, or hold an
    earlier comparison, which is replaced. By default only the tables are printed."""


@releasing_locks()
def run(options: Options) -> int:
    """Compare, print the tables and write the folder; returns the exit code.

    Raises:
        ValueError, OSError: a folder is not a run's, runs are of different commands, or the folder for the
            comparison holds something else.
    """
    if len(options.runs) < 2:
        raise ValueError(f"expected two runs or more to compare, found {len(options.runs)}")
    if options.out is not None:
        _check_folder(options.out)
    found = compare([read_record(path) for path in options.runs], shows_the_same)
    summary, report = summarize(found, options.out), None
    if options.out is not None:
        report = options.out / "report.html"
        write_report(report, summary)
        write_json(options.out / _JSON, as_json(found))
    print_summary(summary, report, notes=True, titles=True)
    return 0


def _check_folder(out: Path) -> None:
    """Locks the folder; raises FileExistsError if it holds something other than a comparison."""
    lock(out)
    if is_nonempty(out) and (is_run(out) or not (out / _JSON).is_file()):
        what = "a run" if is_run(out) else "other files"
        raise FileExistsError(
            f"--out {out}: expected a new folder, an empty one or an earlier comparison, found {what}; "
            "name another"
        )
    for name, written in FOLDERS.items():
        expect_replaceable(out / name, (written,))
