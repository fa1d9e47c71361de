"""The inputs and outputs that FastSAM's exported network must have, checked in its file before it is run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fus3dmaps_core.encoders.optional_packages import import_optional
from fus3dmaps_core.segmenters.fastsam.decoding import PROTOTYPES, STRIDE
from fus3dmaps_core.segmenters.fastsam.published import refusal

_STRIDES = (8, 16, 32)  # Of the three grids whose cells are the anchors.
_VALUES = 4 + 1 + PROTOTYPES  # Box, score and weights of an anchor.


def input_shape(path: Path) -> tuple[int, int]:
    """Check an exported network and return height and width of the images that it takes, pixels.

    Args:
        path: ONNX file.

    Raises:
        EncoderError: It cannot be read, or is another network's: it must take one float32 image of fixed size whose sides
            are multiples of 32 and give ``(1, 37, N)`` detections and ``(1, 32, h / 4, w / 4)`` prototypes.
    """
    onnx = import_optional("onnx", "fastsam", "segmenter")
    try:
        graph = onnx.load(path, load_external_data=False).graph
    except Exception as error:  # The reader raises whatever its format comes across.
        raise refusal(f"'{path}' is no ONNX file, or cut short ({type(error).__name__})") from None
    stored = {tensor.name for tensor in graph.initializer}
    inputs = [_described(onnx, value) for value in graph.input if value.name not in stored]
    outputs = [_described(onnx, value) for value in graph.output]
    shape = inputs[0][1] if inputs else ()
    height, width = (int(side) if isinstance(side, int) else 0 for side in shape[2:]) if len(shape) == 4 else (0, 0)
    fits = height > 0 and width > 0 and not height % _STRIDES[-1] and not width % _STRIDES[-1]
    anchors = sum((height // stride) * (width // stride) for stride in _STRIDES)
    expected = [
        ("FLOAT", (1, _VALUES, anchors)),
        ("FLOAT", (1, PROTOTYPES, height // STRIDE, width // STRIDE)),
    ]
    if not fits or inputs != [("FLOAT", (1, 3, height, width))] or outputs != expected:
        raise refusal(
            f"'{path}' is another network, or exported with other options: it takes {_listed(inputs)} and gives "
            f"{_listed(outputs)}, not FLOAT (1, 3, h, w) and FLOAT (1, {_VALUES}, N), (1, {PROTOTYPES}, h/4, w/4)"
        )
    return height, width


def _described(onnx: Any, value: Any) -> tuple[str, tuple[int | str, ...]]:
    """Return type and shape of an input or output; sides that are not fixed have their name, or "?"."""
    tensor = value.type.tensor_type
    sides = (side.dim_value if side.HasField("dim_value") else side.dim_param or "?" for side in tensor.shape.dim)
    return str(onnx.TensorProto.DataType.Name(tensor.elem_type)), tuple(sides)


def _listed(values: list[tuple[str, tuple[int | str, ...]]]) -> str:
    return ", ".join(f"{kind} ({', '.join(map(str, shape))})" for kind, shape in values) or "nothing"
