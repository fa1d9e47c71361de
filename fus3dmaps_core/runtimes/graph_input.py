"""The input of an ONNX file, read without its weights."""

from __future__ import annotations

from pathlib import Path

from fus3dmaps_core.errors import EncoderError, first_line
from fus3dmaps_core.runtimes.packages import import_onnx


def input_shape(path: Path) -> tuple[int, int, int, int]:
    """Read the shape of the one input of an ONNX file, (n, channels, H, W).

    Raises:
        EncoderError: The package ``onnx`` is missing, the file cannot be read, or it has another kind of input.
    """
    onnx = import_onnx()
    try:
        graph = onnx.load(path, load_external_data=False).graph
    except Exception as error:  # Of its own and of the package protobuf, which have nothing in common.
        reason = first_line(error)
        raise EncoderError(f"graph '{path}': it cannot be read: {reason}") from None
    weights = {weight.name for weight in graph.initializer}
    inputs = [value for value in graph.input if value.name not in weights]
    dims = [dim.dim_value for dim in inputs[0].type.tensor_type.shape.dim] if len(inputs) == 1 else []
    if len(dims) != 4 or min(dims) < 1 or inputs[0].type.tensor_type.elem_type != onnx.TensorProto.FLOAT:
        raise EncoderError(f"graph '{path}': it must have one float32 input of a fixed shape (n, 3, H, W)")
    count, channels, height, width = (int(side) for side in dims)
    return count, channels, height, width
