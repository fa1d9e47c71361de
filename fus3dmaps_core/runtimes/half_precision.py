"""Products of matrices in half precision, in a graph whose other steps stay in float32.

Products and convolutions are nearly all of a transformer's work and read all of its weights; their factors, the weights with
them, are rounded to half precision and so is what they give. Everything between is float32, as autocast has it in torch:
layer norms, softmax, the lengths that embeddings are divided by, and the sums over the blocks, which in RADIO reach values
that float16 does not have. A runtime that obeys the types in the file, as TensorRT does where the network is strongly typed,
has no choice about it.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np

from fus3dmaps_core.config.schema import Precision

_PRODUCTS = {
    "fp16": ("MatMul", "Gemm", "Conv", "ConvTranspose"),
    "bf16": ("MatMul", "Gemm"),  # ONNX's convolution takes no bfloat16 before opset 22.
}


def round_products(ir: ModuleType, model: Any, precision: Precision) -> None:
    """Have the products of a float32 graph taken in half precision; its inputs and outputs stay float32.

    Args:
        ir: The package ``onnx_ir``.
        model: ``onnx_ir.Model`` whose values have types; it is changed.
        precision: ``fp16`` or ``bf16``.
    """
    _take_in(ir, model.graph, _PRODUCTS[precision], ir.DataType.FLOAT, _half(ir, precision), lossless=True)


def emulate_products(ir: ModuleType, model: Any, precision: Precision) -> None:
    """Have the half-precision products of a graph taken in float32, of the same rounded factors, and rounded again.

    So they are summed on GPUs. On a CPU, ONNX Runtime has no bfloat16 products, and of float16 ones it leaves the rounding
    out, so that what overflows elsewhere would not do so there.

    Args:
        ir: The package ``onnx_ir``.
        model: ``onnx_ir.Model`` that :func:`round_products` made; it is changed.
        precision: As it was rounded to.
    """
    _take_in(ir, model.graph, _PRODUCTS[precision], _half(ir, precision), ir.DataType.FLOAT, lossless=False)


def _half(ir: ModuleType, precision: Precision) -> Any:
    return ir.DataType.FLOAT16 if precision == "fp16" else ir.DataType.BFLOAT16


def _take_in(ir: ModuleType, graph: Any, products: tuple[str, ...], source: Any, target: Any, *, lossless: bool) -> None:
    """Cast what enters the products from one type to the other, and what leaves them back.

    Where the cast back is lossless, a product takes what another gives as it is.
    """
    casts: dict[Any, Any] = {}
    for node in list(graph):
        if node.op_type not in products or all(value is None or value.dtype != source for value in node.inputs):
            continue
        for place, value in enumerate(node.inputs):
            if value is not None and value.dtype == source:
                if value not in casts:
                    casts[value] = _cast_before(ir, graph, node, value, target)
                node.replace_input_with(place, casts[value])
        (output,) = node.outputs
        back = _cast_after(ir, graph, node, output, source, target)
        if lossless:
            casts[back] = output
    for name, value in list(graph.initializers.items()):
        if not value.uses() and not value.is_graph_output():
            del graph.initializers[name]


def _cast_before(ir: ModuleType, graph: Any, node: Any, value: Any, target: Any) -> Any:
    """Cast a value to another type for a node; weights are rounded at once."""
    name = f"{value.name}_as_{target.name.lower()}"
    if value.is_initializer():
        with np.errstate(over="ignore"):  # What is too large becomes infinite, and is found when the graph is run.
            rounded = ir.tensor(value.const_value.numpy().astype(target.numpy()), dtype=target, name=name)
        weight = ir.Value(name=name, shape=value.shape, type=ir.TensorType(target), const_value=rounded)
        graph.register_initializer(weight)
        return weight
    cast = ir.node("Cast", [value], {"to": int(target)})
    _describe(ir, cast.outputs[0], name, value.shape, target)
    graph.insert_before(node, cast)
    return cast.outputs[0]


def _cast_after(ir: ModuleType, graph: Any, node: Any, output: Any, source: Any, target: Any) -> Any:
    """Give a node's output the other type, and hand it on in the one it had, which is returned."""
    cast = ir.node("Cast", [output], {"to": int(source)})
    name = output.name
    users = [use for use in output.uses() if use.node is not cast]
    _describe(ir, cast.outputs[0], name, output.shape, source)
    _describe(ir, output, f"{name}_in_{target.name.lower()}", output.shape, target)
    graph.insert_after(node, cast)
    for use in users:
        use.node.replace_input_with(use.idx, cast.outputs[0])
    for place, value in enumerate(graph.outputs):
        if value is output:
            graph.outputs[place] = cast.outputs[0]
    return cast.outputs[0]


def _describe(ir: ModuleType, value: Any, name: str, shape: Any, dtype: Any) -> None:
    value.name, value.shape, value.type = name, shape, ir.TensorType(dtype)
