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
import http.client
import logging
import os
import pickle
import re
import socket
import tempfile
import urllib.parse
import urllib.request
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from fus3dmaps_core.encoders.weight_content import TORCH_SUFFIXES, content_problem, hash_problem
from fus3dmaps_core.errors import EncoderError, first_line

_log = logging.getLogger(__name__)

_HUB_NAME = re.compile(r"(?P<repo>[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*)(?:@(?P<revision>[\w./-]+))?")
_SUFFIXES = (".safetensors", *TORCH_SUFFIXES, ".onnx")
_TIMEOUT_S = 20.0  # Of one read from the network, not of the whole download.
_CONNECT_S = 5.0  # Until a host that does not answer counts as not reachable.
_CHUNK_BYTES = 1 << 20
_WRAPPERS = ("state_dict", "model_state_dict", "model")  # Under which training scripts store the weights.
_OBJECT = re.compile(r"GLOBAL (\S+) was not")  # Of torch's refusal to unpickle one.
_NAMED = 3  # How many names of a list a message has.


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
    """Return this package's cache: ``fus3dmaps`` in ``XDG_CACHE_HOME``, or in ``~/.cache``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "fus3dmaps"


def local_path(value: str) -> Path | None:
    """Return the file or directory that the value of a parameter names; None where there is none."""
    try:
        path = Path(value).expanduser()
        return path if value and path.exists() else None
    except (OSError, RuntimeError, ValueError):  # A name too long, the home of somebody unknown, or a byte of zero.
        return None


def is_hub_name(value: str) -> bool:
    """Tell whether a value that names no file or directory can name a repository of the hub."""
    return _as_hub_name(value) is not None


def locate(value: str, file: WeightFile) -> Path | None:
    """Find a weight file that is on this machine already, without the network and without reading it.

    Args:
        value: Value of the parameter, see above.
        file: Which file is looked for.

    Returns:
        What :func:`find_weights` would take without a download, if its content is right; None where there is no such file,
        or an empty one, or it cannot be looked for.
    """
    try:
        path = local_path(value)
        if path is not None:
            found = _in_directory(path, Path(file.file_name).name) if path.is_dir() else path
            return found if _has_content(found) else None
        repository = _repository(value, file)
        return None if repository is None else _cached(*repository, file)
    except OSError:
        return None


def find_weights(parameter: str, value: str, file: WeightFile) -> Path:
    """Find a weight file, and download it from where it is published if it is not on this machine.

    Args:
        parameter: Name of the parameter for messages, e.g. ``encoder.weights``.
        value: Its value, see above.
        file: Which file is needed.

    Raises:
        EncoderError: There is no such file and it cannot be downloaded, or it cannot be read, or its hash is wrong, or its
            ends show that it is cut short or something else; the message says what to download from where and where to put
            it.
    """
    refusal = f"parameter '{parameter}': {file.title}"
    try:
        path, is_published = _find(refusal, parameter, value, file)
        is_known = is_published and (file.sha256 or file.git_blob)
        problem = hash_problem(path, file.sha256, file.git_blob) if is_known else content_problem(path)
    except OSError as error:
        raise EncoderError(f"{refusal}: cannot be read: {first_line(error)}; {_advice(parameter, file)}") from None
    if problem:
        raise EncoderError(f"{refusal}: '{path}' {problem}; {_advice(parameter, file)}")
    return path


def only_directory(value: str) -> str:
    """Return the value of a parameter if it is a directory, in which any file is looked for, and otherwise ""."""
    path = local_path(value)
    return value if path is not None and path.is_dir() else ""


@contextmanager
def saying_what_to_get(parameter: str, file: WeightFile) -> Iterator[None]:
    """Add to a refusal inside what to download from where, and where to put it.

    Args:
        parameter: Name of the parameter for messages.
        file: Which file is needed.

    Raises:
        EncoderError: That refusal.
    """
    try:
        yield
    except EncoderError as error:
        raise EncoderError(f"{error}; {_advice(parameter, file)}") from None


def _find(refusal: str, parameter: str, value: str, file: WeightFile) -> tuple[Path, bool]:
    """Find the file, and tell whether it has to be the published one, byte for byte."""
    path = local_path(value)
    if path is not None:
        name = Path(file.file_name).name
        found = _in_directory(path, name) if path.is_dir() else path
        if path.is_dir() and not found.is_file():
            raise EncoderError(f"{refusal}: directory '{path}' has no '{found.name}'; {_advice(parameter, file)}")
        if not found.is_file():
            raise EncoderError(f"{refusal}: '{path}' is neither a file nor a directory; {_advice(parameter, file)}")
        return found, found.name == name
    repository = _repository(value, file)
    if repository is None:
        raise EncoderError(f"{refusal}: there is no file or directory '{value}'; {_advice(parameter, file)}")
    is_published = repository == (file.hub, file.revision)
    cached = _cached(*repository, file)
    return cached or _download(refusal, *repository, parameter, file, by_url=is_published), is_published


def read_state(path: Path) -> dict[str, torch.Tensor]:
    """Read the tensors of a weight file onto the CPU, by name; whatever else it holds is left out.

    Args:
        path: A safetensors file, or one that ``torch.save`` wrote. Weights below ``state_dict``, ``model_state_dict`` or
            ``model`` are found there, and a ``module.`` before all names is dropped.

    Raises:
        EncoderError: The file cannot be read, holds Python objects other than tensors and plain values, or no tensors.
    """
    if path.suffix == ".onnx":
        raise EncoderError(f"weights '{path}': an ONNX graph; weights are read from safetensors or what torch.save wrote")
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            content: Any = load_file(path)
        else:
            # Options of a training script are often stored beside the weights; this class can only hold values.
            with torch.serialization.safe_globals([argparse.Namespace]), warnings.catch_warnings():
                warnings.simplefilter("ignore")  # About files that are refused below, or read all the same.
                content = torch.load(path, map_location="cpu", weights_only=True)
    except ImportError as error:
        raise EncoderError(f"weights '{path}': '{error.name}' is not installed; use fus3dmaps_ros[models]") from None
    except Exception as error:  # The readers raise whatever their formats come across.
        raise EncoderError(f"weights '{path}': {reading_problem(error)}") from None
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


def reading_problem(error: Exception) -> str:
    """Say why a file is not read; torch's own words advise an option under which it would run what the file holds."""
    text = str(error)
    if isinstance(error, pickle.UnpicklingError):
        found = _OBJECT.search(text)
        holds = (
            f"the file holds Python objects ({found[1]})" if found else "not a weight file, or one with Python objects in it"
        )
        return f"{holds}, which are not loaded; save its tensors alone"
    if "TorchScript" in text:
        return "the file holds a TorchScript program, which is not loaded; save its tensors alone"
    return f"not a weight file, or cut short: {first_line(error)}"


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
    """Return the file of this name, or one with another suffix, which a user converted or trained."""
    stem = name
    while stem.endswith(_SUFFIXES):
        stem = stem.removesuffix(Path(stem).suffix)
    candidates = (directory / name, *(directory / f"{stem}{suffix}" for suffix in _SUFFIXES))
    return next((path for path in candidates if path.is_file()), directory / name)


def _as_hub_name(value: str) -> re.Match[str] | None:
    match = None if value.endswith(_SUFFIXES) else _HUB_NAME.fullmatch(value)
    return match if match and not re.search(r"--|\.\.", value) else None  # Which the hub has in no name.


def _repository(value: str, file: WeightFile) -> tuple[str, str] | None:
    """Return the repository and revision that a value names which is no file or directory; None where it names none."""
    if not value:
        return file.hub, file.revision
    name = _as_hub_name(value)
    if name is None:
        return None
    revision = name["revision"] or ""
    return name["repo"], file.revision if name["repo"] == file.hub and not revision else revision


def _cached(repository: str, revision: str, file: WeightFile) -> Path | None:
    """Find the file in the cache of the hub's client, or in this package's own."""
    found = _cached_by_hub(repository, revision, file.file_name) if repository else None
    is_published = (repository, revision) == (file.hub, file.revision)
    candidates = (*((found,) if found else ()), *((file.cached_path,) if is_published else ()))
    return next((path for path in candidates if _has_content(path)), None)


def _has_content(path: Path) -> bool:
    return path.is_file() and path.stat().st_size > 0


def _advice(parameter: str, file: WeightFile) -> str:
    return f"download {file.source} and put it at '{file.cached_path}', or set '{parameter}' to where it lies"


def _cached_by_hub(repository: str, revision: str, file_name: str) -> Path | None:
    try:
        from huggingface_hub import try_to_load_from_cache
    except ImportError:
        return None
    try:
        path = try_to_load_from_cache(repository, file_name, revision=revision or None)
    except ValueError:  # No name of a repository.
        return None
    return Path(path) if isinstance(path, str) else None


def _download(refusal: str, repository: str, revision: str, parameter: str, file: WeightFile, *, by_url: bool) -> Path:
    """Fetch the file from the hub, or from its address if it is the published one."""
    causes = []
    if repository:
        try:
            from huggingface_hub import constants, hf_hub_download

            check_reachable(constants.ENDPOINT)
            _log.info("downloading %s from huggingface.co/%s", file.file_name, repository)
            return Path(hf_hub_download(repository, file.file_name, revision=revision or None, etag_timeout=_TIMEOUT_S))
        except ImportError:
            causes.append("the package 'huggingface_hub' is not installed")
        except Exception as error:  # The client passes on what its HTTP library raises.
            neither = "" if by_url else " is no directory here, and as a repository of the hub"
            causes.append(f"'{repository}'{neither}: {first_line(error)}")
    if by_url and file.url:
        try:
            _log.info("downloading %s", file.url)
            return _fetch(file.url, file.cached_path)
        except (OSError, ValueError, http.client.HTTPException) as error:
            causes.append(first_line(error))
    raise EncoderError(
        f"{refusal} is not on this machine and cannot be downloaded ({'; '.join(causes)}); {_advice(parameter, file)}"
    )


def check_reachable(address: str) -> None:
    """Fail soon without a network; clients of the hubs wait for minutes or try again for half a one.

    Args:
        address: A URL of the host to try. Behind a proxy nothing is tried, since only the proxy would be asked.

    Raises:
        OSError: Its host cannot be reached.
    """
    parts = urllib.parse.urlsplit(address)
    if parts.hostname and not urllib.request.getproxies():
        port = parts.port or (80 if parts.scheme == "http" else 443)
        socket.create_connection((parts.hostname, port), timeout=_CONNECT_S).close()


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
