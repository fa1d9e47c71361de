"""An exported graph as a network, by the runtime that a configuration names."""

from __future__ import annotations

from pathlib import Path

from fus3dmaps_core.config.schema import Precision, Runtime
from fus3dmaps_core.encoders.network_graphs import Network
from fus3dmaps_core.runtimes.onnx_network import OnnxNetwork
from fus3dmaps_core.runtimes.tensorrt_network import engine_of


def open_network(path: Path, device: str, runtime: Runtime, precision: Precision, directory: Path) -> Network:
    """Open an exported graph.

    Args:
        path: ONNX file with one float32 input of static shape (n, 3, H, W) and float32 outputs.
        device: Torch device of images and outputs.
        runtime: ``tensorrt``, or anything else for ONNX Runtime: torch itself runs no exported graphs.
        precision: Which the graph was exported in; it is part of the name of an engine. The graph itself says what is
            computed in which precision, and both runtimes obey it.
        directory: Where TensorRT engines are kept; made if it is missing.

    Returns:
        Takes (m, 3, H, W) tensors of the device, any m, and returns the file's output with m rows, or a tuple of them.

    Raises:
        EncoderError: The runtime is missing or not for this device, or the file is not such a graph.
    """
    if runtime == "tensorrt":
        return engine_of(path, device, precision, directory)[0]
    return OnnxNetwork(path, device)
