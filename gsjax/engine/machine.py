"""The machine: what a result was made on (no name that someone gave it), and which cores to keep to."""

import os
import platform
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax

from gsjax.optim.compiler import has_avx512


def describe() -> dict[str, Any]:
    """Processor and the cores that this process may use, JAX's devices, and versions."""
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


def usable_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def keep_to_cores(count: int | None) -> None:
    """Have this process run on `count` of the cores that it may use, the last of them; None changes nothing.

    XLA starts a thread for each core that it finds, so call it before JAX computes anything. Threads that
    there are already are kept to them too.

    Raises:
        ValueError: there are fewer, or this system does not let a process choose.
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
        raise ValueError(f"--cores: expected {most}, which is what this process may use, found {count}")
    keep_to(allowed[-count:])


def keep_to(cores: Iterable[int]) -> None:
    """Have this process run on these cores, by their numbers; threads that there are already too."""
    tasks = Path("/proc/self/task")
    for thread in [int(task.name) for task in tasks.iterdir()] if tasks.is_dir() else [0]:
        with suppress(ProcessLookupError):  # it has ended meanwhile
            os.sched_setaffinity(thread, cores)


def resident_mb() -> float:
    """Memory that this process holds now, MB; the most it ever held where the system tells only that."""
    status = Path("/proc/self/status")
    if status.exists():
        kilobytes = next(
            line for line in status.read_text().splitlines() if line.startswith("VmRSS")
        ).split()[1]
        return int(kilobytes) / 1e3
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6  # macOS counts bytes


def peak_memory_mb() -> dict[str, float | None]:
    """The most memory that this process ever held, and that JAX ever held on the first device, MB; None where
    the device does not tell (a CPU, whose memory is the process's)."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    peak = next((int(line.split()[1]) / 1e3 for line in lines if line.startswith("VmHWM")), None)
    if peak is None:
        import resource

        unit = 1e6 if platform.system() == "Darwin" else 1e3
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
    on_device = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use")
    return {"process": peak, "device": None if on_device is None else on_device / 1e6}


def available_mb() -> float:
    """Memory that a program may still take, MB; infinity where the system does not tell."""
    meminfo = Path("/proc/meminfo")
    if not meminfo.exists():
        return float("inf")
    fields = dict(line.split(":") for line in meminfo.read_text().splitlines())
    return int(fields["MemAvailable"].split()[0]) / 1e3


def name(machine: dict[str, Any]) -> str:
    """What two runs must share for their milliseconds to be compared: processor, cores and device."""
    device = "" if machine["device"] == "cpu" else f", {machine['device']}"
    return f"{machine['processor']}, {_cores(machine)}{device}"


def in_words(machine: dict[str, Any]) -> str:
    """On one line, for people."""
    extra = ", AVX-512" if machine["avx512"] else ""
    devices = f"{machine['devices']} x " if machine["devices"] > 1 else ""
    versions = f"JAX {machine['jax']}, Python {machine['python']}, {devices}{machine['device']}"
    return f"{machine['processor']}, {_cores(machine)}{extra}; {versions}"


def _cores(machine: dict[str, Any]) -> str:
    return "1 core" if machine["cores"] == 1 else f"{machine['cores']} cores"
