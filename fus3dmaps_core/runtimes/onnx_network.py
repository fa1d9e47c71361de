"""An ONNX file of static shape, run by ONNX Runtime on the CPU or a CUDA device."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch

from fus3dmaps_core.errors import EncoderError, first_line
from fus3dmaps_core.runtimes.packages import import_onnxruntime
from fus3dmaps_core.runtimes.static_batches import run_in_batches

_FLOAT32 = "tensor(float)"
_CUDA = "CUDAExecutionProvider"


class OnnxNetwork:
    """Images in, one or several tensors out, as the file says. Safe to use from several threads.

    The same images give the same numbers each time. On CUDA the tensors are read and written where torch has them, without
    the host between.

    Attributes:
        path: The file.
        shape: (n, channels, H, W) of its input.
        outputs: Names of its outputs, in order.
    """

    def __init__(self, path: Path, device: str) -> None:
        """Load the file.

        Args:
            path: ONNX file with one float32 input of static shape and float32 outputs.
            device: Torch device that images and outputs lie on, ``cpu`` or a CUDA device.

        Raises:
            EncoderError: ONNX Runtime is missing or not built for the device, or the file cannot be read or is another kind
                of graph.
        """
        runtime = import_onnxruntime()
        self.path, self._device = path, torch.device(device)
        if not path.is_file():
            raise EncoderError(f"graph '{path}': there is no such file")
        self._session = _open(runtime, path, self._device)
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        self.shape = _static_shape(path, inputs)
        wrong = [value.name for value in outputs if value.type != _FLOAT32]
        if wrong:
            raise EncoderError(f"graph '{path}': output '{wrong[0]}' is no float32 tensor; export it with float32 outputs")
        self._input, self.outputs = inputs[0].name, tuple(value.name for value in outputs)
        self._output_shapes = _output_shapes(path, outputs) if self._device.type == "cuda" else []

    def __call__(self, images: torch.Tensor) -> torch.Tensor | tuple[torch.Tensor, ...]:
        """Run any number of images.

        Args:
            images: (m, channels, H, W) on the device; fewer than a batch are padded, more are cut into several.

        Returns:
            The outputs with m rows, float32 on the device; a tuple where there are several.

        Raises:
            EncoderError: The images are of another size.
        """
        run = self._run_cuda if self._device.type == "cuda" else self._run_cpu
        return run_in_batches(run, images, self.shape, f"graph '{self.path.name}'")

    def _run_cpu(self, images: torch.Tensor) -> list[torch.Tensor]:
        found = self._session.run(None, {self._input: images.detach().numpy()})
        return [torch.from_numpy(values) for values in found]

    def _run_cuda(self, images: torch.Tensor) -> list[torch.Tensor]:
        binding, index = self._session.io_binding(), self._device.index or 0
        found = [torch.empty(shape, dtype=torch.float32, device=self._device) for shape in self._output_shapes]
        # The runtime works in a stream of its own: what torch has queued for the images must be done before it starts.
        torch.cuda.current_stream(self._device).synchronize()
        binding.bind_input(self._input, "cuda", index, np.float32, list(images.shape), images.data_ptr())
        for name, values in zip(self.outputs, found, strict=True):
            binding.bind_output(name, "cuda", index, np.float32, list(values.shape), values.data_ptr())
        self._session.run_with_iobinding(binding)
        binding.synchronize_outputs()
        return found


def _open(runtime: ModuleType, path: Path, device: torch.device) -> Any:
    options = runtime.SessionOptions()
    options.use_deterministic_compute = True
    options.log_severity_level = 3  # Errors; the rest is about nodes that it moves.
    options.intra_op_num_threads = torch.get_num_threads()
    providers: list[Any] = ["CPUExecutionProvider"]
    if device.type == "cuda":
        if _CUDA not in runtime.get_available_providers():
            raise EncoderError(
                "parameter 'encoder.runtime': this onnxruntime has no CUDA; install onnxruntime-gpu in its place, or set "
                "'encoder.device' to cpu"
            )
        providers.insert(0, (_CUDA, {"device_id": device.index or 0}))
    elif device.type != "cpu":
        raise EncoderError(f"parameter 'encoder.device': onnxruntime runs on cpu and CUDA devices, not on '{device}'")
    try:
        session = runtime.InferenceSession(path, options, providers=providers)
    except Exception as error:  # Its exceptions have no common base but this.
        raise EncoderError(f"graph '{path}': onnxruntime cannot load it: {first_line(error)}") from None
    if device.type == "cuda" and _CUDA not in session.get_providers():  # It falls back without a word.
        raise EncoderError(
            "parameter 'encoder.runtime': onnxruntime cannot use its CUDA libraries; install those of its CUDA version"
        )
    return session


def _static_shape(path: Path, inputs: Sequence[Any]) -> tuple[int, int, int, int]:
    if len(inputs) != 1 or inputs[0].type != _FLOAT32:
        found = ", ".join(f"{value.name} {value.type}" for value in inputs) or "none"
        raise EncoderError(f"graph '{path}': it must have one float32 input, it has {found}")
    shape = inputs[0].shape
    if len(shape) != 4 or not all(isinstance(side, int) and side > 0 for side in shape):
        raise EncoderError(f"graph '{path}': its input must have a fixed shape (n, 3, H, W), it has {shape}")
    count, channels, height, width = (int(side) for side in shape)
    return count, channels, height, width


def _output_shapes(path: Path, outputs: Sequence[Any]) -> list[tuple[int, ...]]:
    for value in outputs:
        if not all(isinstance(side, int) for side in value.shape):
            raise EncoderError(f"graph '{path}': output '{value.name}' must have a fixed shape on CUDA")
    return [tuple(value.shape) for value in outputs]
