"""What makes the same program faster on the host: compiler options, and what is kept: memory, programs."""

import ctypes
import hashlib
import os
import platform
import threading
from functools import cache
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from platformdirs import user_cache_dir


@cache
def host_options() -> dict[str, Any]:
    """What makes compositing fast on this machine: the full vector width where the CPU has AVX-512.

    Use it as `jax.jit(f, compiler_options=host_options())`, or with `.lower(...).compile(host_options())`,
    and for the outermost jit of a host loop only: inside another trace, options raise.
    """
    wide = jax.default_backend() == "cpu" and has_avx512()
    return {"xla_cpu_prefer_vector_width": 512} if wide else {}


def in_memory(arrays: Any, finite: Float[Array, "*n"]) -> Any:
    """`arrays`, worked out before anything reads them. It is for what is read more than once.

    XLA:CPU fuses what is worked out with the reading, and works it out again for every number read: the place
    of a pixel for each of its channels, and of those of its three neighbours. It drops
    `jax.lax.optimization_barrier` before it fuses; a branch is a barrier that it keeps.

    Args:
        arrays: a pytree.
        finite: numbers that are, which the compiler cannot know; of no axis that is mapped over. Where the
            first is not, nor is what comes back, as far as it can be.
    """
    if jax.default_backend() != "cpu":
        return arrays
    true = jnp.isfinite(finite.ravel()[0])

    def nothing(array):
        return jnp.full_like(array, jnp.nan if jnp.issubdtype(array.dtype, jnp.inexact) else 0)

    return jax.lax.cond(true, lambda: arrays, lambda: jax.tree.map(nothing, arrays))


_compiling = threading.local()


def compile_seconds() -> float:
    """Seconds that this thread has spent tracing and compiling since the first call of this function. Like
    `time.perf_counter`, only the difference between two readings has a meaning."""
    _listen()
    return getattr(_compiling, "seconds", 0.0)


@cache
def _listen() -> None:
    def add(event: str, seconds: float, **_: Any) -> None:
        if event.startswith("/jax/core/compile/"):
            _compiling.seconds = getattr(_compiling, "seconds", 0.0) + seconds

    jax.monitoring.register_event_duration_secs_listener(add)


def has_avx512() -> bool:
    """Whether this machine's processor has registers of 512 bits; False where that is not known."""
    cpuinfo = Path("/proc/cpuinfo")
    return cpuinfo.exists() and "avx512f" in cpuinfo.read_text()


def forget_programs(most_maps: int = 30_000) -> bool:
    """Drop all compiled programs if this process has more memory maps than that; whether it did.

    Each program takes some. Linux allows a process 65,530, and then compiling fails ("Cannot allocate
    memory") with all memory free: for who runs one job after the other for hours in one process.
    """
    maps = Path("/proc/self/maps")
    if not maps.exists() or maps.read_bytes().count(b"\n") <= most_maps:
        return False
    jax.clear_caches()
    return True


_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
_KEPT = 2**30  # bytes: the largest array, and how much freed memory


def keep_freed_memory() -> bool:
    """Have this process keep up to 1 GiB of memory that it has freed, which saves a fifth of a forward call.

    XLA:CPU allocates a program's temporary arrays anew in every call. glibc takes large ones from the kernel
    and hands them back each time, so every page of them is zeroed and faulted in again: 9,500 faults, 10 ms,
    for 110,000 Gaussians at 648x420. This raises its thresholds. Threads keep heaps of their own: in one for
    all, what a compiler leaves behind makes every later allocation longer (a third of a tracker's update).
    It holds for the whole process, but for threads that are there already: call it once, before JAX computes
    anything. The command line does. MALLOC_MMAP_THRESHOLD_ and MALLOC_TRIM_THRESHOLD_ in the environment do
    the same.

    Returns:
        whether it could: False where the C library is not glibc of 2.35 or later, and nothing is changed.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return False
    if not mallopt(_MMAP_THRESHOLD, _KEPT):  # older ones refuse that, and the rest alone would do harm
        return False
    return bool(mallopt(_TRIM_THRESHOLD, _KEPT))


_MOST_BYTES, _WORTH_S = 2**30, 0.3  # of programs on disk; what compiles faster is not kept


def keep_programs(folder: str | Path | None = None) -> Path | None:
    """Have JAX keep compiled programs on disk, up to 1 GiB, so that the next process finds them. The command
    line does: what would compile for a minute starts in seconds. Call it before JAX computes anything.

    Programs hold instructions that another processor may lack, and are split among as many cores as there
    were, so each kind has a folder of its own. What a full disk or a kill left of one is removed.

    Args:
        folder: where; the user's cache folder unless given.

    Returns:
        where they are kept; None, and nothing is changed, where JAX was told already
        (`JAX_COMPILATION_CACHE_DIR`, or `JAX_ENABLE_COMPILATION_CACHE=0` for none), or nothing can be
        written there.
    """
    if jax.config.jax_compilation_cache_dir is not None or not jax.config.jax_enable_compilation_cache:
        return None
    kind = hashlib.sha256(_processor().encode()).hexdigest()[:8]
    try:
        root = Path(folder) if folder is not None else Path(user_cache_dir("gsjax", appauthor=False))
        place = root / f"programs-jax-{jax.__version__}-{kind}"
        place.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=place):
            pass
        for program in place.glob("*-cache"):  # JAX writes when it was last used after it, and needs both
            if not program.with_name(program.name.removesuffix("cache") + "atime").exists():
                program.unlink(missing_ok=True)
    except (OSError, RuntimeError):  # the latter: a user without a home
        return None
    jax.config.update("jax_compilation_cache_dir", str(place))
    jax.config.update("jax_compilation_cache_max_size", _MOST_BYTES)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _WORTH_S)
    return place


def _processor() -> str:
    """What tells processors with different instructions apart, and how many cores of it may be used."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    marks = sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))})
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return "\n".join([platform.machine(), platform.processor(), f"{cores}", *marks])
