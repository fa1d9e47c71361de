"""Weight files of large encoders: found on disk or fetched once, checked by hash, and read without running what they hold.

A parameter (``encoder.weights``) says where they are:

- a path: the file itself, or a directory that holds it under its own name, or under this name with another suffix;
- ``org/repo`` or ``org/repo@revision``: that repository of the Hugging Face hub, its local cache first;
- nothing: the cache of the hub, then ``~/.cache/fus3dmaps`` (``XDG_CACHE_HOME`` is honoured), then a download from where
  the authors published the file.

Every refusal is one line that says what to download from where, and where to put it.
"""

from __future__ import annotations

import argparse
import hashlib
import logging
import os
import pickle
import re
import socket
import tempfile
import urllib.parse
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from fus3dmaps_core.errors import EncoderError

_log = logging.getLogger(__name__)

_HUB_NAME = re.compile(r"(?P<repo>[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*)(?:@(?P<revision>[\w./-]+))?")
_SUFFIXES = (".safetensors", ".pt", ".pth", ".tar", ".bin", ".onnx", ".ckpt")
_TIMEOUT_S = 20.0  # Of one read from the network, not of the whole download.
_CHUNK_BYTES = 1 << 20
_WRAPPERS = ("state_dict", "model_state_dict", "model")  # Under which training scripts store the weights.
_NAMED = 3  # Names of a list that a message has.


@dataclass(frozen=True)
class WeightFile:
    """One published file of weights.

    Attributes:
        title: What it is, for messages.
        file_name: Its name where it is published, in the hub's repository or in a directory of the user's.
        url: Where it can be downloaded without the hub's client; "" where the hub alone has it.
        hub: Repository on the Hugging Face hub, ``org/repo``; "" where it is not there.
        revision: Commit, branch or tag of that repository.
        sha256: Its hash, hexadecimal; "" where it is not known. Files of another name or repository are not held to it.
        licence: Licence of the weights.
        git_blob: Its name in the git repository that publishes it, the SHA-1 of its size and content, in place of a SHA-256
            where only this is known.
    """

    title: str
    file_name: str
    url: str
    hub: str
    revision: str
    sha256: str
    licence: str
    git_blob: str = ""

    @property
    def cached_path(self) -> Path:
        """Where the file lies, or may be put, in this package's own cache."""
        folder = re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-")
        return cache_directory() / folder / Path(self.file_name).name

    @property
    def source(self) -> str:
        """The address to download it from by hand."""
        return self.url or f"https://huggingface.co/{self.hub}/resolve/{self.revision or 'main'}/{self.file_name}"


def cache_directory() -> Path:
    """``~/.cache/fus3dmaps``, or its like under ``XDG_CACHE_HOME``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "fus3dmaps"


def local_path(value: str) -> Path | None:
    """The file or directory that the value of a parameter names, where there is one."""
    try:
        path = Path(value).expanduser()
        return path if value and path.exists() else None
    except (OSError, RuntimeError):  # A name too long, or the home of somebody unknown.
        return None


def find_weights(parameter: str, value: str, file: WeightFile) -> Path:
    """Path of a weight file, which is downloaded where it is published if it is nowhere on this machine.

    Args:
        parameter: Name of the parameter for messages, e.g. ``encoder.weights``.
        value: Its value, see above.
        file: Which file is needed.

    Raises:
        EncoderError: There is no such file and it cannot be downloaded, or its hash is wrong; the message says what to
            download from where and where to put it.
    """
    refusal = f"parameter '{parameter}': {file.title}"
    path = local_path(value)
    if path is not None:
        found = _in_directory(path, Path(file.file_name).name) if path.is_dir() else path
        if not found.is_file():
            raise EncoderError(f"{refusal}: directory '{path}' has no '{found.name}'; {_advice(parameter, file)}")
        if found.name == Path(file.file_name).name:
            _check_hash(refusal, found, parameter, file)
        return found
    hub = _HUB_NAME.fullmatch(value)
    if value and (hub is None or value.endswith(_SUFFIXES)):
        raise EncoderError(f"{refusal}: there is no file or directory '{value}'; {_advice(parameter, file)}")
    repository, revision = (hub["repo"], hub["revision"] or "") if hub else (file.hub, file.revision)
    if repository == file.hub and not revision:
        revision = file.revision
    is_published = (repository, revision) == (file.hub, file.revision)
    found_or_none = _cached_by_hub(repository, revision, file.file_name) if repository else None
    if found_or_none is None and is_published and file.cached_path.is_file():
        found_or_none = file.cached_path
    if found_or_none is None:
        found_or_none = _download(refusal, repository, revision, parameter, file, by_url=is_published)
    if is_published:
        _check_hash(refusal, found_or_none, parameter, file)
    return found_or_none


def read_state(path: Path) -> dict[str, torch.Tensor]:
    """Read the tensors of a weight file onto the CPU, by name; whatever else it holds is left out.

    Args:
        path: A safetensors file, or one that ``torch.save`` wrote. Weights below ``state_dict``, ``model_state_dict`` or
            ``model`` are found there, and a ``module.`` before all names is dropped.

    Raises:
        EncoderError: The file cannot be read, holds Python objects other than tensors and plain values, or no tensors.
    """
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            content: Any = load_file(path)
        else:
            # Options of a training script are often stored beside the weights; this class can only hold values.
            with torch.serialization.safe_globals([argparse.Namespace]):
                content = torch.load(path, map_location="cpu", weights_only=True)
    except ImportError as error:
        raise EncoderError(f"weights '{path}': '{error.name}' is not installed; use fus3dmaps[models]") from None
    except pickle.UnpicklingError as error:
        raise EncoderError(
            f"weights '{path}': not a weight file, or one with Python objects in it, which are not loaded: {_line(error)}"
        ) from None
    except Exception as error:  # The readers raise whatever their formats come across.
        raise EncoderError(f"weights '{path}': not a weight file, or cut short: {_line(error)}") from None
    for wrapper in _WRAPPERS:
        if isinstance(content, Mapping) and isinstance(content.get(wrapper), Mapping):
            content = content[wrapper]
            break
    state: dict[str, torch.Tensor] = {}
    if isinstance(content, Mapping):
        state = {name: value for name, value in content.items() if isinstance(value, torch.Tensor)}
    if not state:
        raise EncoderError(f"weights '{path}': the file holds no named tensors")
    prefix = "module."
    if all(name.startswith(prefix) for name in state):
        state = {name.removeprefix(prefix): value for name, value in state.items()}
    return state


def fit(module: torch.nn.Module, state: Mapping[str, torch.Tensor], what: str) -> None:
    """Copy weights into a network, all of them and nothing else.

    Args:
        module: Network.
        state: Tensors by name, as the network's ``state_dict`` has them.
        what: Which weights these are, for the message.

    Raises:
        EncoderError: The weights are another architecture's; the network is as it was. The message has the first names that
            are missing, not expected, or of another shape.
    """
    expected = module.state_dict()
    problems = {
        "missing": [name for name in expected if name not in state],
        "not expected": [name for name in state if name not in expected],
        "of another shape": [
            f"{name} {tuple(state[name].shape)}, not {tuple(value.shape)}"
            for name, value in expected.items()
            if name in state and state[name].shape != value.shape
        ],
    }
    if any(problems.values()):
        parts = [f"{len(names)} {problem} ({_some(names)})" for problem, names in problems.items() if names]
        raise EncoderError(f"{what}: weights of another architecture than {type(module).__name__}: {'; '.join(parts)}")
    module.load_state_dict(state, strict=True)


def _in_directory(directory: Path, name: str) -> Path:
    """The file of this name, or one of the same name but for its suffix, which a user converted or trained."""
    stem = name
    while stem.endswith(_SUFFIXES):
        stem = stem.removesuffix(Path(stem).suffix)
    candidates = (directory / name, *(directory / f"{stem}{suffix}" for suffix in _SUFFIXES))
    return next((path for path in candidates if path.is_file()), directory / name)


def _advice(parameter: str, file: WeightFile) -> str:
    return f"download {file.source} and put it at '{file.cached_path}', or set '{parameter}' to where it lies"


def _check_hash(refusal: str, path: Path, parameter: str, file: WeightFile) -> None:
    for kind, expected, prefix in (
        ("sha256", file.sha256, b""),
        ("sha1", file.git_blob, f"blob {path.stat().st_size}\0".encode()),  # Git hashes the size along.
    ):
        if not expected:
            continue
        digest = hashlib.new(kind, prefix)
        with path.open("rb") as stream:
            while chunk := stream.read(_CHUNK_BYTES):
                digest.update(chunk)
        if digest.hexdigest() != expected:
            name = "git blob" if prefix else kind
            raise EncoderError(
                f"{refusal}: '{path}' is altered or incomplete, its {name} is {digest.hexdigest()}, not {expected}; "
                f"{_advice(parameter, file)}"
            )


def _cached_by_hub(repository: str, revision: str, file_name: str) -> Path | None:
    try:
        from huggingface_hub import try_to_load_from_cache
    except ImportError:
        return None
    path = try_to_load_from_cache(repository, file_name, revision=revision or None)
    return Path(path) if isinstance(path, str) else None


def _download(refusal: str, repository: str, revision: str, parameter: str, file: WeightFile, *, by_url: bool) -> Path:
    """Fetch the file from the hub, or from its address if it is the published one."""
    causes = []
    if repository:
        try:
            from huggingface_hub import constants, hf_hub_download

            _check_reachable(constants.ENDPOINT)
            _log.info("downloading %s from huggingface.co/%s", file.file_name, repository)
            return Path(hf_hub_download(repository, file.file_name, revision=revision or None, etag_timeout=_TIMEOUT_S))
        except ImportError:
            causes.append("the package 'huggingface_hub' is not installed")
        except Exception as error:  # The client passes on what its HTTP library raises.
            neither = "" if by_url else " is no directory here, and as a repository of the hub"
            causes.append(f"'{repository}'{neither}: {_line(error)}")
    if by_url and file.url:
        try:
            _log.info("downloading %s", file.url)
            return _fetch(file.url, file.cached_path)
        except (OSError, ValueError) as error:
            causes.append(_line(error))
    raise EncoderError(
        f"{refusal} is not on this machine and cannot be downloaded ({'; '.join(causes)}); {_advice(parameter, file)}"
    )


def _check_reachable(address: str) -> None:
    """Fail at once without a network; the hub's client tries again for half a minute."""
    host = urllib.parse.urlsplit(address).hostname
    if host and not urllib.request.getproxies():
        socket.getaddrinfo(host, None)


def _fetch(url: str, path: Path) -> Path:
    """Download into a temporary file that takes its name only once it is complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    partial = Path(name)
    try:
        with os.fdopen(handle, "wb") as stream, urllib.request.urlopen(url, timeout=_TIMEOUT_S) as answer:
            announced, received = answer.headers.get("Content-Length"), 0
            while chunk := answer.read(_CHUNK_BYTES):
                received += stream.write(chunk)
        if announced is not None and received != int(announced):
            raise OSError(f"{url}: {received} of {announced} bytes arrived")
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return path


def _some(names: list[str]) -> str:
    return ", ".join(names[:_NAMED]) + (", ..." if len(names) > _NAMED else "")


def _line(error: Exception) -> str:
    """First line of what an exception says, and its class where it says nothing."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__
