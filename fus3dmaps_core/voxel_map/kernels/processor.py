"""A check of the processor that numba compiles for."""

from __future__ import annotations

import platform

from llvmlite import binding
from numba.core import config

_X86 = ("x86_64", "AMD64", "i386", "i686")


def check_processor() -> None:
    """Check that the processor can convert half-precision numbers.

    Otherwise the compiler would call a library that it does not bring, and the first call would end the process. x86
    processors have these instructions (F16C) since about 2012, except small ones, which were built without for some years
    more. All 64-bit ARM processors have them.

    Raises:
        ImportError: It cannot.
    """
    if platform.machine() not in _X86:
        return
    chosen = config.CPU_FEATURES  # NUMBA_CPU_FEATURES; None leaves it to the processor.
    has_halves = binding.get_host_cpu_features().get("f16c", False) if chosen is None else "+f16c" in chosen
    if not has_halves:
        raise ImportError("the processor that numba compiles for has no conversions of half-precision numbers (F16C)")
