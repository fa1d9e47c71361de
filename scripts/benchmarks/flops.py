"""The arithmetic of a network, counted while it runs in torch or read from an ONNX file; 2 for a product and its sum."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from fus3dmaps_core.encoders.lite.packaged_files import DETECTOR_GRAPH, DETECTOR_LAYOUT

DETECTOR_INPUT = (1, 3, 300, 300)
"""Of the detector that ``lite`` has beside its classifier."""


def count_flops(network: Callable[[torch.Tensor], object], images: torch.Tensor) -> int:
    """Count the floating-point operations of convolutions, matrix products and attention in one pass.

    Attention is computed step by step here: the counter does not know all of the fused kernels, and leaves out the work of
    those that it does not know.

    Args:
        network: In evaluation mode, or what calls one; it is run once.
        images: What it takes, on its device.
    """
    counter = FlopCounterMode(display=False)
    was_enabled = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(False)
    try:
        # In inference mode, as encoders run it, linear layers reach the counter whole and uncounted.
        with torch.no_grad(), sdpa_kernel(SDPBackend.MATH), counter:
            network(images)
    finally:
        torch.backends.mha.set_fastpath_enabled(was_enabled)
    return counter.get_total_flops()


def count_onnx(path: Path) -> tuple[int, int]:
    """Count the weights and floating-point operations of an ONNX file of static shapes.

    Args:
        path: The file.

    Returns:
        Elements of all its floating-point weights, and operations of its convolutions and matrix products.
    """
    onnx = import_module("onnx")
    graph = onnx.shape_inference.infer_shapes(onnx.load(path)).graph
    weights = {tensor.name: tuple(tensor.dims) for tensor in graph.initializer}
    floats = {onnx.TensorProto.FLOAT, onnx.TensorProto.FLOAT16, onnx.TensorProto.BFLOAT16}
    parameters = sum(math.prod(tensor.dims) for tensor in graph.initializer if tensor.data_type in floats)
    shapes = weights | {
        value.name: tuple(side.dim_value for side in value.type.tensor_type.shape.dim)
        for value in (*graph.input, *graph.output, *graph.value_info)
    }
    return parameters, sum(_flops_of(node, shapes) for node in graph.node)


def _flops_of(node: Any, shapes: dict[str, tuple[int, ...]]) -> int:
    if node.op_type in ("Conv", "ConvTranspose"):
        kernel = shapes[node.input[1]]
        # A kernel is applied at each place of the output, or for the transposed one at each place of the input.
        places = shapes[node.output[0] if node.op_type == "Conv" else node.input[0]]
        return 2 * math.prod(places) * math.prod(kernel[1:])
    if node.op_type in ("MatMul", "Gemm"):
        left = shapes[node.input[0]]
        turned = any(attribute.name == "transA" and attribute.i for attribute in node.attribute)
        return 2 * math.prod(shapes[node.output[0]]) * left[-2 if turned else -1]
    return 0


def count_detector() -> tuple[int, int]:
    """Count the weights of the detector of ``lite``, and the floating-point operations of its convolutions on one image.

    Raises:
        EncoderError: The package that brings it is missing or altered.
    """
    # The newer engine of OpenCV 5 does not tell what its layers give.
    engine = [cv2.dnn.ENGINE_CLASSIC] if hasattr(cv2.dnn, "ENGINE_CLASSIC") else []
    network: Any = cv2.dnn.readNetFromTensorflow(str(DETECTOR_GRAPH.locate()), str(DETECTOR_LAYOUT.locate()), *engine)
    layers = [network.getLayer(name) for name in network.getLayerNames()]
    convolutions = [layer for layer in layers if layer.type == "Convolution"]
    network.setInput(np.zeros(DETECTOR_INPUT, np.float32))
    outputs = network.forward([layer.name for layer in convolutions])
    flops = sum(
        2 * output.size * math.prod(layer.blobs[0].shape[1:]) for layer, output in zip(convolutions, outputs, strict=True)
    )
    return sum(int(blob.size) for layer in layers for blob in layer.blobs), flops
