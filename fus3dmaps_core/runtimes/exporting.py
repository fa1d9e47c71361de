"""The networks of a trio as checked ONNX files."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import torch

from fus3dmaps_core.config.schema import Precision
from fus3dmaps_core.encoders.network_graphs import Graph, GraphEncoder
from fus3dmaps_core.encoders.protocols import EncoderTrio
from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.runtimes.cached_files import external_data
from fus3dmaps_core.runtimes.example_images import GraphCropEncoder, GraphPatchEncoder, crop_images, patch_images
from fus3dmaps_core.runtimes.graph_files import checksum_path, graph_path, is_whole, write_checksum
from fus3dmaps_core.runtimes.onnx_writer import OPSET, plain_network, write_onnx
from fus3dmaps_core.runtimes.packages import check_exporter, import_onnxruntime
from fus3dmaps_core.runtimes.parity import Parity, check_parity

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class NamedEncoder:
    """An encoder of a trio that has a graph.

    Attributes:
        trio: Name of the trio.
        encoder: The encoder.
        images: Makes images, as they reach its network, from the size of a frame.
    """

    trio: str
    encoder: GraphEncoder
    images: Callable[[int, int], torch.Tensor]


@dataclass(frozen=True)
class ExportedGraph:
    """A graph that was written and checked.

    Attributes:
        name: ``patch`` or ``crop``.
        path: Its file; further weights and the checksum lie beside it.
        size_bytes: Size of the file and its weights.
        opset: Opset of ONNX.
        shape: Shape of its input.
        precision: Precision of weights and products.
        parameters: How many weights the network has.
        parity: How near it is to torch.
    """

    name: str
    path: Path
    size_bytes: int
    opset: int
    shape: tuple[int, int, int, int]
    precision: Precision
    parameters: int
    parity: Parity


def graph_encoders(trio: EncoderTrio, with_crops: bool = True) -> list[NamedEncoder]:
    """Return the encoders of a trio whose networks can be run elsewhere.

    Args:
        trio: The trio.
        with_crops: Whether the crop encoder is among them.

    Raises:
        EncoderError: One of them has no graph; the message names it.
    """
    chosen = {"patch": trio.patch, **({"crop": trio.crop} if with_crops else {})}
    for kind, encoder in chosen.items():
        if not isinstance(encoder, GraphEncoder):
            raise EncoderError(
                f"encoder '{trio.name}': its {kind} encoder, {type(encoder).__name__}, has no graph to export; set "
                "'encoder.runtime' to torch"
            )
    patch = cast(GraphPatchEncoder, trio.patch)
    found = [NamedEncoder(trio.name, patch, lambda height, width: patch_images(patch, height, width))]
    if with_crops:
        crop = cast(GraphCropEncoder, trio.crop)
        found.append(NamedEncoder(trio.name, crop, lambda height, width: crop_images(crop, height, width)))
    return found


def export_graph(encoder: NamedEncoder, precision: Precision, directory: Path, height: int, width: int) -> ExportedGraph:
    """Export the graph of an encoder, check it against torch and put it into a directory under its name.

    Args:
        encoder: The encoder whose graph is exported.
        precision: Precision of weights and products.
        directory: Made if it is missing.
        height: Height of the images that it will be run on, pixels.
        width: Their width, pixels.

    Raises:
        EncoderError: The directory cannot be written, a package is missing, torch cannot export the network, or the file is
            too far from it. No new file has this name then.
    """
    check_exporter()
    import_onnxruntime()  # The file is checked with it at the end.
    graph = encoder.encoder.graph(height, width)
    path = graph_path(directory, encoder.trio, graph, precision)
    network = plain_network(graph)
    images = encoder.images(height, width)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=directory, prefix=".export-") as folder:
            written = Path(folder) / path.name
            write_onnx(graph, network, encoder.trio, precision, written)
            parity = check_parity(written, graph, network, images, precision)
            write_checksum(written)
            size = _move(written, path)
    except OSError as error:
        raise EncoderError(
            f"cannot write the graph '{graph.name}' of encoder '{encoder.trio}' into '{directory}': "
            f"{error.strerror or error}; choose another directory (--out, 'encoder.graph_directory')"
        ) from None
    parameters = sum(value.numel() for value in network.parameters())
    return ExportedGraph(graph.name, path, size, OPSET, graph.shape, precision, parameters, parity)


def ensure_exported(encoder: NamedEncoder, precision: Precision, directory: Path, height: int, width: int) -> Path:
    """Return the file of an encoder's graph, and export it where there is no whole one.

    Raises:
        EncoderError: As :func:`export_graph`.
    """
    graph: Graph = encoder.encoder.graph(height, width)
    path = graph_path(directory, encoder.trio, graph, precision)
    if is_whole(path):
        return path
    if path.exists():
        _log.warning("graph '%s' is not what its checksum says; it is exported anew", path)
    _log.info("exporting the graph '%s' of encoder '%s' in %s to '%s'", graph.name, encoder.trio, precision, path)
    return export_graph(encoder, precision, directory, height, width).path


def _move(written: Path, path: Path) -> int:
    """Put a graph and what lies beside it into place, the graph last; returns its size in bytes."""
    weights = external_data(written)
    size = written.stat().st_size + (weights.stat().st_size if weights.is_file() else 0)
    if weights.is_file():
        weights.replace(external_data(path))
    checksum_path(written).replace(checksum_path(path))
    written.replace(path)
    return size
