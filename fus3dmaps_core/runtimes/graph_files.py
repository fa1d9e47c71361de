"""Exported graphs on disk: names that say what is in a file, and a checksum that says whether it still is."""

from __future__ import annotations

import hashlib
from pathlib import Path

import torch
from torch import nn

from fus3dmaps_core.config.schema import Precision
from fus3dmaps_core.encoders.network_graphs import Graph
from fus3dmaps_core.encoders.weights import cache_directory
from fus3dmaps_core.runtimes.cached_files import graph_hash, slug
from fus3dmaps_core.runtimes.onnx_writer import OPSET
from fus3dmaps_core.version import __version__

_FINGERPRINT_DIGITS = 16


def graph_directory(value: str) -> Path:
    """Return the directory of graphs and engines that the parameter ``encoder.graph_directory`` names."""
    return Path(value).expanduser() if value else cache_directory() / "graphs"


def graph_path(directory: Path, trio: str, graph: Graph, precision: Precision) -> Path:
    """Return where a graph is kept; the name tells weights, shapes, precisions and versions of this package apart."""
    shape = "x".join(map(str, graph.shape))
    return directory / f"{slug(trio)}_{graph.name}_{shape}_{precision}_{fingerprint(graph.network)}.onnx"


def fingerprint(network: nn.Module) -> str:
    """Hash a network's class and weights and what else an export depends on, hexadecimal.

    Weights are taken as bfloat16, so that a network has the same one whether it was loaded in float32 or, as on CUDA, in
    bfloat16: what was exported on the CPU of one machine is found on the robot.
    """
    digest = hashlib.sha256(f"{type(network).__qualname__} {__version__} {OPSET}".encode())
    for name, value in sorted(network.state_dict().items()):
        digest.update(f"{name} {tuple(value.shape)}".encode())
        rounded = value.detach().to(torch.bfloat16) if value.is_floating_point() else value.detach().to(torch.int64)
        digest.update(rounded.cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()[:_FINGERPRINT_DIGITS]


def own_precision(network: nn.Module) -> Precision:
    """Return the precision of a network's weights."""
    dtype = next(value.dtype for value in network.state_dict().values() if value.is_floating_point())
    precisions: dict[torch.dtype, Precision] = {torch.float16: "fp16", torch.bfloat16: "bf16"}
    return precisions.get(dtype, "fp32")


def checksum_path(path: Path) -> Path:
    """Return where the checksum of a graph lies."""
    return path.with_name(path.name + ".sha256")


def write_checksum(path: Path) -> None:
    """Write the SHA-256 of a graph beside it, in the form of ``sha256sum``; of one in two files, that of both together."""
    checksum_path(path).write_text(f"{graph_hash(path)}  {path.name}\n")


def is_whole(path: Path) -> bool:
    """Tell whether a graph is there and is what its checksum says."""
    try:
        return checksum_path(path).read_text().split()[:1] == [graph_hash(path)]
    except (OSError, UnicodeDecodeError):
        return False
