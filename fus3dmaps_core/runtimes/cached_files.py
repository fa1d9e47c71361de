"""Files that others may read at any time: written whole or not at all, and told apart by what they hold."""

from __future__ import annotations

import hashlib
import re
import tempfile
from pathlib import Path

_CHUNK_BYTES = 1 << 20
_EXTERNAL = ".data"


def external_data(path: Path) -> Path:
    """Where the weights of an ONNX file of ours lie that is too large to hold them."""
    return path.with_name(path.name + _EXTERNAL)


def graph_hash(path: Path) -> str:
    """SHA-256 of an ONNX file and of the weights beside it, hexadecimal.

    Raises:
        OSError: It cannot be read.
    """
    digest = hashlib.sha256()
    for part in (path, external_data(path)):
        if part == path or part.is_file():
            with part.open("rb") as stream:
                while chunk := stream.read(_CHUNK_BYTES):
                    digest.update(chunk)
    return digest.hexdigest()


def slug(text: str) -> str:
    """A text as part of a file's name: lower case, and hyphens for all but letters, digits and points."""
    return re.sub(r"[^a-z0-9.]+", "-", text.lower()).strip("-")


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file that is there whole or not at all; makes the directory.

    Raises:
        OSError: It cannot be written; an earlier file of that name is as it was.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as stream:
        temporary = Path(stream.name)
        try:
            stream.write(content)
            stream.close()
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
