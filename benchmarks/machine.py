"""What a result was measured on."""

import os
import platform
from pathlib import Path

import jax


def _cpuinfo(key: str) -> str:
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith(key)), "")


def has_avx512() -> bool:
    return "avx512f" in _cpuinfo("flags").split()


def describe() -> dict[str, str]:
    """Processor, cores, device, and versions."""
    return {
        "cpu": _cpuinfo("model name") or platform.processor() or platform.machine(),
        "cores": str(os.cpu_count()),
        "avx512": "yes" if has_avx512() else "no",
        "device": jax.devices()[0].device_kind,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "jax": jax.__version__,
    }


def name() -> str:
    """What two runs must share for their milliseconds to be compared: processor, cores and device."""
    d = describe()
    device = "" if d["device"] == "cpu" else f", {d['device']}"
    return f"{d['cpu']}, {d['cores']} cores{device}"


def in_words() -> str:
    d = describe()
    extra = ", AVX-512" if d["avx512"] == "yes" else ""
    return f"{d['cpu']}, {d['cores']} cores{extra}; JAX {d['jax']}, Python {d['python']}, {d['device']}"
