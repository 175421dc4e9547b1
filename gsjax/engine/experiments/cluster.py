"""Running cells on the workers of a Dask cluster: processes here, those at an address, or SLURM jobs.

A worker has a checkout of its own and gets the options of a cell. It runs the cell in a temporary folder and
sends back all that the cell left: its record and files. So no disk need be shared, and the experiment's
folder ends up as after a run in this process.
"""

import io
import logging
import os
import shutil
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager, suppress
from functools import cache, lru_cache
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from time import sleep
from types import ModuleType
from typing import Any
from zipfile import ZipFile

from gsjax import extras
from gsjax.engine.experiments.local import run_cell
from gsjax.engine.experiments.script import forget_scripts
from gsjax.engine.experiments.sweep import Cell, Experiment, read_experiment
from gsjax.engine.machine import keep_to, usable_cores
from gsjax.engine.messages import counted
from gsjax.io.atomic import write_json
from gsjax.optim.compiler import keep_freed_memory

PROCESSES, SLURM = "processes", "slurm"
CONNECT_S = 10
_POLL_S, _COLLECTED_S = 1, 60
_KEYS = "gsjax-"
# A terminal sends Ctrl-C to workers too, but this process ends them. Subprocesses of a cell get it as usual.
_UNDISTURBED = "import signal; signal.signal(signal.SIGINT, lambda *_: None)"


def run_on_cluster(
    experiment: Experiment,
    cells: Sequence[Cell],
    scheduler: str,
    workers: int | None,
    say: Callable[[str], Any],
    connected: Callable[[], Any],
    debug: bool = False,
) -> Iterator[tuple[Cell, dict[str, Any]]]:
    """Run cells on workers, and yield each with its record, which is on disk by then, as they finish.

    A cell whose worker dies is run by another. One that lost more workers than Dask allows
    (`distributed.scheduler.allowed-failures`) waits until all others are done: it may only have been queued
    on workers that another cell killed. If it then loses one more, it has failed.

    Args:
        experiment: the experiment.
        cells: the cells to run.
        scheduler: `processes`, `slurm`, or an address such as tcp://HOST:8786.
        workers: number of processes or jobs to start (default: one process per core).
        say: called with the number of workers, in words.
        connected: called when there is a scheduler, before any cell is submitted.
        debug: whether exceptions of cells are passed on.

    Raises:
        ValueError: there is no such scheduler, or a worker differs from this process.
        OSError: the scheduler does not answer, or no longer does.
    """
    killed_worker = _package("distributed").KilledWorker
    if scheduler == PROCESSES:
        workers = workers or usable_cores()
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # its errors are reported here
    with _client(scheduler, workers) as client, _reporting_loss(scheduler):
        connected()
        sharing = workers if scheduler == PROCESSES else None
        under_way = {_submit(client, experiment, cell, sharing, debug): cell for cell in cells}
        suspects, alone = [], False
        while under_way:
            for future in _finished(client, list(under_way), say):
                cell = under_way.pop(future)
                try:
                    record = _unpack(experiment, cell, future.result())
                except killed_worker as error:
                    if not alone:
                        suspects.append((future, cell))
                        continue
                    record = _killed(experiment, cell, error.allowed_failures + 2)
                except ImportError as error:
                    if debug:  # a script's own
                        raise
                    raise ValueError(
                        f"a worker cannot load the code of a cell: {error}; start workers where gsjax "
                        f"{experiment.made_with} is installed, as here"
                    ) from error
                future.release()  # or else Dask would compute it again if its worker died
                yield cell, record
            if not under_way and suspects:
                future, cell = suspects.pop(0)
                client.retry([future])
                under_way, alone = {future: cell}, True


@contextmanager
def _reporting_loss(scheduler: str) -> Iterator[None]:
    """Raises an OSError if the scheduler, and with it every submitted cell, is lost."""
    try:
        yield
    except CancelledError as error:
        raise OSError(
            f"--scheduler {scheduler}: the connection was lost; finished cells are kept, and the "
            "same command continues from there"
        ) from error


def _submit(client: Any, experiment: Experiment, cell: Cell, sharing: int | None, debug: bool) -> Any:
    """Submit a cell; returns its future. A cell submitted again while it runs shares the result."""
    about = (f"{experiment.root}", experiment.name, experiment.fingerprint, experiment.made_with)
    arguments = (*about, cell.options, cell.seed, sharing, debug)
    key = f"{_KEYS}{import_module('dask.base').tokenize(arguments)}"
    # By module name, and with plain arguments: a worker without this module then reports that it cannot load
    # it, whereas unpickling a function of the module would break the worker.
    module = __name__
    return client.submit(lambda: import_module(module).run_there(*arguments), key=key)


def run_there(
    root: str,
    name: str,
    script: str,
    made_with: str,
    options: dict[str, Any],
    seed: int,
    sharing: int | None,
    debug: bool,
) -> bytes:
    """Run a cell on a worker.

    Args:
        root: the folder of the experiments, relative to where the worker was started.
        name: name of the experiment.
        script: the fingerprint that its script must have.
        made_with: the version of gsjax that the worker must have.
        options: options of the cell.
        seed: seed of the cell.
        sharing: number of workers that share this machine's cores; None does not restrict them.
        debug: whether exceptions of the cell are passed on.

    Returns:
        a zip of the cell's record, ID.json, and of its folder, ID.

    Raises:
        ValueError: the worker has several threads, or another gsjax, script or folder than the client.
    """
    worker = import_module("distributed").get_worker()
    if worker.state.nthreads != 1:
        raise ValueError(
            f"worker {worker.address}: expected one thread, because cells share what a script has loaded, "
            f"found {worker.state.nthreads}; start it with --nthreads 1"
        )
    _wait_until_collected(worker)
    # JAX keeps freed memory. A worker that Dask pauses for that would never continue.
    worker.memory_manager.memory_pause_fraction = False
    if sharing is not None:
        _keep_to_share(worker.name, sharing)
    keep_freed_memory()
    try:
        experiment, script_run = _loaded(root, name, script, made_with)
    except ValueError as error:
        raise ValueError(f"worker {worker.address}: {error}") from error
    with TemporaryDirectory(dir=worker.local_directory, prefix="gsjax-") as temporary:
        left = Path(temporary) / "left"
        run_cell(experiment, Cell(options, seed), script_run, left, debug)
        return Path(shutil.make_archive(f"{temporary}/sent", "zip", left)).read_bytes()


def _wait_until_collected(worker: Any) -> None:
    """Wait until the client has stored what this worker computed before, because the next cell may kill it;
    but not for ever, because the client may be gone."""
    for _ in range(int(_COLLECTED_S / 0.01)):
        if not any(str(key).startswith(_KEYS) for key in list(worker.data)):
            return
        sleep(0.01)


@lru_cache(maxsize=1)
def _loaded(root: str, name: str, script: str, made_with: str) -> tuple[Experiment, Callable]:
    """An experiment, and `run` of its script, loaded once for all cells.

    Raises:
        ValueError: it does not match `script` and `made_with`, or cannot be loaded.
    """
    forget_scripts(Path(root))  # other helpers of the same name, or edited ones
    experiment = read_experiment(Path(root), name, Path())
    if experiment.made_with != made_with:
        raise ValueError(
            f"expected gsjax {made_with}, as where the run was started, found {experiment.made_with}; check "
            "out the same version here and start the worker again"
        )
    if experiment.fingerprint != script:
        raise ValueError(
            f"{experiment.script}: expected the same script as where the run was started, found a different "
            "one; check out the same version here"
        )
    return experiment, experiment.load()[0]


@cache
def _keep_to_share(index: int, sharing: int) -> None:
    """Restrict this process to its share of the cores, so that workers do not disturb each other's timings.
    If there are more processes than cores, they share them."""
    if hasattr(os, "sched_getaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        first, end = (n * len(cores) // sharing for n in (index % sharing, index % sharing + 1))
        keep_to(cores[first : max(end, first + 1)])


def _finished(client: Any, futures: list[Any], say: Callable[[str], Any]) -> list[Any]:
    """The finished futures, as soon as there are any."""
    while True:
        with suppress(OSError):  # the client is reconnecting, and gives up after a while
            workers = len(client.nthreads())
            say(f"cells on {counted(workers, 'worker')}" if workers else "waiting for a worker")
        with suppress(TimeoutError):
            wait = import_module("distributed").wait
            return list(wait(futures, timeout=_POLL_S, return_when="FIRST_COMPLETED").done)


def _unpack(experiment: Experiment, cell: Cell, sent: bytes) -> dict[str, Any]:
    """Store what a worker sent, the record last; returns the record."""
    experiment.cells_folder.mkdir(parents=True, exist_ok=True)
    folder, path = experiment.cells_folder / cell.id, experiment.path(cell)
    with TemporaryDirectory(dir=experiment.cells_folder, prefix=".partial-") as temporary:
        with ZipFile(io.BytesIO(sent)) as archive:
            archive.extractall(temporary)
        shutil.rmtree(folder, ignore_errors=True)
        if (Path(temporary) / folder.name).is_dir():
            os.replace(Path(temporary) / folder.name, folder)
        os.replace(Path(temporary) / path.name, path)
    found = experiment.own(cell)
    assert found is not None
    return found


def _killed(experiment: Experiment, cell: Cell, workers: int) -> dict[str, Any]:
    """Write the record of a cell whose workers all died; returns it."""
    error = (
        f"KilledWorker: {workers} workers died with this cell, the last one while it ran no other: perhaps "
    )
    error += "there is too little memory; the reason is in their logs"
    record = experiment.new_record(cell, error)
    write_json(experiment.path(cell), record)
    return record


@contextmanager
def _client(scheduler: str, workers: int | None) -> Iterator[Any]:
    """A client of the scheduler, which, unless it is an address, is started here and ended with its
    workers."""
    distributed, config = _package("distributed"), _package("dask.config")
    with ExitStack() as stack:
        # Cells take long: none should wait for a busy worker while another one is idle.
        stack.enter_context(config.set({"distributed.scheduler.worker-saturation": 1.0}))
        place = scheduler
        if scheduler == PROCESSES:
            place = stack.enter_context(
                distributed.LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    memory_limit=0,
                    dashboard_address=None,
                    silence_logs=logging.CRITICAL,
                    preload=[*config.get("distributed.worker.preload"), _UNDISTURBED],
                )
            )
        elif scheduler == SLURM:
            place = stack.enter_context(slurm_cluster())
            place.adapt(minimum_jobs=workers, maximum_jobs=workers)  # replaces jobs that ended
        try:
            client = distributed.Client(place, timeout=CONNECT_S)
        except OSError as error:
            raise OSError(
                f"--scheduler {scheduler}: expected a Dask scheduler, found none that answers within "
                f"{CONNECT_S} s; check the address"
            ) from error
        yield stack.enter_context(client)


def slurm_cluster() -> Any:
    """Dask's cluster of SLURM jobs, with none submitted yet. A job is one worker, with all its cores.

    Jobs are configured in Dask's own settings: `jobqueue.slurm` of ~/.config/dask/*.yaml.

    Raises:
        MissingExtra: dask-jobqueue is not installed.
        ValueError: the configuration lacks what a job must have.
    """
    jobqueue, config = _package("dask_jobqueue"), _package("dask.config")
    cores = config.get("jobqueue.slurm.job-cpu") or config.get("jobqueue.slurm.cores")
    if cores is None or config.get("jobqueue.slurm.memory") is None:
        raise ValueError(
            "--scheduler slurm: expected jobqueue.slurm.cores and .memory in Dask's settings, a .yaml in "
            f"{config.PATH}, found no {'cores' if cores is None else 'memory'}"
        )
    # Dask's "cores" are its threads, each of which would run a cell at the same time.
    free_port = {"dashboard_address": ":0", **config.get("jobqueue.slurm.scheduler-options")}
    return jobqueue.SLURMCluster(cores=1, processes=1, job_cpu=cores, scheduler_options=free_port)


def check_scheduler(scheduler: str, workers: int | None) -> None:
    """Raises a ValueError if these options are invalid, and MissingExtra if a package is missing."""
    _package("distributed")
    if workers is not None and workers < 1:
        raise ValueError(f"--workers: expected 1 or more, found {workers}")
    if "://" in scheduler:
        if workers is not None:
            raise ValueError(f"--workers: expected none, because {scheduler} has its own, found {workers}")
    elif scheduler == SLURM:
        if workers is None:
            raise ValueError("--workers: expected the number of jobs to submit to SLURM, found none")
        if shutil.which("sbatch") is None:
            raise ValueError("--scheduler slurm: expected SLURM's sbatch on this machine, found none")
    elif scheduler != PROCESSES:
        known = f"{PROCESSES}, {SLURM} or an address such as tcp://HOST:8786"
        raise ValueError(f"--scheduler: expected {known}, found {scheduler!r}")


def _package(name: str) -> ModuleType:
    """A package of the extra `cluster`, or a module of one, imported without changing the handler of Ctrl-C.

    Raises:
        MissingExtra: it is not installed.
    """
    handler = signal.getsignal(signal.SIGINT)
    module = extras.load(name, "cluster", "--executor dask")
    if signal.getsignal(signal.SIGINT) is not handler:  # dask-jobqueue replaces it on import
        signal.signal(signal.SIGINT, handler)
    return module
