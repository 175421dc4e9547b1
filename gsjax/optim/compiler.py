"""Compiler options, for the outermost jit of a host loop only: inside another trace they raise."""

from functools import cache
from pathlib import Path
from typing import Any

import jax


@cache
def host_options() -> dict[str, Any]:
    """What makes compositing fast on this machine: the full vector width where the CPU has AVX-512.

    Use it as `jax.jit(f, compiler_options=host_options())`, or with `.lower(...).compile(host_options())`.
    """
    if jax.default_backend() != "cpu":
        return {}
    cpuinfo = Path("/proc/cpuinfo")
    has_avx512 = cpuinfo.exists() and "avx512f" in cpuinfo.read_text()
    return {"xla_cpu_prefer_vector_width": 512} if has_avx512 else {}
