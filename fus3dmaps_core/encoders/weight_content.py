"""Checks of whether a file holds the right weights: by its hash where this is known, otherwise by a look at its ends."""

from __future__ import annotations

import hashlib
import pickle
import zipfile
from pathlib import Path

TORCH_SUFFIXES = (".pt", ".pth", ".tar", ".bin", ".ckpt")
"""Of files that ``torch.save`` writes."""

_CHUNK_BYTES = 1 << 20
_LOOKED_AT_BYTES = 256
_LFS_POINTER = b"version https://git-lfs.github.com"  # What a clone without Git LFS has in place of a large file.


def hash_problem(path: Path, sha256: str, git_blob: str) -> str:
    """Say what is wrong with a file of known hash, in words that follow its path; "" where nothing is.

    Args:
        path: The file.
        sha256: Its SHA-256, hexadecimal; "" where it is not known.
        git_blob: Its name in a git repository, see :class:`fus3dmaps_core.encoders.weights.WeightFile`; "" likewise.

    Raises:
        OSError: It cannot be read.
    """
    for kind, expected, prefix in (
        ("sha256", sha256, b""),
        ("sha1", git_blob, f"blob {path.stat().st_size}\0".encode()),  # Git hashes the size along.
    ):
        if not expected:
            continue
        digest = hashlib.new(kind, prefix)
        with path.open("rb") as stream:
            while chunk := stream.read(_CHUNK_BYTES):
                digest.update(chunk)
        if digest.hexdigest() != expected:
            name = "git blob" if prefix else kind
            return f"is altered or incomplete, its {name} is {digest.hexdigest()}, not {expected}"
    return ""


def content_problem(path: Path) -> str:
    """Say why a file cannot be what its suffix says, in words that follow its path; "" where its ends look right.

    What lies between the ends is left to the reader of the file. Files of other suffixes must only not be empty, a web page
    that came in place of a download, or a pointer of Git LFS.

    Raises:
        OSError: It cannot be read.
    """
    size = path.stat().st_size
    with path.open("rb") as stream:
        start = stream.read(_LOOKED_AT_BYTES).lstrip()
        stream.seek(max(0, size - _LOOKED_AT_BYTES))
        end = stream.read().rstrip()
    if not size:
        return "is empty"
    if start.startswith(_LFS_POINTER):
        return "is a pointer of Git LFS in place of the file"
    if start[:1] == b"<":
        return "is a web page"
    if path.suffix == ".safetensors":
        return _safetensors_problem(path)
    if path.suffix == ".json" and not (start[:1] == b"{" and end[-1:] == b"}"):
        return "is not a JSON object, or cut short"
    # Torch writes zip archives, whose directory is at their end, and wrote pickles before.
    if path.suffix in TORCH_SUFFIXES and not (zipfile.is_zipfile(path) or start[:1] == pickle.PROTO):
        return "is not a weight file, or cut short"
    return ""


def _safetensors_problem(path: Path) -> str:
    try:
        from safetensors import SafetensorError, safe_open
    except ImportError:
        return ""  # Reading the file will say so.
    try:
        with safe_open(path, "pt"):  # Compares the header with the size.
            return ""
    except SafetensorError as error:
        return f"is not a weight file, or cut short: {str(error).splitlines()[0]}"
