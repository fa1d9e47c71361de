"""Graphs as ONNX files: static shapes, float32 in and out, weights inside or, where they are too large, beside."""

from __future__ import annotations

import copy
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path

import torch
from torch import nn

from fus3dmaps_core.config.schema import Precision
from fus3dmaps_core.encoders.network_graphs import Graph
from fus3dmaps_core.errors import EncoderError, first_line
from fus3dmaps_core.runtimes.cached_files import external_data
from fus3dmaps_core.runtimes.half_precision import round_products
from fus3dmaps_core.version import __version__

OPSET = 18
"""Of ONNX; TensorRT 10 and ONNX Runtime read it, and torch's exporter writes it without conversion."""

INPUT = "images"

_LARGEST_INSIDE_BYTES = 1_800_000_000  # A protobuf ends at 2 GiB.
_FOLDED_VALUES = 1 << 27  # Constants that are computed here, e.g. position embeddings at the size of the image.


def plain_network(graph: Graph) -> nn.Module:
    """Return the network of a graph on the CPU in float32: itself if it is there already, or a copy."""
    parameters = [*graph.network.parameters(), *graph.network.buffers()]
    floating = [value for value in parameters if value.is_floating_point()]
    if all(value.device.type == "cpu" and value.dtype == torch.float32 for value in floating):
        return graph.network
    return copy.deepcopy(graph.network).cpu().float()


def write_onnx(graph: Graph, network: nn.Module, trio: str, precision: Precision, path: Path) -> None:
    """Write a graph as an ONNX file; see :mod:`fus3dmaps_core.runtimes.half_precision` for what a precision means.

    The file's metadata have the trio, the graph, its input shape, the precision and this package's version.

    Args:
        graph: The graph.
        network: Its network as :func:`plain_network` gives it.
        trio: Name of its trio.
        precision: Precision of weights and products.
        path: The file. Weights of more than 1.8 GB go into a file of this name with ``.data`` after it.

    Raises:
        EncoderError: Torch cannot export the network.
        OSError: The file cannot be written.
    """
    ir, optimizer = import_module("onnx_ir"), import_module("onnxscript.optimizer")
    try:
        with torch.no_grad(), warnings.catch_warnings(), _quiet():
            warnings.simplefilter("ignore")  # About the exporter's own internals.
            program = torch.onnx.export(
                network,
                (torch.zeros(graph.shape),),
                dynamo=True,
                opset_version=OPSET,
                input_names=[INPUT],
                output_names=list(graph.outputs),
                optimize=False,
                verbose=False,
            )
    except Exception as error:  # The exporter raises whatever its steps come across.
        raise EncoderError(f"encoder '{trio}': torch cannot export the graph '{graph.name}': {_reason(error)}") from error
    assert program is not None
    model = program.model
    with _quiet():
        optimizer.optimize_ir(model, input_size_limit=_FOLDED_VALUES, output_size_limit=_FOLDED_VALUES)
    if precision != "fp32":
        round_products(ir, model, precision)
    model.graph.name = f"{trio}_{graph.name}"
    model.producer_name, model.producer_version = "fus3dmaps", __version__
    model.metadata_props.update(
        {
            "model": trio,
            "graph": graph.name,
            "shape": "x".join(map(str, graph.shape)),
            "precision": precision,
            "fus3dmaps": __version__,
        }
    )
    size = sum(value.const_value.nbytes for value in model.graph.initializers.values() if value.const_value is not None)
    ir.save(model, path, external_data=external_data(path).name if size > _LARGEST_INSIDE_BYTES else None)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the loggers of the exporter, which report on every pass."""
    loggers = [logging.getLogger(name) for name in ("torch.onnx", "onnxscript", "onnx_ir")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _reason(error: BaseException) -> str:
    """Return the first line of the error at the root: those around it explain the exporter's steps over many lines."""
    while error.__cause__ is not None:
        error = error.__cause__
    return first_line(error)
