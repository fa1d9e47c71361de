"""Saved maps by name, all of them inside one directory.

Names come from whoever calls a service, so that none may lead to another place of the file system.
"""

from __future__ import annotations

from pathlib import Path

from fus3dmaps_core.errors import StorageError
from fus3dmaps_core.saved_maps.manifest import MANIFEST, read_manifest

MAX_NAME_BYTES = 128


def map_root(directory: str | Path) -> Path:
    """Return the directory of saved maps as an absolute path, ``~`` expanded; it need not exist.

    Raises:
        StorageError: The home directory that it speaks of is unknown, or it cannot be a path.
    """
    try:
        return Path(directory).expanduser().absolute()
    except (RuntimeError, OSError) as error:
        raise StorageError(f"'{directory}' cannot be a directory of maps: {error}") from None


def map_path(root: str | Path, name: str) -> Path:
    """Return the path of the map with a name, which need not exist.

    Args:
        root: Directory of saved maps (``node.map_directory``); ``~`` is expanded.
        name: One path component: at most MAX_NAME_BYTES of printable Unicode, no separator and no leading dot.

    Raises:
        StorageError: The name is no such component, or is a symbolic link that leads out of the directory.
    """
    directory = map_root(root)
    if not name:
        raise _refused(name, "it is empty")
    if any(separator in name for separator in "/\\"):
        raise _refused(name, "it must be a name, not a path")
    if name.startswith("."):
        raise _refused(name, "it starts with a dot")
    if not name.isprintable():  # Control characters, NUL, lone surrogates, marks that turn the direction of writing.
        raise _refused(name, "it has characters that cannot be printed")
    if name != name.strip():
        raise _refused(name, "it starts or ends with a space")
    if len(name.encode()) > MAX_NAME_BYTES:
        raise _refused(name, f"it is longer than {MAX_NAME_BYTES} bytes")
    path = directory / name
    try:
        inside = path.resolve().parent.is_relative_to(directory.resolve())
    except (RuntimeError, OSError, ValueError) as error:
        raise _refused(name, str(error)) from None
    if not inside:
        raise _refused(name, f"it leads out of '{directory}'")
    return path


def list_maps(root: str | Path) -> list[str]:
    """List the names of the maps whose manifest can be read, the newest save first; none without the directory.

    Raises:
        StorageError: The directory cannot be listed.
    """
    directory = map_root(root)
    found: list[tuple[int, str]] = []
    try:
        names = [path.name for path in directory.iterdir() if (path / MANIFEST).is_file()]
    except FileNotFoundError:
        return []
    except (OSError, ValueError) as error:
        raise StorageError(f"cannot list the maps of '{directory}': {error}") from None
    for name in names:
        try:
            found.append((-read_manifest(map_path(directory, name)).saved_ns, name))
        except StorageError:
            continue  # Something else, or damaged: whoever loads it by its name is told why.
    return [name for _, name in sorted(found)]


def _refused(name: str, cause: str) -> StorageError:
    return StorageError(f"{name[: 2 * MAX_NAME_BYTES]!r} cannot be the name of a map: {cause}")
