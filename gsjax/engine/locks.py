"""Locks that admit one writer at a time to a folder.

A writer locks a file in the folder, RUN/.gsjax.lock, with `flock`. The system releases the lock when the
process ends, however it ends: the folder of a killed run is free for the next writer, and a reused process id
misleads nobody. Network file systems with locks (NFS 4, SMB, Lustre mounted with `flock`) share them between
machines. Where a file system has none, the writers listed in the file count as holders: those on this machine
as long as their processes live, and those on other machines until the file is removed.

Commands that only add to a run, such as a query, share its lock: they keep out a run that would replace it,
but not each other.
"""

import atexit
import errno
import json
import os
import random
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from dataclasses import asdict, astuple, dataclass, field, replace
from pathlib import Path

from gsjax.io.brief import brief
from gsjax.io.parsed import parse_json

try:
    import fcntl
except ImportError:  # Windows: the list of writers decides
    fcntl = None

LOCK = ".gsjax.lock"
"""A folder's lock file: present while a process writes into the folder, and after a writer was killed."""
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL)
_ATTEMPTS, _BETWEEN_S = 5, 0.1
_MOST_BYTES = 2**16  # of a list of writers
_QUOTED = 80  # characters of a name or a time from it


@dataclass(frozen=True)
class Writer:
    """A process that writes into a folder, as listed in the lock file.

    Attributes:
        pid: its process id.
        host: the name of its machine.
        since: the local time at which it began.
        shared: whether others may write at the same time.
    """

    pid: int = field(default_factory=os.getpid)
    host: str = field(default_factory=socket.gethostname)
    since: str = field(default_factory=lambda: time.strftime("%Y-%m-%d %H:%M:%S"))
    shared: bool = False

    def __str__(self) -> str:
        where = "" if self.host == socket.gethostname() else f" on {brief(self.host, _QUOTED)}"
        return f"process {self.pid}{where}, which has been writing there since {brief(self.since, _QUOTED)}"

    @property
    def may_live(self) -> bool:
        """Whether the process may still be alive; True if that cannot be checked, as on another machine."""
        if self.host != socket.gethostname() or os.name != "posix":
            return True
        try:
            os.kill(self.pid, 0)
        except (ProcessLookupError, OverflowError):
            return False
        except OSError:  # it is another user's
            pass
        return True


@dataclass
class _Held:
    """A lock that this process has taken `times` times: its open file, and the folders created for it."""

    file: int
    made: list[Path]
    writer: Writer
    times: int = 0


_held: dict[Path, _Held] = {}
_of_process = ExitStack()
atexit.register(_of_process.close)
_scope: ContextVar[ExitStack] = ContextVar("the locks of a command", default=_of_process)


@contextmanager
def releasing_locks() -> Iterator[None]:
    """Release what `lock` locks in the block when the block ends; also a decorator."""
    with ExitStack() as stack:
        token = _scope.set(stack)
        try:
            yield
        finally:
            _scope.reset(token)


def lock(folder: Path, *, shared: bool = False) -> None:
    """Lock a folder until the end of the `releasing_locks` block or, outside one, of the process.

    Args, raises: as for `locked`.
    """
    _scope.get().enter_context(locked(folder, shared=shared))


def share(folder: Path) -> None:
    """Share a folder that this process has locked. Those who add to it may then write too; those who want it
    for themselves are still refused.

    Args:
        folder: the folder.

    Raises:
        BlockingIOError: another process locked it meanwhile, since a lock is released before it is shared.
    """
    path = folder.resolve() / LOCK
    held = _held[path]
    held.writer = replace(held.writer, shared=True)
    _claim(held.file, folder, path, held.writer)


@contextmanager
def locked(folder: Path, part: str = "", *, shared: bool = False) -> Iterator[None]:
    """Lock a folder, or a part of it, while the block runs. A process may take the same lock twice.

    Args:
        folder: the folder. It is created if missing, and removed again if it is still empty at the end.
        part: the part of the folder (default: all of it). Each part has its own lock.
        shared: whether other processes may share the lock. Then a folder without write access is no error,
            and is not locked.

    Raises:
        BlockingIOError: another process has locked it; the message says which, and since when.
        NotADirectoryError: it is a file.
        OSError: the folder cannot be made or written.
    """
    if folder.exists() and not folder.is_dir():
        raise NotADirectoryError(f"{folder}: expected a folder, found a file; name another folder")
    path = folder.resolve() / (f".{part}{LOCK}" if part else LOCK)
    held = _held.get(path)
    if held is None:
        held = _open_and_claim(folder, path, shared)
    elif held.writer.shared and not shared:
        alone = replace(held.writer, shared=False)
        try:
            _claim(held.file, folder, path, alone)
        except BlockingIOError:
            _flock(held.file, shared=True)  # the failed upgrade has released the shared lock
            raise
        held.writer = alone
    if held is not None:
        held.times += 1
    try:
        yield
    finally:
        if held is not None:
            held.times -= 1
            if not held.times:
                del _held[path]
                _release(path, held)


def _open_and_claim(folder: Path, path: Path, shared: bool) -> _Held | None:
    """Acquire the lock for this process; None if a shared one cannot be written."""
    writer, made = Writer(shared=shared), []
    while True:
        made += [place for place in path.parents if not place.exists()]
        try:
            file = _opened(folder, path)
        except OSError:
            if shared:
                return None
            raise
        try:
            if _claim(file, folder, path, writer):
                break
        except BaseException:
            os.close(file)
            raise
        os.close(file)  # its previous holder has removed the file meanwhile
    _held[path] = _Held(file, made, writer)
    return _held[path]


def _claim(file: int, folder: Path, path: Path, writer: Writer) -> bool:
    """Lock an open file, and list its writer there; returns False if it is no longer the one at the path.

    Raises:
        BlockingIOError: others have locked it.
    """
    sure = _acquire(file, folder, path, writer)
    if not _is_at(file, path):
        return False
    _enter(file, writer)
    if not sure:  # of two that began at once, the one that listed itself last wins
        time.sleep(_BETWEEN_S * (1 + random.random()))
        _acquire(file, folder, path, writer)
        _enter(file, writer)
    return True


def _opened(folder: Path, path: Path) -> int:
    """Open the file of a lock, creating it if necessary."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise type(error)(f"{folder}: cannot make this folder ({error.strerror})") from error
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise type(error)(
            f"{folder}: cannot write into this folder ({error.strerror}); name another"
        ) from error


def _acquire(file: int, folder: Path, path: Path, writer: Writer) -> bool:
    """Lock an open file; returns whether the file system has locks, so that the outcome is certain.

    Raises:
        BlockingIOError: others have locked it.
    """
    for attempt in range(_ATTEMPTS):
        free = _flock(file, writer.shared)
        others = _others(file, writer)
        if free or (free is None and not any(not (writer.shared and one.shared) for one in others)):
            return free is not None
        if others:
            break
        time.sleep(_BETWEEN_S * (attempt + 1 < _ATTEMPTS))  # the holder is not listed yet, or is ending
    who = str(others[-1]) if others else "another process, which writes there"
    gone = "" if free is not None else f"; if it is gone, remove {path}"
    raise BlockingIOError(
        f"{folder}: expected a folder into which no other process writes, found {who}; wait until it ends, "
        f"stop it, or name another folder{gone}"
    )


def _flock(file: int, shared: bool) -> bool | None:
    """Lock an open file; returns whether that succeeded, or None where the file system has no locks."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in _NO_LOCKS:
            return None
        if error.errno in (errno.EACCES, errno.EAGAIN):
            return False
        raise
    return True


def _is_at(file: int, path: Path) -> bool:
    """Whether an open file is the one at a path."""
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(file), os.stat(path))
    return False


def _others(file: int, writer: Writer) -> list[Writer]:
    """The other writers that an open file lists and that may live; what cannot be read is left out."""
    os.lseek(file, 0, os.SEEK_SET)
    own, found = (writer.pid, writer.host), []
    for line in os.read(file, _MOST_BYTES).splitlines():
        with suppress(ValueError, TypeError):
            other = _listed(line)
            if (other.pid, other.host) != own and other.may_live:
                found.append(other)
    return found


def _listed(line: bytes) -> Writer:
    """The writer in a line of the list; raises ValueError or TypeError if no writer wrote the line."""
    writer = Writer(**parse_json(line))
    if [type(value) for value in astuple(writer)] != [int, str, str, bool] or writer.pid < 1:
        raise ValueError("another value")
    return writer


def _enter(file: int, writer: Writer) -> None:
    """List a writer, along with those that share the lock with it."""
    _list_writers(file, [*(_others(file, writer) if writer.shared else []), writer])


def _list_writers(file: int, writers: list[Writer]) -> None:
    lines = "".join(json.dumps(asdict(writer)) + "\n" for writer in writers)
    with suppress(OSError):  # a full disk; the lock holds all the same
        os.ftruncate(file, 0)
        os.lseek(file, 0, os.SEEK_SET)
        os.write(file, lines.encode())


def _release(path: Path, held: _Held) -> None:
    """Release a lock; its file is removed unless others share it."""
    with suppress(OSError):  # the file system may be gone
        others = _others(held.file, held.writer)
        alone = _flock(held.file, shared=False)  # so that nobody joins before the file is removed
        if alone or (alone is None and not others):
            if _is_at(held.file, path):
                path.unlink()
        else:
            _list_writers(held.file, others)
    os.close(held.file)
    for place in held.made:
        with suppress(OSError):  # something was written into it
            place.rmdir()
