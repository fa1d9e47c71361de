"""Files of the graph cache: their names and hashes; each is written whole or not at all, since others may read it."""

from __future__ import annotations

import hashlib
import re
import tempfile
from pathlib import Path

_CHUNK_BYTES = 1 << 20
_EXTERNAL = ".data"


def external_data(path: Path) -> Path:
    """Return where the weights of an ONNX file lie that is too large to hold them itself."""
    return path.with_name(path.name + _EXTERNAL)


def graph_hash(path: Path) -> str:
    """Compute the SHA-256 of an ONNX file and of the weights beside it, hexadecimal.

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
    """Make a text fit for a file's name: lower case, and hyphens for all but letters, digits and points."""
    return re.sub(r"[^a-z0-9.]+", "-", text.lower()).strip("-")


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file whole or not at all; make its directory where it is missing.

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
