"""Whether the processor that numba compiles for can run the compiled kernels."""

from __future__ import annotations

import platform

from llvmlite import binding
from numba.core import config

_X86 = ("x86_64", "AMD64", "i386", "i686")


def check_processor() -> None:
    """Raise ImportError if the compiler would leave conversions of halves to a library that it does not bring.

    Processors for x86 have them since about 2012 (F16C), but for small ones that were built for years after; ARM's 64-bit
    ones all have them. Without this check the first call would end the process.
    """
    if platform.machine() not in _X86:
        return
    chosen = config.CPU_FEATURES  # NUMBA_CPU_FEATURES; None leaves it to the processor.
    has_halves = binding.get_host_cpu_features().get("f16c", False) if chosen is None else "+f16c" in chosen
    if not has_halves:
        raise ImportError("the processor that numba compiles for has no conversions of half-precision numbers (F16C)")
