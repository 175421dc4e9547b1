"""A cache of traces on disk, beside the compiled programs, so that the next process need not trace again."""

import hashlib
import json
import os
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import time
from types import FunctionType
from typing import Any

import jax
import jax.export
import numpy as np

from gsjax.io.checkpoints import encode, load_checkpoint, save_checkpoint
from gsjax.optim.compiler import TRACES
from gsjax.rasterize.sorting import CUSTOM_CALLS

_MOST_FILES = 200  # half a megabyte each
_TRACED_THROUGH = ("jax", "jaxlib", "equinox", "jaxlie", "lineax", "optax", "optimistix", "jaxopt")
_PACKAGE = "gsjax"  # the package whose sources are known; functions of others are never kept
_VAGUE = re.compile(r" at 0x|\.\.\.")  # in the text of a tree: an address, or an omission
_BEGUN = time()


def jit_once(fun: Callable, closed_over: Any, **options: Any) -> Callable:
    """`jax.jit(fun, **options)`, traced once for all processes if `keep_programs` keeps compiled programs.

    JAX caches what XLA compiles, but every process traces again to find it: an update of the tracker takes
    5 s to trace, and 0.2 s to read. The key of a trace consists of the trees, shapes and types of the
    arguments, `closed_over`, the sources of gsjax, the versions of its libraries, and JAX's configuration.

    Use it only for an outermost `jax.jit`: a stored trace can be neither differentiated nor vmapped. On
    anything but a single CPU device, and where a trace cannot be kept, `fun` is traced as usual.

    Args:
        fun: a pure function of pytrees of arrays, without keyword arguments.
        closed_over: all static values that `fun` closes over: a module-level function of gsjax, or what
            `save_checkpoint` takes, without arrays. With anything else, nothing is kept.
        options: those of `jax.jit`.
    """
    folder = jax.config.jax_compilation_cache_dir
    traces = None if folder is None else Path(folder) / TRACES
    if traces is None or not traces.is_dir() or jax.default_backend() != "cpu" or jax.device_count() > 1:
        return jax.jit(fun, **options)

    def traced(*args):
        leaves, tree = jax.tree.flatten(args)
        types = [jax.typeof(leaf) for leaf in leaves]
        specs = [jax.ShapeDtypeStruct(t.shape, t.dtype, weak_type=t.weak_type) for t in types]
        name = _name(fun, closed_over, f"{tree} {specs}")
        if name is None:
            return fun(*args)
        found = _read(traces / name) or _trace_and_save(traces / name, fun, tree, specs)
        if found is None:
            return fun(*args)
        program, out_tree = found
        return jax.tree.unflatten(out_tree, program.call(*leaves))

    traced.__name__ = fun.__name__
    # The results of such a program are committed to its device, and the next call takes them as inputs:
    # without shardings the program would be compiled a second time for those.
    here = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    return jax.jit(traced, in_shardings=here, out_shardings=here, **options)


def _name(fun: Callable, closed_over: Any, inputs: str) -> str | None:
    """The file name of a trace, or None if something that it depends on may differ in the next process."""
    static, sources = _described(closed_over), _sources()
    if static is None or sources is None or not _is_ours(fun) or _VAGUE.search(inputs):
        return None
    settings = sorted(f"{name}={value!r}" for name, value in jax.config.values.items())
    about = "\n".join((fun.__module__, fun.__qualname__, static, inputs, sources, *settings))
    return f"{hashlib.sha256(about.encode()).hexdigest()[:32]}.npz"


def _described(value: Any) -> str | None:
    """A static value as text that is equal only for equal values; None if it has no such text."""
    if isinstance(value, FunctionType):
        name = f"{value.__module__}.{value.__qualname__}"
        return name if _is_ours(value) and "<" not in name else None
    try:
        encoded, arrays = encode(value)
    except TypeError:
        return None
    return None if arrays else json.dumps(encoded)


def _is_ours(value: Any) -> bool:
    return value.__module__.split(".")[0] == _PACKAGE


@cache
def _sources() -> str | None:
    """A text that identifies the code that is traced: a hash of gsjax's sources, and versions of libraries;
    None if a source file changed since this process began, because it may run the old version."""
    digest, package = hashlib.sha256(), Path(__file__).resolve().parents[1]
    for file in sorted(package.rglob("*.py")):
        if file.stat().st_mtime > _BEGUN:
            return None
        digest.update(file.read_bytes())
    return " ".join((digest.hexdigest(), *map(_version, _TRACED_THROUGH)))


def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return "none"


def _read(path: Path) -> tuple[jax.export.Exported, Any] | None:
    """A trace and the tree of its results; None if there is none, or it is damaged."""
    if not path.exists():
        return None
    try:
        kept, _ = load_checkpoint(path)
        program = jax.export.deserialize(bytearray(kept["program"].tobytes()))
        os.utime(path)  # the least recently read are deleted first
    except (OSError, ValueError, KeyError, TypeError, ImportError):
        return None
    return program, jax.tree.structure(kept["results"])


def _trace_and_save(
    path: Path, fun: Callable, tree: Any, specs: Sequence[jax.ShapeDtypeStruct]
) -> tuple[jax.export.Exported, Any] | None:
    """Trace `fun`, write the trace to `path`, and return it as another process will read it; None if that is
    not possible."""
    results: list[Any] = []

    def flat(*leaves):
        results[:] = [fun(*jax.tree.unflatten(tree, leaves))]
        return jax.tree.leaves(results[0])

    checks = [jax.export.DisabledSafetyCheck.custom_call(name) for name in CUSTOM_CALLS]
    try:
        exported = jax.export.export(jax.jit(flat), disabled_checks=checks)(*specs)
        out_tree = jax.tree.structure(results.pop())
        numbered = jax.tree.unflatten(out_tree, [np.int32(i) for i in range(out_tree.num_leaves)])
        program = np.frombuffer(exported.serialize(), np.uint8)
        save_checkpoint(path, {"program": program, "results": numbered})
    except (OSError, ValueError, TypeError, ImportError, NotImplementedError):
        return None
    with suppress(OSError):  # another process may do the same
        newest = sorted(path.parent.glob("[!.]*.npz"), key=lambda file: -file.stat().st_mtime)
        for old in newest[_MOST_FILES:]:
            old.unlink(missing_ok=True)
    found = _read(path)
    if found is None or found[1] != out_tree:  # a static value does not survive the round trip
        path.unlink(missing_ok=True)
        return None
    return found
