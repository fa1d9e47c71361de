"""A cache for compiled loops that is never out of date and never in the way.

numba's own cache notices changes of a loop's own file only, and fails where it finds no folder to write to or a file that is
damaged. This one depends on the content of all files that the loops are made of. Whatever goes wrong with it, the loop is
compiled.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import pickle
import platform
import sys
from collections.abc import Callable
from functools import cache
from typing import Any

import llvmlite
import numba
import numpy as np
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps

from fus3dmaps_core.voxel_map.kernels import cache_folders
from fus3dmaps_core.voxel_map.kernels.loop_sources import source_digest

_LOG = logging.getLogger(__name__)
_CHECKSUM_BYTES = hashlib.sha256().digest_size

with contextlib.suppress(OSError):
    source_digest()  # Now, when the loops are imported: files that change later are not what this process compiles.


def njit(*, cache: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return numba's decorator ``njit``; with ``cache``, machine code is kept as this module describes."""

    def decorate(function: Callable[..., Any]) -> Any:
        loop = numba.njit(**options)(function)
        if cache:
            loop._cache = LoopCache(function)
        return loop

    return decorate


class LoopCache(NullCache):  # type: ignore[misc]
    """Machine code of one loop: a file for each signature and processor, named by both."""

    def __init__(self, function: Callable[..., Any]) -> None:
        """Only remember the loop; folders are looked for at its first call."""
        self._name = f"{function.__module__.rpartition('.')[2]}.{function.__qualname__}"

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return the compiled loop for a signature, or None where no folder has it undamaged."""
        target.refresh()
        name = self._file_name(signature, target.codegen())
        for folder in _folders():
            try:
                content = (folder / name).read_bytes()
                if not cache_folders.is_safe(folder):
                    continue
            except OSError:
                continue
            checksum, code = content[:_CHECKSUM_BYTES], content[_CHECKSUM_BYTES:]
            # Without the checksum, a file that lost bytes when the power went could end the process.
            if hashlib.sha256(code).digest() != checksum:
                continue
            try:
                # Machine code is code, in whatever form: the folder's owner is what makes it trustworthy.
                return CompileResult._rebuild(target, *pickle.loads(code))  # noqa: S301  (our own, in a safe folder)
            except Exception as error:  # Whatever it is, a map that starts slowly is better than none.
                _LOG.warning("compiled loop '%s' cannot be loaded (%s) and is compiled anew", folder / name, error)
        return None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Keep a compiled loop in the first folder that takes it."""
        if result.library.has_dynamic_globals:  # Addresses of this process.
            return
        try:
            name, code = self._file_name(signature, result.codegen), dumps(result._reduce())
        except Exception as error:  # A later numba may keep its results in another way.
            _LOG.warning("compiled loop '%s' cannot be kept: %s", self._name, error)
            return
        for folder in _folders():
            try:
                cache_folders.make(folder)
                cache_folders.write(folder / name, hashlib.sha256(code).digest() + code)
                return
            except OSError:
                continue
        _warn_once()

    def _file_name(self, signature: Any, codegen: Any) -> str:
        key = repr((signature, codegen.magic_tuple()))
        return f"{self._name}-{hashlib.sha256(key.encode()).hexdigest()[:24]}.bin"


@cache
def _folders() -> tuple[Any, ...]:
    try:
        sources = source_digest()
    except OSError:  # Installed without its source.
        return ()
    versions = (numba.__version__, llvmlite.__version__, np.__version__, sys.implementation.cache_tag, platform.machine())
    key = hashlib.sha256(repr((sources, versions)).encode()).hexdigest()[:24]
    return tuple(cache_folders.folders(key, numba.config.CACHE_DIR))


@cache
def _warn_once() -> None:
    _LOG.warning(
        "no folder was found for compiled loops, so every start takes some fifteen seconds longer; set NUMBA_CACHE_DIR to a"
        " folder that you, and nobody else, can write to"
    )
