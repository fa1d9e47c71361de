"""A TensorRT engine as a network over torch's CUDA tensors, whose memory it reads and writes in place."""

from __future__ import annotations

import threading
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

from fus3dmaps_core.config.schema import Precision
from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.runtimes.engine_cache import Gpu, cached_engine
from fus3dmaps_core.runtimes.graph_input import input_shape
from fus3dmaps_core.runtimes.packages import import_tensorrt
from fus3dmaps_core.runtimes.static_batches import run_in_batches


class TensorRTNetwork:
    """Images in, one or several tensors out, as the engine says. Safe to use from several threads; one runs at a time.

    Nothing passes through the host: inputs and outputs are torch's own memory, and the work is queued in torch's current
    stream, after what is queued there for the images and before what will be for the outputs.

    Attributes:
        shape: (n, channels, H, W) of its input.
        outputs: Names of its outputs, in order.
    """

    def __init__(self, tensorrt: ModuleType, engine: Any, device: str, name: str) -> None:
        """Keep an engine.

        Args:
            tensorrt: The package.
            engine: An ``ICudaEngine`` with one input and static shapes, all tensors float32.
            device: CUDA device that it was built on.
            name: Name of the graph, for messages.

        Raises:
            EncoderError: It is another kind of engine, or there is no memory for it.
        """
        self._engine, self._device, self._name = engine, torch.device(device), name
        self._lock = threading.Lock()
        self._done: torch.cuda.Event | None = None
        names = [engine.get_tensor_name(index) for index in range(engine.num_io_tensors)]
        inputs = [value for value in names if engine.get_tensor_mode(value) == tensorrt.TensorIOMode.INPUT]
        strange = [value for value in names if engine.get_tensor_dtype(value) != tensorrt.DataType.FLOAT]
        if len(inputs) != 1 or strange:
            raise EncoderError(
                f"engine '{name}': it must have one input and float32 tensors alone, it has {', '.join(names)}"
            )
        self._input, self.outputs = inputs[0], tuple(value for value in names if value != inputs[0])
        self.shape = tuple(int(side) for side in engine.get_tensor_shape(self._input))
        self._output_shapes = [tuple(int(side) for side in engine.get_tensor_shape(value)) for value in self.outputs]
        if any(side < 1 for shape in (self.shape, *self._output_shapes) for side in shape):
            raise EncoderError(f"engine '{name}': its shapes must be fixed; export the graph with a fixed input shape")
        self._context = engine.create_execution_context()
        if self._context is None:
            raise EncoderError(f"engine '{name}': TensorRT finds no memory on '{device}' to run it")

    def __call__(self, images: torch.Tensor) -> torch.Tensor | tuple[torch.Tensor, ...]:
        """Run any number of images.

        Args:
            images: (m, channels, H, W) on the device; fewer than a batch are padded, more are cut into several.

        Returns:
            The outputs with m rows, float32 on the device; a tuple where there are several.

        Raises:
            EncoderError: The images are of another size or on another device, or TensorRT fails.
        """
        if images.device.type != self._device.type:  # Its address would mean nothing there.
            raise EncoderError(f"engine '{self._name}' runs on '{self._device}', got images on '{images.device}'")
        with self._lock:
            return run_in_batches(self._run, images, self.shape, f"engine '{self._name}'")

    def _run(self, images: torch.Tensor) -> list[torch.Tensor]:
        found = [torch.empty(shape, dtype=torch.float32, device=self._device) for shape in self._output_shapes]
        context, stream = self._context, torch.cuda.current_stream(self._device)
        if self._done is not None:  # A run in another stream may still use the engine's scratch memory.
            stream.wait_event(self._done)
        bound = [context.set_tensor_address(self._input, images.data_ptr())]
        bound += [context.set_tensor_address(name, out.data_ptr()) for name, out in zip(self.outputs, found, strict=True)]
        if not all(bound) or not context.execute_async_v3(stream.cuda_stream):
            raise EncoderError(f"engine '{self._name}': TensorRT cannot run it on '{self._device}'")
        self._done = stream.record_event()
        return found


def engine_of(path: Path, device: str, precision: Precision, directory: Path) -> tuple[TensorRTNetwork, Path]:
    """Open the engine of an ONNX file as a network; build it first where there is none, which takes minutes.

    Args:
        path: ONNX file with one float32 input of static shape and float32 outputs.
        device: CUDA device.
        precision: Precision of the graph.
        directory: Where engines are kept; made if it is missing.

    Returns:
        The network, and the file of its engine.

    Raises:
        EncoderError: The device is no CUDA device, TensorRT is missing, or the engine cannot be built or kept.
    """
    check_cuda(device)
    tensorrt, shape = import_tensorrt(), input_shape(path)
    with torch.cuda.device(torch.device(device)):
        engine, kept = cached_engine(tensorrt, path, shape, precision, Gpu.of(device), directory)
        return TensorRTNetwork(tensorrt, engine, device, path.name), kept


def check_cuda(device: str) -> None:
    """Check that TensorRT runs on a device.

    Raises:
        EncoderError: It is no CUDA device.
    """
    if torch.device(device).type != "cuda":
        raise EncoderError(
            f"parameter 'encoder.runtime': tensorrt runs on CUDA devices alone, 'encoder.device' is '{device}'; set it to "
            "cuda, or the runtime to onnxruntime"
        )
