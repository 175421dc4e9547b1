"""Fuzz the readers of files: damage one of the files that a reader reads, and check how it responds.

It may read the file, with warnings, or refuse it in a sentence that names the file (docs/data-errors.md). A
fault is any other exception, a message that is endless or names no file, a number that is not finite, more
than `SECONDS` of computing or `GIB` of new memory, or a crash of the process. Each case depends only on the
seed and its number. Run it with

    python -m benchmarks.fuzz_files --count 10000 --out benchmarks/results/fuzz_files.json
    python -m benchmarks.fuzz_files --only .splat --seed 0 --first 123 --count 1   # one case, as printed
"""

import argparse
import collections
import json
import multiprocessing
import resource
import signal
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.mutations import mutated
from benchmarks.readers import READERS
from benchmarks.readers_of_data import Reader
from gsjax.engine import machine
from gsjax.engine.messages import describe
from gsjax.engine.program import USER_ERRORS

SECONDS, GIB = 2.0, 1.0
LONGEST = 1000  # characters of a message
_NO_ANSWER_S = 60.0  # wall-clock time, because signals do not interrupt a library's computing
_GIB = 1 << 30


class Overtime(BaseException):
    """A case computed for too long; no `except Exception` may hide it."""


class Case(NamedTuple):
    """The outcome of a case: "read", "refused" or "fault", and the message."""

    number: int
    outcome: str
    said: str


@contextmanager
def bounded(seconds: float = SECONDS, gib: float = GIB) -> Iterator[None]:
    """Raise Overtime after `seconds` of computing, MemoryError if more than `gib` of new memory is needed."""

    def stop(*_: object) -> None:
        raise Overtime(f"more than {seconds:g} s")

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + int(gib * _GIB)
    before = signal.signal(signal.SIGPROF, stop)
    resource.setrlimit(
        resource.RLIMIT_AS, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard)
    )
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


class Trial:
    """A reader with intact files in a folder, one of which is damaged in each case."""

    def __init__(self, reader: Reader, folder: Path):
        """
        Args:
            reader: the reader.
            folder: an empty folder.
        """
        self._reader, self._root = reader, folder / "freiburg3_DATA"  # TUM's reader knows cameras by the name
        self._root.mkdir()
        reader.build(self._root)
        files = sorted(path for path in self._root.rglob("*") if path.is_file())
        self._files = {path: path.read_bytes() for path in files}
        reader.open(self._root)
        kinds = collections.defaultdict(list)
        for path in files:
            kinds[path.parent, path.suffix].append(path)
        self._kinds = list(kinds.values())

    def case(self, seed: int, number: int) -> Case:
        """Damage a file, open it, and put it back.

        Args:
            seed: the seed of all cases.
            number: the number of this case.
        """
        rng = np.random.default_rng([seed, number])
        kind = self._kinds[rng.integers(len(self._kinds))]
        path = kind[rng.integers(len(kind))]
        path.write_bytes(mutated(self._files[path], [*self._files.values()], rng))
        try:
            outcome, said = self._opened()
        finally:
            path.write_bytes(self._files[path])
        return Case(number, outcome, said.replace(str(self._root), "DATA"))

    def _opened(self) -> tuple[str, str]:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            try:
                with bounded():
                    arrays = [array for array in self._reader.open(self._root) if array is not None]
            except USER_ERRORS as error:
                wrong = self._wrong(describe(error))
                return ("fault", f"{wrong}: {_told(error)}") if wrong else ("refused", describe(error))
            except (Exception, Overtime) as error:
                return "fault", _told(error)
        if not all(np.isfinite(np.asarray(array)).all() for array in arrays):
            return "fault", "read, but not finite"
        said = [str(warning.message) for warning in caught if issubclass(warning.category, UserWarning)]
        long = next((text for text in said if len(text) > LONGEST), "")
        return ("fault", f"a warning of {len(long)} characters: {long[:200]}") if long else ("read", "")

    def _wrong(self, message: str) -> str:
        """What is wrong with a message; "" if nothing is."""
        if str(self._root) not in message:
            return "a message without the file"
        return f"a message of {len(message)} characters" if len(message) > LONGEST else ""


def _told(error: BaseException) -> str:
    """An exception, and where it comes from."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [f"{Path(f.filename).name}:{f.lineno}" for f in frames if "/gsjax/" in f.filename]
    return f"{type(error).__name__}: {describe(error)[:200]} ({' '.join(own[-3:])})"


def try_reader(name: str, numbers: Iterator[int] | range, seed: int, folder: Path) -> Iterator[Case]:
    """Cases of a reader, in this process.

    Args:
        name: name of the reader, as in `READERS`.
        numbers: numbers of the cases.
        seed: the seed of all cases.
        folder: an empty folder.
    """
    trial = Trial(READERS[name], folder)
    for number in numbers:
        yield trial.case(seed, number)


def _work(name: str, first: int, end: int, seed: int, pipe: Connection) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for case in try_reader(name, range(first, end), seed, Path(folder)):
            pipe.send(case)
    pipe.send(None)


def try_in_process(name: str, first: int, end: int, seed: int) -> Iterator[Case]:
    """Cases of a reader, in a separate process, which is replaced whenever a case ends it.

    Args:
        name: name of the reader.
        first, end: range of the numbers of the cases; `end` is not included.
        seed: the seed of all cases.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["benchmarks.readers"])  # imported once for all processes
    while first < end:
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=_work, args=(name, first, end, seed, theirs))
        process.start()
        theirs.close()
        ended = ""
        while not ended:
            try:
                case = ours.recv() if ours.poll(_NO_ANSWER_S) else f"no answer for {_NO_ANSWER_S:g} s"
            except EOFError:
                process.join()
                case = f"the process ended ({process.exitcode})"
            if case is None:
                process.join()
                return
            if isinstance(case, str):
                ended = case
                process.kill()
                process.join()
                yield Case(first, "fault", ended)
            else:
                yield case
            first += 1


def main() -> None:
    parser = argparse.ArgumentParser(description="fuzz the readers of files")
    parser.add_argument("--only", nargs="+", choices=READERS, default=[*READERS], metavar="READER")
    parser.add_argument("--count", type=int, default=1000, help="cases of a reader; of slow ones, a share")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="a .json for the table")
    arguments = parser.parse_args()
    record = {"machine": machine.describe(), "seed": arguments.seed, "readers": {}}
    print("| reader | tried | read | refused | faults | s |", "| --- " * 6 + "|", sep="\n", flush=True)
    for name in arguments.only:
        count = max(1, round(arguments.count * READERS[name].share))
        begun, counts, faults = time.perf_counter(), collections.Counter(), []
        for case in try_in_process(name, arguments.first, arguments.first + count, arguments.seed):
            counts[case.outcome] += 1
            if case.outcome == "fault":
                faults.append(case._asdict())
        row = {kind: counts[kind] for kind in ("read", "refused", "fault")}
        seconds = round(time.perf_counter() - begun, 1)
        print("|", " | ".join(map(str, (name, count, *row.values(), seconds))), "|", flush=True)
        for said, alike in _by_place(faults).items():
            print(
                f"    {len(alike)} such as --only {name!r} --first {alike[0]} --count 1: {said}", flush=True
            )
        record["readers"][name] = {"tried": count, **row, "seconds": seconds, "faults": faults}
        if arguments.out:
            arguments.out.write_text(json.dumps(record, indent=1) + "\n")
    if any(row["fault"] for row in record["readers"].values()):
        raise SystemExit(1)


def _by_place(faults: list[dict]) -> dict[str, list[int]]:
    """Numbers of the cases with faults, grouped by the place that raised them, under its first message."""
    alike: dict[str, list[int]] = {}
    for fault in faults:
        place = fault["said"].rpartition("(")[2]
        key = next((said for said in alike if said.rpartition("(")[2] == place), fault["said"])
        alike.setdefault(key, []).append(fault["number"])
    return alike


if __name__ == "__main__":
    main()
