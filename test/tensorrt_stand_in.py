"""A stand-in for the package ``tensorrt``, for machines without a GPU: the calls and return values of version 10 and 11.

Plans are text around the ONNX file; engines read and write memory at the addresses that they are given, which on the CPU are
those of torch's tensors there. What it is asked for is written down.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from types import SimpleNamespace

import numpy as np


class Severity(Enum):
    INTERNAL_ERROR, ERROR, WARNING, INFO, VERBOSE = range(5)


class ILogger:
    Severity = Severity

    def log(self, severity: Severity, message: str) -> None:
        raise NotImplementedError


def array_at(address: int, shape: tuple[int, ...]) -> np.ndarray:
    """Return the float32 memory at an address."""
    count = int(np.prod(shape))
    return np.ctypeslib.as_array(ctypes.cast(address, ctypes.POINTER(ctypes.c_float)), (count,)).reshape(shape)


class TensorRT:
    """The module.

    Attributes:
        shape: Of the input of every engine.
        outputs: Shapes of its outputs by name.
        compute: From the input's array to those of the outputs.
        parses, builds, has_memory, runs: Whether the step succeeds.
        log: What was asked for, in order.
    """

    def __init__(self, version: str = "10.3.0") -> None:
        self.__version__ = version
        self.shape: tuple[int, ...] = (2, 3, 4, 4)
        self.outputs: dict[str, tuple[int, ...]] = {"embeddings": (2, 5)}
        self.compute: Callable[[np.ndarray], list[np.ndarray]] = lambda images: [images.reshape(2, -1)[:, :5]]
        self.parses = self.builds = self.has_memory = self.runs = True
        self.log: list[tuple] = []
        self.ILogger = ILogger
        self.NetworkDefinitionCreationFlag = SimpleNamespace(STRONGLY_TYPED=1)
        self.MemoryPoolType = SimpleNamespace(WORKSPACE="workspace")
        self.BuilderFlag = SimpleNamespace(TF32="tf32")
        self.TensorIOMode = SimpleNamespace(INPUT="input", OUTPUT="output")
        self.DataType = SimpleNamespace(FLOAT="float", HALF="half")
        self.dtype = self.DataType.FLOAT

    def Builder(self, logger: ILogger) -> SimpleNamespace:  # noqa: N802
        return SimpleNamespace(
            create_network=lambda flags: SimpleNamespace(flags=flags, file=None),
            create_builder_config=lambda: _Config(self),
            build_serialized_network=lambda network, config: self._build(logger, network),
        )

    def _build(self, logger: ILogger, network: SimpleNamespace) -> memoryview | None:
        self.log.append(("build", network.flags, network.file))
        if not self.builds:
            logger.log(Severity.ERROR, "out of scratch memory")
            return None
        return memoryview(f"{self.__version__}|".encode() + network.file.read_bytes() + b"|end")

    def OnnxParser(self, network: SimpleNamespace, logger: ILogger) -> SimpleNamespace:  # noqa: N802
        def parse_from_file(path: str) -> bool:
            network.file = Path(path)
            return self.parses

        problem = SimpleNamespace(desc=lambda: "In node 3: no such operator")
        return SimpleNamespace(parse_from_file=parse_from_file, num_errors=int(not self.parses), get_error=lambda _: problem)

    def Runtime(self, logger: ILogger) -> SimpleNamespace:  # noqa: N802
        def deserialize_cuda_engine(plan: bytes) -> _Engine | None:
            good = plan.startswith(f"{self.__version__}|".encode()) and plan.endswith(b"|end")
            return _Engine(self) if good else None

        return SimpleNamespace(deserialize_cuda_engine=deserialize_cuda_engine)


class _Config:
    def __init__(self, module: TensorRT) -> None:
        self._module, self._cache = module, b""

    def set_memory_pool_limit(self, pool: str, size: int) -> None:
        self._module.log.append(("limit", pool, size))

    def clear_flag(self, flag: str) -> None:
        self._module.log.append(("clear", flag))

    def create_timing_cache(self, content: bytes) -> bytes:
        return content

    def set_timing_cache(self, cache: bytes, ignore_mismatch: bool) -> bool:
        good = cache in (b"", b"timings")
        self._module.log.append(("timings", cache, good, ignore_mismatch))
        return good

    def get_timing_cache(self) -> SimpleNamespace:
        return SimpleNamespace(serialize=lambda: b"timings")


class _Engine:
    def __init__(self, module: TensorRT) -> None:
        self._module, self._shapes = module, {"images": module.shape, **module.outputs}
        self.num_io_tensors = len(self._shapes)

    def get_tensor_name(self, index: int) -> str:
        return list(self._shapes)[index]

    def get_tensor_mode(self, name: str) -> str:
        return "input" if name == "images" else "output"

    def get_tensor_dtype(self, name: str) -> str:
        return self._module.dtype

    def get_tensor_shape(self, name: str) -> tuple[int, ...]:
        return self._shapes[name]

    def create_execution_context(self) -> _Context | None:
        return _Context(self._module, self._shapes) if self._module.has_memory else None


class _Context:
    def __init__(self, module: TensorRT, shapes: dict[str, tuple[int, ...]]) -> None:
        self._module, self._shapes, self._addresses = module, shapes, {}

    def set_tensor_address(self, name: str, address: int) -> bool:
        self._addresses[name] = address
        return name in self._shapes

    def execute_async_v3(self, stream: int) -> bool:
        self._module.log.append(("run", stream, dict(self._addresses)))
        if not self._module.runs or set(self._addresses) != set(self._shapes):
            return False
        given = array_at(self._addresses["images"], self._shapes["images"])
        for (name, shape), values in zip(self._module.outputs.items(), self._module.compute(given), strict=True):
            array_at(self._addresses[name], shape)[:] = values
        return True


class Stream:
    """A CUDA stream of torch, which a CPU does not have.

    Attributes:
        log: What was queued in it, in order.
    """

    def __init__(self, handle: int) -> None:
        self.cuda_stream = handle
        self.log: list[tuple] = []

    def wait_event(self, event: tuple) -> None:
        self.log.append(("wait", event))

    def record_event(self) -> tuple:
        self.log.append(("record", (self.cuda_stream, len(self.log))))
        return self.log[-1][1]
