"""Reading of binary PLY meshes with all properties of vertices and faces, also labels, which mesh libraries leave out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import RecordingError

_TYPES = {
    **{"char": "<i1", "uchar": "<u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4"},
    **{"int8": "<i1", "uint8": "<u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4"},
    **{"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8"},
}
_MAX_HEADER = 65536


@dataclass(frozen=True)
class _Property:
    name: str
    dtype: str
    count_dtype: str | None = None


def read_ply(path: Path) -> dict[str, NDArray[np.void]]:
    """Read the elements of a little-endian PLY by name, each as a structured array with its properties.

    A list property must have the same length in all elements, like the corners in a mesh of triangles or of quads. It
    becomes a field with that many columns.

    Raises:
        RecordingError: The file cannot be read, is truncated, is of another format, or has lists of different lengths.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"cannot read '{path}': {error.strerror}") from error
    end = data.find(b"end_header\n", 0, _MAX_HEADER)
    if not data.startswith(b"ply") or end < 0:
        raise RecordingError(f"'{path}' is not a PLY file")
    elements = _header(data[:end].decode("ascii", "replace"), path)
    at = end + len(b"end_header\n")
    arrays = {}
    for name, count, properties in elements:
        dtype = np.dtype(_fields(properties, data, at if count else None, path))
        if at + count * dtype.itemsize > len(data):
            raise RecordingError(f"'{path}' is truncated: it ends within its {count} elements '{name}'")
        array = np.frombuffer(data, dtype, count, at)
        for field in dtype.names or ():
            if field.startswith("#") and count and np.any(array[field] != array[field][0]):
                raise RecordingError(f"'{path}': lists '{field[1:]}' of '{name}' have several lengths, expected one")
        arrays[name] = array
        at += count * dtype.itemsize
    return arrays


def _header(text: str, path: Path) -> list[tuple[str, int, list[_Property]]]:
    elements: list[tuple[str, int, list[_Property]]] = []
    for line in text.splitlines()[1:]:
        words = line.split()
        try:
            if words[:1] == ["format"] and words[1] != "binary_little_endian":
                raise RecordingError(f"'{path}' is PLY in format {words[1]}, expected binary_little_endian")
            if words[:1] == ["element"]:
                elements.append((words[1], int(words[2]), []))
            elif words[:2] == ["property", "list"]:
                elements[-1][2].append(_Property(words[4], _TYPES[words[3]], _TYPES[words[2]]))
            elif words[:1] == ["property"]:
                elements[-1][2].append(_Property(words[2], _TYPES[words[1]]))
        except (IndexError, KeyError, ValueError):
            raise RecordingError(f"'{path}' has an odd line in its PLY header: {line[:60]!r}") from None
    return elements


def _fields(properties: list[_Property], data: bytes, at: int | None, path: Path) -> list[tuple[str, str, tuple[int, ...]]]:
    """Lay out the fields of an element whose first one is at byte ``at``; None without any. '#NAME' counts list NAME."""
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    for item in properties:
        length: tuple[int, ...] = ()
        if item.count_dtype is not None:
            fields.append((f"#{item.name}", item.count_dtype, ()))
            start = 0 if at is None else at + np.dtype(fields).itemsize
            before = start - np.dtype(item.count_dtype).itemsize
            if at is not None and start > len(data):
                raise RecordingError(f"'{path}' is truncated")
            length = (int(np.frombuffer(data, item.count_dtype, 1, before)[0]) if at is not None else 0,)
        fields.append((item.name, item.dtype, length))
    return fields
