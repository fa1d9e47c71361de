"""Files of a saved map: written so that they last, locked while they are written, and verified when they are read.

A save never changes a file that a manifest in place names. It adds files under names that hold their checksum, commits by
renaming the new manifest onto the old one, and only then removes what no manifest names any more.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from io import BufferedReader
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import StorageError
from fus3dmaps_core.saved_maps.manifest import DIGITS_IN_NAME, MANIFEST, NAME_PATTERN, ArrayFile, Manifest, read_manifest

LOCK = ".lock"
_TEMPORARY_SUFFIX = ".writing"
_ARRAY_NAME = rf"{NAME_PATTERN}\.[0-9a-f]{{{DIGITS_IN_NAME}}}\.npy"
_OWN_NAME = re.compile(
    rf"{re.escape(LOCK)}|{_ARRAY_NAME}|\.({_ARRAY_NAME}|{re.escape(MANIFEST)}){re.escape(_TEMPORARY_SUFFIX)}"
)


class _Digest:
    """A file that keeps only the checksum and the size of what is written to it."""

    def __init__(self) -> None:
        self.sha256 = hashlib.sha256()
        self.size_bytes = 0

    def write(self, data: bytes) -> int:
        self.sha256.update(data)
        self.size_bytes += len(data)
        return len(data)


class _Chunks:
    """A file that numpy hands its data to in pieces; given a real one, it would report a full disk without its cause."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def write(self, data: bytes) -> int:
        return self._file.write(data)


def is_own_name(name: str) -> bool:
    """Tell whether a file of this name, in a map's directory, is one that a save may have left."""
    return _OWN_NAME.fullmatch(name) is not None


@contextmanager
def writing_to(directory: Path) -> Iterator[None]:
    """Make the directory and hold its lock; before and after, remove array and temporary files that its manifest lacks.

    Where there is no manifest at the end, what was made is removed as well.

    Raises:
        StorageError: Another process or thread is saving to the directory.
        OSError: The directory cannot be made or locked.
    """
    missing = [path for path in (directory, *directory.parents) if not path.exists()]
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for path in missing:
            _sync(path.parent)
        with _locked(directory):
            remove_unnamed(directory)
            try:
                yield
            finally:
                remove_unnamed(directory)
                if not (directory / MANIFEST).exists():
                    (directory / LOCK).unlink(missing_ok=True)
    finally:
        for path in missing:
            with suppress(OSError):  # A directory that holds something stays, which is most often the map.
                path.rmdir()


def write_array(directory: Path, name: str, array: NDArray[Any]) -> ArrayFile:
    """Store an array under its checksum's name, unless the same file is there and intact.

    Memory beside the array is a piece of some megabytes. The file's name lasts once the directory is synced.

    Raises:
        OSError: The file cannot be written.
    """
    digest = _Digest()
    np.save(digest, array, allow_pickle=False)
    entry = ArrayFile(
        dtype=str(array.dtype), shape=array.shape, size_bytes=digest.size_bytes, sha256=digest.sha256.hexdigest()
    )
    path = directory / entry.file_name(name)
    if path.is_file() and _digest_of(path) == entry.sha256:
        return entry
    temporary = _temporary(path)
    with temporary.open("wb") as file:
        np.save(_Chunks(file), array, allow_pickle=False)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
    return entry


def commit(directory: Path, manifest: Manifest) -> None:
    """Make the arrays that a manifest names the content of the map, at one point: the renaming of the manifest.

    Raises:
        OSError: The manifest cannot be written. If that happens once it is renamed, the map is the new one, complete.
    """
    temporary = _temporary(directory / MANIFEST)
    with temporary.open("wb") as file:
        file.write(manifest.encode())
        file.flush()
        os.fsync(file.fileno())
    _sync(directory)  # The arrays' names must last before a manifest speaks of them.
    temporary.replace(directory / MANIFEST)
    _sync(directory)


def remove_unnamed(directory: Path) -> None:
    """Remove array and temporary files that the manifest in place does not name; for the holder of the lock."""
    named: set[str] = set()
    if (directory / MANIFEST).exists():
        try:
            named = read_manifest(directory).file_names()
        except StorageError:
            return  # Which of the files it needs is unknown.
    for path in directory.iterdir():
        if is_own_name(path.name) and path.name not in named and path.name != LOCK:
            with suppress(OSError):
                path.unlink()


@contextmanager
def opened(directory: Path) -> Iterator[tuple[Manifest, dict[str, BufferedReader]]]:
    """Open a manifest and its array files. What is open stays readable while another process saves.

    Raises:
        StorageError: It is no map, or a file is missing; the message names it.
    """
    while True:
        manifest = read_manifest(directory)
        files: dict[str, BufferedReader] = {}
        with ExitStack() as stack:
            try:
                for name, entry in manifest.arrays.items():
                    files[name] = stack.enter_context((directory / entry.file_name(name)).open("rb"))
            except OSError as error:
                if read_manifest(directory) != manifest:
                    continue  # A save has replaced the map in this moment.
                raise StorageError(f"'{directory}' is incomplete, {MANIFEST} names what cannot be read: {error}") from None
            yield manifest, files
            return


def read_array(path: Path, file: BufferedReader, entry: ArrayFile) -> NDArray[Any]:
    """Read and verify an array.

    Args:
        path: Its file's path, for messages.
        file: Its file.
        entry: What the manifest says of it.

    Raises:
        StorageError: It is truncated, altered, no array of numbers, or not what the manifest says.
    """
    try:
        size_bytes = os.fstat(file.fileno()).st_size
        if size_bytes != entry.size_bytes:
            raise StorageError(f"'{path}' is damaged: it has {size_bytes} bytes, the manifest says {entry.size_bytes}")
        if hashlib.file_digest(file, "sha256").hexdigest() != entry.sha256:
            raise StorageError(f"'{path}' is damaged: its checksum is not the manifest's")
        file.seek(0)
        array: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    except (OSError, ValueError, MemoryError) as error:
        raise StorageError(f"cannot read '{path}': {error}") from None
    if str(array.dtype) != entry.dtype or array.shape != entry.shape:
        raise StorageError(f"'{path}' holds {array.dtype} {array.shape}, the manifest says {entry.dtype} {entry.shape}")
    return array


@contextmanager
def _locked(directory: Path) -> Iterator[None]:
    path = directory / LOCK
    busy = StorageError(f"cannot write map '{directory}': it is being saved by another process or thread")
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise busy from None
        # A save that failed removes its lock; whoever had opened it before holds a lock that nobody else sees.
        if not path.exists() or not os.path.samestat(os.fstat(descriptor), path.stat()):
            raise busy
        yield
    finally:
        os.close(descriptor)


def _temporary(path: Path) -> Path:
    return path.with_name(f".{path.name}{_TEMPORARY_SUFFIX}")


def _digest_of(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sync(directory: Path) -> None:
    """Make the names in a directory last."""
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
