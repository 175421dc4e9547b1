"""The machine: a description for results (without its host name), its memory, and the cores to use."""

import os
import platform
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax

from gsjax.engine.messages import counted
from gsjax.engine.messages import describe as describe_error
from gsjax.optim.compiler import has_avx512

_ASKED = ("JAX_PLATFORMS", "JAX_PLATFORM_NAME")  # environment variables that name a backend


def describe() -> dict[str, Any]:
    """The processor, the number of cores that this process may use, JAX's devices, and versions."""
    devices, cpuinfo = jax.devices(), Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    processor = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "")
    return {
        "processor": processor or platform.processor() or platform.machine(),
        "cores": usable_cores(),
        "avx512": has_avx512(),
        "device": devices[0].device_kind,
        "devices": len(devices),
        "jax": jax.__version__,
        "python": platform.python_version(),
    }


def compute_on_host() -> None:
    """Make JAX use only the CPU, whatever the environment asks for. Call it before JAX computes anything."""
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_platform_name", "cpu")


def missing_device() -> str | None:
    """Why JAX has no device to compute on, and what to do, in a sentence; None if it has one."""
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # from JAX, if the backend is missing or has no device
        asked = next((f"{name}={value}" for name in _ASKED if (value := os.environ.get(name))), "JAX")
        why = f" ({describe_error(error)})" if str(error) else ""
        return (
            f"{asked}: expected a backend with a device on this machine, found none{why}; leave it out, or "
            "set JAX_PLATFORMS=cpu"
        )
    return None


def usable_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def keep_to_cores(count: int | None) -> None:
    """Restrict this process to the last `count` of the cores that it may use; None changes nothing.

    XLA starts a thread for each core that it finds, so call it before JAX computes anything. Existing threads
    are restricted too.

    Raises:
        ValueError: there are fewer cores, or the system does not let a process choose its own.
    """
    if count is None:
        return
    if not hasattr(os, "sched_setaffinity"):
        raise ValueError(
            f"--cores {count}: {platform.system()} does not let a process choose its cores; leave it out"
        )
    allowed = sorted(os.sched_getaffinity(0))
    if not 1 <= count <= len(allowed):
        most = "1 core" if len(allowed) == 1 else f"1 to {len(allowed)} cores"
        raise ValueError(f"--cores: expected {most}, which this process may use, found {count}")
    keep_to(allowed[-count:])


def keep_to(cores: Iterable[int]) -> None:
    """Restrict this process, and its existing threads, to the cores with these numbers."""
    tasks = Path("/proc/self/task")
    for thread in [int(task.name) for task in tasks.iterdir()] if tasks.is_dir() else [0]:
        with suppress(ProcessLookupError):  # it has ended meanwhile
            os.sched_setaffinity(thread, cores)


def resident_mb() -> float:
    """Resident memory of this process, MB; its peak on systems that report only that."""
    return _size_mb("/proc/self/status", "VmRSS") or _largest_mb()


def peak_memory_mb() -> dict[str, float | None]:
    """The peak memory of this process, and of JAX on the first device, MB; None if the device does not report
    it (a CPU, whose memory is the process's)."""
    on_device = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use")
    return {
        "process": _size_mb("/proc/self/status", "VmHWM") or _largest_mb(),
        "device": None if on_device is None else on_device / 1e6,
    }


def available_mb() -> float:
    """Memory that is still available, MB; infinity if the system does not report it."""
    return _size_mb("/proc/meminfo", "MemAvailable") or float("inf")


def _size_mb(file: str, name: str) -> float | None:
    """A size from a file in Linux's /proc, MB; None if it is not there."""
    lines = Path(file).read_text().splitlines() if Path(file).exists() else []
    return next((int(line.split()[1]) / 1e3 for line in lines if line.startswith(f"{name}:")), None)


def _largest_mb() -> float:
    """The peak memory of this process as POSIX reports it, MB."""
    import resource

    unit = 1e6 if platform.system() == "Darwin" else 1e3  # macOS counts bytes
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def name(machine: dict[str, Any]) -> str:
    """Processor, cores and device, which two runs must share for their times to be comparable."""
    device = "" if machine["device"] == "cpu" else f", {machine['device']}"
    return f"{machine['processor']}, {counted(machine['cores'], 'core')}{device}"


def in_words(machine: Mapping[str, Any]) -> str:
    """The description in one line."""
    extra = ", AVX-512" if machine["avx512"] else ""
    devices = f"{machine['devices']} x " if machine["devices"] > 1 else ""
    versions = f"JAX {machine['jax']}, Python {machine['python']}, {devices}{machine['device']}"
    return f"{machine['processor']}, {counted(machine['cores'], 'core')}{extra}; {versions}"
