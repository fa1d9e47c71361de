"""Folders for machine code that outlives the process.

Loading machine code means running it. So nothing is loaded from a folder that another user could have written to.
"""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

_PREFIX = "loops-"
_KEPT = 4  # Folders of earlier contents that stay: another version may be in use beside this one.


def folders(key: str, first: str) -> Iterator[Path]:
    """Yield the folders for code of a content, best first; they need not exist.

    Args:
        key: Digest of the content.
        first: A folder that the user prefers, or nothing.
    """
    if first:
        yield Path(first, "fus3dmaps", _PREFIX + key)
    # Beside the source, where set-up and images can fill it for every user.
    yield Path(__file__).resolve().with_name("__pycache__") / (_PREFIX + key)
    yield from (root / "fus3dmaps" / (_PREFIX + key) for root in _user_caches())
    try:
        yield Path(tempfile.gettempdir(), f"fus3dmaps-{os.getuid()}", _PREFIX + key)
    except FileNotFoundError:  # The system has no place for temporary files.
        return


def is_safe(folder: Path) -> bool:
    """Tell whether only this user, root and the owner of this package can change what lies in a folder.

    Raises:
        OSError: The folder does not exist or cannot be looked at.
    """
    places = [folder.resolve(strict=True), *folder.resolve().parents]
    states = [place.stat() for place in places]
    trusted = {os.geteuid(), 0, Path(__file__).stat().st_uid}
    if states[0].st_mode & (stat.S_IWGRP | stat.S_IWOTH) or any(state.st_uid not in trusted for state in states[:2]):
        return False
    # Where the sticky bit is set, as in /tmp, nobody can rename or remove what others own.
    return all(not state.st_mode & stat.S_IWOTH or state.st_mode & stat.S_ISVTX for state in states)


def make(folder: Path) -> None:
    """Make a folder where it does not exist, and remove the oldest ones of other contents beside it.

    Raises:
        OSError: It cannot be made, or other users could write to it.
    """
    if not folder.is_dir():
        root = folder.parent
        root.mkdir(mode=0o755 if root.name == "__pycache__" else 0o700, parents=True, exist_ok=True)
        folder.mkdir(mode=0o755, exist_ok=True)
        _remove_old(folder)
    if not is_safe(folder):
        raise PermissionError(f"other users can write to '{folder}'")


def write(path: Path, content: bytes) -> None:
    """Write a file as a whole or not at all; other processes may read or write it at the same time.

    Raises:
        OSError: It cannot be written.
    """
    unfinished = path.with_name(f"{path.name}.{uuid4().hex}.tmp")
    try:
        # Whatever the user's umask is, nobody else may write to it.
        with os.fdopen(os.open(unfinished, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644), "wb") as stream:
            stream.write(content)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def _user_caches() -> Iterator[Path]:
    """Yield the folder for caches of this user, as the XDG specification has it."""
    named = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if named.is_absolute():
        yield named
        return
    try:
        home = Path.home()
    except RuntimeError:  # This user has none.
        return
    if os.path.isdir(home):  # noqa: PTH112  (Path.is_dir raises where it may not look; no home is made)
        yield home / ".cache"


def _remove_old(folder: Path) -> None:
    """Remove the oldest folders of other contents. A process that uses one compiles what it then misses."""
    ages = {}
    for other in folder.parent.glob(f"{_PREFIX}*"):
        try:
            ages[other] = other.stat().st_mtime
        except OSError:  # Another process was faster.
            continue
    ages.pop(folder, None)
    for other in sorted(ages, key=ages.__getitem__, reverse=True)[_KEPT:]:
        shutil.rmtree(other, ignore_errors=True)
