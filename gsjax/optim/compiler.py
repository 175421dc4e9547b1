"""Faster programs on the host: compiler options, memory reuse, and a cache of compiled programs."""

import ctypes
import gc
import hashlib
import os
import platform
import threading
from collections.abc import Callable
from functools import cache, wraps
from pathlib import Path
from tempfile import TemporaryFile
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gsjax.io.cache import user_cache


@cache
def host_options() -> dict[str, Any]:
    """Compiler options that make compositing fast on this machine: the full vector width with AVX-512.

    Use it as `jax.jit(f, compiler_options=host_options())`, or with `.lower(...).compile(host_options())`,
    and only for the outermost jit of a host loop: inside another trace, compiler options raise an error.
    """
    wide = jax.default_backend() == "cpu" and has_avx512()
    return {"xla_cpu_prefer_vector_width": 512} if wide else {}


def host_jit(function: Callable, **options: Any) -> Callable:
    """`jax.jit` with `host_options`, which are read at the first call: reading them on import would start
    JAX's backend, which can then no longer be configured (`jax.distributed.initialize`).

    Args:
        function: the function to compile, at the top level of a module.
        options: of `jax.jit`.
    """
    jitted = cache(lambda: jax.jit(function, compiler_options=host_options(), **options))
    return wraps(function)(lambda *args, **kwargs: jitted()(*args, **kwargs))


def in_memory(arrays: Any, finite: Float[Array, "*n"]) -> Any:
    """`arrays`, computed and stored before anything reads them. Use it for arrays that are read repeatedly.

    XLA:CPU fuses a computation into its consumers and repeats it for every number they read: the position of
    a pixel for each of its channels, and again for those of its three neighbours. It drops
    `jax.lax.optimization_barrier` before fusion; a branch is a barrier that it keeps.

    Args:
        arrays: a pytree.
        finite: numbers that are finite, which the compiler cannot know; they must not depend on an axis that
            is mapped over. If the first is not finite, floating arrays are returned as NaN, others as 0.
    """
    if jax.default_backend() != "cpu":
        return arrays
    true = jnp.isfinite(finite.ravel()[0])

    def nothing(array):
        return jnp.full_like(array, jnp.nan if jnp.issubdtype(array.dtype, jnp.inexact) else 0)

    return jax.lax.cond(true, lambda: arrays, lambda: jax.tree.map(nothing, arrays))


_compiling = threading.local()


def compile_seconds() -> float:
    """Seconds that this thread has spent tracing and compiling since the first call of this function. As with
    `time.perf_counter`, only the difference between two readings is meaningful."""
    _listen()
    return getattr(_compiling, "seconds", 0.0)


@cache
def _listen() -> None:
    def add(event: str, seconds: float, **_: Any) -> None:
        if event.startswith("/jax/core/compile/"):
            end = perf_counter()
            spans = _compiling.__dict__.setdefault("spans", [])
            inner = 0.0
            while spans and spans[-1][0] >= end - seconds:  # one program traced within another counts once
                inner += spans.pop()[1]
            spans.append((end - seconds, seconds))
            _compiling.seconds = getattr(_compiling, "seconds", 0.0) + seconds - inner

    jax.monitoring.register_event_duration_secs_listener(add)


def has_avx512() -> bool:
    """Whether this machine's processor has 512-bit registers; False if unknown."""
    cpuinfo = Path("/proc/cpuinfo")
    return cpuinfo.exists() and "avx512f" in cpuinfo.read_text()


def forget_programs(most_maps: int = 30_000) -> bool:
    """Drop all compiled programs if this process has over `most_maps` memory maps; returns whether it did.

    Each program takes some. Linux allows 65,530 per process, beyond which compiling fails ("Cannot allocate
    memory") even with free memory. Call this when one process runs many jobs for hours.
    """
    maps = Path("/proc/self/maps")
    if not maps.exists() or maps.read_bytes().count(b"\n") <= most_maps:
        return False
    jax.clear_caches()
    gc.collect()  # programs are in cycles
    return True


_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # from glibc's malloc.h
_KEPT = 2**30  # bytes: the largest reusable array, and the most freed memory that is kept


def keep_freed_memory() -> bool:
    """Make this process keep up to 1 GiB of freed memory for reuse, which saves a fifth of a forward call.

    XLA:CPU allocates a program's temporary arrays in every call. glibc requests large ones from the kernel
    and returns them each time, so all their pages are zeroed and faulted in again: 9,500 faults, 10 ms, for
    110,000 Gaussians at 648x420. This function raises glibc's thresholds. Threads keep separate heaps: with a
    single heap, fragments left by the compiler slow down every later allocation (by a third of a tracker's
    update). The setting applies to the whole process except to threads that already exist: call it once,
    before JAX computes anything. The command line does. MALLOC_MMAP_THRESHOLD_ and MALLOC_TRIM_THRESHOLD_ in
    the environment have the same effect.

    Returns:
        Whether the thresholds were set: False if the C library is not glibc 2.35 or later; nothing is changed
        then.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return False
    if not mallopt(_MMAP_THRESHOLD, _KEPT):  # older versions refuse it, and the other alone would do harm
        return False
    return bool(mallopt(_TRIM_THRESHOLD, _KEPT))


TRACES = "traces"
"""Folder beside the compiled programs for what `gsjax.optim.traces` keeps."""
_MOST_BYTES, _WORTH_S = 2**30, 0.0  # size of the cache on disk; least compile time of a program that is kept


def keep_programs(folder: str | Path | None = None) -> Path | None:
    """Make JAX cache compiled programs on disk, up to 1 GiB, so that the next process can reuse them. The
    command line does this: what would compile for a minute starts in seconds. Call it before JAX computes
    anything.

    Programs contain instructions that another processor may lack, and are partitioned for the number of cores
    at hand, so each kind of machine has its own folder. Incomplete files left by a full disk or a kill are
    removed.

    Args:
        folder: where to cache (default: the user's cache folder).

    Returns:
        The folder of the cache; None, with nothing changed, if JAX is already configured
        (`JAX_COMPILATION_CACHE_DIR`, or `JAX_ENABLE_COMPILATION_CACHE=0` for no cache) or the folder is not
        writable, or the user has no home.
    """
    if jax.config.jax_compilation_cache_dir is not None or not jax.config.jax_enable_compilation_cache:
        return None
    root = user_cache() if folder is None else Path(folder)
    if root is None:
        return None
    kind = hashlib.sha256(_processor().encode()).hexdigest()[:8]
    try:
        place = root / f"programs-jax-{jax.__version__}-{kind}"
        (place / TRACES).mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=place):
            pass
        for program in place.glob("*-cache"):  # JAX writes the access time afterwards, and needs both files
            if not program.with_name(program.name.removesuffix("cache") + "atime").exists():
                program.unlink(missing_ok=True)
    except OSError:
        return None
    jax.config.update("jax_compilation_cache_dir", str(place))
    jax.config.update("jax_compilation_cache_max_size", _MOST_BYTES)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _WORTH_S)
    return place


def _processor() -> str:
    """A text that identifies the processor's instruction set and the number of usable cores."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    marks = sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))})
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return "\n".join([platform.machine(), platform.processor(), f"{cores}", *marks])
